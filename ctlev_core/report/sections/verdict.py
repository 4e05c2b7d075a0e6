"""Whether synthetic data helped, in sentences made from the scores and their intervals alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctlev_core.report.page.display_names import metric_words, set_name
from ctlev_core.report.page.html import Answer
from ctlev_core.scoring.score_info import find_score, lower_is_better
from ctlev_core.statistics.bootstrap import score_text
from ctlev_core.statistics.paired_differences import Difference
from data_contracts.training_sets import ORACLE, RECORDED, SYNTHETIC, LabelAgreement, with_recorded

ADDING = "adding synthetic frames to the recorded ones"
_INSTEAD = "training on synthetic frames instead of recorded ones"


@dataclass(frozen=True)
class Verdict:
    """The answer of an experiment.

    Attributes:
        headline: the answer in a sentence, with number and interval.
        details: what else the scores say, a sentence each.
        answer: the same as the page draws it; None where nothing was compared.
    """

    headline: str
    details: tuple[str, ...] = ()
    answer: Answer | None = None

    def __str__(self) -> str:
        """One paragraph."""
        return " ".join([self.headline, *self.details])


def in_range(score: Difference, metric: str) -> Difference:
    """The score with its interval cut off where the metric ends: shares lie in 0 to 1."""
    if not find_score(metric).is_share:
        return score
    return Difference(score.value, max(score.low, 0.0), min(score.high, 1.0))


def made_better(difference: Difference, metric: str) -> bool | None:
    """Whether a change of a score is one for the better; None where its interval does not say."""
    return (difference.value < 0) == lower_is_better(metric) if difference.is_certain else None


def tell_change(what: str, difference: Difference, metric: str, before: float, after: float) -> str:
    """`Adding ... helped: accuracy went from 0.6 to 0.7, a difference of +0.1 [+0.05, +0.15].`

    Args:
        what: was done: `adding synthetic frames to the recorded ones`.
        difference: of the score, after minus before.
        metric: code name of the score.
        before: the score without it.
        after: the score with it.
    """
    name, unit = metric_words(metric)
    unit = unit and f" {unit}"
    numbers = f"{name} went from {score_text(before)} to {score_text(after)}{unit}"
    if difference.low == difference.high == 0:
        return f"{what[:1].upper()}{what[1:]} changed nothing: {name} is {score_text(after)}{unit}."
    numbers += f", a difference of {difference.text()}"
    if math.isnan(difference.low):
        return f"There are too few test recordings to say whether {what} helped: {numbers}."
    if not difference.is_certain:
        return f"Whether {what} helped is undecided: {numbers}."
    share = f" ({abs(difference.value / before) * 100:.0f} %)" if before else ""
    helped = "helped" if made_better(difference, metric) else "did harm"
    return f"{what[:1].upper()}{what[1:]} {helped}: {numbers}{share}."


def verdict(
    rows: list[dict[str, Any]],
    training_sets: Sequence[str],
    difference: Difference | None = None,
    beside: Mapping[str, Difference | None] | None = None,
    oracle: tuple[Difference, Difference | None] | None = None,
    instead: Difference | None = None,
) -> Verdict:
    """Compare training on recorded data with training on recorded and synthetic data, and synthetic data with
    baselines.

    Args:
        rows: rows of the table `scores`.
        training_sets: the training sets that were trained; the first metric found is the one compared.
        difference: recorded + synthetic minus recorded in that metric, paired by sample.
        beside: for each baseline, recorded + synthetic minus recorded + baseline, paired by sample.
        oracle: recorded + oracle minus recorded, and the share of that gain which synthetic data reached (None where
            the gain is not certain).
        instead: synthetic alone minus recorded, likewise; told where nothing was trained on both together.
    Returns:
        A change counts as shown only where the interval of the difference excludes zero.
    """
    scored = [row for row in rows if row["group"] == "all" and row["subject"] in training_sets]
    if not scored:
        return Verdict("No downstream model was scored.")
    metric = scored[0]["metric"]
    values = _means(rows, metric)
    both, labels = with_recorded(SYNTHETIC), _labels(values)
    name, unit = metric_words(metric)
    meaning = find_score(metric).meaning
    sense = "Less is better." if lower_is_better(metric) else "More is better."
    about = f"{name[:1].upper()}{name[1:]}: {meaning}. {sense}" if meaning else f"{sense}"
    if RECORDED in values and both in values and difference is not None:
        details = [about]
        if oracle is not None and with_recorded(ORACLE) in values:
            details.append(_oracle(*oracle))
        details += [
            _beside(other, values[with_recorded(other)], compared, metric)
            for other, compared in (beside or {}).items()
            if compared is not None and with_recorded(other) in values
        ]
        headline = tell_change(ADDING, difference, metric, values[RECORDED], values[both])
        return Verdict(headline, (*details, *labels), _answer(difference, metric))
    if both not in values and instead is not None and {RECORDED, SYNTHETIC} <= values.keys():
        headline = tell_change(_INSTEAD, instead, metric, values[RECORDED], values[SYNTHETIC])
        return Verdict(headline, (about, *labels), _answer(instead, metric))
    own = {one: values[one] for one in (RECORDED, SYNTHETIC, both) if one in values}
    told = ", ".join(
        f"{set_name(one)} {score_text(value)}" for one, value in (own or values).items() if one in training_sets
    )
    return Verdict(f"{name[:1].upper()}{name[1:]}{unit and f', {unit}'}, by what was trained on: {told}.", (about,))


def _answer(difference: Difference, metric: str) -> Answer:
    """Better is positive, whatever the score."""
    known = not math.isnan(difference.low)
    better = made_better(difference, metric) if known else None
    word = {True: "Helped", False: "Did harm", None: "Undecided" if known else "Too few test recordings"}[better]
    unit = metric_words(metric)[1]
    text = f"{difference.text()}{unit and f' {unit}'}"
    ends = (difference.low, difference.value, difference.high)
    low, value, high = [-end for end in reversed(ends)] if lower_is_better(metric) else ends
    return Answer(word, {True: "good", False: "bad", None: "open"}[better], text, value, low, high)


def _means(rows: list[dict[str, Any]], metric: str) -> dict[str, float]:
    """Mean over trainings of each training set's score on all rows."""
    found: dict[str, list[float]] = {}
    for row in rows:
        if row["group"] == "all" and row["metric"] == metric:
            found.setdefault(row["subject"], []).append(row["value"])
    return {training_set: float(np.mean(values)) for training_set, values in found.items()}


def _oracle(gain: Difference, share: Difference | None) -> str:
    beginning = f"Recorded frames of the same poses in the place of synthetic ones change it by {gain.text()}"
    if share is None:
        return f"{beginning}."
    interval = "" if math.isnan(share.low) else f" [{share.low * 100:.0f}, {share.high * 100:.0f}]"
    return f"{beginning}; synthetic ones give {share.value * 100:.0f}{interval} % of that."


def _beside(name: str, value: float, difference: Difference, metric: str) -> str:
    sentence = f"With {set_name(name)} in the place of its own synthetic frames the score is {score_text(value)}"
    if math.isnan(difference.low):
        return f"{sentence}."
    if not difference.is_certain:
        return f"{sentence}; which is better is undecided: {difference.text()}."
    better = made_better(difference, metric)
    return f"{sentence}; its own are {'better' if better else 'worse'}: {difference.text()}."


def _labels(values: Mapping[str, float]) -> tuple[str, ...]:
    """Whether synthetic frames show their labels, as the model trained on recorded frames sees them."""
    own, shuffled = (values.get(str(LabelAgreement(SYNTHETIC, shuffled))) for shuffled in (False, True))
    if own is None:
        return ()
    control = "" if shuffled is None else f", and {score_text(shuffled)} on them with shuffled labels"
    scores = f"scores {score_text(own)} on synthetic frames against their labels"
    return (f"The model trained on recorded frames {scores}{control}.",)
