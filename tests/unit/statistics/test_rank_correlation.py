"""Rank correlations against SciPy, and their intervals by counting."""

import numpy as np
import pytest
from scipy import stats

from ctlev_core.statistics.rank_correlation import rank_correlation


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("levels", [3, 1000])
def test_the_value_is_that_of_scipy_with_ties_too(seed, levels):
    random = np.random.default_rng(seed)
    first = random.integers(0, levels, 20)
    second = first + random.integers(0, levels, 20)
    assert rank_correlation(first, second).value == pytest.approx(stats.spearmanr(first, second).statistic)


def test_any_rising_function_changes_nothing_and_a_falling_one_the_sign():
    random = np.random.default_rng(0)
    first, second = random.normal(size=12), random.normal(size=12)
    found = rank_correlation(first, second)
    assert rank_correlation(np.exp(first), second) == found
    turned = rank_correlation(-first, second)
    assert (turned.value, turned.low, turned.high) == pytest.approx((-found.value, -found.high, -found.low))


def test_the_same_order_is_one_and_equal_numbers_say_nothing():
    assert rank_correlation(range(6), np.arange(6) ** 3).value == 1
    assert np.isnan(rank_correlation([1.0] * 6, range(6)).value)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_same_order_of_few_things_is_not_certain(sign):
    few, many = (rank_correlation(range(count), sign * np.arange(count)) for count in (6, 40))
    ends = [(sign * found.low, sign * found.high)[::sign] for found in (few, many)]
    assert ends[0][1] == ends[1][1] == 1 and 0.5 < ends[0][0] < 0.8 < 0.9 < ends[1][0] < 1


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.8])
def test_intervals_cover_the_rank_correlation_of_many(correlation):
    random = np.random.default_rng(1)
    # Of two normal numbers: Pearson, On further methods of determining correlation, 1907.
    truth, runs, covered = 6 / np.pi * np.arcsin(correlation / 2), 1000, 0
    for _ in range(runs):
        first = random.normal(size=14)
        second = correlation * first + np.sqrt(1 - correlation**2) * random.normal(size=14)
        found = rank_correlation(first, second)
        covered += found.low <= truth <= found.high
    assert covered / runs >= 0.93  # 95 % within three binomial deviations


def test_what_cannot_be_ranked_is_refused():
    with pytest.raises(ValueError, match="at least 6"):
        rank_correlation([1, 2, 3], [1, 2, 3])
    with pytest.raises(ValueError, match="as many numbers"):
        rank_correlation(range(6), range(7))
    with pytest.raises(ValueError, match="finite"):
        rank_correlation([*range(5), np.nan], range(6))
