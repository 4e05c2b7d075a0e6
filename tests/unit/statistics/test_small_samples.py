"""Corrections of few recordings against published tables and SciPy."""

import math

import numpy as np
import pytest
from scipy import stats

from ctlev_core.statistics.small_samples import (
    percentile_levels,
    satterthwaite,
    stretch,
    t_quantile,
    variance_of_mean,
    widening,
)


@pytest.mark.parametrize("count, tail", [(5, 0.0010), (10, 0.0086), (20, 0.0159), (40, 0.0203), (100, 0.0231)])
def test_expanded_levels_are_those_of_t(count, tail):
    low, high = percentile_levels(count)
    expected = stats.norm.cdf(-math.sqrt(count / (count - 1)) * stats.t.ppf(0.975, count - 1))
    assert low == pytest.approx(expected, rel=1e-9) and low == pytest.approx(tail, abs=6e-5)
    assert low + high == pytest.approx(1)


def test_many_recordings_have_the_plain_levels():
    assert percentile_levels(10**7) == pytest.approx((0.025, 0.975), rel=1e-5)
    assert percentile_levels(10**7, level=0.9) == pytest.approx((0.05, 0.95), rel=1e-5)


@pytest.mark.parametrize("freedom, quantile", [(1, 12.706), (4, 2.776), (9, 2.262), (math.inf, 1.960)])
def test_quantiles_of_the_printed_tables(freedom, quantile):
    assert t_quantile(freedom) == pytest.approx(quantile, abs=6e-4)


@pytest.mark.parametrize("level", [0.5, 0.95, 0.99])
def test_quantiles_are_those_of_scipy_to_the_last_digit(level):
    """Without `scipy.stats`, whose import takes a second."""
    freedoms = range(1, 60)
    assert [t_quantile(n, level) for n in freedoms] == [float(stats.t.ppf((1 + level) / 2, n)) for n in freedoms]


def test_degrees_of_freedom_are_those_of_welch():
    random = np.random.default_rng(0)
    first, second = random.normal(0, 1, 4), random.normal(0, 3, 9)
    expected = stats.ttest_ind(first, second, equal_var=False).df
    assert satterthwaite([variance_of_mean(first), variance_of_mean(second)]) == pytest.approx(expected)


def test_one_part_has_its_own_freedom_and_nothing_is_normal():
    assert satterthwaite([(2.0, 7.0), (0.0, 1.0)]) == pytest.approx(7)
    assert satterthwaite([(0.0, 1.0)]) == math.inf and widening([(0.0, 1.0)]) == pytest.approx(1)
    assert variance_of_mean(np.ones(1)) == (0.0, math.inf)


@pytest.mark.parametrize("count", [2, 5, 30])
def test_a_stretched_drawing_has_the_variance_of_a_mean(count):
    random = np.random.default_rng(count)
    values = random.normal(size=count)
    times = random.multinomial(count, np.full(count, 1 / count), size=40_000)
    drawn = stretch(count) * (times @ values / count - values.mean())
    assert drawn.var() == pytest.approx(variance_of_mean(values)[0], rel=0.03)
