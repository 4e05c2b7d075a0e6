"""One self-contained HTML page of the experiment, its tables in other languages, and where every number came from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ctlev_core.provenance.records import Record, read_records, write_provenance
from ctlev_core.provenance.scores import paired_samples, trace_lineage
from ctlev_core.realism.distances import DISTRIBUTIONS
from ctlev_core.realism.two_sample import TWO_SAMPLE_TESTS
from ctlev_core.report.page.display_names import set_name
from ctlev_core.report.page.html import Chapter, Curves, Folded, Section, render_report
from ctlev_core.report.page.report_files import LATEX, MARKDOWN, PAGE, PROVENANCE
from ctlev_core.report.page.tables import Table, render_latex, render_markdown
from ctlev_core.report.sections import pictures
from ctlev_core.report.sections.colour_legends import all_colours
from ctlev_core.report.sections.contact_sheet import contact_sheet_sections
from ctlev_core.report.sections.costs import cost_table, versions_table
from ctlev_core.report.sections.data_split import recordings_table, told_split
from ctlev_core.report.sections.distances import floor_tables
from ctlev_core.report.sections.lineage import lineage_diagram, record_tables
from ctlev_core.report.sections.memorisation import memorisation_sections
from ctlev_core.report.sections.nearest_classes import nearest_sections
from ctlev_core.report.sections.plain_words import plain_words
from ctlev_core.report.sections.realism import realism_sections
from ctlev_core.report.sections.rejections import rejection_sections
from ctlev_core.report.sections.scaling import scaling_figure, scaling_points
from ctlev_core.report.sections.score_tables import (
    PairedScores,
    baseline_tables,
    frame_tables,
    group_tables,
    score_tables,
    trained_rows,
)
from ctlev_core.report.sections.training_curves import base_model_figures, loss_curves
from ctlev_core.report.sections.verdict import Verdict, verdict
from ctlev_core.report.studies.paper_numbers import paper_section
from ctlev_core.report.studies.summary import Summary, write_summary
from ctlev_core.statistics.paired_differences import share_of_gain
from data_contracts import tables
from data_contracts.manifest import Manifest
from data_contracts.run_record import read_run_record
from data_contracts.training_sets import ORACLE, RECORDED, with_recorded
from tasks.stage import Output, stage

Row = dict[str, Any]
FEWEST_AMOUNTS = 3
"""Amounts of synthetic data that are worth a curve."""


@stage(version=19, schema=tables.REPORT)
def report(
    out: Output,
    recordings: Manifest,
    frames: Manifest,
    frame_conditions: Manifest,
    conditions: Manifest,
    checkpoints: list[Manifest],
    generated: list[Manifest],
    scores: list[Manifest],
    models: list[Manifest],
    realism: Manifest,
    memorisation: list[Manifest],
    oracle: Manifest | None = None,
    target: Manifest | None = None,
    nearest: Manifest | None = None,
    *,
    title: str,
    notice: str,
    training_sets: Sequence[str],
    generator_names: Sequence[str],
    checkpoint_names: Sequence[str],
    model_names: Sequence[str],
) -> pa.Table:
    """Write `report.html`, `tables.tex`, `tables.md`, four tables as Parquet, `provenance.json` and `summary.json`.

    `generated` are the frames of each generator: first the experiment's own, called `synthetic`, then the baselines; of
    several sets of one name the first is shown. `oracle` are other recorded frames of the moments asked for, `target`
    those of another dataset that was tested on, `nearest` what of the training set is most like its classes.
    """
    if target is None:  # whose recordings are others
        notice = f"{notice} {told_split(recordings.column('splits'))}".strip()
    shown = dict(reversed(list(zip(generator_names, generated, strict=True))))
    shown = {name: shown[name] for name in dict.fromkeys(generator_names)}
    records = read_records(
        [
            ("recordings", recordings.ref.path),
            ("frames", frames.ref.path),
            ("conditions of frames", frame_conditions.ref.path),
            ("conditions to sample from", conditions.ref.path),
            *_roles("checkpoint of", checkpoint_names, checkpoints),
            *_roles("frames of", generator_names, generated),
            *_roles("model of", model_names, models),
            *_roles("score of", [_score_name(manifest) for manifest in scores], scores),
            ("realism", realism.ref.path),
            *_roles("memorisation of", generator_names, memorisation),
            *([] if oracle is None else [("more recorded frames", oracle.ref.path)]),
            *([] if target is None else [("target frames", target.ref.path)]),
            *([] if nearest is None else [("nearest seen classes", nearest.ref.path)]),
        ]
    )
    traced = trace_lineage([(manifest.ref.key, manifest.table) for manifest in scores], records)
    real = [frames, *(manifest for manifest in (oracle, target) if manifest is not None)]
    samples = paired_samples(_samples(scores, [*real, *generated]))
    rows, paired = traced.to_pylist(), PairedScores(samples)
    own = next(iter(shown.values()))
    kind, options = _condition(frame_conditions)
    event_image = np.asarray(frames.array("frames")[0]) if len(frames) else np.zeros((1, 1, 3), np.uint8)
    colours = all_colours(kind, options, event_image)
    results = score_tables(rows, training_sets, paired)
    origins, by_class = group_tables(rows, training_sets)
    results += [*origins, *baseline_tables(list(shown), _first_metric(rows), paired)]
    about_frames, floors = frame_tables(rows), floor_tables(scores)
    copied = memorisation_sections(frames, generated, memorisation)
    distributions, tests = (realism.attached(schema).to_pylist() for schema in (DISTRIBUTIONS, TWO_SAMPLE_TESTS))
    looks = realism_sections(realism.table.to_pylist(), distributions, tests)
    refused = rejection_sections(shown)
    words = _verdict(rows, training_sets, list(shown), paired)
    steps = pictures.steps(frames, frame_conditions, conditions, own, kind)
    grid, *other_grids = pictures.sample_grids(conditions, shown, real, colours)
    charts, moving = _charts(rows, _learnt_with(records)), pictures.motion(conditions, own)
    write_summary(out.folder, Summary(str(words), steps, grid, [*charts[:-1], *moving, *charts[-1:]], colours))
    page = render_report(
        title=title,
        lead=notice,
        verdict=words.headline,
        answer=words.answer,
        plain=plain_words(rows, words, len(frame_conditions), len(own), pictures.condition_in_words(kind)),
        details=words.details,
        steps=steps,
        colours=colours,
        sections=[
            Chapter("Did it help?", [*results, *charts, *_folded("Class by class", by_class)]),
            Chapter(
                "What the frames look like",
                [
                    grid,
                    *other_grids,
                    *moving,
                    pictures.real_grid(frames, target),
                    *([] if nearest is None else nearest_sections(nearest)),
                    *_folded(
                        "What was learnt from, and asked for",
                        contact_sheet_sections(frames, frame_conditions, conditions),
                    ),
                ],
            ),
            Chapter(
                "How good are they?",
                [
                    *about_frames,
                    *_folded("How to read the distances", floors),
                    *looks[:1],
                    *_folded("More on how real frames look", looks[1:]),
                    *copied[:1],
                    *_folded("Closest pairs of generated and training frames", copied[1:]),
                    *refused,
                ],
            ),
            Chapter(
                "How they were made",
                [
                    lineage_diagram(records),
                    *(
                        loss_curves(f"Training of the generator: {set_name(name)}", [checkpoint], [name])
                        for name, checkpoint in zip(checkpoint_names, checkpoints, strict=True)
                    ),
                    *_folded("Downstream training", [loss_curves("Downstream training", models, model_names)]),
                    *_folded("Recordings", [recordings_table(recordings, frames)]),
                    *_folded("Where the time went", [cost_table(records)]),
                ],
            ),
            Chapter(
                "For reference",
                [
                    Folded("What exactly was run", [*record_tables(records), versions_table(records)]),
                    paper_section(),
                ],
            ),
        ],
    )
    (out.folder / PAGE).write_text(page, encoding="utf-8")
    kept = [
        table for table in (*results, *about_frames, *by_class, *floors, *copied, *refused) if isinstance(table, Table)
    ]
    (out.folder / LATEX).write_text(render_latex(kept, title=title, lead=notice), encoding="utf-8")
    (out.folder / MARKDOWN).write_text(
        render_markdown(kept, title=title, lead=notice, verdict=str(words)), encoding="utf-8"
    )
    write_provenance(out.folder / PROVENANCE, records)
    parquet = {"scores": traced, "samples": samples, "realism": realism.table, "recordings": recordings.table}
    for name, table in parquet.items():
        pq.write_table(table, out.folder / f"{name}.parquet", compression="zstd")
    return pa.table({"table": list(parquet), "file": [f"{name}.parquet" for name in parquet]})


def _first_metric(rows: list[Row]) -> str:
    return next((row["metric"] for row in trained_rows(rows)), "")


def _charts(rows: list[Row], learnt_with: dict[str, dict[str, Any]]) -> list[Curves]:
    metric = _first_metric(rows)
    points = scaling_points(rows, metric)
    return [
        *base_model_figures(rows, learnt_with, metric),
        *([scaling_figure(points, metric)] if len({point.ratio for point in points}) >= FEWEST_AMOUNTS else []),
    ]


def _verdict(rows: list[Row], training_sets: Sequence[str], names: list[str], paired: PairedScores) -> Verdict:
    metric = _first_metric(rows)
    own, *others = names
    beside = {other: paired.difference(with_recorded(other), with_recorded(own), metric) for other in others}
    gain = paired.difference(RECORDED, with_recorded(ORACLE), metric)
    trainings = [
        paired.of(training_set, metric) for training_set in (RECORDED, with_recorded(own), with_recorded(ORACLE))
    ]
    start, reached, most = trainings
    oracle = None
    if gain is not None and start is not None and reached is not None and most is not None:
        oracle = gain, share_of_gain(start, reached, most)
    added, instead = (paired.difference(RECORDED, training_set, metric) for training_set in (with_recorded(own), own))
    return verdict(rows, training_sets, added, beside, oracle, instead)


def _learnt_with(records: Sequence[Record]) -> dict[str, dict[str, Any]]:
    """Options of each generator that learnt, by its name."""
    prefix = "checkpoint of "
    return {
        record.role.removeprefix(prefix): record.arguments["generator"]["options"]
        for record in records
        if record.role.startswith(prefix) and "generator" in record.arguments
    }


def _roles(role: str, names: Sequence[str], manifests: Sequence[Manifest]) -> list[tuple[str, Path]]:
    return [(f"{role} {name}", manifest.ref.path) for name, manifest in zip(names, manifests, strict=True)]


def _score_name(manifest: Manifest) -> str:
    first = manifest.table.slice(0, 1).to_pylist()[0]
    return f"{first['subject']}, seed {first['seed']}" + (", distance" if first["task"] == "distance" else "")


def _condition(conditions: Manifest) -> tuple[str, dict[str, Any]]:
    """Name and options of the condition plug-in that made them."""
    made_by = read_run_record(conditions.ref.path).arguments["condition"]
    return made_by["plugin"].rpartition("/")[2], made_by["options"]


def _samples(scores: list[Manifest], data: list[Manifest]) -> Iterator[tuple[list[Row], pa.Table, str]]:
    """Rows, sample scores, and a digest of the samples, of each manifest of scores that has such."""
    by_digest = {manifest.ref.digest: manifest for manifest in data}
    digests: dict[tuple[str, tuple[str, ...]], str] = {}
    for manifest in scores:
        if f"{tables.SAMPLE_SCORES.name}.parquet" not in manifest.files:
            continue
        rows, samples = manifest.table.to_pylist(), manifest.attached(tables.SAMPLE_SCORES)
        names = tuple(dict.fromkeys(samples["sample_id"].to_pylist()))
        of_data = rows[0]["data_digest"]
        if (of_data, names) not in digests:
            scored = by_digest.get(of_data)
            digests[of_data, names] = of_data if scored is None else _content_digest(scored, names)
        yield rows, samples, digests[of_data, names]


def _content_digest(data: Manifest, names: Sequence[str]) -> str:
    """SHA-256 of images and labels of some rows, whatever else the manifest holds."""
    rows_of = {name: row for row, name in enumerate(data.column("sample_id"))}
    rows = np.array([rows_of[name] for name in names], np.int64)
    digest, frames, labels = hashlib.sha256(), data.array("frames"), data.labels.take(rows)
    for row in rows:
        digest.update(np.ascontiguousarray(frames[row]).tobytes())
    for name, array in sorted(labels.arrays.items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(json.dumps([list(names), list(labels.class_names), labels.joint_set]).encode())
    return digest.hexdigest()


def _folded(title: str, sections: Sequence[Section]) -> list[Folded]:
    return [Folded(title, sections)] if sections else []
