"""Generated frames as event streams in files, for users of events rather than images."""

# pyarrow.compute makes its functions when it is imported, where a type checker cannot see them.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from ctlev_core import plugins
from ctlev_core.events import files as event_files
from ctlev_core.events.decoding import event_chunks
from ctlev_core.events.image_grid import check_whole_counts, count_size, pixel_bins
from ctlev_core.events.windows import spread
from ctlev_core.plugin_contracts import FormatWithWriter
from ctlev_core.postprocessing.event_streams import TimeModel, fit_times, join_windows, sample_streams
from ctlev_core.postprocessing.image_counts import CountModel, estimate_counts, fit_counts
from ctlev_core.progress import ProgressBar
from ctlev_core.recordings.stored_events import StoredEvents, stored_events
from ctlev_core.supervised.frame_sequences import name_stretches, stretch_lengths, training_interval_us
from data_contracts import tables
from data_contracts.config import EncodingChoice
from data_contracts.errors import DataError
from data_contracts.event_export import EventExport
from data_contracts.events import Events
from data_contracts.manifest import LABEL_COLUMNS, Manifest, ManifestRef
from tasks import file_locks
from tasks.stage import Output, stage

MAX_WINDOWS = 64
"""Recorded windows that times are learnt from, evenly spread over those of the training split."""
BLOCK_ROWS = 64
READ_EVENTS = 1 << 20
_COUNT_STREAM, _TIME_STREAM = 1, 2
_ENCODING = "event_histogram"


@stage(version=3, schema=tables.EVENT_STREAMS)
def export_events(
    out: Output,
    generated: Manifest,
    frames: Manifest,
    recordings: Manifest,
    *,
    encoding: EncodingChoice,
    export: EventExport,
) -> pa.Table:
    """Event streams of all generated frames, under `events/`; the table says where each frame lies, with its label.

    Counts and times are drawn as in the training windows of `frames`, which were cut from `recordings`; each row from
    its own seed. A stream is one frame; or, asked for stretches, all frames whose labels follow one another in time,
    each in the window that it would have in a recording.
    """
    plugin, writer = plugins.load_options(encoding), plugins.load("formats", export.format)
    if plugin.name != _ENCODING:
        raise DataError(f"events can be drawn from counts, encoding {_ENCODING!r}, alone; got {plugin.name!r}")
    if not isinstance(writer, FormatWithWriter):
        raise DataError(f"format {export.format!r} is read, not written; choose parquet, evt2 or evt3, for example")
    counts, times = _learn(frames, recordings, plugin)
    folder = out.folder / "events"
    folder.mkdir()
    rows: list[dict[str, Any]] = []
    interval_us, lengths = None, [1] * len(generated)
    if export.streams == "stretches":
        interval_us = training_interval_us(frames)
        lengths = stretch_lengths(name_stretches(generated.table, np.arange(len(generated)), interval_us))
    windows = _window_events(generated, counts, times, export, rows, interval_us)
    joined = _streams(windows, lengths, interval_us or 0, times.least_gap_us)
    streams = iter(ProgressBar(joined, "export events", len(lengths), unit="stream"))
    if export.one_file:
        _write_together(folder / f"events{_suffix(export.format, writer)}", streams, rows, export, writer)
    else:
        first = 0
        for number, stream in enumerate(streams):
            path = folder / f"{number:06d}{_suffix(export.format, writer)}"
            event_files.write_event_chunks(path, [stream.events], export.format)
            _place(rows[first : first + len(stream.starts_us)], path, stream)
            first += len(stream.starts_us)
    table = pa.Table.from_pylist(rows)
    for name in ("sample_id", "class_name", "joint_set", *LABEL_COLUMNS.values()):
        table = table.append_column(name, generated.table[name])
    return table.select([column.name for column in tables.EVENT_STREAMS.columns]).cast(tables.EVENT_STREAMS.arrow())


def events_folder(home: Path, name: str) -> Path:
    """Where a person looks for the events of an experiment."""
    return home / "events" / name


def publish_events(ref: ManifestRef, home: Path, name: str) -> str:
    """Put the newest events of an experiment where a person looks for them, and say where that is."""
    folder = events_folder(home, name)
    temporary = folder.with_name(f".{name}")
    locks = home / "locks"
    locks.mkdir(parents=True, exist_ok=True)
    with file_locks.locked(locks / f"events-{name}", f"the events of {name}"):
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.copytree(ref.path / "events", temporary / "events")
        shutil.copyfile(ref.path / "manifest.parquet", temporary / "event_streams.parquet")
        shutil.rmtree(folder, ignore_errors=True)
        temporary.rename(folder)
    return f"events: {ref.rows} streams in {folder}, listed in {folder / 'event_streams.parquet'}"


def _learn(frames: Manifest, recordings: Manifest, plugin: plugins.Plugin) -> tuple[CountModel, TimeModel]:
    """What the training windows say about counts and about times."""
    rows = frames.rows_where(split="train")
    num_events = frames.table["num_events"].to_numpy()
    if not num_events[rows].all():
        raise DataError(
            f"{frames.ref.path}: row {rows[int(np.argmin(num_events[rows]))]} comes from a finished event image; "
            "events can be drawn only where the recorded windows have events"
        )
    histograms = frames.array("histograms")
    check_whole_counts(histograms.shape, frames.array("frames").shape, "export of events")
    counts = fit_counts(np.asarray(histograms[rows[spread(len(rows), 4 * MAX_WINDOWS)]]), plugin.options)
    chosen = frames.table.take(pa.array(rows[spread(len(rows), MAX_WINDOWS)]))
    windows = _windows(chosen.to_pylist(), recordings)
    return counts, fit_times(_in_image(events, plugin.options) for events in windows)


def _in_image(events: Events, options: Any) -> Events:
    """The events in the pixels that counts are of: many pixels of a sensor may be one of the image, and take turns."""
    columns, rows = pixel_bins(events.sensor_size, options)
    x, y = columns[events.x], rows[events.y]
    inside = (x >= 0) & (y >= 0)
    return Events(
        events.t[inside], x[inside].astype(np.uint16), y[inside].astype(np.uint16), events.p[inside],
        count_size(events.sensor_size, options),
    )  # fmt: skip


def _windows(rows: list[dict[str, Any]], recordings: Manifest) -> Iterator[Events]:
    """The events of each row; at its ends also those others that have the same time stamp."""
    # Rows of Python's are made of these recordings alone: those of a million would take a gigabyte.
    wanted = pa.array(sorted({row["recording_id"] for row in rows}), pa.string())
    table, parts = (
        every.filter(pc.is_in(every["recording_id"], wanted)).to_pylist()
        for every in (recordings.table, recordings.attached(tables.PARTS))
    )
    known = {row["recording_id"]: row for row in table}
    for row in rows:
        stored = stored_events(recordings, known[row["recording_id"]])
        start_us, end_us = row["t_start_us"], row["t_end_us"]
        found = []
        for part in parts:
            if part["recording_id"] == row["recording_id"] and part["split"] == row["split"]:
                found += _events_between(stored, part["event_start"], part["event_stop"], start_us, end_us)
        if found:
            yield event_chunks.concatenate(found)


def _events_between(stored: StoredEvents, start: int, stop: int, start_us: int, end_us: int) -> list[Events]:
    """Events of a stretch of a recording from one time to another, both included, in chunks."""
    # By halves, so that a window of a long recording costs a few reads of single events.
    low, high = start, stop
    while low < high:
        middle = (low + high) // 2
        if stored.read(middle, middle + 1).t[0] < start_us:
            low = middle + 1
        else:
            high = middle
    found = []
    while low < stop:
        chunk = stored.read(low, min(low + READ_EVENTS, stop))
        last = int(np.searchsorted(chunk.t, end_us, "right"))
        found.append(chunk.slice(0, last))
        if last < len(chunk):
            break
        low += len(chunk)
    return found


class _Stream(NamedTuple):
    """Events, where the windows of its rows start, and where the last one ends."""

    events: Events
    starts_us: list[int]
    end_us: int


def _window_events(
    generated: Manifest,
    counts: CountModel,
    times: TimeModel,
    export: EventExport,
    rows: list[dict[str, Any]],
    interval_us: int | None,
) -> Iterator[Events]:
    """The events of each row's window, from 0 us; what is known of it is appended to `rows` before it comes."""
    frames, seeds = generated.array("frames"), generated.column("seed")
    duration_us = None if interval_us is None else interval_us - 1
    for start in range(0, len(generated), BLOCK_ROWS):
        block = range(start, min(start + BLOCK_ROWS, len(generated)))
        made = estimate_counts(
            np.asarray(frames[start : block.stop]), counts, seeds=[_seed(seeds[row], _COUNT_STREAM) for row in block]
        )
        time_seeds = [_seed(seeds[row], _TIME_STREAM) for row in block]
        windows = sample_streams(made.counts, times, seeds=time_seeds, spread=export.spread, duration_us=duration_us)
        for number, events in enumerate(windows):
            rows.append(
                {
                    "has_polarity": made.counts.shape[1] == 2,
                    "is_exact": bool(made.is_exact[number]),
                    "error_levels": float(made.error_levels[number]),
                    "seed": seeds[start + number],
                }
            )
            yield events


def _streams(windows: Iterator[Events], lengths: list[int], interval_us: int, least_gap_us: int) -> Iterator[_Stream]:
    """Windows joined to streams of so many each."""
    for length in lengths:
        starts_us = [interval_us * number for number in range(length)]
        parts = list(itertools.islice(windows, length))
        events = parts[0] if length == 1 else join_windows(parts, interval_us, least_gap_us)
        last_us = int(events.t[-1]) if len(events) else 0
        yield _Stream(events, starts_us, max(length * interval_us, last_us))


def _seed(seed: int, stream: int) -> int:
    return int(np.random.SeedSequence([seed, stream]).generate_state(1)[0])


def _write_together(
    path: Path, streams: Iterator[_Stream], rows: list[dict[str, Any]], export: EventExport, writer: FormatWithWriter
) -> None:
    """All streams in one file, one after another on one clock."""

    def shifted() -> Iterator[Events]:
        start_us, event_start, first = 0, 0, 0
        for stream in streams:
            moved = replace(stream.events, t=stream.events.t + start_us)
            own = rows[first : first + len(stream.starts_us)]
            starts_us, end_us = [start_us + each for each in stream.starts_us], start_us + stream.end_us
            _place(own, path, _Stream(moved, starts_us, end_us), event_start)
            start_us = end_us + export.gap_us
            event_start, first = event_start + len(moved), first + len(own)
            yield moved

    event_files.write_event_chunks(path, shifted(), export.format)


def _place(rows: list[dict[str, Any]], path: Path, stream: _Stream, event_start: int = 0) -> None:
    """Say of the rows of a stream, whose first event is the `event_start`-th of a file, where they lie."""
    t_us = stream.events.t
    bounds = [0, *np.searchsorted(t_us, stream.starts_us[1:]).tolist(), len(t_us)]
    for row, start_us, (first, last) in zip(rows, stream.starts_us, itertools.pairwise(bounds), strict=True):
        row |= {
            "file": f"{path.parent.name}/{path.name}",
            "t_start_us": start_us,
            "t_end_us": int(t_us[last - 1]) if last > first else start_us,
            "event_start": event_start + first,
            "num_events": last - first,
        }


def _suffix(name: str, writer: FormatWithWriter) -> str:
    """The format's own suffix: where several formats share one, that with its name."""
    own = f".{name}"
    return own if own in writer.SUFFIXES else writer.SUFFIXES[0]
