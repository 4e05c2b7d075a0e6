"""Raw recordings to checked event columns, label tracks and fixed splits."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
from tqdm import tqdm

from ctlev_core import event_files, plugins
from ctlev_core.plugins import Plugin
from data_contracts import tables
from data_contracts.config import DatasetChoice
from data_contracts.errors import DataError
from data_contracts.events import check_events
from data_contracts.labels import Labels, Recording, check_labels
from data_contracts.manifest import concat_labels, label_columns
from tasks.stage import Output, stage


class _Ingested(NamedTuple):
    """What is known of one recording after reading it."""

    row: dict[str, Any]
    parts: list[dict[str, Any]]
    labels: Labels


def _raw_files(arguments: dict[str, Any]) -> list[tuple[str, Path]]:
    plugin = plugins.load_options(arguments["dataset"])
    recordings = _list_recordings(plugin)
    return [(f"{recording.recording_id}:{path.name}", path) for recording in recordings for path in recording.files]


def _list_recordings(plugin: Plugin) -> list[Recording]:
    """The dataset's recordings, refused when a subject is both learnt from and tested on."""
    recordings = plugin.module.list_recordings(plugin.options)
    if not recordings:
        raise DataError(f"dataset {plugin.name!r} has no recordings with options {plugin.options!r}")
    subjects: dict[str, set[str]] = {}
    for recording in recordings:
        if len(recording.parts) == 1:  # a recording split in time shares its subject by the user's own choice
            subjects.setdefault(recording.parts[0].split, set()).add(recording.subject)
    shared = subjects.get("train", set()) & subjects.get("test", set())
    if shared:
        raise DataError(f"dataset {plugin.name!r}: subjects {sorted(shared)} are in both train and test")
    return recordings


@stage(version=2, schema=tables.RECORDINGS, raw_files=_raw_files)
def ingest(out: Output, *, dataset: DatasetChoice) -> pa.Table:
    """Read every recording once, check it, and keep events and labels in the project's own form."""
    plugin = plugins.load_options(dataset)
    recordings = _list_recordings(plugin)
    # Readers and the simulator release the interpreter lock; map() keeps the order of the recordings.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        results = pool.map(lambda recording: _ingest_recording(plugin, recording, out), recordings)
        progress = tqdm(results, "ingest", len(recordings), unit="recording", leave=False, disable=None)
        ingested = list(progress)
    out.write_table(pa.Table.from_pylist([p for i in ingested for p in i.parts]), tables.PARTS)
    out.write_table(_label_table(recordings, [i.labels for i in ingested]), tables.LABELS)
    return pa.Table.from_pylist([i.row for i in ingested], schema=tables.RECORDINGS.arrow())


def _ingest_recording(plugin: Plugin, recording: Recording, out: Output) -> _Ingested:
    where = f"{plugin.name} {recording.recording_id}"
    labels = check_labels(plugin.module.read_labels(recording, plugin.options), where)
    row: dict[str, Any] = {
        "recording_id": recording.recording_id,
        "subject": recording.subject,
        "class_name": recording.class_name,
        "splits": "+".join(part.split for part in recording.parts),
        "events_file": "",
        **dict.fromkeys(("sensor_width_px", "sensor_height_px", "num_events", "num_positive", "num_negative"), 0),
        **dict.fromkeys(("t_first_us", "t_last_us", "duration_us"), 0),
    }
    if recording.has_events:
        name = f"events/{recording.recording_id}.parquet"
        finished, attached = out.work / name, out.folder / name
        for path in (finished, attached):
            path.parent.mkdir(parents=True, exist_ok=True)
        if finished.exists():  # by an earlier run that was interrupted
            events = event_files.read_events_file(finished)
        else:
            events = check_events(plugin.module.read_events(recording, plugin.options), where)
            if len(events) == 0:
                raise DataError(f"{where}: the recording holds no events")
            event_files.write_events_parquet(finished, events)
        os.link(finished, attached)
        row |= event_files.summarise(events)
        row |= {
            "events_file": name,
            "sensor_width_px": events.sensor_size[0],
            "sensor_height_px": events.sensor_size[1],
        }
    count = row["num_events"]
    parts = [
        {
            "recording_id": recording.recording_id,
            "split": part.split,
            "event_start": round(part.start * count),
            "event_stop": round(part.stop * count),
        }
        for part in recording.parts
    ]
    return _Ingested(row, parts, labels)


def _label_table(recordings: list[Recording], tracks: list[Labels]) -> pa.Table:
    stacked = concat_labels(tracks)
    repeated = [recording for recording, track in zip(recordings, tracks, strict=True) for _ in range(len(track))]
    return pa.table(
        {
            "recording_id": [recording.recording_id for recording in repeated],
            "subject": [recording.subject for recording in repeated],
            "class_name": list(stacked.class_names),
            "t_us": stacked.t_us,
            **label_columns(stacked),
        }
    )
