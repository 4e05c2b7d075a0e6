"""Which number of generated frames tells beforehand whether they will help?

Where an experiment compares several generators, each has many numbers (distances, two-sample tests, label agreement,
copies) and a gain: how much better a model gets by its frames. A number that ranks generators as their gains do can
stand for a downstream training. Each is turned so that a higher rank correlation is better: 1 = what it calls best
helps most.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from ctlev_core.realism.two_sample import C2ST
from ctlev_core.report.page.display_names import Name, metric_name, set_name
from ctlev_core.report.page.html import Curves, Section
from ctlev_core.report.page.tables import Cell, Table
from ctlev_core.report.sections.score_tables import PairedScores, trained_rows
from ctlev_core.scoring.score_info import lower_is_better
from ctlev_core.statistics.bootstrap import score_text
from ctlev_core.statistics.paired_differences import Difference
from ctlev_core.statistics.rank_correlation import MIN_THINGS, rank_correlation
from data_contracts.labels import HELD_OUT_SPLITS
from data_contracts.training_sets import RECORDED, LabelAgreement, with_recorded

Row = dict[str, Any]
_NUM_SHOWN = 4


@dataclass(frozen=True)
class Gain:
    """What frames of a generator do for the first score.

    Attributes:
        added: recorded and these frames minus recorded ones, positive = better.
        alone: these frames alone minus recorded ones, positive = better; NaN where nothing learnt from them alone.
    """

    added: Difference
    alone: float


@dataclass(frozen=True)
class Predictor:
    """A number of generators' frames, and how well it ranks them.

    Attributes:
        name: of the number, with what it is against.
        values: by generator.
        with_added: rank correlation with `Gain.added`.
        with_alone: with `Gain.alone`; NaN where too few generators have one.
    """

    name: Name
    values: dict[str, float]
    with_added: Difference
    with_alone: Difference


@dataclass(frozen=True)
class Usefulness:
    """The gain of each generator, and the numbers, the best first."""

    metric: str
    gains: dict[str, Gain]
    predictors: list[Predictor]


def usefulness_of(
    rows: Sequence[Row], realism: Sequence[Row], names: Sequence[str], paired: PairedScores
) -> Usefulness | None:
    """Rank the numbers of an experiment by how well they rank its generators.

    Args:
        rows: of the table `scores`.
        realism: of the same table of the stage `realism`.
        names: of the generators.
        paired: scores sample by sample.
    Returns:
        None where fewer than `MIN_THINGS` generators have a gain.
    """
    metric = next((row["metric"] for row in trained_rows(rows)), "")
    sign = -1.0 if lower_is_better(metric) else 1.0
    gains = {}
    for name in names:
        added = paired.difference(RECORDED, with_recorded(name), metric)
        alone = paired.difference(RECORDED, name, metric)
        if added is not None:
            low, high = sorted((sign * added.low, sign * added.high))
            gains[name] = Gain(
                Difference(sign * added.value, low, high), math.nan if alone is None else sign * alone.value
            )
    if len(gains) < MIN_THINGS:
        return None
    predictors = []
    for number in _numbers(rows, realism, gains):
        better = -1.0 if number.lower_is_better else 1.0
        turned = {name: better * value for name, value in number.values.items()}
        with_added = _correlate(turned, {name: gain.added.value for name, gain in gains.items()})
        if not math.isnan(with_added.value):
            with_alone = _correlate(turned, {name: gain.alone for name, gain in gains.items()})
            predictors.append(Predictor(number.name, number.values, with_added, with_alone))
    predictors.sort(key=lambda one: -one.with_added.value)
    return Usefulness(metric, gains, predictors)


def usefulness_sections(found: Usefulness | None) -> list[Section]:
    """The table of numbers, that of generators, and the gains over the best number; nothing without any."""
    if found is None or not found.predictors:
        return []
    return [_predictors_table(found), _generators_table(found), _gains_chart(found)]


def usefulness_overview(of_experiments: Sequence[tuple[str, Usefulness]]) -> Table:
    """The numbers of several experiments side by side, those first that rank best in the mean of all.

    Args:
        of_experiments: heading of each, and what was found.
    """
    by_name: dict[str, dict[str, Predictor]] = {}
    for heading, found in of_experiments:
        for predictor in found.predictors:
            # By what readers see: in code, distances name the classifier, and each experiment has another.
            by_name.setdefault(str(predictor.name), {})[heading] = predictor
    headings = [heading for heading, _ in of_experiments]
    shared = {name: found for name, found in by_name.items() if set(found) == set(headings)}

    def mean(name: str) -> float:
        return sum(one.with_added.value for one in shared[name].values()) / len(headings)

    body = [
        [name, f"{mean(name):+.2f}", *(_correlation_text(shared[name][heading].with_added) for heading in headings)]
        for name in sorted(shared, key=mean, reverse=True)
    ]
    return Table(
        "Which number tells beforehand whether frames help?",
        ["number of generated frames", "mean", *headings],
        body,
        caption=f"Rank correlation over generators with the gain from adding their frames. {_CAPTION}",
    )


@dataclass(frozen=True)
class _Number:
    name: Name
    lower_is_better: bool
    values: dict[str, float]


def _numbers(rows: Sequence[Row], realism: Sequence[Row], names: Iterable[str]) -> list[_Number]:
    """All numbers that each of the generators has."""
    found: dict[str, _Number] = {}

    def add(code: str, name: str, lower: bool, generator: str, value: float) -> None:
        number = found.setdefault(code, _Number(Name(name, code), lower, {}))
        number.values.setdefault(generator, value)  # of several fine-tunings the first, as the report shows

    known = set(names)
    for row in rows:
        code, agreement = row["metric"], LabelAgreement.parse(row["subject"])
        if row["task"] == "distance" and row["subject"] in known:
            add(code, metric_name(code), lower_is_better(code), row["subject"], row["value"])
        if agreement is None or agreement.shuffled or row["group"] != "all":
            continue
        if agreement.generator in known:
            told = f"label agreement: {metric_name(code)}"
            add(f"label agreement {code}", told, lower_is_better(code), agreement.generator, row["value"])
    for row in realism:
        generator, _, against = row["subject"].partition(" against ")
        code = row["metric"]
        if generator in known and against in (RECORDED, *HELD_OUT_SPLITS):
            told = str(metric_name(code))
            if code == C2ST:
                told += f" from {'training' if against == RECORDED else against} frames"
            elif not code.endswith("_js_bits") and "_wasserstein_" not in code:
                told += ": difference from recorded"
            add(f"{code} {against}", told, True, generator, row["value"])
    return [number for number in found.values() if set(number.values) == known]


def _correlate(numbers: dict[str, float], gains: dict[str, float]) -> Difference:
    both = [name for name in numbers if not math.isnan(numbers[name]) and not math.isnan(gains[name])]
    if len(both) < MIN_THINGS:
        return Difference(math.nan, math.nan, math.nan)
    return rank_correlation([numbers[name] for name in both], [gains[name] for name in both])


_CAPTION = (
    "1 = the number ranks generators as their gains do, 0 = it says nothing, below 0 = what it calls better helps "
    "less; in brackets 95 % over generators of the same kind. Gains are themselves measured with errors, which make "
    "correlations smaller than they are."
)


def _predictors_table(found: Usefulness) -> Table:
    body: list[list[Cell]] = []
    bold: set[tuple[int, int]] = set()
    for number, one in enumerate(found.predictors):
        body.append([one.name, _correlation_text(one.with_added), _correlation_text(one.with_alone)])
        bold |= {
            (number, column)
            for column, value in enumerate((one.with_added, one.with_alone), 1)
            if value.low > 0 or value.high < 0
        }
    return Table(
        "Which number tells beforehand whether frames help?",
        ["number of generated frames", "with the gain beside recorded frames", "with the score of these frames alone"],
        body,
        caption=f"Rank correlations over {len(found.gains)} generators. {_CAPTION} Bold: the interval excludes 0.",
        bold=bold,
    )


def _generators_table(found: Usefulness) -> Table:
    shown = found.predictors[:_NUM_SHOWN]
    order = sorted(found.gains, key=lambda name: -found.gains[name].added.value)
    body: list[list[Cell]] = [
        [
            set_name(name),
            found.gains[name].added.text(),
            None if math.isnan(found.gains[name].alone) else score_text(found.gains[name].alone, signed=True),
            *(one.values[name] for one in shown),
        ]
        for name in order
    ]
    better = "less error" if lower_is_better(found.metric) else "more"
    return Table(
        "The generators, and the numbers that rank them best",
        ["frames of", "gain beside recorded frames", "alone", *(one.name for one in shown)],
        body,
        caption=f"Gains in {metric_name(found.metric)}, beyond recorded frames alone: positive = {better}.",
    )


def _gains_chart(found: Usefulness) -> Curves:
    best = found.predictors[0]
    order = sorted(found.gains, key=lambda name: best.values[name])
    gains = [found.gains[name].added for name in order]
    return Curves(
        "Gain over the number that ranks best",
        {"generators": ([best.values[name] for name in order], [gain.value for gain in gains])},
        best.name,
        f"gain, {metric_name(found.metric)}",
        spans={"generators": ([gain.low for gain in gains], [gain.high for gain in gains])},
        caption="A point is a generator, with the 95 % interval of its gain; the line joins them in order.",
    )


def _correlation_text(value: Difference) -> str | None:
    return None if math.isnan(value.value) else score_text(value.value, value.low, value.high, signed=True)
