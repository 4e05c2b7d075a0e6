"""The paragraph that says whether synthetic data helped, made from the scores and their intervals alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

_LOWER = ("mpjpe", "pve", "fd_", "kid", "error", "calibration_error")


@dataclass(frozen=True)
class Difference:
    """Mean difference of two models on the same samples, and the ends of its 95 % interval (NaN = unknown)."""

    value: float
    low: float
    high: float


def lower_is_better(metric: str) -> bool:
    """Errors and distances want to be small; shares want to be large."""
    return metric.startswith(_LOWER)


def verdict(
    rows: list[dict[str, Any]],
    settings: Sequence[str],
    difference: Difference | None = None,
    beside: Mapping[str, Difference | None] | None = None,
) -> str:
    """Compare training on real data with training on real and synthetic data, and synthetic data with baselines.

    Args:
        rows: rows of the table `scores`.
        settings: the settings that were trained; the first metric found is the one compared.
        difference: real + synthetic minus real in that metric, paired by sample.
        beside: for each baseline, real + synthetic minus real + baseline, paired by sample.
    Returns:
        A few sentences. A change counts as shown only where the interval of the difference excludes zero; it covers
        the choice of test recordings, not of seeds.
    """
    scored = [row for row in rows if row["group"] == "all" and row["setting"] in settings]
    if not scored:
        return "No downstream model was scored."
    metric = scored[0]["metric"]
    values = {
        setting: float(np.mean(found))
        for setting in settings
        if (found := [row["value"] for row in scored if row["setting"] == setting and row["metric"] == metric])
    }
    beside = beside or {}
    own = {name: value for name, value in values.items() if name.removeprefix("real+") not in beside}
    summary = f"{metric} on held-out real data ({'lower' if lower_is_better(metric) else 'higher'} is better): "
    summary += ", ".join(f"{setting} {value:.3f}" for setting, value in own.items()) + "."
    if difference is None or "real" not in values or "real+synthetic" not in values:
        return summary
    sentences = [summary, _what_it_did(difference, metric)]
    for name, compared in beside.items():
        if compared is not None and f"real+{name}" in values:
            sentences.append(_beside(name, values[f"real+{name}"], compared, metric))
    return " ".join(sentences)


def _what_it_did(difference: Difference, metric: str) -> str:
    if math.isnan(difference.low):
        return "There are too few test recordings to say whether adding synthetic data helped."
    if difference.low == difference.high == 0:
        return "Adding synthetic data changed nothing."
    if difference.low <= 0 <= difference.high:
        return f"Whether adding synthetic data helped is undecided: paired difference {_text(difference)}."
    better = (difference.value < 0) == lower_is_better(metric)
    return f"Adding synthetic data made it {'better' if better else 'worse'}: paired difference {_text(difference)}."


def _beside(name: str, value: float, difference: Difference, metric: str) -> str:
    sentence = f"With frames of {name} in the place of its own, real+{name} is {value:.3f}"
    if math.isnan(difference.low):
        return f"{sentence}."
    if difference.low <= 0 <= difference.high:
        return f"{sentence}; which is better is undecided: {_text(difference)}."
    better = (difference.value < 0) == lower_is_better(metric)
    return f"{sentence}; its own are {'better' if better else 'worse'}: {_text(difference)}."


def _text(difference: Difference) -> str:
    return f"{difference.value:+.3f} [{difference.low:+.3f}, {difference.high:+.3f}]"
