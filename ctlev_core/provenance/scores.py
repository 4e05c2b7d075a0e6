"""Scores with the digests that trace each of them to options, data and code, and scores of samples to be compared."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core.provenance.records import Record, behind, options_of, versions_of
from data_contracts import tables
from data_contracts.run_record import digest_of
from data_contracts.tables import Column, TableSchema

Row = dict[str, Any]
_DIGESTS = pa.list_(pa.string())
GENERATOR_STAGES = ("finetune", "train_motion_layers", "distill")
"""Stages whose artefacts are generators."""
SCORE_LINEAGE = TableSchema(
    "score_lineage",
    1,
    None,
    (
        *(replace(column) for column in tables.SCORES.columns),
        Column("score_digest", pa.string(), "manifest digest of the artefact this row is of"),
        Column("split", pa.string(), "split of the data it was scored on"),
        Column("training_digests", _DIGESTS, "manifest digests of the sets of frames the model learnt from"),
        Column("checkpoint_digests", _DIGESTS, "manifest digests of the generators that made them, if any"),
        Column("recordings_digests", _DIGESTS, "manifest digests of all recordings behind it"),
        Column("config_digest", pa.string(), "SHA-256 of the options of every stage behind it"),
        Column("code_digest", pa.string(), "SHA-256 of the versions of stages, plug-ins and software behind it"),
    ),
)
"""The table `scores` with what its numbers stem from. `provenance.json` says what every digest stands for."""

PAIRED_SAMPLES = TableSchema(
    "paired_samples",
    2,
    None,
    (
        Column("subject", pa.string(), "what the model was trained on"),
        Column("metric", pa.string(), "the score that is the mean of these values by their weights"),
        Column("training", pa.int32(), "number of the training within its subject", minimum=0),
        Column("sample_id", pa.string(), "the join key"),
        Column("recording_id", pa.string(), "its recording"),
        Column("value", pa.float64(), "score of this sample; missing where it has none", nullable=True),
        Column("weight", pa.float64(), "of the sample in the mean", minimum=0),
        Column("samples_digest", pa.string(), "SHA-256 of all samples scored together, images and labels"),
    ),
)


def trace_lineage(scores: Sequence[tuple[str, pa.Table]], records: Sequence[Record]) -> pa.Table:
    """All scores in one table of the schema `SCORE_LINEAGE`.

    Args:
        scores: (key, table) of each artefact of scores.
        records: of these artefacts and of everything behind them.
    """
    by_key = {record.key: record for record in records}
    parts = []
    for key, table in scores:
        record, origin = by_key[key], behind(records, key)
        learnt = [by_key[name] for name in _keys(record.arguments.get("training_sets"))]
        extra = {
            "score_digest": record.digest,
            "split": str(record.arguments.get("split", "")),
            "training_digests": [one.digest for one in learnt],
            "checkpoint_digests": sorted(
                {one.digest for set_ in learnt for stage in GENERATOR_STAGES for one in _of(records, set_, stage)}
            ),
            "recordings_digests": sorted({one.digest for one in _of(records, record, "ingest")}),
            # By text: an option can be a number in one stage and null in another.
            "config_digest": digest_of(
                sorted(json.dumps([one.stage, options_of(one)], sort_keys=True) for one in origin)
            ),
            "code_digest": digest_of(versions_of(origin)),
        }
        columns = {name: table[name] for name in table.column_names}
        for column in SCORE_LINEAGE.columns:
            if column.name in extra:
                columns[column.name] = pa.array([extra[column.name]] * len(table), column.type)
        parts.append(pa.table(columns).select([column.name for column in SCORE_LINEAGE.columns]))
    return pa.concat_tables([part.cast(SCORE_LINEAGE.arrow()) for part in parts])


def _keys(value: Any) -> list[str]:
    return [item["manifest"] for item in value or []]


def _of(records: Sequence[Record], record: Record, stage: str) -> list[Record]:
    return [one for one in behind(records, record.key) if one.stage == stage]


def paired_samples(scored: Iterable[tuple[list[Row], pa.Table, str]]) -> pa.Table:
    """The scores of single samples of all trainings, in one table of the schema `PAIRED_SAMPLES`.

    Args:
        scored: for each training and test set the rows of `scores`, the table `sample_scores`, and a digest of the
            samples.
    """
    parts: list[pa.Table] = []
    counts: dict[tuple[str, str], int] = {}
    for rows, samples, digest in scored:
        subject = rows[0]["subject"]
        names = np.array(samples["metric"].to_pylist())
        for metric in dict.fromkeys(names.tolist()):
            column = samples.filter(pa.array(names == metric))
            number = counts.get((subject, metric), 0)
            counts[subject, metric] = number + 1
            same = {"subject": subject, "metric": metric, "training": number, "samples_digest": digest}
            columns = {name: column[name] for name in ("sample_id", "recording_id", "value", "weight")}
            types = {one.name: one.type for one in PAIRED_SAMPLES.columns}
            columns |= {name: pa.array([value] * len(column), types[name]) for name, value in same.items()}
            parts.append(pa.table(columns).select(list(types)))
    empty = PAIRED_SAMPLES.arrow().empty_table()
    return pa.concat_tables([empty, *(part.cast(PAIRED_SAMPLES.arrow()) for part in parts)])
