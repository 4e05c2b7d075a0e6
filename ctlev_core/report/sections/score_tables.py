"""The tables of scores: what training on synthetic data is worth, whether frames show their labels, and distances.

Rows are those of the table `scores`; whatever training sets, tasks and metrics occur are shown. Bold cells are only
those whose paired interval says so.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core.report.page.display_names import metric_heading, metric_name, set_name, subject_name
from ctlev_core.report.page.tables import Cell, Table
from ctlev_core.report.sections.verdict import in_range, made_better
from ctlev_core.scoring.score_info import find_score, lower_is_better
from ctlev_core.scoring.subsets import DATASET
from ctlev_core.statistics.bootstrap import score_text
from ctlev_core.statistics.paired_differences import Difference, Trainings, paired_difference, read_trainings
from ctlev_core.statistics.small_samples import satterthwaite, t_quantile, variance_of_mean
from data_contracts.training_sets import (
    HELD_OUT,
    LABEL_CONSISTENT,
    ORACLE,
    RECORDED,
    SYNTHETIC,
    LabelAgreement,
    TrainingSet,
    with_recorded,
)

Row = dict[str, Any]
ORIGINS = "classes with"
"""Groups that begin so are classes by where they were to be learnt from."""
SUBJECTS = ("subject ", "subjects ")
"""Groups that begin so are one subject, or subjects by whether they were learnt from."""
_CHANCE, _ONE_CLASS = "chance_", "binary_accuracy_"
_WIDEST = 7
"""Training sets side by side that fit on a page."""
_ENOUGH = 4
"""Trainings of a training set from which their spread is known well enough to say no more about it."""
_SOURCES = {
    ORACLE: "recorded frames of the very poses that synthetic frames are sampled from: the most they can give",
    LABEL_CONSISTENT: "the synthetic frames whose labels a model trained on recorded frames finds best",
    SYNTHETIC: "frames of the experiment's own generator",
    RECORDED: "the recorded frames that every generator learnt from",
}


class PairedScores:
    """The scores of single samples, by training set and score, of all trainings."""

    def __init__(self, samples: pa.Table) -> None:
        """Args: a table of the schema `PAIRED_SAMPLES`."""
        self._trainings = read_trainings(samples)

    def of(self, training_set: str, metric: str) -> Trainings | None:
        """The trainings of a training set, where they have scores of single samples, all of the same ones."""
        return self._trainings.get((training_set, metric))

    def difference(self, before: str, after: str, metric: str) -> Difference | None:
        """The second training set minus the first; None where they were not both scored on the same samples."""
        first, second = self.of(before, metric), self.of(after, metric)
        if first is None or second is None or not first.scores_the_same_as(second):
            return None
        return paired_difference(first, second)


def is_about_labels(row: Row) -> bool:
    """Does the row score synthetic frames against labels, rather than a model on recorded test data?"""
    return LabelAgreement.parse(row["subject"]) is not None


def trained_rows(rows: Iterable[Row]) -> list[Row]:
    """The rows that score models on held-out recorded data, all groups."""
    return [row for row in rows if row["task"] != "distance" and not is_about_labels(row)]


def score_tables(rows: list[Row], training_sets: Sequence[str], paired: PairedScores) -> list[Table]:
    """What models score by what they were trained on, a headline and other scores for each task.

    Args:
        rows: of the table `scores`, of all trainings.
        training_sets: what was trained on, in the order of the tables; others follow as they come.
        paired: for the differences.
    """
    trained = [row for row in trained_rows(rows) if row["group"] == "all"]
    order = {training_set: number for number, training_set in enumerate(training_sets)}
    trained.sort(key=lambda row: order.get(row["subject"], len(order)))
    tasks = list(dict.fromkeys(row["task"] for row in trained))
    found = []
    for task in tasks:
        of_task = [row for row in trained if row["task"] == task]
        found += _headline(of_task, "" if len(tasks) == 1 else f"{task}: ", paired)
        found += _one_against_rest(of_task, list(dict.fromkeys(row["subject"] for row in of_task)))
    return found


def frame_tables(rows: list[Row]) -> list[Table]:
    """Whether generated frames show their labels, and how far they are from recorded ones; from the same rows."""
    trained = [row for row in trained_rows(rows) if row["group"] == "all"]
    found = []
    labels = [row for row in rows if row["task"] != "distance" and is_about_labels(row) and row["group"] == "all"]
    if labels:
        floor = [{**row, "subject": HELD_OUT} for row in trained if row["subject"] == RECORDED]
        caption = (
            "The model trained on recorded frames, scored on synthetic frames against the labels they were sampled "
            "from, beside its score on held-out recorded frames, the floor. Shuffled: the same frames against labels "
            "of others, which is what frames that show nothing of their labels would score."
        )
        found += _pivot("Do the synthetic frames show their labels?", floor + labels, caption)
    distances = [row for row in rows if row["task"] == "distance"]
    if distances:
        caption = (
            "Distances to the recorded training frames in the features of a classifier trained on recorded events, "
            "so that the Frechet distance is not the FID of other papers. They depend on the number of frames, so read "
            "them against the row of held-out recorded frames; alone they do not tell whether labels are right. In "
            "brackets 95 %, from halves by recording."
        )
        counts = ("recorded training frames", "frames compared")
        found += _pivot("How far from recorded frames?", distances, caption, counts, shown=3)
    return found


def group_tables(rows: list[Row], training_sets: Sequence[str]) -> tuple[list[Table], list[Table]]:
    """The first score by group: classes by where they were to be learnt from and subjects, and class by class."""
    groups = [row for row in trained_rows(rows) if row["group"] != "all"]
    if not groups:
        return [], []
    code = groups[0]["metric"]
    groups = [row for row in groups if row["metric"] == code]
    metric = _capital(metric_name(code))
    names = list(dict.fromkeys([*training_sets, *(row["subject"] for row in groups)]))
    by_origin = [row for row in groups if row["group"].startswith(ORIGINS)]
    by_subject = [row for row in groups if row["group"].startswith(SUBJECTS)]
    by_dataset = [row for row in groups if row["group"].startswith(DATASET)]
    by_class = [row for row in groups if not row["group"].startswith((ORIGINS, DATASET, *SUBJECTS))]
    caption = (
        "Held-out recorded frames by class. What synthetic frames add is seen in those that no training frame shows."
    )
    origins = _by_group(f"{metric}: on each dataset", by_dataset, names, first="test frames of")
    origins += _by_group(f"{metric}: where does it help?", by_origin, names, caption)
    origins += _by_group(f"{metric}: by subject", by_subject, names, first="subjects")
    classes = _by_group(f"{metric}: class by class", by_class, names)
    return origins, classes


def baseline_tables(names: Sequence[str], metric: str, paired: PairedScores) -> list[Table]:
    """What the frames of the first generator are worth beside those of each other; nothing without others."""
    own, *others = names
    body: list[list[Cell]] = []
    bold: set[tuple[int, int]] = set()
    for other in others:
        row: list[Cell] = [set_name(other)]
        for before, after in (
            (other, own),
            (with_recorded(other), with_recorded(own)),
            (RECORDED, with_recorded(other)),
        ):
            difference = paired.difference(before, after, metric)
            if difference is not None and difference.is_certain:
                bold.add((len(body), len(row)))
            row.append("" if difference is None else difference.text())
        body.append(row)
    if not body:
        return []
    columns = [
        "baseline",
        f"alone: {set_name(own)} minus baseline",
        f"beside recorded: {set_name(own)} minus baseline",
        "recorded + baseline minus recorded",
    ]
    caption = (
        f"Differences in {metric_name(metric)} ({'lower' if lower_is_better(metric) else 'higher'} is better), sample "
        "by sample on the same held-out frames; in brackets the 95 % interval over test recordings and trainings. "
        "Bold: the interval excludes 0."
    )
    return [Table("Beside the baselines", columns, body, caption=caption, bold=bold)]


def _headline(rows: list[Row], prefix: str, paired: PairedScores) -> list[Table]:
    """The first score with its difference from recorded frames alone; then, closed, all other scores."""
    chance = {row["metric"]: row["value"] for row in rows if row["metric"].startswith(_CHANCE)}
    rows = [row for row in rows if not row["metric"].startswith((_CHANCE, _ONE_CLASS)) or _is_mean(row["metric"])]
    metric, *others = dict.fromkeys(row["metric"] for row in rows)
    by_set: dict[str, list[Row]] = {}
    for row in rows:
        by_set.setdefault(row["subject"], []).append(row)
    body: list[list[Cell]] = []
    bold: set[tuple[int, int]] = set()
    for training_set, of_set in by_set.items():
        difference = None if training_set == RECORDED else paired.difference(RECORDED, training_set, metric)
        if difference is not None and difference.is_certain:
            bold |= {(len(body), 2)} | ({(len(body), 1)} if made_better(difference, metric) else set())
        counts = [len({_training(row) for row in of_set}), of_set[0]["num_train"]]
        told = "" if difference is None else difference.text()
        body.append([set_name(training_set), _cell(of_set, metric), told, *counts])
    caption = (
        f"Scores on {rows[0]['num_samples']:,} held-out recorded test frames; equal optimiser steps for every row. "
        "Each number is the mean over the row's trainings, which differ in their seeds; in brackets the 95 % interval "
        "over test recordings and trainings. Bold: a difference that is not 0, and a score that is better for it, as "
        "the interval of the difference says that compares sample by sample."
    )
    columns = ["trained on", metric_heading(metric), "minus recorded", "trainings", "frames trained on"]
    table = Table(
        f"{prefix}Does synthetic data help?",
        columns,
        body,
        caption=caption,
        footnotes=_notes(by_set, metric),
        bold=bold,
    )
    told = [f"{metric_name(name)}: {score_text(value)}" for name, value in chance.items()]
    return [table, *_other_scores(by_set, others, prefix, paired, told)]


def _other_scores(
    by_set: dict[str, list[Row]], metrics: list[str], prefix: str, paired: PairedScores, notes: list[str]
) -> list[Table]:
    if not metrics:
        return []
    bold = {
        (row, column)
        for row, training_set in enumerate(by_set)
        for column, metric in enumerate(metrics, 1)
        if (difference := paired.difference(RECORDED, training_set, metric)) and made_better(difference, metric)
    }
    body = [[set_name(name), *(_cell(of_set, metric) for metric in metrics)] for name, of_set in by_set.items()]
    caption = "As above. Bold: better than recorded frames alone, by a difference whose interval excludes 0."
    columns = ["trained on", *map(metric_heading, metrics)]
    notes = [*_meanings(metrics), *notes]
    return [Table(f"{prefix}Other scores", columns, body, caption=caption, footnotes=notes, bold=bold, folded=True)]


def _notes(by_set: dict[str, list[Row]], metric: str) -> list[str]:
    parsed = [TrainingSet.parse(training_set) for training_set in by_set]
    notes = [f"{set_name(name)}: {text}" for name, text in _SOURCES.items() if any(name in one.names for one in parsed)]
    notes += _meanings([metric])
    if any(one.in_part for one in parsed):
        notes.append("50 % of synthetic, and the like: the first part of the synthetic frames")
    fewest = min(len({_training(row) for row in of_set}) for of_set in by_set.values())
    if fewest == 1:
        notes.append("Intervals cannot cover the spread between trainings where there is one.")
    elif fewest < _ENOUGH:
        notes.append(
            "Two or three trainings say little about their own spread: intervals of differences are wider for it, and "
            "more trainings make them narrower."
        )
    return notes


def _meanings(metrics: Sequence[str]) -> list[str]:
    explained = {find_score(name).meaning: name for name in reversed(metrics) if find_score(name).meaning}
    return [f"{metric_name(name)}: {text}" for text, name in reversed(explained.items())]


def _cell(rows: Sequence[Row], metric: str) -> str:
    return cell_text([row for row in rows if row["metric"] == metric])


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _is_mean(metric: str) -> bool:
    return metric.endswith("_mean")


def _one_against_rest(rows: list[Row], training_sets: Sequence[str]) -> list[Table]:
    """Classes down, training sets across: the layout of the paper's Table 5."""
    binary = [row for row in rows if row["metric"].startswith(_ONE_CLASS) and not _is_mean(row["metric"])]
    rows = [{**row, "group": row["metric"].removeprefix(_ONE_CLASS)} for row in binary]
    caption = "Accuracy of telling a class from the others with as many negatives as positives; 0.5 is chance."
    return _by_group("One class against the others", rows, training_sets, caption)


def _training(row: Row) -> tuple:
    return row["seed"], row.get("model_digest")


def _pivot(
    title: str,
    rows: list[Row],
    caption: str,
    counts: tuple[str, str] = ("frames trained on", "frames scored"),
    shown: int = 1,
) -> list[Table]:
    """Frames down, metrics across; those after the first `shown` in a second table, closed."""
    metrics = list(dict.fromkeys(row["metric"] for row in rows))
    subjects = {
        name: [row for row in rows if row["subject"] == name] for name in dict.fromkeys(r["subject"] for r in rows)
    }
    body: list[list[Cell]] = []
    others: list[list[Cell]] = []
    for subject, of_set in subjects.items():
        cells: list[Cell] = [_cell(of_set, metric) for metric in metrics]
        body.append([subject_name(subject), *cells[:shown], of_set[0]["num_train"], of_set[0]["num_samples"]])
        others.append([subject_name(subject), *cells[shown:]])
    tables = [Table(title, ["frames", *map(metric_heading, metrics[:shown]), *counts], body, caption=caption)]
    if metrics[shown:]:
        columns = ["frames", *map(metric_heading, metrics[shown:])]
        tables.append(Table(f"{title} Other scores", columns, others, caption="As above.", folded=True))
    return tables


def _by_group(
    title: str, rows: list[Row], training_sets: Sequence[str], caption: str = "", first: str = "classes"
) -> list[Table]:
    """Groups down, training sets across; many of these in several tables, each with the first beside it."""
    if not rows:
        return []
    if len(training_sets) > _WIDEST:
        baseline, *others = training_sets
        parts = [[baseline, *others[start : start + _WIDEST - 1]] for start in range(0, len(others), _WIDEST - 1)]
        titles = [title, *(f"{title} ({number})" for number in range(2, len(parts) + 1))]
        return [
            table
            for name, part in zip(titles, parts, strict=True)
            for table in _by_group(name, rows, part, caption, first)
        ]
    by_group: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        by_group.setdefault(row["group"], {}).setdefault(row["subject"], []).append(row)
    body: list[list[Cell]] = []
    for group, of_group in by_group.items():
        cells: list[Cell] = [cell_text(of_group.get(training_set, ())) for training_set in training_sets]
        body.append([group, *cells, next(iter(of_group.values()))[0]["num_samples"]])
    return [Table(title, [first, *map(set_name, training_sets), "frames scored"], body, caption=caption)]


def cell_text(rows: Sequence[Row]) -> str:
    """Mean over trainings with its 95 % interval; empty without rows.

    The interval joins that over recordings (its ends averaged over trainings, which share the test recordings) and the
    spread of the mean over trainings as independent: variances add up, and the quantile is that of t for the degrees of
    freedom of their sum (Satterthwaite), of which few trainings have few.
    """
    if not rows:
        return ""
    score = in_range(Difference(*interval_over_trainings(rows)), rows[0]["metric"])
    return score_text(score.value, score.low, score.high)


def interval_over_trainings(rows: Sequence[Row]) -> tuple[float, float, float]:
    """Mean of the rows' values and the ends of its interval as `cell_text` shows it; NaN without intervals."""
    values = np.array([row["value"] for row in rows], np.float64)
    value = float(values.mean())
    if any(row["low"] is None or row["high"] is None for row in rows):
        return value, float("nan"), float("nan")
    # An interval of a biased score need not hold its value: it then ends there.
    below = float(np.mean([max(row["value"] - row["low"], 0.0) for row in rows]))
    above = float(np.mean([max(row["high"] - row["value"], 0.0) for row in rows]))
    of_trainings = variance_of_mean(values)
    low, high = (_joined(half_width, of_trainings) for half_width in (below, above))
    return value, value - low, value + high


def _joined(half_width: float, of_trainings: tuple[float, float]) -> float:
    """Half width over recordings and trainings; the former of many recordings, as its own quantile is wider for few."""
    of_recordings = (half_width / t_quantile(math.inf)) ** 2, math.inf
    quantile = t_quantile(satterthwaite([of_recordings, of_trainings]))
    return quantile * math.sqrt(of_recordings[0] + of_trainings[0])
