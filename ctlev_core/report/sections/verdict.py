"""The paragraph that says whether synthetic data helped, made from the scores and their intervals alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ctlev_core.scoring.score_info import find_score, lower_is_better
from ctlev_core.statistics.bootstrap import score_text
from ctlev_core.statistics.paired_differences import Difference
from data_contracts.training_sets import ORACLE, RECORDED, SYNTHETIC, LabelAgreement, with_recorded


def in_range(score: Difference, metric: str) -> Difference:
    """The score with its interval cut off where the metric ends: shares lie in 0 to 1."""
    if not find_score(metric).is_share:
        return score
    return Difference(score.value, max(score.low, 0.0), min(score.high, 1.0))


def made_better(difference: Difference, metric: str) -> bool | None:
    """Whether a change of a score is one for the better; None where its interval does not say."""
    return (difference.value < 0) == lower_is_better(metric) if difference.is_certain else None


def verdict(
    rows: list[dict[str, Any]],
    training_sets: Sequence[str],
    difference: Difference | None = None,
    beside: Mapping[str, Difference | None] | None = None,
    oracle: tuple[Difference, Difference | None] | None = None,
    instead: Difference | None = None,
) -> str:
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
        A few sentences. A change counts as shown only where the interval of the difference excludes zero.
    """
    scored = [row for row in rows if row["group"] == "all" and row["subject"] in training_sets]
    if not scored:
        return "No downstream model was scored."
    metric = scored[0]["metric"]
    values = _means(rows, metric)
    beside = beside or {}
    both = with_recorded(SYNTHETIC)
    own = {name: values[name] for name in (RECORDED, SYNTHETIC, both) if name in values}
    if not own:
        own = {name: values[name] for name in training_sets if name in values}
    sense = f"{'lower' if lower_is_better(metric) else 'higher'} is better"
    summary = f"{metric} ({'; '.join(filter(None, (find_score(metric).meaning, sense)))}) on held-out recorded data: "
    summary += ", ".join(f"{training_set} {score_text(value)}" for training_set, value in own.items()) + "."
    if both not in values and instead is not None and {RECORDED, SYNTHETIC} <= values.keys():
        told = _what_it_did(instead, metric, values[RECORDED], "Training on synthetic data instead of recorded data")
        return f"{summary} {told} {_labels(values)}".rstrip()
    if difference is None or RECORDED not in values or both not in values:
        return summary
    sentences = [summary, _what_it_did(difference, metric, values[RECORDED])]
    if oracle is not None and with_recorded(ORACLE) in values:
        sentences.append(_oracle(*oracle))
    for name, compared in beside.items():
        if compared is not None and with_recorded(name) in values:
            sentences.append(_beside(name, values[with_recorded(name)], compared, metric))
    sentences.append(_labels(values))
    return " ".join(sentence for sentence in sentences if sentence)


def _means(rows: list[dict[str, Any]], metric: str) -> dict[str, float]:
    """Mean over trainings of each training set's score on all rows."""
    found: dict[str, list[float]] = {}
    for row in rows:
        if row["group"] == "all" and row["metric"] == metric:
            found.setdefault(row["subject"], []).append(row["value"])
    return {training_set: float(np.mean(values)) for training_set, values in found.items()}


def _what_it_did(difference: Difference, metric: str, real: float, what: str = "Adding synthetic data") -> str:
    doing = what[0].lower() + what[1:]
    if math.isnan(difference.low):
        return f"There are too few test recordings to say whether {doing} helped."
    if difference.low == difference.high == 0:
        return f"{what} changed nothing."
    text = f"paired difference {difference.text()}"
    if not difference.is_certain:
        return f"Whether {doing} helped is undecided: {text}."
    better = made_better(difference, metric)
    share = f", {abs(difference.value / real):.0%} of what recorded data alone gives" if real else ""
    return f"{what} made it {'better' if better else 'worse'}: {text}{share}."


def _oracle(gain: Difference, share: Difference | None) -> str:
    beginning = f"Recorded frames of the same poses in the place of synthetic ones change it by {gain.text()}"
    if share is None:
        return f"{beginning}."
    interval = "" if math.isnan(share.low) else f" [{share.low:.0%}, {share.high:.0%}]"
    return f"{beginning}; synthetic ones give {share.value:.0%}{interval} of that."


def _beside(name: str, value: float, difference: Difference, metric: str) -> str:
    sentence = f"With frames of {name} in the place of its own, {with_recorded(name)} is {score_text(value)}"
    if math.isnan(difference.low):
        return f"{sentence}."
    if not difference.is_certain:
        return f"{sentence}; which is better is undecided: {difference.text()}."
    better = made_better(difference, metric)
    return f"{sentence}; its own are {'better' if better else 'worse'}: {difference.text()}."


def _labels(values: Mapping[str, float]) -> str:
    """Whether synthetic frames show their labels, as the model trained on recorded frames sees them."""
    own, shuffled = (values.get(str(LabelAgreement(SYNTHETIC, shuffled))) for shuffled in (False, True))
    if own is None:
        return ""
    control = "" if shuffled is None else f", and {score_text(shuffled)} on them with shuffled labels"
    scores = f"scores {score_text(own)} on synthetic frames against their labels"
    return f"The model trained on recorded frames {scores}{control}."
