"""One recording to event histograms, images and labels, some windows at a time."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ctlev_core.events.windows import cut_at_labels, cut_chunks, spread
from ctlev_core.labels.interpolation import interpolate_labels, is_between_labels
from ctlev_core.labels.labelling import has_label, labels_at_windows, labels_in_image
from ctlev_core.plugins import Plugin
from ctlev_core.recordings.stored_events import StoredEvents
from data_contracts.arrays import load_array, times_file
from data_contracts.config import Windows
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize
from data_contracts.labels import Labels

COUNTS = "event_histogram"
"""The encoding that finished event images, which show how many events there were, can stand for."""
MAX_EVENTS = 1 << 22
"""Events held at a time; with what reading them takes, 0.2 GiB."""
MAX_GAP = 1 << 18
"""Events between two windows that are read rather than skipped."""
MAX_WINDOWS = 64
"""Frames made at a time: the pages of large new arrays cost more than the counting in them."""
BLOCK_BYTES = 1 << 26
"""What is encoded at a time: 64 windows of 512 x 512 px in two channels, 18 of 1280 x 720 px."""

logger = logging.getLogger(__name__)


class RecordingPart(NamedTuple):
    """A stretch of a recording that belongs to one split; `start` and `stop` count events."""

    split: str
    start: int
    stop: int


class RecordingSource(NamedTuple):
    """An ingested recording.

    Attributes:
        recording_id: its name.
        subject: who is on it.
        class_name: of what is on it; may be empty.
        sensor_size: (width, height) px.
        events: where its events are; None where event images come finished.
        event_images: the file of these, else None.
        parts: by split.
        track: its labels, ascending in time.
        windows: [W, 2] int64 index ranges into its events, where the dataset's own windows are wanted.
        window_labels: one row for each of them, where the dataset has a rule for that too.
    """

    recording_id: str
    subject: str
    class_name: str
    sensor_size: SensorSize
    events: StoredEvents | None
    event_images: Path | None
    parts: tuple[RecordingPart, ...]
    track: Labels
    windows: np.ndarray | None
    window_labels: Labels | None


class EncodedWindows(NamedTuple):
    """Some windows of a recording.

    Attributes:
        split: that they belong to.
        numbers: [N] int64, of the windows within their part.
        t_start_us: [N] int64 first time stamp.
        t_end_us: [N] int64 last time stamp.
        num_events: [N] int64; 0 of finished event images.
        histograms: [N, C, h, w] as the encoding gives them.
        frames: [N, H, W, 3] uint8.
        labels: N rows, in image pixels.
    """

    split: str
    numbers: np.ndarray
    t_start_us: np.ndarray
    t_end_us: np.ndarray
    num_events: np.ndarray
    histograms: np.ndarray
    frames: np.ndarray
    labels: Labels


def encode_recording(source: RecordingSource, encoding: Plugin, windows: Windows) -> Iterator[EncodedWindows]:
    """Cut a recording into windows and encode each.

    Neither events nor histograms of a recording need fit into memory. Of event images that come finished every one is
    a window, and its grey values stand for counts.

    Args:
        source: the recording.
        encoding: the plug-in.
        windows: how to cut, and which label a window gets.
    Raises:
        DataError: finished event images and options that do not fit them.
    """
    if source.events is not None:
        return _encode_events(source, source.events, encoding, windows)
    assert source.event_images is not None
    return _encode_images(source, source.event_images, encoding, windows)


def _encode_events(
    source: RecordingSource, stored: StoredEvents, plugin: Plugin, windows: Windows
) -> Iterator[EncodedWindows]:
    """The windows of each part, some at a time: neither events nor histograms of a recording need fit into memory."""
    at_once = _windows_at_once(plugin, source.sensor_size)
    for part in source.parts:
        start, stop = part.start, part.stop
        held = stored.read(start, stop) if stop - start <= MAX_EVENTS else None
        stamps = _time_stamps(stored, start, stop, held)
        if windows.anchor == "labels":
            ranges, own_labels = cut_at_labels(stamps, source.track.t_us, windows)
            ranges, labels = start + ranges, source.track.take(own_labels)
        elif source.windows is None:
            ranges, labels = start + cut_chunks(stamps, windows), None
        else:
            inside = (source.windows[:, 0] >= start) & (source.windows[:, 1] <= stop)
            chosen = np.flatnonzero(inside & (np.diff(source.windows)[:, 0] >= windows.min_events))
            chosen = chosen[spread(len(chosen), windows.max_windows)]
            ranges = source.windows[chosen]
            labels = None if source.window_labels is None else source.window_labels.take(chosen)
        for rows in _groups(ranges, at_once):
            first, last = int(ranges[rows[0], 0]), int(ranges[rows[-1], 1])
            if held is None:
                events = stored.read(first, last)
            else:
                events = held.slice(first - start, last - start)
            local = ranges[rows] - first
            t_start, t_end = events.t[local[:, 0]], events.t[local[:, 1] - 1]
            if labels is None:
                known = _is_labelled(source.track, t_start, t_end, windows)
                rows, local, t_start, t_end = (array[known] for array in (rows, local, t_start, t_end))
                if not len(rows):
                    continue
            counts = plugin.module.encode(events, local, plugin.options)
            _tell_full(counts, source.recording_id, rows)
            frames = plugin.module.render_image(counts, plugin.options)
            own = _label(source.track, t_start, t_end, windows) if labels is None else labels.take(rows)
            own = _to_image(own, events.sensor_size, plugin, (frames.shape[2], frames.shape[1]))
            num_events = local[:, 1] - local[:, 0]
            yield EncodedWindows(part.split, rows, t_start, t_end, num_events, counts, frames, own)


def _encode_images(source: RecordingSource, file: Path, plugin: Plugin, windows: Windows) -> Iterator[EncodedWindows]:
    """Finished event images: every one is a window; the grey values stand for counts.

    They are what counts of a recording become by the encoding's normalisation, and go on as those do.
    """
    name = source.recording_id
    if plugin.name != COUNTS:
        raise DataError(f"{name} comes as grey event images, which only the encoding {COUNTS!r} takes")
    if plugin.options.polarity:
        raise DataError(
            f"{name} comes as grey event images, which have no polarity; set encoding.options.polarity=false"
        )
    if len(source.parts) != 1:
        raise DataError(f"{name}: finished event images cannot be split in time")
    images, times_us = load_array(file), np.atleast_2d(load_array(Path(times_file(str(file)))))
    starts_us, t_us = times_us[0], times_us[-1]
    known = np.flatnonzero(_is_labelled(source.track, t_us, t_us, windows))
    chosen = known[spread(len(known), windows.max_windows)]
    at_once = _windows_at_once(plugin, source.sensor_size)
    for first in range(0, len(chosen), at_once):
        rows = chosen[first : first + at_once]
        grey = np.asarray(images[rows])[:, None]
        frames = plugin.module.render_levels(grey, plugin.options)
        times = t_us[rows]
        image_size = (frames.shape[2], frames.shape[1])
        labels = _to_image(_label(source.track, times, times, windows), source.sensor_size, plugin, image_size)
        numbers = np.arange(first, first + len(rows))
        none, split = np.zeros(len(times), np.int64), source.parts[0].split
        yield EncodedWindows(split, numbers, starts_us[rows], times, none, grey.astype(np.uint16), frames, labels)


def _is_labelled(track: Labels, t_start: np.ndarray, t_end: np.ndarray, windows: Windows) -> np.ndarray:
    """Which windows [N] `_label` has something to say of."""
    return is_between_labels(track, t_end) if windows.labels == "interpolated" else has_label(track, t_start, t_end)


def _label(track: Labels, t_start: np.ndarray, t_end: np.ndarray, windows: Windows) -> Labels:
    """One row for each of N windows."""
    if windows.labels == "interpolated":
        return interpolate_labels(track, t_end)
    return labels_at_windows(track, t_start, t_end)


def _tell_full(counts: np.ndarray, name: str, rows: np.ndarray) -> None:
    """Warn where a count stopped at what 16 bits hold: a hot pixel, or a window that is too long."""
    full = np.iinfo(np.uint16).max
    if counts.dtype != np.uint16 or not counts.size or counts.max() < full:
        return
    window = int(np.argmax(counts.reshape(len(counts), -1).max(axis=1)))
    _, y, x = np.unravel_index(int(np.argmax(counts[window])), counts.shape[1:])
    logger.warning(
        "recording %r, window %d: pixel x = %d, y = %d fired %d times or more; counts stop there",
        name, rows[window], x, y, full,
    )  # fmt: skip


def _time_stamps(stored: StoredEvents, start: int, stop: int, held: Events | None) -> Iterator[np.ndarray]:
    if held is not None:
        yield held.t
        return
    for first in range(start, stop, MAX_EVENTS):
        yield stored.read(first, min(first + MAX_EVENTS, stop)).t


def _windows_at_once(plugin: Plugin, sensor_size: SensorSize) -> int:
    """How many windows are encoded together: few of a large sensor."""
    t, x, p = (np.zeros(0, dtype) for dtype in (np.int64, np.uint16, np.uint8))
    none = plugin.module.encode(Events(t, x, x, p, sensor_size), np.zeros((0, 2), np.int64), plugin.options)
    window_bytes = math.prod(none.shape[1:]) * none.itemsize
    return min(max(BLOCK_BYTES // max(window_bytes, 1), 1), MAX_WINDOWS)


def _groups(ranges: np.ndarray, at_once: int) -> Iterator[np.ndarray]:
    """Consecutive windows that are encoded together: few, close, and of few events unless a window alone has more."""
    first = 0
    skips = np.flatnonzero(ranges[1:, 0] - ranges[:-1, 1] > MAX_GAP) + 1
    while first < len(ranges):
        fitting = int(np.searchsorted(ranges[:, 1], ranges[first, 0] + MAX_EVENTS, side="right"))
        skip = int(np.append(skips, len(ranges))[np.searchsorted(skips, first, side="right")])
        last = min(max(fitting, first + 1), first + at_once, skip)
        yield np.arange(first, last)
        first = last


def _to_image(labels: Labels, sensor_size: SensorSize, plugin: Plugin, image_size: tuple[int, int]) -> Labels:
    return labels_in_image(
        labels, lambda points: plugin.module.map_points(points, sensor_size, plugin.options), image_size
    )
