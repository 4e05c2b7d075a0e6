"""Groups of experiments that differ in their draw of training recordings alone, told as one column each.

The page of a study with groups begins with them: whether synthetic frames helped, every training set's score, the
differences that matter, and accuracy over the number of recordings.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pyarrow as pa

from ctlev_core.report.page.display_names import SOURCES, Name, metric_name, metric_words, set_name
from ctlev_core.report.page.html import Curves, Folded, Section
from ctlev_core.report.page.tables import Cell, Table
from ctlev_core.report.sections.verdict import ADDING, in_range, made_better, tell_change
from ctlev_core.report.studies.study import Part
from ctlev_core.scoring.score_info import find_score, lower_is_better
from ctlev_core.statistics.bootstrap import score_text
from ctlev_core.statistics.paired_differences import Difference
from ctlev_core.statistics.pooled_scores import PooledScores, pool_values
from data_contracts.training_sets import (
    ORACLE,
    RECORDED,
    SYNTHETIC,
    LabelAgreement,
    TrainingSet,
    with_recorded,
)

BOTH = with_recorded(SYNTHETIC)
AUGMENTED, SIMULATED = with_recorded("augmentation"), with_recorded("simulator")
LABELS = str(LabelAgreement(SYNTHETIC))
_COMPARED = (
    (RECORDED, BOTH, "recorded and synthetic frames, against recorded frames alone"),
    (AUGMENTED, BOTH, "recorded and synthetic frames, against recorded frames and augmented copies"),
    (
        AUGMENTED,
        str(TrainingSet.of(RECORDED, SYNTHETIC, "augmentation")),
        "synthetic frames on top of augmented copies",
    ),
    (RECORDED, SYNTHETIC, "synthetic frames alone, against recorded frames alone"),
    ("random_weights", SYNTHETIC, "synthetic frames: pre-trained weights against random weights"),
    (SIMULATED, BOTH, "recorded and synthetic frames, against recorded and simulated frames"),
    (with_recorded("event_gan"), BOTH, "recorded and synthetic frames, against recorded frames and Event-GAN's"),
    (with_recorded("smpl_esim"), BOTH, "recorded and synthetic frames, against recorded frames and SMPL-ESIM's"),
    (with_recorded(ORACLE), BOTH, "recorded and synthetic frames, against as many more recorded ones"),
)
"""Before, after, and what the row is called."""
_WITH_ORACLE = with_recorded(ORACLE)
_LINES = (RECORDED, AUGMENTED, BOTH, SYNTHETIC, SIMULATED)


@dataclass(frozen=True, eq=False)
class Group:
    """Experiments that differ in their draw alone.

    Attributes:
        name: of the column.
        parts: the experiments.
        scores: theirs, pooled.
    """

    name: str
    parts: Sequence[Part]
    scores: PooledScores

    @property
    def metric(self) -> str:
        """The score it is about: the first of its experiments."""
        return self.parts[0].metric

    @cached_property
    def label_agreement(self) -> Difference | None:
        """Score of synthetic frames against the labels asked for, as models trained on recorded frames see them."""
        draws = [
            [
                row["value"]
                for row in part.rows
                if (row["subject"], row["metric"], row["group"]) == (LABELS, self.metric, "all")
            ]
            for part in self.parts
        ]
        counts = {len(values) for values in draws}
        if len(counts) > 1 or counts == {0} or max(counts) % self.scores.num_generators:
            return None
        return in_range(pool_values(np.array(draws), self.scores.num_generators), self.metric)

    def score(self, training_set: str) -> Difference:
        """Of a training set that every experiment has."""
        return in_range(self.scores.score(training_set), self.metric)

    def difference(self, before: str, after: str) -> Difference | None:
        """The second training set minus the first; None where it has not both."""
        return self.scores.difference(before, after) if {before, after} <= set(self.scores.training_sets) else None


def pool_parts(
    name: str, parts: Sequence[Part], samples: Sequence[pa.Table], num_generators: int, *, own_tests: bool = False
) -> Group:
    """The group of some experiments.

    Args:
        name: of the group.
        parts: the experiments.
        samples: of each the table of the schema `PAIRED_SAMPLES`.
        num_generators: fine-tunings in each.
        own_tests: the experiments have test recordings of their own.

    Raises:
        DrawsDiffer, ValueError: as `PooledScores`.
    """
    return Group(name, parts, PooledScores(samples, parts[0].metric, num_generators, own_tests=own_tests))


def pooled_verdict(groups: Sequence[Group]) -> str:
    """A paragraph a group: did synthetic frames help?"""
    return "\n\n".join(_sentence(group) for group in groups)


def pooled_tables(groups: Sequence[Group]) -> list[Table]:
    """Scores of all training sets; differences; how probable it is that one training set beats another."""
    return [_score_table(groups), *_difference_tables(groups)]


def pooled_chart(groups: Sequence[Group]) -> list[Curves]:
    """The score over the number that the groups' names begin with; nothing where they begin with none."""
    matches = [re.match(r"([\d.,]*\d)\s*(.*)", group.name) for group in groups]
    found = [match for match in matches if match]
    if len(found) < max(2, len(groups)) or len({match[2] for match in found}) > 1:
        return []
    places = [float(match[1].replace(",", "")) for match in found]
    series: dict[str, tuple[list[float], list[float]]] = {}
    spans: dict[str, tuple[list[float], list[float]]] = {}
    apart = 0.02 if min(places) > 0 else 0.0
    for number, training_set in enumerate(_LINES):
        # A little beside one another, so that no bar hides another.
        points = [
            (place * (1 + apart) ** (number - len(_LINES) // 2), group.score(training_set))
            for place, group in sorted(zip(places, groups, strict=True), key=lambda pair: pair[0])
            if training_set in group.scores.training_sets
        ]
        if points:
            name = set_name(training_set)
            series[name] = [place for place, _ in points], [score.value for _, score in points]
            spans[name] = [score.low for _, score in points], [score.high for _, score in points]
    metric = groups[0].metric
    caption = f"{_counts(groups)} Bars are 95 % intervals; lines stand a little apart, so that all can be seen."
    x_label = found[0][2] or "recordings"
    title = f"{metric_words(metric)[0][:1].upper()}{metric_words(metric)[0][1:]} by the number of recordings"
    return [Curves(title, series, x_label, metric_name(metric), log_x=min(places) > 0, caption=caption, spans=spans)]


def pooled_sections(groups: Sequence[Group], tables: Sequence[Table]) -> list[Section | Folded]:
    """What follows the first of the tables: differences, the chart, probabilities, and samples of each group.

    Args:
        groups: in reading order.
        tables: as `pooled_tables` gives them.
    """
    differences, probabilities = tables[1:2], tables[2:]
    sections: list[Section | Folded] = [*differences, *pooled_chart(groups)]
    sections += [Folded(table.title, [table]) for table in probabilities]
    for group in groups:
        first = group.parts[0]
        title = f"{group.name}: asked for, and sampled"
        sections.append(replace(first.summary.grid, title=title))
    return sections


def _sentence(group: Group) -> str:
    added = group.difference(RECORDED, BOTH)
    if added is None:
        return f"{group.name}: nothing was trained on recorded and synthetic frames together."
    before, after = (group.score(training_set).value for training_set in (RECORDED, BOTH))
    told = tell_change(ADDING, added, group.metric, before, after)
    told = f"{group.name}: {told[:1].lower()}{told[1:]}"
    beside = group.difference(AUGMENTED, BOTH)
    if beside is None:
        return told
    compared = {
        True: "It did more than augmented copies of the recorded frames do",
        False: "It did less than augmented copies of the recorded frames do",
        None: "Whether it did more than augmented copies of the recorded frames do is undecided",
    }[made_better(beside, group.metric)]
    return f"{told} {compared} ({beside.text()})."


def _reading_order(training_sets: Sequence[str]) -> list[str]:
    """Recorded frames alone, recorded frames with others, then others alone; within these as `SOURCES` names them."""
    known = list(SOURCES)

    def place(training_set: str) -> tuple:
        parts = TrainingSet.parse(training_set).names
        kind = 0 if parts == (RECORDED,) else 1 if RECORDED in parts else 2
        others = [known.index(part) if part in known else len(known) for part in parts]
        return kind, len(parts), others

    return sorted(training_sets, key=place)


def _score_table(groups: Sequence[Group]) -> Table:
    metric = groups[0].metric
    training_sets = _reading_order(list(dict.fromkeys(name for group in groups for name in group.scores.training_sets)))
    body: list[list[Cell]] = []
    bold: set[tuple[int, int]] = set()
    for training_set in training_sets:
        row: list[Cell] = [set_name(training_set)]
        for column, group in enumerate(groups, 1):
            known = training_set in group.scores.training_sets
            row.append(_score(group.score(training_set)) if known else "")
            difference = group.difference(RECORDED, training_set)
            if difference is not None and made_better(difference, metric):
                bold.add((len(body), column))
        body.append(row)
    notes = [f"{metric_name(metric)}: {find_score(metric).meaning}"] if find_score(metric).meaning else []
    agreed = [group.label_agreement for group in groups]
    if any(agreed):
        body.append(
            [Name("synthetic, against their labels", LABELS), *("" if one is None else _score(one) for one in agreed)]
        )
        notes.append(
            f"Against their labels: {metric_name(metric)} of classifiers trained on recorded frames when they are "
            "shown synthetic frames and the labels asked for. It says nothing of test recordings."
        )
    sense = "lower" if lower_is_better(metric) else "higher"
    caption = (
        f"Scores in {metric_name(metric)}, on test recordings that nothing was trained on; {sense} is better. "
        f"{_counts(groups)} In brackets 95 % intervals over test recordings, draws, fine-tunings and seeds. Bold: "
        "better than recorded frames alone, by a difference whose interval excludes 0."
    )
    title = "Scores by training frames" + ("" if groups[0].scores.own_tests else " and number of recordings")
    return Table(title, ["trained on", *_names(groups)], body, caption=caption, bold=bold, footnotes=notes)


def _difference_tables(groups: Sequence[Group]) -> list[Table]:
    metric = groups[0].metric
    body: list[list[Cell]] = []
    probable: list[list[Cell]] = []
    bold: set[tuple[int, int]] = set()
    for before, after, told in _COMPARED:
        found = [group.difference(before, after) for group in groups]
        if not any(found):
            continue
        bold |= {(len(body), n) for n, one in enumerate(found, 1) if one is not None and one.is_certain}
        body.append([told, *("" if one is None else one.text() for one in found)])
        probable.append([told, *(_probability(group, before, after) for group in groups)])
    shares = [_share(group) for group in groups]
    if any(shares):
        body.append(["share of the gain of more recorded frames that synthetic frames give", *shares])
    if not body:
        return []
    sense = "Lower" if lower_is_better(metric) else "Higher"
    caption = (
        f"Differences in {metric_name(metric)}, the first of the two minus the second, paired by test recording and by "
        f"draw. {sense} is better. In brackets 95 % intervals; bold: the interval excludes 0."
    )
    notes = []
    if any(shares):
        notes.append(
            "The share is that of the gain from adding more recorded frames to the recorded ones. It is given where "
            "this gain "
            "is certain."
        )
    chances = (
        f"Share of resampled studies in which the first of the two has the better {metric_name(metric)}; 50 % is a "
        "tie. Resampled studies are spread as widely as the intervals are."
    )
    return [
        Table(
            "Differences that matter", ["compared", *_names(groups)], body, caption=caption, bold=bold, footnotes=notes
        ),
        Table("How probable is it that the first is better?", ["compared", *_names(groups)], probable, caption=chances),
    ]


def _probability(group: Group, before: str, after: str) -> str:
    if group.difference(before, after) is None:
        return ""
    found = group.scores.probability(after, before, lower_is_better=lower_is_better(group.metric))
    if math.isnan(found):
        return ""
    # Replicates are too few to tell more.
    return f"{min(max(found, 0.001), 0.999):.1%}".replace("%", " %")


def _share(group: Group) -> str:
    if not {RECORDED, BOTH, _WITH_ORACLE} <= set(group.scores.training_sets):
        return ""
    share = group.scores.share_of_gain(RECORDED, BOTH, _WITH_ORACLE)
    return "" if share is None else f"{share.value:.0%} [{share.low:.0%}, {share.high:.0%}]".replace("%", " %")


def _score(score: Difference) -> str:
    return score_text(score.value, score.low, score.high)


def _names(groups: Sequence[Group]) -> list[str]:
    return [group.name for group in groups]


def _counts(groups: Sequence[Group]) -> str:
    """What every number is the mean of."""
    told = [_count(group) for group in groups]
    if len(set(told)) == 1:
        return f"Each score is the mean over {told[0]}."
    return " ".join(f"{group.name}: the mean over {text}." for group, text in zip(groups, told, strict=True))


def _count(group: Group) -> str:
    scores = group.scores
    trainings = max(scores.num_trainings.values())
    frames = f" ({scores.num_samples:,} frames)" if scores.num_samples != scores.num_recordings else ""
    tunings = "fine-tuning" if scores.num_generators == 1 else "fine-tunings"
    seeds = trainings // scores.num_generators
    of_each = f"{scores.num_generators} {tunings} of the generator in each draw, and {seeds} training "
    of_each += "seed for each of them" if seeds == 1 else "seeds for each of them"
    drawn = "random draws of the training recordings"
    if scores.own_tests:
        drawn = "draws of recordings to train and test on"
    return (
        f"{scores.num_recordings:,} test recordings{frames}, {scores.num_draws} {drawn}, {of_each} "
        f"({trainings} trainings for each draw and row)"
    )
