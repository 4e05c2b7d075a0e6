"""Cut a recording into windows: by number of events, by duration, or not at all."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from data_contracts.config import Windows
from data_contracts.errors import DataError
from data_contracts.events import Events

_NONE = np.zeros((0, 2), np.int64)


def cut(events: Events, windows: Windows) -> np.ndarray:
    """Index ranges of the windows of a recording.

    Windows do not overlap and start at the first event. An incomplete last window is dropped: with `count` the events
    left over, with `duration` a window that ends after the last event. A recording too short for one window has none.

    Args:
        events: N events.
        windows: how to cut.
    Returns:
        [W, 2] int64, start and stop of each window in events, in order; W may be 0.
    Raises:
        DataError: the method is `dataset`, whose ranges come from the dataset and not from the events, or windows end
            at labels (`cut_at_labels`).
    """
    return cut_chunks([events.t], windows)


def cut_chunks(chunks: Iterable[np.ndarray], windows: Windows) -> np.ndarray:
    """What `cut` returns, for a recording whose time stamps come in chunks because they do not fit into memory.

    Only the ranges are kept, 16 bytes a window; how the stamps are divided into chunks changes nothing.

    Args:
        chunks: [N_i] int64, us, non-decreasing from chunk to chunk; chunks may be empty.
        windows: how to cut.
    Returns:
        [W, 2] int64, start and stop of each window in events of the whole recording.
    Raises:
        DataError: the method is `dataset`.
    """
    cutter = Cutter(windows)
    found = [cutter.add(t) for t in chunks]
    ranges = np.concatenate([*found, cutter.finish()])
    return ranges[spread(len(ranges), windows.max_windows)]


def cut_at_labels(
    chunks: Iterable[np.ndarray], labels_us: np.ndarray, windows: Windows
) -> tuple[np.ndarray, np.ndarray]:
    """One window that ends at each label, with its last event at that time or before.

    With `duration` it begins so long before, itself excluded; with `count` it has so many events. Windows that begin
    before the first event, and labels after the last one, are left out. Windows overlap where labels follow one another
    faster.

    Args:
        chunks: as `cut_chunks`.
        labels_us: [L] int64, ascending; of equal times the first counts.
        windows: how to cut, by `count` or `duration`.
    Returns:
        [W, 2] int64, start and stop of each window in events, and [W] int64, the label that it ends at.
    """
    times, rows = np.unique(np.asarray(labels_us, np.int64), return_index=True)
    starts, stops, count = np.zeros(len(times), np.int64), np.zeros(len(times), np.int64), 0
    first_us = last_us = 0
    for t in chunks:
        if len(t):
            first_us, last_us = int(t[0]) if count == 0 else first_us, int(t[-1])
            starts += np.searchsorted(t, times - windows.duration_us, side="right")
            stops += np.searchsorted(t, times, side="right")
            count += len(t)
    if windows.method == "count":
        starts = stops - windows.num_events
        kept = starts >= 0
    else:
        kept = (times - windows.duration_us + 1 >= first_us) & (stops - starts >= windows.min_events)
    chosen = np.flatnonzero(kept & (times <= last_us) & (count > 0))
    chosen = chosen[spread(len(chosen), windows.max_windows)]
    return np.stack([starts, stops], axis=1)[chosen], rows[chosen].astype(np.int64)


def window_around(t_us: np.ndarray, moment_us: int, duration_us: int, windows: Windows) -> tuple[int, int]:
    """The one window around a moment, as `cut` would make it if recordings started half a window before.

    Where labels are those of a window's end it ends at the moment, as those of `cut_at_labels` do.

    Args:
        t_us: [N] int64, times of events, non-decreasing.
        moment_us: the middle of the window, or its end.
        duration_us: its length where `windows` does not fix it (`whole`, `dataset`).
        windows: how to cut.
    Returns:
        Start and stop in events. With `count` as many events on either side, as far as there are so many; fewer in all
        only where the recording has fewer.
    """
    span_us = windows.duration_us if windows.method == "duration" else duration_us
    if windows.end_at_labels:
        start, stop = np.searchsorted(t_us, [moment_us - span_us, moment_us], side="right").tolist()
        return (max(stop - windows.num_events, 0), stop) if windows.method == "count" else (start, stop)
    if windows.method == "count":
        middle = int(np.searchsorted(t_us, moment_us))
        start = min(max(middle - windows.num_events // 2, 0), max(len(t_us) - windows.num_events, 0))
        return start, min(start + windows.num_events, len(t_us))
    start_us = moment_us - span_us // 2
    start, stop = np.searchsorted(t_us, [start_us, start_us + span_us])
    return int(start), int(stop)


class Cutter:
    """Windows of a recording that is read chunk by chunk: those that `add` completes, then those that `finish` does.

    `max_windows` is not heeded, because which windows it keeps is only known at the end: see `spread`.
    """

    def __init__(self, windows: Windows) -> None:
        if windows.method == "dataset":
            raise DataError(
                "windows.method 'dataset': the ranges come from the dataset; cut by count, duration or whole instead"
            )
        if windows.anchor == "labels":
            raise DataError("windows.anchor 'labels': windows end at labels, which events do not have; leave it out")
        self.windows = windows
        self.num_events = 0
        """Time stamps seen so far."""
        self._first_us = self._last_us = 0
        self._start = 0
        """First event of the window that is open."""
        self._open_window = 0
        """Its number, counted from the first event; duration only."""

    def add(self, t: np.ndarray) -> np.ndarray:
        """Take the next time stamps.

        Args:
            t: [N] int64, us, non-decreasing, none before those of earlier chunks.
        Returns:
            [W, 2] int64, the windows that are complete now and were not before.
        """
        if len(t) == 0:
            return _NONE
        if self.num_events == 0:
            self._first_us = int(t[0])
        before, self.num_events, self._last_us = self.num_events, self.num_events + len(t), int(t[-1])
        if self.windows.method == "count":
            return self._full_counts()
        if self.windows.method == "whole":
            return _NONE
        # Only windows that have events are listed: a jump of the clock by years costs nothing.
        number = (t - self._first_us) // self.windows.duration_us
        bounds = np.flatnonzero(number[1:] != number[:-1]) + before + 1
        if number[0] != self._open_window:
            bounds = np.concatenate([[before], bounds])
        if len(bounds) == 0:
            return _NONE
        starts = np.concatenate([[self._start], bounds[:-1]])
        self._start, self._open_window = int(bounds[-1]), int(number[-1])
        return self._with_enough_events(np.stack([starts, bounds], axis=1).astype(np.int64))

    def finish(self) -> np.ndarray:
        """The window that only the end of the recording completes, [0 or 1, 2] int64."""
        last = np.array([[self._start, self.num_events]], np.int64)
        if self.windows.method == "whole":
            return self._with_enough_events(last)
        if self.windows.method == "count" or self.num_events == 0:
            return _NONE
        is_complete = (self._open_window + 1) * self.windows.duration_us <= self._last_us - self._first_us + 1
        return self._with_enough_events(last) if is_complete else _NONE

    def _full_counts(self) -> np.ndarray:
        size = self.windows.num_events
        starts = np.arange(self._start, self.num_events - size + 1, size, dtype=np.int64)
        self._start += len(starts) * size
        return np.stack([starts, starts + size], axis=1)

    def _with_enough_events(self, ranges: np.ndarray) -> np.ndarray:
        return ranges[ranges[:, 1] - ranges[:, 0] >= self.windows.min_events]


def spread(count: int, wanted: int | None) -> np.ndarray:
    """Indices of at most `wanted` of `count`: the middle of each of as many equal stretches."""
    if wanted is None or count <= wanted:
        return np.arange(count)
    # In integers, so that it is the same on every machine.
    return (2 * np.arange(wanted, dtype=np.int64) + 1) * count // (2 * wanted)


def time_bins(t_us: np.ndarray, windows: np.ndarray, num_bins: int) -> np.ndarray:
    """Each window cut into bins of equal duration, from its first event to its last.

    Bin b of an event at t is floor(B (t - t_first) / (t_last - t_first + 1)), in integers; where all times of a window
    are equal every event is in the first.

    Args:
        t_us: [E] int64, us, non-decreasing.
        windows: [N, 2] int64, start and stop of each window in events.
        num_bins: B.
    Returns:
        [N, B, 2] int64, start and stop of each bin in events; bins may be empty.
    """
    ranges = np.empty((len(windows), num_bins, 2), np.int64)
    for row, (start, stop) in enumerate(windows.tolist()):
        edges = np.full(num_bins + 1, stop, np.int64)
        if stop > start:
            times = t_us[start:stop]
            span = int(times[-1] - times[0]) + 1
            # The first time that belongs to bin b: ceil(b span / B).
            firsts = times[0] + (np.arange(num_bins, dtype=np.int64) * span + num_bins - 1) // num_bins
            edges[:-1] = start + np.searchsorted(times, firsts)
        ranges[row, :, 0], ranges[row, :, 1] = edges[:-1], edges[1:]
    return ranges


def check_ranges(windows: np.ndarray, num_events: int) -> np.ndarray:
    """The windows as contiguous [N, 2] int64.

    Raises:
        ValueError: another shape, or a window is not a range within `num_events` events.
    """
    windows = np.ascontiguousarray(windows, np.int64)
    if windows.ndim != 2 or windows.shape[1] != 2:
        raise ValueError(f"windows must be [N, 2], got {windows.shape}")
    wrong = (windows[:, 0] < 0) | (windows[:, 1] < windows[:, 0]) | (windows[:, 1] > num_events)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise ValueError(f"window {row} must be a range within {num_events} events, got {windows[row].tolist()}")
    return windows


def check_order(t: np.ndarray) -> None:
    """Raise `DataError` where a time stamp is before the one ahead of it."""
    descending = t[1:] < t[:-1]
    if descending.any():
        first = int(np.argmax(descending)) + 1
        raise DataError(f"t decreases at event {first}: {t[first - 1]} us, then {t[first]} us")
