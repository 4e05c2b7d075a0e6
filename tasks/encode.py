"""Events to windows, windows to event histograms and images, label tracks to one label a window."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.events import files as event_files
from ctlev_core.events.windows import cut_at_labels, cut_chunks, spread
from ctlev_core.labels.interpolation import interpolate_labels, is_between_labels
from ctlev_core.labels.labelling import has_label, labels_at_windows, labels_in_image
from ctlev_core.progress import ProgressBar
from data_contracts import tables
from data_contracts.config import EncodingChoice, Windows
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest, by_recording, concat_labels, label_columns, labels_of
from tasks.stage import Output, stage
from tasks.workers import is_spread, map_shards

COUNTS = "event_histogram"
"""The encoding that finished event images, which show how many events there were, can stand for."""
MAX_EVENTS = 1 << 22
"""Events held at a time; with what reading them takes, 0.2 GiB."""
MAX_GAP = 1 << 18
"""Events between two windows that are read rather than skipped."""
MAX_WINDOWS = 64
"""Frames made at a time: the pages of large new arrays cost more than the counting in them."""
BLOCK_BYTES = 1 << 26
"""What `encode` returns at a time: 64 windows of 512 x 512 px in two channels, 18 of 1280 x 720 px."""
HELD_BYTES = 1 << 23
"""Images of a recording that wait in memory until their turn comes; four frames of 512 x 512 px fit."""
MAX_GROUP = 4
"""Recordings that travel together; up to two such groups a worker wait, so that 16 workers hold 1 GiB at most."""


class _Source(NamedTuple):
    """One recording and what was ingested with it; `windows` [W, 2] and their labels where the dataset's are wanted.

    `file` holds its events, or event images that come finished.
    """

    recording: dict[str, Any]
    file: Path
    parts: list[dict[str, Any]]
    track: Labels
    windows: np.ndarray | None
    window_labels: Labels | None


logger = logging.getLogger(__name__)


class _Samples(NamedTuple):
    """Some windows of a recording, encoded."""

    rows: list[dict[str, Any]]
    histograms: np.ndarray
    frames: np.ndarray
    labels: Labels


@stage(version=5, schema=tables.FRAMES)
def encode(out: Output, recordings: Manifest, *, encoding: EncodingChoice, windows: Windows) -> pa.Table:
    """Cut every recording into windows and encode each: arrays `histograms` (counts) and `frames` (8-bit RGB).

    Counts have the size of the sensor, or with resampling `events` that of the image. Where sensors differ, counts lie
    in the upper left corner of an array that is as large as the largest, with zeros beyond. Of event images that come
    finished every one is a window, and its grey values stand for counts.
    """
    sources = _sources(recordings, windows)
    canvas = _canvas(sources, encoding)
    rows: list[dict[str, Any]] = []
    labels: list[Labels] = []
    with out.open_array("histograms") as histograms, out.open_array("frames") as frames:
        encoded = _encode_spread if is_spread(len(sources)) else _encode_in_turn
        for name, samples in encoded(sources, encoding, windows, out.work):
            try:
                for counts in _on_canvas(samples.histograms, canvas):
                    histograms.append(counts)
                frames.append(samples.frames)
            except DataError as error:
                raise DataError(
                    f"encode: sensors differ in size, {name} does; set encoding.options.image_size ({error})"
                ) from error
            rows += samples.rows
            labels.append(samples.labels)
    for split in ("train", "test"):
        if not any(row["split"] == split for row in rows):
            raise DataError(f"encode: no window in split {split!r}; the recordings are too short for {windows!r}")
    stacked = concat_labels(labels)
    _check_classes(sources, rows, stacked.class_names, windows)
    table = pa.Table.from_pylist(rows).append_column("class_name", pa.array(stacked.class_names, pa.string()))
    for name, column in label_columns(stacked).items():
        table = table.append_column(name, column)
    return table


def _canvas(sources: list[_Source], encoding: EncodingChoice) -> tuple[int, int] | None:
    """(height, width) px that the counts of every sensor fit into; None where counts have the size of the image."""
    if getattr(plugins.load_options(encoding).options, "resampling", "") != "area":
        return None
    sizes = [_sensor_size(source.recording) for source in sources]
    return (max(height for _, height in sizes), max(width for width, _ in sizes)) if sizes else None


def _on_canvas(histograms: np.ndarray, canvas: tuple[int, int] | None) -> Iterator[np.ndarray]:
    """Counts [N, C, H, W] at the size of the canvas: as they are, else window by window, for canvases may be large."""
    height, width = histograms.shape[2:]
    if canvas is None or canvas == (height, width):
        yield histograms
        return
    beyond = (0, 0), (0, 0), (0, canvas[0] - height), (0, canvas[1] - width)
    for row in range(len(histograms)):
        yield np.pad(histograms[row : row + 1], beyond)


def _sensor_size(recording: dict[str, Any]) -> tuple[int, int]:
    return recording["sensor_width_px"], recording["sensor_height_px"]


def _check_classes(
    sources: list[_Source], rows: list[dict[str, Any]], class_names: Sequence[str], windows: Windows
) -> None:
    """Say where a class was recorded and none of it is left: what follows does not know that there is such a class."""
    left = {(row["split"], name) for row, name in zip(rows, class_names, strict=True)}
    recorded = {
        (part["split"], source.recording["class_name"])
        for source in sources
        for part in source.parts
        if source.recording["class_name"] and part["split"] in ("train", "test")
    }
    for split, name in sorted(recorded - left):
        logger.warning(
            "no window of class %r in split %r: its recordings are too short for %r, or have no labels",
            name, split, windows,
        )  # fmt: skip


def _encode_in_turn(
    sources: list[_Source], encoding: EncodingChoice, windows: Windows, work: Path
) -> Iterator[tuple[str, _Samples]]:
    """Some windows at a time, each handed on before the next are read."""
    plugin = plugins.load_options(encoding)
    for source in ProgressBar(sources, "encode", unit="recording"):
        for samples in _encode_source(source, plugin, windows):
            yield source.recording["recording_id"], samples


def _encode_spread(
    sources: list[_Source], encoding: EncodingChoice, windows: Windows, work: Path
) -> Iterator[tuple[str, _Samples]]:
    """The same, several recordings at a time."""
    found = map_shards(partial(_encode_shard, encoding, windows, work), list(enumerate(sources)), max_group=MAX_GROUP)
    found = ProgressBar(found, "encode", len(sources), unit="recording")
    for source, chunks in zip(sources, found, strict=True):
        for samples in chunks:
            yield source.recording["recording_id"], samples if isinstance(samples, _Samples) else samples.take_back()


class _PutAway(NamedTuple):
    """Samples whose images wait in files."""

    samples: _Samples
    histograms: Path
    frames: Path

    def take_back(self) -> _Samples:
        histograms, frames = (np.load(path, allow_pickle=False) for path in (self.histograms, self.frames))
        self.histograms.unlink()
        self.frames.unlink()
        return self.samples._replace(histograms=histograms, frames=frames)


def _put_away(samples: _Samples, path: Path) -> _PutAway:
    paths = path.with_suffix(".histograms.npy"), path.with_suffix(".frames.npy")
    for images, file in zip((samples.histograms, samples.frames), paths, strict=True):
        np.save(file, images, allow_pickle=False)
    return _PutAway(samples._replace(histograms=samples.histograms[:0], frames=samples.frames[:0]), *paths)


def _encode_shard(
    encoding: EncodingChoice, windows: Windows, work: Path, numbered: tuple[int, _Source]
) -> list[_Samples | _PutAway]:
    """All windows of a recording; images beyond `HELD_BYTES` go to files, for many recordings may wait."""
    number, source = numbered
    chunks: list[_Samples | _PutAway] = []
    held = 0
    for samples in _encode_source(source, plugins.load_options(encoding), windows):
        held += samples.histograms.nbytes + samples.frames.nbytes
        chunks.append(samples if held <= HELD_BYTES else _put_away(samples, work / f"{number:07d}_{len(chunks):05d}"))
    return chunks


def _sources(recordings: Manifest, windows: Windows) -> list[_Source]:
    """Every recording that something can be seen of, with its rows of the attached tables."""
    parts = by_recording(recordings.attached(tables.PARTS))
    tracks = by_recording(recordings.attached(tables.LABELS))
    own = windows.method == "dataset"
    ranges = by_recording(recordings.attached(tables.WINDOWS)) if own else {}
    window_labels = by_recording(recordings.attached(tables.WINDOW_LABELS)) if own else {}
    found = []
    for row in recordings.table.to_pylist():
        name = row["recording_id"]
        if not row["events_file"] and not row["event_images_file"]:
            continue
        dataset_windows = None
        if own and row["events_file"]:
            if row["num_windows"] is None:
                raise DataError(
                    f"windows.method 'dataset': {name} comes without windows of its own; "
                    "choose count, duration or whole"
                )
            table = ranges.get(name, tables.WINDOWS.arrow().empty_table())
            dataset_windows = np.stack([table["event_start"].to_numpy(), table["event_stop"].to_numpy()], axis=1)
        labels = labels_of(window_labels[name]) if name in window_labels else None
        file = recordings.path(row["events_file"] or row["event_images_file"])
        found.append(_Source(row, file, parts[name].to_pylist(), labels_of(tracks[name]), dataset_windows, labels))
    return found


def _encode_source(source: _Source, plugin: plugins.Plugin, windows: Windows) -> Iterator[_Samples]:
    made = _encode_events if source.recording["events_file"] else _encode_images
    return made(source, plugin, windows)


def _encode_events(source: _Source, plugin: plugins.Plugin, windows: Windows) -> Iterator[_Samples]:
    """The windows of each part, some at a time: neither events nor histograms of a recording need fit into memory."""
    path, at_once = source.file, _windows_at_once(plugin, _sensor_size(source.recording))
    for part in source.parts:
        start, stop = part["event_start"], part["event_stop"]
        held = event_files.read_events_range(path, start, stop) if stop - start <= MAX_EVENTS else None
        stamps = _time_stamps(path, start, stop, held)
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
                events = event_files.read_events_range(path, first, last)
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
            _tell_full(counts, source.recording["recording_id"], rows)
            frames = plugin.module.render_image(counts, plugin.options)
            own = _label(source.track, t_start, t_end, windows) if labels is None else labels.take(rows)
            own = _to_image(own, events.sensor_size, plugin, (frames.shape[2], frames.shape[1]))
            described = _rows(source.recording, part["split"], rows, t_start, t_end, local[:, 1] - local[:, 0])
            yield _Samples(described, counts, frames, own)


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


def _time_stamps(path: Path, start: int, stop: int, held: Events | None) -> Iterator[np.ndarray]:
    if held is not None:
        yield held.t
        return
    for first in range(start, stop, MAX_EVENTS):
        yield event_files.read_events_range(path, first, min(first + MAX_EVENTS, stop)).t


def _windows_at_once(plugin: plugins.Plugin, sensor_size: tuple[int, int]) -> int:
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


def _encode_images(source: _Source, plugin: plugins.Plugin, windows: Windows) -> Iterator[_Samples]:
    """Finished event images: every one is a window; the grey values stand for counts.

    They are what counts of a recording become by the encoding's normalisation, and go on as those do.
    """
    recording, name = source.recording, source.recording["recording_id"]
    if plugin.name != COUNTS:
        raise DataError(f"{name} comes as grey event images, which only the encoding {COUNTS!r} takes")
    if getattr(plugin.options, "polarity", False):
        raise DataError(
            f"{name} comes as grey event images, which have no polarity; set encoding.options.polarity=false"
        )
    if len(source.parts) != 1:
        raise DataError(f"{name}: finished event images cannot be split in time")
    images = np.load(source.file, mmap_mode="r", allow_pickle=False)
    t_us = np.load(source.file.with_suffix(".t_us.npy"), mmap_mode="r", allow_pickle=False)
    sensor_size = _sensor_size(recording)
    known = np.arange(len(images))
    if windows.labels == "interpolated":
        known = np.flatnonzero(is_between_labels(source.track, t_us))
    chosen = known[spread(len(known), windows.max_windows)]
    at_once = _windows_at_once(plugin, sensor_size)
    for first in range(0, len(chosen), at_once):
        rows = chosen[first : first + at_once]
        grey = np.asarray(images[rows])[:, None]
        frames = plugin.module.render_levels(grey, plugin.options)
        times = np.asarray(t_us[rows])
        image_size = (frames.shape[2], frames.shape[1])
        labels = _to_image(_label(source.track, times, times, windows), sensor_size, plugin, image_size)
        numbers = np.arange(first, first + len(rows))
        described = _rows(recording, source.parts[0]["split"], numbers, times, times, np.zeros(len(times), np.int64))
        yield _Samples(described, grey.astype(np.uint16), frames, labels)


def _rows(
    recording: dict[str, Any],
    split: str,
    numbers: np.ndarray,
    t_start: np.ndarray,
    t_end: np.ndarray,
    num_events: np.ndarray,
) -> list[dict[str, Any]]:
    columns = zip(numbers.tolist(), t_start.tolist(), t_end.tolist(), num_events.tolist(), strict=True)
    return [
        {
            "sample_id": f"{recording['recording_id']}:{split}:{number:05d}",
            "recording_id": recording["recording_id"],
            "subject": recording["subject"],
            "split": split,
            "t_start_us": start,
            "t_end_us": end,
            "num_events": count,
        }
        for number, start, end, count in columns
    ]


def _to_image(
    labels: Labels, sensor_size: tuple[int, int], plugin: plugins.Plugin, image_size: tuple[int, int]
) -> Labels:
    return labels_in_image(
        labels, lambda points: plugin.module.map_points(points, sensor_size, plugin.options), image_size
    )
