"""The report of an experiment: one self-contained page, its tables in other languages, and what they came from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ctlev_core.provenance.records import Record, read_records, write_provenance
from ctlev_core.provenance.scores import paired_samples, trace_lineage
from ctlev_core.realism.distances import DISTRIBUTIONS
from ctlev_core.report.inputs import ReportInputs
from ctlev_core.report.page.display_names import set_name
from ctlev_core.report.page.html import Chapter, Colours, Curves, Folded, Section, render_report
from ctlev_core.report.page.report_files import LATEX, MARKDOWN, PAGE, PROVENANCE
from ctlev_core.report.page.tables import Table, render_latex, render_markdown
from ctlev_core.report.sections import pictures
from ctlev_core.report.sections.colour_legends import all_colours
from ctlev_core.report.sections.contact_sheet import contact_sheet_sections
from ctlev_core.report.sections.costs import cost_table, versions_table
from ctlev_core.report.sections.data_split import recordings_table, told_openings, told_split
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
from ctlev_core.report.sections.sequences import sequence_sections
from ctlev_core.report.sections.training_curves import base_model_figures, loss_curves
from ctlev_core.report.sections.usefulness import usefulness_of, usefulness_sections
from ctlev_core.report.sections.verdict import Verdict, verdict
from ctlev_core.report.studies.paper_numbers import paper_section
from ctlev_core.report.studies.summary import Summary, write_summary
from ctlev_core.statistics.paired_differences import share_of_gain
from data_contracts import tables
from data_contracts.manifest import Manifest
from data_contracts.run_record import read_run_record
from data_contracts.training_sets import ORACLE, RECORDED, with_recorded

Row = dict[str, Any]
FEWEST_AMOUNTS = 3
"""Amounts of synthetic data that are worth a curve."""
CHECKPOINT_OF = "checkpoint of "


TABLES = ("scores", "samples", "realism", "recordings")
"""Written as Parquet beside the page."""


def write_report(
    made: ReportInputs[Manifest], folder: Path, openings: int | None = None, sequences: Manifest | None = None
) -> None:
    """Write `report.html`, `tables.tex`, `tables.md`, `TABLES`, `provenance.json` and `summary.json`.

    Args:
        made: what is shown.
        folder: to write to.
        openings: experiments that were scored on the same test frames so far; None = not known.
        sequences: stretches of consecutive frames, recorded and generated, in numbers; None leaves them out.
    """
    tested = made.target or made.frames
    told = [made.notice]
    if made.target is None:  # whose recordings are others
        told.append(told_split(made.recordings.column("splits"), tested.held_out))
    notice = " ".join(filter(None, [*told, told_openings(tested.held_out, openings)]))
    records = read_records([*_artefacts(made), *([("sequences", sequences.ref.path)] if sequences else [])])
    traced = trace_lineage([(one.ref.key, one.table) for one in made.scores], records)
    shown = {one.name: one.frames for one in made.generated}
    recorded = [made.frames, *(one for one in (made.oracle, made.target) if one is not None)]
    samples = paired_samples(_samples(made.scores, [*recorded, *shown.values()]))
    rows, paired = traced.to_pylist(), PairedScores(samples)
    words = _verdict(rows, made.training_sets, list(shown), paired)
    kind, colours = _drawn_as(made)
    own = next(iter(shown.values()))
    steps = pictures.steps(made.frames, made.frame_conditions, made.conditions, own, kind)
    grid, *other_grids = pictures.sample_grids(made.conditions, shown, recorded, colours)
    charts, moving = _charts(rows, _learnt_with(records)), pictures.motion(made.conditions, own)
    results, by_class = _results(rows, made.training_sets, list(shown), paired)
    quality = _Quality.of(made, rows, paired)
    in_time: Sequence[Section] = []
    if sequences is not None:
        in_time = sequence_sections(sequences, made.frames, made.conditions, shown, colours)
    alone = [] if in_time else moving
    page = render_report(
        title=made.title,
        lead=notice,
        verdict=words.headline,
        answer=words.answer,
        plain=plain_words(rows, words, len(made.frame_conditions), len(own), pictures.condition_in_words(kind)),
        details=words.details,
        steps=steps,
        colours=colours,
        sections=[
            Chapter("Did it help?", [*results, *charts, *_folded("Class by class", by_class)]),
            Chapter("What the frames look like", [grid, *other_grids, *alone, *_recorded_frames(made)]),
            Chapter("Sequences", in_time),
            Chapter("How good are they?", quality.sections()),
            Chapter("How they were made", _origins(made, records)),
            Chapter(
                "For reference",
                [
                    Folded("What exactly was run", [*record_tables(records), versions_table(records)]),
                    paper_section(),
                ],
            ),
        ],
    )
    (folder / PAGE).write_text(page, encoding="utf-8")
    kept = [
        table
        for table in (*results, *quality.about_frames, *by_class, *in_time, *quality.others)
        if isinstance(table, Table)
    ]
    (folder / LATEX).write_text(render_latex(kept, title=made.title, lead=notice), encoding="utf-8")
    (folder / MARKDOWN).write_text(
        render_markdown(kept, title=made.title, lead=notice, verdict=str(words)), encoding="utf-8"
    )
    write_provenance(folder / PROVENANCE, records)
    write_summary(folder, Summary(str(words), steps, grid, [*charts[:-1], *moving, *charts[-1:]], colours))
    written = traced, samples, _realism_table(made), made.recordings.table
    for name, table in zip(TABLES, written, strict=True):
        pq.write_table(table, folder / f"{name}.parquet", compression="zstd")


def _realism_table(made: ReportInputs[Manifest]) -> pa.Table:
    """Of events and of each generator's frames; the floors of the latter are among these."""
    return pa.concat_tables([made.event_realism.table, *(one.realism.table for one in made.generated)])


def _artefacts(made: ReportInputs[Manifest]) -> list[tuple[str, Path]]:
    """Role and folder of everything that is shown."""
    named = [
        ("recordings", made.recordings),
        ("frames", made.frames),
        ("conditions of frames", made.frame_conditions),
        ("conditions to sample from", made.conditions),
        *((f"{CHECKPOINT_OF}{one.name}", one.manifest) for one in made.checkpoints),
        *((f"frames of {one.name}", one.frames) for one in made.generated),
        *((f"model of {one.name}", one.manifest) for one in made.models),
        *((f"score of {_score_name(one)}", one) for one in made.scores),
        ("events of recordings", made.event_realism),
        ("recorded frames told apart", made.realism_floors),
        *((f"realism of {one.name}", one.realism) for one in made.generated),
        *((f"memorisation of {one.name}", one.memorisation) for one in made.generated),
        ("more recorded frames", made.oracle),
        ("target frames", made.target),
        ("nearest seen classes", made.nearest),
    ]
    return [(role, manifest.ref.path) for role, manifest in named if manifest is not None]


def _drawn_as(made: ReportInputs[Manifest]) -> tuple[str, Colours]:
    """Name of the condition plug-in, and what the colours of conditions and event images mean."""
    kind, options = _condition(made.frame_conditions)
    frames = made.frames
    event_image = np.asarray(frames.array("frames")[0]) if len(frames) else np.zeros((1, 1, 3), np.uint8)
    return kind, all_colours(kind, options, event_image)


def _results(
    rows: list[Row], training_sets: Sequence[str], names: list[str], paired: PairedScores
) -> tuple[Sequence[Section], Sequence[Section]]:
    """Tables of all classes, and of each."""
    results = score_tables(rows, training_sets, paired)
    origins, by_class = group_tables(rows, training_sets)
    return [*results, *origins, *baseline_tables(names, _first_metric(rows), paired)], by_class


def _recorded_frames(made: ReportInputs[Manifest]) -> list[Section | Folded]:
    return [
        pictures.real_grid(made.frames, made.target),
        *([] if made.nearest is None else nearest_sections(made.nearest)),
        *_folded(
            "What was learnt from, and asked for",
            contact_sheet_sections(made.frames, made.frame_conditions, made.conditions),
        ),
    ]


class _Quality(NamedTuple):
    """Tables on generated frames themselves."""

    about_frames: Sequence[Section]
    floors: Sequence[Section]
    realism: Sequence[Section]
    memorisation: Sequence[Section]
    rejections: Sequence[Section]
    usefulness: Sequence[Section]

    @classmethod
    def of(cls, made: ReportInputs[Manifest], rows: list[Row], paired: PairedScores) -> _Quality:
        realism, names = _realism_table(made).to_pylist(), [one.name for one in made.generated]
        of_generators = [one.realism for one in made.generated]
        distributions = [one.attached(DISTRIBUTIONS) for one in (made.event_realism, *of_generators)]
        tests = [made.realism_floors.table, *(one.attached(tables.TWO_SAMPLE_TESTS) for one in of_generators)]
        frames, memorised = ([getattr(one, name) for one in made.generated] for name in ("frames", "memorisation"))
        return cls(
            frame_tables(rows),
            floor_tables(made.scores),
            realism_sections(realism, *(pa.concat_tables(parts).to_pylist() for parts in (distributions, tests))),
            memorisation_sections(made.frames, frames, memorised),
            rejection_sections({one.name: one.frames for one in made.generated}),
            usefulness_sections(usefulness_of(rows, realism, names, paired)),
        )

    @property
    def others(self) -> list[Section]:
        return [*self.usefulness, *self.floors, *self.memorisation, *self.rejections]

    def sections(self) -> list[Section | Folded]:
        return [
            *self.about_frames,
            *_folded("How to read the distances", self.floors),
            *self.realism[:1],
            *_folded("More on how real frames look", self.realism[1:]),
            *self.memorisation[:1],
            *_folded("Closest pairs of generated and training frames", self.memorisation[1:]),
            *self.rejections,
            *self.usefulness,
        ]


def _origins(made: ReportInputs[Manifest], records: Sequence[Record]) -> list[Section | Folded]:
    models, names = [one.manifest for one in made.models], [one.name for one in made.models]
    return [
        lineage_diagram(records),
        *(
            loss_curves(f"Training of the generator: {set_name(one.name)}", [one.manifest], [one.name])
            for one in made.checkpoints
        ),
        *_folded("Downstream training", [loss_curves("Downstream training", models, names)]),
        *_folded("Recordings", [recordings_table(made.recordings, made.frames)]),
        *_folded("Where the time went", [cost_table(records)]),
    ]


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
    return {
        record.role.removeprefix(CHECKPOINT_OF): record.arguments["generator"]["options"]
        for record in records
        if record.role.startswith(CHECKPOINT_OF) and "generator" in record.arguments
    }


def _score_name(manifest: Manifest) -> str:
    first = manifest.table.slice(0, 1).to_pylist()[0]
    return f"{first['subject']}, seed {first['seed']}" + (", distance" if first["task"] == "distance" else "")


def _condition(conditions: Manifest) -> tuple[str, dict[str, Any]]:
    """Name and options of the condition plug-in that made them."""
    made_by = read_run_record(conditions.ref.path).arguments["condition"]
    return made_by["plugin"].rpartition("/")[2], made_by["options"]


def _samples(scores: Sequence[Manifest], data: Sequence[Manifest]) -> Iterator[tuple[list[Row], pa.Table, str]]:
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
