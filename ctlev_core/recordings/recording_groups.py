"""Recordings are ingested in groups; the short ones of a group share a file of events.

A million recordings of 50 ms would be a million files, which are slow to list, hash and copy. How many make a group
depends on how many there are, never on who reads them, so that results do not depend on the number of workers.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ctlev_core.plugins import Plugin
from ctlev_core.recordings.ingestion import IngestedRecording, ingest_recording
from ctlev_core.recordings.stored_events import SUFFIX, SharedEventsWriter
from data_contracts import tables
from data_contracts.arrays import times_file
from data_contracts.file_lists import read_table
from data_contracts.labels import Labels, Recording
from data_contracts.manifest import concat_labels, label_columns
from data_contracts.tables import TableSchema

MAX_GROUP = 2048
"""Recordings of a group. Those of N-ImageNet, 0.4 MB each, share files of 0.8 GB."""
MIN_GROUPS = 128
"""Groups there are at least, so that many workers have something to do; fewer recordings have files of their own."""
TABLES = (tables.PARTS, tables.WINDOWS, tables.LABELS, tables.WINDOW_LABELS, tables.RECORDINGS)
"""What is known of the recordings of a group. The last is written last: a group that has it is finished."""


def recording_groups(recordings: Sequence[Recording]) -> list[tuple[int, Sequence[Recording]]]:
    """Consecutive recordings, numbered."""
    size = min(max(len(recordings) // MIN_GROUPS, 1), MAX_GROUP)
    starts = range(0, len(recordings), size)
    return [(number, recordings[start : start + size]) for number, start in enumerate(starts)]


def ingest_group(plugin: Plugin, work: Path, numbered: tuple[int, Sequence[Recording]]) -> Path:
    """Read a group of recordings, unless an earlier run has finished it.

    Args:
        plugin: the dataset.
        work: keeps what is finished when a run is interrupted: a folder for each group.
        numbered: one of `recording_groups`.

    Returns:
        The folder of the group: its files, named as in the artefact, and `TABLES`.

    Raises:
        DataError: a recording cannot be read or breaks the contract.
    """
    number, recordings = numbered
    folder = work / f"{number:06d}"
    finished = _table_path(folder, TABLES[-1])
    if finished.exists():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    shared_name = f"events/shared_{number:06d}{SUFFIX}"
    with SharedEventsWriter(folder / shared_name) as writer:
        shared = (shared_name, writer) if len(recordings) > 1 else None
        ingested = [ingest_recording(plugin, recording, folder, shared) for recording in recordings]
    found = {
        tables.PARTS.name: pa.Table.from_pylist([part for i in ingested for part in i.parts], tables.PARTS.arrow()),
        tables.WINDOWS.name: _window_table(recordings, ingested),
        tables.LABELS.name: _label_table(recordings, [i.labels for i in ingested]),
        tables.RECORDINGS.name: pa.Table.from_pylist([i.row for i in ingested], tables.RECORDINGS.arrow()),
    }
    named = [(r, i.window_labels) for r, i in zip(recordings, ingested, strict=True) if i.window_labels is not None]
    found[tables.WINDOW_LABELS.name] = _label_table([r for r, _ in named], [labels for _, labels in named])
    for schema in TABLES:
        path = _table_path(folder, schema)
        partial = path.with_suffix(".partial")
        pq.write_table(found[schema.name], partial, compression="zstd")
        os.replace(partial, path)
    return folder


def read_group_table(folder: Path, schema: TableSchema) -> pa.Table:
    """One of `TABLES` of a group that is finished."""
    path = _table_path(folder, schema)
    return read_table(path, path)


def group_files(recordings: pa.Table) -> Iterator[str]:
    """Names of the files that the rows of a table of recordings tell of, each once."""
    yield from dict.fromkeys(name for name in recordings["events_file"].to_pylist() if name)
    for column in ("event_images_file", "intensity_file"):
        for name in filter(None, recordings[column].to_pylist()):
            yield name
            yield times_file(name)


def _table_path(folder: Path, schema: TableSchema) -> Path:
    return folder / f"{schema.name}.parquet"


def _window_table(recordings: Sequence[Recording], ingested: Sequence[IngestedRecording]) -> pa.Table:
    named = [(r.recording_id, i.windows) for r, i in zip(recordings, ingested, strict=True) if i.windows is not None]
    ranges = np.concatenate([np.zeros((0, 2), np.int64), *(windows for _, windows in named)])
    names = [name for name, windows in named for _ in range(len(windows))]
    columns = [pa.array(names, pa.string()), ranges[:, 0], ranges[:, 1]]
    return pa.table(columns, names=[column.name for column in tables.WINDOWS.columns])


def _label_table(recordings: Sequence[Recording], tracks: Sequence[Labels]) -> pa.Table:
    stacked = concat_labels(tracks)
    repeated = [recording for recording, track in zip(recordings, tracks, strict=True) for _ in range(len(track))]
    return pa.table(
        {
            "recording_id": pa.array([recording.recording_id for recording in repeated], pa.string()),
            "subject": pa.array([recording.subject for recording in repeated], pa.string()),
            "class_name": pa.array(stacked.class_names, pa.string()),
            "t_us": stacked.t_us,
            **label_columns(stacked),
        }
    )
