"""What a bootstrap of few recordings or trainings is too narrow by, and how it is mended.

Drawing n of n with replacement makes the variance of a mean (n - 1)/n of what it is, and a normal quantile takes that
variance for known. Percentiles of five to ten recordings therefore cover the truth in 84 to 91 % of studies where they
should in 95 (normal scores).

Sources: expanded percentiles, Hesterberg, What Teachers Should Know about the Bootstrap, The American Statistician 69,
2015, section 4.2; degrees of freedom of a sum of variances, Satterthwaite, Biometrics Bulletin 2, 1946.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

LEVEL = 0.95


def percentile_levels(count: int, level: float = LEVEL) -> tuple[float, float]:
    """Which quantiles of the replicates are the ends of an interval: expanded percentiles.

    Those of the normal distribution at sqrt(n / (n - 1)) times the quantile of t with n - 1 degrees of freedom. Ends
    stay within what replicates can be, so that shares stay below 1; with five recordings, whose replicates end at the
    smallest and the largest of them, 92 % are covered.

    Args:
        count: n, what is drawn: recordings.
        level: probability the interval should cover.
    """
    from scipy.special import ndtr  # here, because a cached run needs no scipy

    low = float(ndtr(-math.sqrt(count / (count - 1)) * t_quantile(count - 1, level)))
    return low, 1 - low


def t_quantile(freedom: float, level: float = LEVEL) -> float:
    """Standard deviations from the middle to an end of the interval, of t; infinite freedom = normal."""
    from scipy.special import ndtri, stdtrit

    tail = (1 + level) / 2
    return float(stdtrit(freedom, tail) if math.isfinite(freedom) else ndtri(tail))


def satterthwaite(parts: Sequence[tuple[float, float]]) -> float:
    """Degrees of freedom of a sum of variances, each given with its own; NaN where one is not known, of one value."""
    if any(math.isnan(variance) or (variance and not freedom) for variance, freedom in parts):
        return math.nan
    total = sum(variance for variance, _ in parts)
    below = sum(variance**2 / freedom for variance, freedom in parts if variance)
    return total**2 / below if below else math.inf


def widening(parts: Sequence[tuple[float, float]]) -> float:
    """What deviations of replicates are multiplied by, so that their percentiles are those of t.

    Args:
        parts: variance and degrees of freedom of all that the replicates vary.
    """
    return t_quantile(satterthwaite(parts)) / t_quantile(math.inf)


def stretch(count: int) -> float:
    """What deviations of the mean of `count` drawn from themselves are multiplied by, so that their variance is right.

    Source: Rao & Wu, Resampling Inference with Complex Survey Data, JASA 83, 1988.
    """
    return math.sqrt(count / (count - 1))


def variance_of_mean(values: np.ndarray) -> tuple[float, float]:
    """Variance of the mean of R values [R], and its degrees of freedom; (0, inf) of one: nothing is known."""
    if len(values) < 2:
        return 0.0, math.inf
    return float(values.var(ddof=1)) / len(values), len(values) - 1.0
