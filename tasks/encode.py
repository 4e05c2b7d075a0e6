"""Events to windows, windows to event histograms and images, label tracks to one label a window."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.events.image_grid import ImageFit
from ctlev_core.progress import ProgressBar
from ctlev_core.recordings.encoding import EncodedWindows, RecordingPart, RecordingSource, encode_recording
from data_contracts import tables
from data_contracts.arrays import load_array, save_compressed
from data_contracts.compressed_arrays import SUFFIX
from data_contracts.config import EncodingChoice, Windows
from data_contracts.errors import DataError
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest, by_recording, concat_labels, label_columns, labels_of
from tasks.stage import Output, stage
from tasks.workers import is_spread, map_shards

HELD_BYTES = 1 << 23
"""Images of a recording that wait in memory until their turn comes; four frames of 512 x 512 px fit."""
MAX_GROUP = 4
"""Recordings that travel together; up to two such groups a worker wait, so that 16 workers hold 1 GiB at most."""

logger = logging.getLogger(__name__)


@stage(version=6, schema=tables.FRAMES)
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
        for source, cut in encoded(sources, encoding, windows, out.work):
            try:
                for counts in _on_canvas(cut.histograms, canvas):
                    histograms.append(counts)
                frames.append(cut.frames)
            except DataError as error:
                raise DataError(
                    f"encode: sensors differ in size, {source.recording_id} does; set encoding.options.image_size "
                    f"({error})"
                ) from error
            rows += _rows(source, cut)
            labels.append(cut.labels)
    for split in ("train", "test"):
        if not any(row["split"] == split for row in rows):
            raise DataError(f"encode: no window in split {split!r}; the recordings are too short for {windows!r}")
    stacked = concat_labels(labels)
    _check_classes(sources, rows, stacked.class_names, windows)
    table = pa.Table.from_pylist(rows).append_column("class_name", pa.array(stacked.class_names, pa.string()))
    for name, column in label_columns(stacked).items():
        table = table.append_column(name, column)
    return table


def _rows(source: RecordingSource, cut: EncodedWindows) -> list[dict[str, Any]]:
    times = (array.tolist() for array in (cut.numbers, cut.t_start_us, cut.t_end_us, cut.num_events))
    return [
        {
            "sample_id": f"{source.recording_id}:{cut.split}:{number:05d}",
            "recording_id": source.recording_id,
            "subject": source.subject,
            "split": cut.split,
            "t_start_us": start_us,
            "t_end_us": end_us,
            "num_events": count,
        }
        for number, start_us, end_us, count in zip(*times, strict=True)
    ]


def _canvas(sources: list[RecordingSource], encoding: EncodingChoice) -> tuple[int, int] | None:
    """(height, width) px that the counts of every sensor fit into; None where counts have the size of the image."""
    options = plugins.load_options(encoding).options
    if not isinstance(options, ImageFit) or options.resampling != "area":
        return None
    sizes = [source.sensor_size for source in sources]
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


def _check_classes(
    sources: list[RecordingSource], rows: list[dict[str, Any]], class_names: Sequence[str], windows: Windows
) -> None:
    """Say where a class was recorded and none of it is left: what follows does not know that there is such a class."""
    left = {(row["split"], name) for row, name in zip(rows, class_names, strict=True)}
    recorded = {
        (part.split, source.class_name)
        for source in sources
        for part in source.parts
        if source.class_name and part.split in ("train", "test")
    }
    for split, name in sorted(recorded - left):
        logger.warning(
            "no window of class %r in split %r: its recordings are too short for %r, or have no labels",
            name, split, windows,
        )  # fmt: skip


def _encode_in_turn(
    sources: list[RecordingSource], encoding: EncodingChoice, windows: Windows, work: Path
) -> Iterator[tuple[RecordingSource, EncodedWindows]]:
    """Some windows at a time, each handed on before the next are read."""
    plugin = plugins.load_options(encoding)
    for source in ProgressBar(sources, "encode", unit="recording"):
        for cut in encode_recording(source, plugin, windows):
            yield source, cut


def _encode_spread(
    sources: list[RecordingSource], encoding: EncodingChoice, windows: Windows, work: Path
) -> Iterator[tuple[RecordingSource, EncodedWindows]]:
    """The same, several recordings at a time."""
    found = map_shards(partial(_encode_shard, encoding, windows, work), list(enumerate(sources)), max_group=MAX_GROUP)
    found = ProgressBar(found, "encode", len(sources), unit="recording")
    for source, chunks in zip(sources, found, strict=True):
        for cut in chunks:
            yield source, cut.take_back() if isinstance(cut, _PutAway) else cut


class _PutAway(NamedTuple):
    """Windows whose images wait in files."""

    others: EncodedWindows
    histograms: Path
    frames: Path

    def take_back(self) -> EncodedWindows:
        histograms, frames = (load_array(path)[:] for path in (self.histograms, self.frames))
        self.histograms.unlink()
        self.frames.unlink()
        return self.others._replace(histograms=histograms, frames=frames)


def _put_away(cut: EncodedWindows, path: Path) -> _PutAway:
    paths = path.with_suffix(f".histograms{SUFFIX}"), path.with_suffix(f".frames{SUFFIX}")
    for images, file in zip((cut.histograms, cut.frames), paths, strict=True):
        save_compressed(file, images)
    return _PutAway(cut._replace(histograms=cut.histograms[:0], frames=cut.frames[:0]), *paths)


def _encode_shard(
    encoding: EncodingChoice, windows: Windows, work: Path, numbered: tuple[int, RecordingSource]
) -> list[EncodedWindows | _PutAway]:
    """All windows of a recording; images beyond `HELD_BYTES` go to files, for many recordings may wait."""
    number, source = numbered
    chunks: list[EncodedWindows | _PutAway] = []
    held = 0
    for cut in encode_recording(source, plugins.load_options(encoding), windows):
        held += cut.histograms.nbytes + cut.frames.nbytes
        chunks.append(cut if held <= HELD_BYTES else _put_away(cut, work / f"{number:07d}_{len(chunks):05d}"))
    return chunks


def _sources(recordings: Manifest, windows: Windows) -> list[RecordingSource]:
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
        found.append(
            RecordingSource(
                recording_id=name,
                subject=row["subject"],
                class_name=row["class_name"],
                sensor_size=(row["sensor_width_px"], row["sensor_height_px"]),
                file=recordings.path(row["events_file"] or row["event_images_file"]),
                has_events=bool(row["events_file"]),
                parts=tuple(
                    RecordingPart(part["split"], part["event_start"], part["event_stop"])
                    for part in parts[name].to_pylist()
                ),
                track=labels_of(tracks[name]),
                windows=dataset_windows,
                window_labels=labels_of(window_labels[name]) if name in window_labels else None,
            )
        )
    return found
