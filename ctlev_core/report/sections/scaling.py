"""How a score changes with the amount of synthetic data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ctlev_core.report.page.display_names import metric_name, metric_words, set_name
from ctlev_core.report.page.html import Curves
from ctlev_core.report.sections.score_tables import interval_over_trainings, trained_rows
from data_contracts.training_sets import RECORDED, TrainingSet


@dataclass(frozen=True)
class ScalePoint:
    """A score with a certain amount of synthetic data beside the same recorded data.

    Attributes:
        series: which frames were added.
        ratio: of added frames to recorded ones; 0 = recorded alone.
        value: the score.
        low: lower end of its 95 % interval; NaN = unknown.
        high: upper end.
    """

    series: str
    ratio: float
    value: float
    low: float = float("nan")
    high: float = float("nan")


def scaling_points(rows: Sequence[dict[str, Any]], metric: str) -> list[ScalePoint]:
    """The points of every generator of which several amounts were added to recorded data.

    Args:
        rows: of the table `scores`; training sets `recorded`, `recorded+NAME` (all frames) and `recorded+NAME@SHARE`.
        metric: which score.
    """
    of_set: dict[str, list[dict[str, Any]]] = {}
    for row in trained_rows(rows):
        if row["group"] == "all" and row["metric"] == metric:
            of_set.setdefault(row["subject"], []).append(row)
    real = of_set.get(RECORDED)
    if not real or not real[0]["num_train"]:
        return []
    parsed = {TrainingSet.parse(name): found for name, found in of_set.items()}
    varied = {one.whole for one in parsed if one.in_part and one.names[0] == RECORDED}
    points = []
    for whole in sorted(varied, key=str):
        for training_set, found in parsed.items():
            if training_set == TrainingSet.of(RECORDED) or training_set.whole == whole:
                ratio = found[0]["num_train"] / real[0]["num_train"] - 1
                added = str(TrainingSet(whole.sources[1:]))
                points.append(ScalePoint(added, ratio, *interval_over_trainings(found)))
    return points


def scaling_figure(points: Sequence[ScalePoint], metric: str = "score") -> Curves:
    """Scores over amounts, one line a series, with the 95 % interval of each point."""
    series: dict[str, tuple[list[float], list[float]]] = {}
    spans: dict[str, tuple[list[float], list[float]]] = {}
    for point in sorted(points, key=lambda point: (point.series, point.ratio)):
        for where, values in (
            (series, (point.ratio, point.value)),
            (spans, (point.low, point.high)),
        ):
            for column, value in zip(where.setdefault(set_name(point.series), ([], [])), values, strict=True):
                column.append(value)
    caption = (
        "Held-out recorded test data after training on all recorded frames and more and more synthetic ones, in equal "
        "numbers of optimiser steps; bars are 95 % intervals. At 0 there is no synthetic data."
    )
    title = f"{metric_words(metric)[0]} by the amount of synthetic data"
    return Curves(
        title, series, "synthetic frames for each recorded one", metric_name(metric), caption=caption, spans=spans
    )
