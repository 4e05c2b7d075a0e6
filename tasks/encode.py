"""Events to windows, windows to event histograms and images, label tracks to one label a window."""

# pyarrow.compute makes its functions when it is imported, where a type checker cannot see them.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from ctlev_core import plugins
from ctlev_core.events.image_grid import ImageFit
from ctlev_core.progress import ProgressBar
from ctlev_core.recordings.encoding import EncodedWindows, RecordingPart, RecordingSource, encode_recording
from ctlev_core.recordings.stored_events import stored_events
from data_contracts import tables
from data_contracts.arrays import load_array, save_compressed
from data_contracts.compressed_arrays import SUFFIX
from data_contracts.config import EncodingChoice, Windows
from data_contracts.errors import DataError
from data_contracts.labels import HeldOut, Labels
from data_contracts.manifest import LabelKinds, Manifest, concat_labels, label_columns, labels_of, rows_by_recording
from data_contracts.tables import TableSchema
from tasks.stage import Output, stage
from tasks.workers import is_spread, map_shards

HELD_BYTES = 1 << 23
"""Images of a recording that wait in memory until their turn comes; four frames of 512 x 512 px fit."""
MAX_GROUP = 4
"""Recordings that travel together; up to two such groups a worker wait, so that 16 workers hold 1 GiB at most."""
BLOCK, NUM_BLOCKS = 256, 4
"""Recordings that are looked up at a time, and how many such blocks are kept."""
TABLE_ROWS = 1 << 13
"""Rows that wait as Python's records."""

logger = logging.getLogger(__name__)


@stage(version=7, schema=tables.FRAMES, optional=("held_out",), spreads=True)
def encode(
    out: Output,
    recordings: Manifest,
    *,
    encoding: EncodingChoice,
    windows: Windows,
    held_out: HeldOut | None = None,
) -> pa.Table:
    """Cut every recording into windows and encode each: arrays `histograms` (counts) and `frames` (8-bit RGB).

    Counts have the size of the sensor, or with resampling `events` that of the image. Where sensors differ, counts lie
    in the upper left corner of an array that is as large as the largest, with zeros beyond. Of event images that come
    finished every one is a window, and its grey values stand for counts.

    With `held_out="validation"` nothing of the split `test` is encoded, so that no later stage can look at it.
    """
    sources = _Sources(recordings, windows, without="test" if held_out == "validation" else None)
    canvas = _canvas(sources, encoding)
    made = _FrameTable()
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
            made.append(source, cut)
    table = made.finish()
    splits = set(pc.unique(table["split"]).to_pylist()) if len(table) else set()
    for split in ("train", held_out or "test"):
        if split not in splits:
            raise DataError(f"encode: no window in split {split!r}: {_why_none(recordings, split, windows)}")
    _check_classes(recordings, table, windows, ("train", held_out or "test"))
    return table


def _why_none(recordings: Manifest, split: str, windows: Windows) -> str:
    """Why no recording of a split has a window."""
    if windows.method != "count":
        return f"the recordings are too short for {windows!r}"
    parts = recordings.attached(tables.PARTS)
    parts = parts.filter(pc.equal(parts["split"], split))
    most = max((row["event_stop"] - row["event_start"] for row in parts.to_pylist()), default=0)
    return (
        f"its recordings have {most:,} events at most there, and a window takes "
        f"{windows.num_events:,}; set windows.num_events to less"
    )


class _FrameTable:
    """The table of frames, gathered window by window: as Arrow's columns, which take a tenth of Python's records."""

    def __init__(self) -> None:
        self._tables: list[pa.Table] = []
        self._rows: list[dict[str, Any]] = []
        self._labels: list[Labels] = []
        self._kinds = LabelKinds()

    def append(self, source: RecordingSource, cut: EncodedWindows) -> None:
        """Rows of some windows of a recording."""
        times = (
            array.tolist() for array in (cut.numbers, cut.t_start_us, cut.t_end_us, cut.labels.t_us, cut.num_events)
        )
        self._rows += [
            {
                "sample_id": f"{source.recording_id}:{cut.split}:{number:05d}",
                "recording_id": source.recording_id,
                "subject": source.subject,
                "split": cut.split,
                "t_start_us": start_us,
                "t_end_us": end_us,
                "t_us": label_us,
                "num_events": count,
            }
            for number, start_us, end_us, label_us, count in zip(*times, strict=True)
        ]
        self._labels.append(cut.labels)
        if len(self._rows) >= TABLE_ROWS:
            self._flush()

    def _flush(self) -> None:
        stacked = concat_labels(self._labels)
        table = pa.Table.from_pylist(self._rows).append_column("class_name", pa.array(stacked.class_names, pa.string()))
        for name, column in label_columns(stacked).items():
            table = table.append_column(name, column)
        self._tables.append(self._kinds.check(table))
        self._rows, self._labels = [], []

    def finish(self) -> pa.Table:
        """All rows; without any, a table of no windows."""
        if self._rows:
            self._flush()
        return pa.concat_tables(self._tables) if self._tables else tables.FRAMES.arrow().empty_table()


def _canvas(sources: _Sources, encoding: EncodingChoice) -> tuple[int, int] | None:
    """(height, width) px that the counts of every sensor fit into; None where counts have the size of the image."""
    options = plugins.load_options(encoding).options
    if not isinstance(options, ImageFit) or options.resampling != "area" or not len(sources):
        return None
    height, width = (pc.max(sources.table[f"sensor_{side}_px"]).as_py() for side in ("height", "width"))
    return height, width


def _on_canvas(histograms: np.ndarray, canvas: tuple[int, int] | None) -> Iterator[np.ndarray]:
    """Counts [N, C, H, W] at the size of the canvas: as they are, else window by window, for canvases may be large."""
    height, width = histograms.shape[2:]
    if canvas is None or canvas == (height, width):
        yield histograms
        return
    beyond = (0, 0), (0, 0), (0, canvas[0] - height), (0, canvas[1] - width)
    for row in range(len(histograms)):
        yield np.pad(histograms[row : row + 1], beyond)


def _check_classes(recordings: Manifest, table: pa.Table, windows: Windows, needed: tuple[str, ...]) -> None:
    """Say where a class was recorded and none of it is left: what follows does not know that there is such a class."""
    left = {(row["split"], row["class_name"]) for row in _different(table.select(["split", "class_name"]))}
    recorded = {
        (split, row["class_name"])
        for row in _different(_visible(recordings).select(["splits", "class_name"]))
        for split in row["splits"].split("+")
        if row["class_name"] and split in needed
    }
    for split, name in sorted(recorded - left):
        logger.warning(
            "no window of class %r in split %r: its recordings are too short for %r, or have no labels",
            name, split, windows,
        )  # fmt: skip


def _different(table: pa.Table) -> list[dict[str, Any]]:
    """The rows of a table, each once."""
    return table.group_by(table.column_names).aggregate([]).to_pylist()


def _encode_in_turn(
    sources: _Sources, encoding: EncodingChoice, windows: Windows, work: Path
) -> Iterator[tuple[RecordingSource, EncodedWindows]]:
    """Some windows at a time, each handed on before the next are read."""
    plugin = plugins.load_options(encoding)
    for source in ProgressBar(sources, "encode", unit="recording"):
        for cut in encode_recording(source, plugin, windows):
            yield source, cut


def _encode_spread(
    sources: _Sources, encoding: EncodingChoice, windows: Windows, work: Path
) -> Iterator[tuple[RecordingSource, EncodedWindows]]:
    """The same, several recordings at a time."""
    found = map_shards(partial(_encode_shard, encoding, windows, work), _Numbered(sources), max_group=MAX_GROUP)
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


def _visible(recordings: Manifest) -> pa.Table:
    """The rows of recordings that something can be seen of."""
    table = recordings.table
    return table.filter(pc.or_(pc.not_equal(table["events_file"], ""), pc.not_equal(table["event_images_file"], "")))


class _Sources(Sequence[RecordingSource]):
    """Every recording that something can be seen of, with its rows of the attached tables.

    They are put together when they are asked for, `BLOCK` at a time: a million would take gigabytes.

    Attributes:
        table: a row for each.
    """

    def __init__(self, recordings: Manifest, windows: Windows, without: str | None = None) -> None:
        own = windows.method == "dataset"
        self.table = _visible(recordings)
        self._recordings, self._own_windows, self._without = recordings, own, without
        schemas = (tables.PARTS, tables.LABELS, *((tables.WINDOWS, tables.WINDOW_LABELS) if own else ()))
        self._attached = {schema.name: recordings.attached(schema) for schema in schemas}
        names = self.table["recording_id"]
        self._ranges = {name: rows_by_recording(table, names) for name, table in self._attached.items()}
        self._block = lru_cache(maxsize=NUM_BLOCKS)(self._make_block)
        if own:
            missing = pc.and_(pc.not_equal(self.table["events_file"], ""), pc.is_null(self.table["num_windows"]))
            first = pc.index(missing, True).as_py()
            if first >= 0:
                raise DataError(
                    f"windows.method 'dataset': {names[first].as_py()} comes without windows of its own; "
                    "choose count, duration or whole"
                )

    def __len__(self) -> int:
        return len(self.table)

    @overload
    def __getitem__(self, index: int) -> RecordingSource: ...

    @overload
    def __getitem__(self, index: slice) -> list[RecordingSource]: ...

    def __getitem__(self, index: int | slice) -> RecordingSource | list[RecordingSource]:
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        number = range(len(self))[index]  # which raises where there is none, as iteration expects
        return self._block(number // BLOCK)[number % BLOCK]

    def _make_block(self, block: int) -> list[RecordingSource]:
        start = block * BLOCK
        parts, first_part = self._rows(tables.PARTS, start)
        tracks, first_label = self._rows(tables.LABELS, start)
        parts, tracks = parts.to_pylist(), labels_of(tracks)
        windows, window_labels, first_window, first_window_label = np.zeros((0, 2), np.int64), None, 0, 0
        if self._own_windows:
            cut, first_window = self._rows(tables.WINDOWS, start)
            windows = np.stack([cut["event_start"].to_numpy(), cut["event_stop"].to_numpy()], axis=1)
            labels, first_window_label = self._rows(tables.WINDOW_LABELS, start)
            window_labels = labels_of(labels) if len(labels) else None

        found = []
        for number, row in enumerate(self.table.slice(start, BLOCK).to_pylist(), start):
            a, b = self._range(tables.PARTS, number, first_part)
            own = self._own_windows and bool(row["events_file"])
            c, d = self._range(tables.WINDOWS, number, first_window) if own else (0, 0)
            e, f = self._range(tables.WINDOW_LABELS, number, first_window_label) if self._own_windows else (0, 0)
            has_events = bool(row["events_file"])
            found.append(
                RecordingSource(
                    recording_id=row["recording_id"],
                    subject=row["subject"],
                    class_name=row["class_name"],
                    sensor_size=(row["sensor_width_px"], row["sensor_height_px"]),
                    events=stored_events(self._recordings, row) if has_events else None,
                    event_images=None if has_events else self._recordings.path(row["event_images_file"]),
                    parts=tuple(
                        RecordingPart(part["split"], part["event_start"], part["event_stop"])
                        for part in parts[a:b]
                        if part["split"] != self._without
                    ),
                    track=tracks.take(np.arange(*self._range(tables.LABELS, number, first_label))),
                    windows=windows[c:d] if own else None,
                    window_labels=window_labels.take(np.arange(e, f)) if window_labels is not None and f > e else None,
                )
            )
        return found

    def _rows(self, schema: TableSchema, start: int) -> tuple[pa.Table, int]:
        """The rows of an attached table that are of the recordings of a block, and the number of the first."""
        ranges = self._ranges[schema.name][start : start + BLOCK]
        ranges = ranges[ranges[:, 1] > ranges[:, 0]]
        first, last = (int(ranges[:, 0].min()), int(ranges[:, 1].max())) if len(ranges) else (0, 0)
        return self._attached[schema.name].slice(first, last - first), first

    def _range(self, schema: TableSchema, number: int, first: int) -> tuple[int, int]:
        start, stop = self._ranges[schema.name][number].tolist()
        return (start - first, stop - first) if stop > start else (0, 0)


class _Numbered(Sequence[tuple[int, RecordingSource]]):
    """The recordings with their numbers, as `enumerate` without a list of all."""

    def __init__(self, sources: _Sources) -> None:
        self._sources = sources

    def __len__(self) -> int:
        return len(self._sources)

    @overload
    def __getitem__(self, index: int) -> tuple[int, RecordingSource]: ...

    @overload
    def __getitem__(self, index: slice) -> list[tuple[int, RecordingSource]]: ...

    def __getitem__(self, index: int | slice) -> tuple[int, RecordingSource] | list[tuple[int, RecordingSource]]:
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        return index, self._sources[index]
