"""Does one number rank things as another does?"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ctlev_core.statistics.paired_differences import Difference
from ctlev_core.statistics.small_samples import t_quantile

MIN_THINGS = 6
"""With fewer ranked things the interval is nearly all there is."""


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> Difference:
    """Spearman's rank correlation, with its 95 % interval.

    The interval is that of Fisher's z with the variance 1.06 / (n - 3) (Fieller, Hartley & Pearson, Tests for Rank
    Correlation Coefficients, Biometrika 44, 1957): over other things of the same kind. It says nothing of how sure the
    numbers themselves are, whose errors make a correlation smaller than it is.

    Args:
        first: [N] numbers, N >= `MIN_THINGS`; equal ones share the mean of their ranks.
        second: [N].
    Returns:
        -1 to 1; NaN where all of either are equal.
    Raises:
        ValueError: they are not as many, too few, or not finite.
    """
    x, y = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if x.shape != y.shape or x.ndim != 1 or len(x) < MIN_THINGS:
        raise ValueError(f"expected as many numbers twice, at least {MIN_THINGS}, got {x.shape} and {y.shape}")
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("numbers to rank must be finite")
    ranks = [_ranks(values) for values in (x, y)]
    centred = [values - values.mean() for values in ranks]
    norm = math.sqrt(float(centred[0] @ centred[0]) * float(centred[1] @ centred[1]))
    if norm == 0:
        return Difference(math.nan, math.nan, math.nan)
    value = float(np.clip(centred[0] @ centred[1] / norm, -1, 1))
    half = t_quantile(math.inf) * math.sqrt(1.06 / (len(x) - 3))
    if abs(value) == 1:  # whose z is infinite: the inner end is that of the value next to it
        inner = math.tanh(math.atanh(1 - 12 / (len(x) * (len(x) ** 2 - 1))) - half)
        return Difference(value, *sorted((value, value * inner)))
    z = math.atanh(value)
    return Difference(value, math.tanh(z - half), math.tanh(z + half))


def _ranks(values: np.ndarray) -> np.ndarray:
    """Ranks from 0 on; the mean of those that equal values share."""
    _, group, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts + 1) / 2)[group]
