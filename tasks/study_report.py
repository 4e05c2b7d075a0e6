"""One page over the reports of several experiments."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from ctlev_core.report.page.html import Chapter, Folded, Links, Text, render_report
from ctlev_core.report.page.report_files import LATEX, MARKDOWN, PAGE, published_files
from ctlev_core.report.page.tables import render_latex, render_markdown
from ctlev_core.report.sections.score_tables import PairedScores
from ctlev_core.report.studies.pooled import Group, pool_parts, pooled_sections, pooled_tables, pooled_verdict
from ctlev_core.report.studies.speed_summary import read_speed_summary
from ctlev_core.report.studies.study import (
    Part,
    distances_table,
    speed_sections,
    speed_table,
    study_chapters,
    study_overview,
    study_plain,
    study_tables,
    study_verdict,
    study_words,
    usefulness_tables,
)
from ctlev_core.report.studies.summary import read_summary
from data_contracts import tables
from data_contracts.manifest import Manifest
from data_contracts.study import SPEED_VS_ERROR
from tasks.stage import Output, stage


@stage(version=15, schema=tables.REPORT)
def study_report(
    out: Output,
    reports: list[Manifest],
    *,
    title: str,
    notice: str,
    names: Sequence[str],
    training_sets: Sequence[Sequence[str]],
    generator_names: Sequence[Sequence[str]],
    pooled: Sequence[tuple[str, Sequence[str]]] = (),
    num_generators: Sequence[int] = (),
    own_tests: bool = False,
) -> pa.Table:
    """Write `report.html`, `tables.tex` and `tables.md` over all experiments, and into a folder each what they report.

    Args:
        out: where.
        reports: of the experiments; then that on speed against error, if it was measured on one of them.
        title: of the page; its links lead to the folder of that name, where the pages are published.
        notice: first line.
        names: of the experiments, likewise the following.
        training_sets: what was trained on.
        generator_names: whose frames were compared, the experiment's own first.
        pooled: groups of experiments that differ in their draw of training recordings: names of the group and of these.
        num_generators: fine-tunings in each experiment; needed where some are pooled.
        own_tests: experiments of a group have test recordings of their own.

    Raises:
        DrawsDiffer: experiments of a group were tested on different samples, or, with `own_tests`, on the same.
    """
    parts = [
        _part(report.ref.path, name, trained, generators)
        for report, name, trained, generators in zip(
            reports[: len(names)], names, training_sets, generator_names, strict=True
        )
    ]
    measured = [read_speed_summary(report.ref.path) for report in reports[len(names) :]]
    folders = [*names, *(SPEED_VS_ERROR for _ in measured)]
    groups = _groups(reports, parts, pooled, num_generators, own_tests=own_tests)
    inside = {part.name for group in groups for part in group.parts}
    # Of a group, the page shows the samples of one experiment, and links to all.
    alone = [part for part in parts if part.name not in inside]
    shown, overview = study_tables(alone), study_overview(alone)
    verdict, words = study_verdict(alone), study_words(alone)
    scores = pooled_tables(groups) if groups else []
    if groups:
        shown[-1] = [distances_table([*(group.parts[0] for group in groups), *alone])]
    useful = usefulness_tables(alone)
    links = [(part.heading, f"{title}/{part.name}/{PAGE}") for part in parts]
    links += [
        (f"Speed against error ({speed.experiment.replace('_', ' ')})", f"{title}/{SPEED_VS_ERROR}/{PAGE}")
        for speed in measured
    ]
    page = render_report(
        title=title,
        lead=notice,
        verdict="\n\n".join(filter(None, (pooled_verdict(groups), verdict or words))),
        overview=scores[0] if scores else overview,
        plain=study_plain(parts),
        steps=parts[0].summary.steps,
        colours=parts[0].summary.colours,
        sections=[
            Chapter("Draws together" if own_tests else "By the number of recordings", pooled_sections(groups, scores)),
            *([overview] if groups and overview.rows else []),
            *useful,
            *study_chapters(alone, shown),
            *(Chapter("Speed against error", speed_sections(parts, speed)) for speed in measured),
            Chapter(
                "More",
                [
                    *([Folded("The same in words", [Text("", words)])] if verdict else []),
                    Links("Everything else, experiment by experiment", links),
                ],
            ),
        ],
    )
    (out.folder / PAGE).write_text(page, encoding="utf-8")
    kept = (
        scores
        + ([overview] if overview.rows or not groups else [])
        + useful
        + [table for of_part in shown for table in of_part]
        + [speed_table(parts, speed) for speed in measured]
    )
    (out.folder / LATEX).write_text(render_latex(kept, title=title, lead=notice), encoding="utf-8")
    told = "\n\n".join(filter(None, (pooled_verdict(groups), verdict, words)))
    (out.folder / MARKDOWN).write_text(render_markdown(kept, title=title, lead=notice, verdict=told), encoding="utf-8")
    files = []
    for name, report in zip(folders, reports, strict=True):
        (out.folder / name).mkdir()
        for path in published_files(report.ref.path):
            files.append(f"{name}/{path.name}")
            shutil.copyfile(path, out.folder / files[-1])
    found = [file for file in files if file.endswith(".parquet")]
    return pa.table({"table": [file.removesuffix(".parquet") for file in found], "file": found})


def _groups(
    reports: Sequence[Manifest],
    parts: Sequence[Part],
    pooled: Sequence[tuple[str, Sequence[str]]],
    num_generators: Sequence[int],
    *,
    own_tests: bool,
) -> list[Group]:
    """The groups, with the scores of single samples of their experiments."""
    places = {part.name: number for number, part in enumerate(parts)}
    found = []
    for name, members in pooled:
        numbers = [places[member] for member in members]
        samples = [pq.read_table(reports[number].ref.path / "samples.parquet") for number in numbers]
        members_parts = [parts[number] for number in numbers]
        found.append(pool_parts(name, members_parts, samples, num_generators[numbers[0]], own_tests=own_tests))
    return found


def _part(folder: Path, name: str, training_sets: Sequence[str], generators: Sequence[str]) -> Part:
    paired = PairedScores(pq.read_table(folder / "samples.parquet"))
    rows, realism = (pq.read_table(folder / f"{table}.parquet").to_pylist() for table in ("scores", "realism"))
    return Part(name, rows, training_sets, generators, paired, read_summary(folder), realism)
