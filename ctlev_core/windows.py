"""Cut a recording into windows: by number of events, by duration, or not at all."""

from __future__ import annotations

import numpy as np

from data_contracts.config import Windows
from data_contracts.events import Events


def cut(events: Events, windows: Windows) -> np.ndarray:
    """Index ranges of the windows of a recording.

    Windows do not overlap and start at the first event. An incomplete last window is dropped: with `count` the events
    left over, with `duration` a window that ends after the last event. A recording too short for one window has none.

    Args:
        events: N events.
        windows: how to cut.
    Returns:
        [W, 2] int64, start and stop of each window in events, in order; W may be 0.
    """
    if windows.method == "count":
        starts = np.arange(len(events) // windows.num_events, dtype=np.int64) * windows.num_events
        ranges = np.stack([starts, starts + windows.num_events], axis=1)
    elif windows.method == "duration":
        ranges = _cut_by_duration(events.t, windows.duration_us)
    else:
        ranges = np.array([[0, len(events)]], np.int64)
    if windows.method != "count":
        ranges = ranges[ranges[:, 1] - ranges[:, 0] >= windows.min_events]
    if windows.max_windows is None or len(ranges) <= windows.max_windows:
        return ranges
    # The middle of each of max_windows equal stretches, in integers so that it is the same on every machine.
    middles = (2 * np.arange(windows.max_windows, dtype=np.int64) + 1) * len(ranges) // (2 * windows.max_windows)
    return ranges[middles]


def _cut_by_duration(t: np.ndarray, duration_us: int) -> np.ndarray:
    """Ranges of the windows that have events: listing only those, a jump of the clock by years costs nothing."""
    if len(t) == 0:
        return np.zeros((0, 2), np.int64)
    window = (t - t[0]) // duration_us
    bounds = np.concatenate([[0], np.flatnonzero(window[1:] != window[:-1]) + 1, [len(t)]]).astype(np.int64)
    ranges = np.stack([bounds[:-1], bounds[1:]], axis=1)
    is_complete = (int(window[-1]) + 1) * duration_us <= int(t[-1] - t[0]) + 1
    return ranges if is_complete else ranges[:-1]
