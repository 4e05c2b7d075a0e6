"""The page over several experiments: the paper's five tables, each from the experiment that asks its question."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from ctlev_core.report.page.display_names import Name, metric_heading, metric_name, subject_name
from ctlev_core.report.page.html import Chapter, Folded, Section, Text
from ctlev_core.report.page.tables import Cell, Table
from ctlev_core.report.sections.score_tables import PairedScores, cell_text, score_tables, trained_rows
from ctlev_core.report.sections.usefulness import usefulness_of, usefulness_overview
from ctlev_core.report.sections.verdict import made_better
from ctlev_core.report.studies import paper_numbers
from ctlev_core.report.studies.speed_summary import SpeedSummary
from ctlev_core.report.studies.summary import Summary
from ctlev_core.scoring.score_info import find_score
from ctlev_core.statistics.paired_differences import Difference
from data_contracts.training_sets import RECORDED, SYNTHETIC, with_recorded

Row = dict[str, Any]
_QUESTIONS = (
    ("binary_accuracy", "Zero-shot recognition", paper_numbers.ZERO_SHOT),
    ("accuracy", "Object recognition", paper_numbers.CLASSIFICATION),
    ("mpjpe2d", "2D pose", paper_numbers.POSE_2D),
    ("mpjpe3d", "3D body", paper_numbers.BODY_3D),
)
"""What an experiment asks, by a score that begins so; the first that any of its scores begins with."""
_COMPARED = (RECORDED, SYNTHETIC, with_recorded(SYNTHETIC))


@dataclass(frozen=True, eq=False)
class Part:
    """One experiment of a study.

    Attributes:
        name: its name in the study.
        rows: of the table `scores`.
        training_sets: what was trained on, in the order of the tables.
        generators: whose frames were compared, its own first.
        paired: its scores sample by sample.
        summary: of its report.
        realism: rows of the table `realism`.
    """

    name: str
    rows: list[Row]
    training_sets: Sequence[str]
    generators: Sequence[str]
    paired: PairedScores
    summary: Summary
    realism: Sequence[Row] = ()

    @property
    def compares(self) -> bool:
        """Was anything trained on synthetic frames? If not, it is here for its samples and figures."""
        return any(training_set != RECORDED for training_set in self.training_sets)

    @property
    def heading(self) -> str:
        """How the sections about it begin."""
        name = self.name.replace("_", " ")
        return f"{self.question} ({name})" if name != self.question else name

    @property
    def question(self) -> str:
        """What it asks, in two words."""
        return self._asked[0]

    @property
    def published(self) -> Table | None:
        """The paper's answer, on other data."""
        return self._asked[1]

    @cached_property
    def metric(self) -> str:
        """The score that its verdict is about; empty where nothing was trained."""
        return next((row["metric"] for row in trained_rows(self.rows)), "")

    @cached_property
    def difference(self) -> Difference | None:
        """Trained on recorded and synthetic frames minus on recorded ones alone, in that score."""
        return self.paired.difference(RECORDED, with_recorded(SYNTHETIC), self.metric)

    @property
    def _asked(self) -> tuple[str, Table | None]:
        metrics = [row["metric"] for row in trained_rows(self.rows)]
        for start, question, published in _QUESTIONS:
            if any(metric.startswith(start) for metric in metrics):
                return question, published
        return self.name.replace("_", " "), None


def study_plain(parts: Sequence[Part]) -> list[tuple[str, str]]:
    """What a study is, and how its intervals are read, (heading, paragraph) each, for a reader new to events."""
    compared = sum(part.compares for part in parts)
    return [
        (
            "What was done",
            "An event camera reports, pixel by pixel, when it gets brighter or darker. In each experiment a generator "
            "learnt from recorded event images and what is known of them, and made synthetic ones for other labels. In "
            f"{compared} of {len(parts)} experiments models were then trained on recorded images and with synthetic "
            "ones, and tested on recorded images that nothing was trained on.",
        ),
        (
            "How sure is it?",
            "Brackets hold 95 % intervals. Where the interval of a difference does not contain 0, chance alone seldom "
            "gives such a difference; where it does, the difference may be chance.",
        ),
    ]


def study_words(parts: Sequence[Part]) -> str:
    """A paragraph for each experiment that trained on synthetic frames."""
    return "\n\n".join(f"{part.heading}: {part.summary.verdict}" for part in parts if part.compares)


def study_overview(parts: Sequence[Part]) -> Table:
    """A row for each experiment that trained on synthetic frames: its first score without them, of them, and with."""
    body: list[list[Cell]] = []
    bold: set[tuple[int, int]] = set()
    explained: dict[str, str] = {}
    for part in parts:
        if not part.compares:
            continue
        rows = [row for row in trained_rows(part.rows) if row["group"] == "all" and row["metric"] == part.metric]
        by_set = {name: [row for row in rows if row["subject"] == name] for name in _COMPARED}
        difference = part.difference
        if difference is not None and difference.is_certain:
            bold.add((len(body), 5))
            if made_better(difference, part.metric):
                bold.add((len(body), 4))
        told = "" if difference is None else difference.text()
        body.append([part.heading, metric_heading(part.metric), *map(cell_text, by_set.values()), told])
        if find_score(part.metric).meaning:
            explained[part.metric] = find_score(part.metric).meaning
    caption = (
        "Models trained on recorded frames, on synthetic ones and on both, all tested on recorded frames that nothing "
        "was trained on; ↓ less is better, ↑ more is. In brackets 95 % intervals. Bold: differences, frame by frame, "
        "whose interval excludes 0, and scores that are better for it."
    )
    columns = ["experiment", "score", "recorded", "synthetic", "both", "both minus recorded"]
    notes = [f"{metric_name(metric)}: {words}" for metric, words in explained.items()]
    return Table("Do synthetic frames help?", columns, body, caption=caption, bold=bold, footnotes=notes)


def study_verdict(parts: Sequence[Part]) -> str:
    """One sentence, where two experiments or more can say by their intervals whether synthetic frames helped."""
    found: dict[bool | None, list[str]] = {True: [], False: [], None: []}
    for part in parts:
        if part.difference is not None and not math.isnan(part.difference.low):
            found[made_better(part.difference, part.metric)].append(part.heading)
    total = sum(len(headings) for headings in found.values())
    if total < 2:
        return ""
    told = ((True, "helped"), (False, "did harm"), (None, "made no difference that can be told"))
    clauses = [f"{what} in {len(found[key])} of {total}: {', '.join(found[key])}" for key, what in told if found[key]]
    return f"By 95 % intervals, adding synthetic frames to recorded ones {'; it '.join(clauses)}."


def study_tables(parts: Sequence[Part]) -> list[list[Table]]:
    """The tables of scores of each experiment that the page shows; in the last list those of all together."""
    found = []
    for part in parts:
        tables = score_tables(part.rows, part.training_sets, part.paired) if part.compares else []
        found.append([replace(table, title=f"{part.heading}: {table.title}") for table in tables])
    return [*found, [distances_table(parts)]]


def study_chapters(parts: Sequence[Part], tables: Sequence[Sequence[Table]]) -> list[Chapter]:
    """Of each experiment its tables, its samples, its figures and the paper's numbers; then the distances of all."""
    chapters = []
    for part, shown in zip(parts, tables, strict=False):
        sections: list[Section | Folded] = [_untitled(part.heading, table) for table in shown]
        sections.append(part.summary.grid)
        sections += part.summary.figures
        sections += _published(part.published) if part.compares else []
        chapters.append(Chapter(part.heading, sections))
    return [*chapters, Chapter("All experiments", [*tables[-1], *_published(paper_numbers.DISTANCES)])]


def _untitled(heading: str, table: Table) -> Table:
    """With the title it has on the experiment's own page."""
    return replace(table, title=table.title.removeprefix(f"{heading}: "))


def usefulness_tables(parts: Sequence[Part]) -> list[Table]:
    """Which number ranks generators as their gains do, where two experiments or more compare enough of them."""
    found = [(part.heading, usefulness_of(part.rows, part.realism, part.generators, part.paired)) for part in parts]
    known = [(heading, one) for heading, one in found if one is not None]
    return [usefulness_overview(known)] if len(known) > 1 else []


def speed_sections(parts: Sequence[Part], speed: SpeedSummary) -> list[Section | Folded]:
    """What is recommended, with a chart that says why; further charts and every setting behind a fold."""
    table = speed_table(parts, speed)
    sections: list[Section | Folded] = [Text(f"Speed against error: {_heading(parts, speed)}", speed.recommendation)]
    for chart in speed.charts[:1]:
        sections.append(replace(chart, title=f"Speed against error: {chart.title[:1].lower()}{chart.title[1:]}"))
    others = speed.charts[1:]
    shown = [*others, replace(table, title="Costs and errors")] if others else [table]
    return [*sections, Folded(table.title, shown)]


def speed_table(parts: Sequence[Part], speed: SpeedSummary) -> Table:
    """Costs and errors of every setting of the sampler."""
    return replace(speed.settings, title=f"Speed against error, every setting: {_heading(parts, speed)}")


def _heading(parts: Sequence[Part], speed: SpeedSummary) -> str:
    (part,) = (part for part in parts if part.name == speed.experiment)
    return part.heading


def _published(table: Table | None) -> list[Folded]:
    caption = (
        "Other data, another base model, other sizes: not comparable with the numbers above. It gives no intervals."
    )
    return [] if table is None else [Folded(table.title, [table], caption)]


def _first_distance(rows: Sequence[Row]) -> list[Row]:
    """Of several Frechet distances the first: extrapolated ones, and those to other frames, are other scores."""
    found = [row for row in rows if row["task"] == "distance" and row["metric"].startswith(("fd", "fid"))]
    return [row for row in found if row["metric"] == found[0]["metric"]]


def distances_table(parts: Sequence[Part]) -> Table:
    """Generators down, experiments across: the layout of the paper's Table 4."""
    distances = [_first_distance(part.rows) for part in parts]
    training_sets = list(dict.fromkeys(row["subject"] for rows in distances for row in rows))
    body: list[list[Cell]] = [
        [
            subject_name(training_set),
            *(cell_text([row for row in rows if row["subject"] == training_set]) for rows in distances),
        ]
        for training_set in training_sets
    ]
    caption = (
        "Frechet distance to the recorded training frames, in features of a classifier trained on recorded events, "
        "another one for each experiment, so that only numbers below one another compare. Lower is nearer; the row of "
        "held-out recorded frames is the floor. In brackets 95 %."
    )
    return Table(
        "Quality of the frames",
        ["frames", *(Name(f"{part.heading} ↓", part.name) for part in parts)],
        body,
        caption=caption,
    )
