"""Distances of sets of recordings: closed forms, SciPy as reference, and the floor."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import jensenshannon
from scipy.stats import wasserstein_distance

from ctlev_core.realism.distances import (
    Estimate,
    estimate_distances,
    estimate_floor,
    estimate_numbers,
    jensen_shannon,
    mean_distributions,
    wasserstein,
)
from ctlev_core.realism.summary import ACTIVE_VALUE, AXES, Summary

BINS = AXES["interval"].num_bins
SHARES = st.lists(st.integers(0, 9), min_size=6, max_size=6).filter(any).map(lambda n: np.array(n) / sum(n))


def at_bin(number: int) -> np.ndarray:
    return np.eye(BINS)[number]


@settings(max_examples=50, deadline=None)
@given(SHARES, SHARES)
def test_distances_of_distributions_equal_scipy(first, second):
    places = np.arange(6) * 0.1
    assert wasserstein(first, second, 0.1) == pytest.approx(
        wasserstein_distance(places, places, first, second), abs=1e-12
    )
    assert jensen_shannon(first, second) == pytest.approx(np.nan_to_num(jensenshannon(first, second, 2)) ** 2, abs=1e-9)
    assert jensen_shannon(first, first) == wasserstein(first, first, 0.1) == 0


def test_disjoint_distributions():
    assert jensen_shannon(at_bin(3), at_bin(60)) == 1
    assert wasserstein(at_bin(3), at_bin(60), 0.1) == pytest.approx(5.7)


def test_a_set_is_the_mean_of_its_recordings_that_have_the_number():
    sets = [Summary({"a": 1.0}, {"interval": at_bin(0)}), Summary({"a": 3.0, "b": 5.0}), Summary()]
    assert estimate_numbers(sets).keys() == {"a", "b"}
    assert [estimate_numbers(sets)[name].value for name in "ab"] == [2, 5]
    assert (mean_distributions(sets)["interval"] == at_bin(0)).all()
    assert estimate_numbers([]) == {} and mean_distributions([]) == {}


def random_set(count: int, mean: float, seed: int) -> list[Summary]:
    rng = np.random.default_rng(seed)
    return [
        Summary({"a": float(value)}, {"interval": rng.dirichlet(np.ones(BINS))}) for value in rng.normal(mean, 1, count)
    ]


def test_intervals_cover_the_mean_of_independent_recordings():
    covered = 0
    for seed in range(60):
        found = estimate_numbers(random_set(30, 7.0, seed), seed=seed)["a"]
        assert found.low < found.value < found.high
        covered += found.low <= 7 <= found.high
    # 95 % of 60 is 57; a percentile bootstrap of 30 covers a little less. Below 48 it would be wrong.
    assert 48 <= covered <= 60


def test_few_recordings_have_no_interval():
    found = estimate_numbers(random_set(4, 0, 0))["a"]
    assert np.isnan([found.low, found.high]).all()
    assert np.isnan(estimate_distances(random_set(4, 0, 0), random_set(9, 0, 1))["a"].low)


def test_recordings_that_lack_a_number_do_not_count():
    """Of six recordings two have a value: black frames have none."""
    some = [Summary({"a": float(row)} | ({"b": float(row)} if row < 2 else {}), {}) for row in range(6)]
    all_six = [Summary({"a": float(row), "b": float(row)}, {}) for row in range(6)]
    for found in (estimate_numbers(some), estimate_distances(some, all_six), estimate_distances(all_six, some)):
        assert np.isfinite(found["a"].low) and np.isnan([found["b"].low, found["b"].high]).all()
    lack = [Summary({}, {"interval": at_bin(3)} if row < 4 else {}) for row in range(6)]
    have = [Summary({}, {"interval": at_bin(5)}) for _ in range(6)]
    assert all(np.isnan(one.low) for one in estimate_distances(lack, have).values())
    assert all(np.isfinite(one.low) for one in estimate_distances(have, have).values())


def test_distances_tell_sets_apart_and_the_floor_does_not():
    first, second, same = random_set(20, 0, 0), random_set(20, 5, 1), random_set(20, 0, 2)
    floor = estimate_floor(first)
    far, near = estimate_distances(first, second), estimate_distances(first, same)
    assert far.keys() == floor.keys() == {"a", "interval_wasserstein_decades", "interval_js_bits"}
    assert far["a"].low > floor["a"].high and far["a"].value == pytest.approx(5, abs=1)
    assert near["a"].value < floor["a"].high
    assert floor["a"].low >= 0
    assert estimate_distances(first, first)["a"].value == 0


def test_halves_of_equal_recordings_have_no_distance():
    same = [Summary({"a": 2.0}, {"interval": at_bin(7)})] * 7
    assert set(estimate_floor(same).values()) == {Estimate(0.0, 0.0, 0.0)}


def test_the_floor_of_two_recordings_is_their_difference_and_one_has_none():
    pair = [Summary({"a": 2.0}), Summary({"a": 5.0})]
    assert estimate_floor(pair)["a"].value == 3
    assert estimate_floor(pair[:1]) == {} and estimate_floor([]) == {}


def test_a_number_that_one_half_lacks_is_left_out_of_that_split():
    assert estimate_floor([Summary({"a": 1.0}), Summary({"a": 2.0}), Summary()])["a"].value == 1
    assert estimate_floor([Summary({"a": 1.0}), Summary()]) == {}


def test_equal_seeds_give_equal_intervals():
    first, second = random_set(10, 0, 0), random_set(10, 1, 1)
    assert estimate_distances(first, second, seed=3) == estimate_distances(first, second, seed=3)
    assert estimate_floor(first, seed=3) == estimate_floor(first, seed=3)


def test_the_divergence_of_values_takes_near_grey_levels_as_one():
    def at_value(value: int) -> Summary:
        return Summary({}, {"value": np.eye(AXES["value"].num_bins)[value - ACTIVE_VALUE]})

    near, far = (estimate_distances([at_value(30)], [at_value(value)]) for value in (40, 200))
    assert (near["value_js_bits"].value, far["value_js_bits"].value) == (0, 1)
    assert near["value_wasserstein_grey_levels"].value == pytest.approx(10)
    assert far["value_wasserstein_grey_levels"].value == pytest.approx(170)
