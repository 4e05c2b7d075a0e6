"""Raw recordings to checked event columns, label tracks and fixed splits."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.plugin_contracts import DatasetWithSynonyms
from ctlev_core.progress import ProgressBar
from ctlev_core.recordings.ingestion import IngestedRecording, ingest_recording, list_recordings
from data_contracts import tables
from data_contracts.config import DatasetChoice
from data_contracts.labels import Labels, Recording
from data_contracts.manifest import concat_labels, label_columns
from tasks.stage import Output, stage
from tasks.workers import map_shards


def _raw_files(arguments: dict[str, Any]) -> list[tuple[str, Path]]:
    plugin = plugins.load_options(arguments["dataset"])
    recordings = list_recordings(plugin)
    # What a dataset says of a recording need not be in its files or in its id: a caption, a split.
    named = {
        recording.recording_id: f"{recording.recording_id}:{recording.subject}:{recording.class_name}:{recording.parts}"
        for recording in recordings
    }
    return [(f"{named[r.recording_id]}:{path.name}", path) for r in recordings for path in r.files]


@stage(version=5, schema=tables.RECORDINGS, raw_files=_raw_files, readers=("formats", "motions"))
def ingest(out: Output, *, dataset: DatasetChoice) -> pa.Table:
    """Read every recording once, check it, and keep events and labels in the project's own form."""
    plugin = plugins.load_options(dataset)
    recordings = list_recordings(plugin)
    # Readers and the simulator release the interpreter lock, so that threads serve.
    results = map_shards(partial(_ingest_one, dataset, out.folder, out.work), recordings)
    ingested = list(ProgressBar(results, "ingest", len(recordings), unit="recording"))
    out.write_table(pa.Table.from_pylist([p for i in ingested for p in i.parts], tables.PARTS.arrow()), tables.PARTS)
    out.write_table(_window_table(recordings, ingested), tables.WINDOWS)
    named_further = isinstance(plugin.module, DatasetWithSynonyms)
    synonyms = plugin.module.read_synonyms(plugin.options) if named_further else {}
    named = [{"class_name": name, "names": list(names)} for name, names in sorted(synonyms.items())]
    out.write_table(pa.Table.from_pylist(named, tables.SYNONYMS.arrow()), tables.SYNONYMS)
    out.write_table(_label_table(recordings, [i.labels for i in ingested]), tables.LABELS)
    of_windows = [(r, i.window_labels) for r, i in zip(recordings, ingested, strict=True) if i.window_labels]
    out.write_table(
        _label_table([r for r, _ in of_windows], [labels for _, labels in of_windows]), tables.WINDOW_LABELS
    )
    return pa.Table.from_pylist([i.row for i in ingested], schema=tables.RECORDINGS.arrow())


def _ingest_one(dataset: DatasetChoice, folder: Path, work: Path, recording: Recording) -> IngestedRecording:
    return ingest_recording(plugins.load_options(dataset), recording, folder, work)


def _window_table(recordings: list[Recording], ingested: list[IngestedRecording]) -> pa.Table:
    named = [(r.recording_id, i.windows) for r, i in zip(recordings, ingested, strict=True) if i.windows is not None]
    ranges = np.concatenate([np.zeros((0, 2), np.int64), *(windows for _, windows in named)])
    names = [name for name, windows in named for _ in range(len(windows))]
    columns = [pa.array(names, pa.string()), ranges[:, 0], ranges[:, 1]]
    return pa.table(columns, names=[column.name for column in tables.WINDOWS.columns])


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
