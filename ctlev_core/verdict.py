"""The paragraph that says whether synthetic data helped, made from the scores and their intervals alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

_LOWER = ("mpjpe", "fd_", "kid", "error")


def lower_is_better(metric: str) -> bool:
    """Errors and distances want to be small; shares want to be large."""
    return metric.startswith(_LOWER)


def verdict(rows: list[dict[str, Any]], settings: Sequence[str]) -> str:
    """Compare training on real data with training on real and synthetic data.

    Args:
        rows: rows of the table `scores`.
        settings: the settings that were trained; the first metric found decides.
    Returns:
        One or two sentences. A difference is called one only where the 95 % intervals do not overlap, which is stricter
        than a test of the difference; anything else is called undecided.
    """
    scored = [row for row in rows if row["group"] == "all" and row["setting"] in settings]
    if not scored:
        return "No downstream model was scored."
    metric = scored[0]["metric"]
    scored = [row for row in scored if row["metric"] == metric]
    found = {setting: [row for row in scored if row["setting"] == setting] for setting in settings}
    parts = [f"{setting} {_value(found[setting]):.3f}" for setting in settings if found[setting]]
    summary = f"{metric} on held-out real data ({'lower' if lower_is_better(metric) else 'higher'} is better): "
    summary += ", ".join(parts) + "."
    real, mixed = found.get("real"), found.get("real+synthetic")
    if not real or not mixed:
        return summary
    better = (_value(mixed) < _value(real)) == lower_is_better(metric)
    change = abs(_value(mixed) - _value(real)) / max(abs(_value(real)), 1e-12)
    if _value(mixed) == _value(real):
        return f"{summary} Adding synthetic data changed nothing."
    direction = "better" if better else "worse"
    sure = _apart(real, mixed)
    certainty = "the intervals do not overlap" if sure else "the intervals overlap, so this alone decides nothing"
    return f"{summary} Adding synthetic data made it {change:.1%} {direction}; {certainty}."


def _value(rows: list[dict[str, Any]]) -> float:
    return float(np.mean([row["value"] for row in rows]))


def _apart(first: list[dict[str, Any]], second: list[dict[str, Any]]) -> bool:
    ends = [row[end] for row in (*first, *second) for end in ("low", "high")]
    if any(end is None for end in ends):
        return False
    low_first, high_first = (np.mean([row[end] for row in first]) for end in ("low", "high"))
    low_second, high_second = (np.mean([row[end] for row in second]) for end in ("low", "high"))
    return bool(high_first < low_second or high_second < low_first)
