"""Raw recordings to checked event columns, label tracks and fixed splits."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.plugin_contracts import DatasetWithSynonyms
from ctlev_core.progress import ProgressBar
from ctlev_core.recordings.ingestion import list_recordings
from ctlev_core.recordings.recording_groups import (
    TABLES,
    group_files,
    ingest_group,
    read_group_table,
    recording_groups,
)
from data_contracts import tables
from data_contracts.config import DatasetChoice
from data_contracts.labels import Recording
from data_contracts.manifest import LabelKinds
from tasks.stage import Output, stage
from tasks.workers import map_shards

logger = logging.getLogger(__name__)


def _raw_files(arguments: dict[str, Any]) -> list[tuple[str, Path]]:
    plugin = plugins.load_options(arguments["dataset"])
    recordings = list_recordings(plugin)
    # What a dataset says of a recording need not be in its files or in its id: a caption, a split.
    named = {
        recording.recording_id: f"{recording.recording_id}:{recording.subject}:{recording.class_name}:{recording.parts}"
        for recording in recordings
    }
    return [(f"{named[r.recording_id]}:{path.name}", path) for r in recordings for path in r.files]


@stage(version=6, schema=tables.RECORDINGS, raw_files=_raw_files, readers=("formats", "motions"), spreads=True)
def ingest(out: Output, *, dataset: DatasetChoice) -> pa.Table:
    """Read every recording once, check it, and keep events and labels in the project's own form."""
    plugin = plugins.load_options(dataset)
    groups = recording_groups(list_recordings(plugin))
    # Readers and the simulator release the interpreter lock, so that threads serve.
    finished = map_shards(partial(_ingest_group, dataset, out.work), groups)
    rows: list[pa.Table] = []
    with contextlib.ExitStack() as stack:
        written = {schema: stack.enter_context(out.open_table(schema)) for schema in TABLES[:-1]}
        kinds = {schema: LabelKinds() for schema in (tables.LABELS, tables.WINDOW_LABELS)}
        bar = stack.enter_context(ProgressBar(desc="ingest", total=sum(len(g) for _, g in groups), unit="recording"))
        for folder in finished:
            rows.append(read_group_table(folder, tables.RECORDINGS))
            for name in group_files(rows[-1]):
                out.share(folder / name, name)
            for schema, writer in written.items():
                table = read_group_table(folder, schema)
                writer.append(kinds[schema].check(table) if schema in kinds else table)
            bar.update(len(rows[-1]))
    named_further = isinstance(plugin.module, DatasetWithSynonyms)
    synonyms = plugin.module.read_synonyms(plugin.options) if named_further else {}
    named = [{"class_name": name, "names": list(names)} for name, names in sorted(synonyms.items())]
    out.write_table(pa.Table.from_pylist(named, tables.SYNONYMS.arrow()), tables.SYNONYMS)
    table = pa.concat_tables(rows)
    _warn_of_sizes(plugin, table)
    return table


def _warn_of_sizes(plugin: plugins.Plugin, table: pa.Table) -> None:
    """Say where recordings whose camera can be named have sensors of several sizes: some may have been guessed."""
    if not hasattr(plugin.options, "sensor_size") or plugin.options.sensor_size is not None:
        return
    counted = table.group_by(["sensor_width_px", "sensor_height_px"]).aggregate([([], "count_all")]).to_pylist()
    if len(counted) > 1:
        sizes = ", ".join(
            f"{row['sensor_width_px']} x {row['sensor_height_px']} px ({row['count_all']})"
            for row in sorted(counted, key=lambda row: (row["sensor_width_px"], row["sensor_height_px"]))
        )
        logger.warning(
            "recordings are of sensors of %s, and each is drawn at its own scale. Files that do not state a size have "
            "the smallest common one that holds their events: if one camera recorded all, set "
            "dataset.options.sensor_size=[WIDTH,HEIGHT]", sizes,
        )  # fmt: skip


def _ingest_group(dataset: DatasetChoice, work: Path, numbered: tuple[int, Sequence[Recording]]) -> Path:
    return ingest_group(plugins.load_options(dataset), work, numbered)
