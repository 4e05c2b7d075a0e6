"""Distances of sampled frames, against a formula of its own and against what is known beforehand."""

import numpy as np
import pytest
from scipy.linalg import sqrtm

from ctlev_core.statistics.bootstrap import MIN_RECORDINGS
from ctlev_core.statistics.sampling_errors import (
    CONVERGED,
    CPU,
    EXCESS,
    FD,
    HELD_OUT,
    KID,
    OF_HALVES,
    PIXEL_RMS,
    REFERENCE,
    WALL,
    FeatureSet,
    costs,
    feature_errors,
    floors,
    pixel_error,
)


def features(count, shift=0.0, seed=0, per_group=2):
    random = np.random.default_rng(seed)
    return FeatureSet(random.normal(shift, 1, size=(count, 4)), np.arange(count) // per_group)


def by_name(found):
    return {(one.metric, one.against): one for one in found}


def test_the_distance_is_frechets():
    sampled, real = features(60, 0.7, seed=1), features(80, seed=2)
    found = by_name(feature_errors(sampled, real, None))
    assert set(found) == {(FD, HELD_OUT), (KID, HELD_OUT)}
    means = [values.features.mean(axis=0) for values in (sampled, real)]
    first, second = (np.cov(values.features.T) for values in (sampled, real))
    expected = np.square(means[0] - means[1]).sum() + np.trace(first + second - 2 * np.real(sqrtm(first @ second)))
    one = found[FD, HELD_OUT]
    assert one.value == pytest.approx(expected, rel=1e-9) and one.num_samples == 60
    assert one.low < one.value < one.high


def test_a_sampler_of_the_references_distribution_lies_within_its_floor_and_another_does_not():
    reference, real = features(200, seed=3), features(200, 0.5, seed=4)
    (floor,) = [one for one in floors(reference) if one.metric == FD + OF_HALVES]
    same = by_name(feature_errors(features(200, seed=5), real, reference))[FD + OF_HALVES, REFERENCE]
    other = by_name(feature_errors(features(200, 0.5, seed=6), real, reference))[FD + OF_HALVES, REFERENCE]
    assert floor.low < same.value < floor.high < other.value


def test_in_pairs_a_small_difference_is_seen_that_the_distances_themselves_do_not_show():
    """Noise of the rows, common to both, falls out; what is left is a shift that every row has."""
    reference, real = features(100, 0.4, seed=9), features(200, seed=10)
    worse = FeatureSet(reference.features + 0.05, reference.groups)
    found = by_name(feature_errors(worse, real, reference))
    alone, excess = found[FD, HELD_OUT], found[FD + EXCESS, HELD_OUT]
    own = by_name(feature_errors(reference, real, None))[FD, HELD_OUT]
    assert excess.value == pytest.approx(alone.value - own.value)
    assert alone.low < own.value and excess.low > 0


def test_other_rows_than_the_references_are_not_paired():
    sampled, reference, real = features(40, seed=1), features(40, seed=2, per_group=4), features(60, seed=3)
    assert (FD + EXCESS, HELD_OUT) not in by_name(feature_errors(sampled, real, reference))
    first = FeatureSet(reference.features[:20], reference.groups[:20])
    assert by_name(feature_errors(first, real, reference))[FD + EXCESS, HELD_OUT].num_samples == 20


def test_rows_of_one_condition_are_not_independent():
    """Sampling each condition twice with the same result tells nothing new: the interval must not shrink."""
    once, real = features(40, 0.5, seed=7, per_group=1), features(300, seed=8)
    twice = FeatureSet(np.repeat(once.features, 2, axis=0), np.repeat(once.groups, 2))
    single, double = (by_name(feature_errors(one, real, None))[KID, HELD_OUT] for one in (once, twice))
    assert (double.high - double.low) > 0.8 * (single.high - single.low)


def test_too_few_recordings_give_no_interval_and_no_floor():
    sampled, real = features(8, per_group=2), features(30)
    assert np.isnan(by_name(feature_errors(sampled, real, None))[FD, HELD_OUT].high)
    assert floors(sampled) == []


def test_pixel_error_is_a_root_mean_square_over_images():
    frames, solution = np.full((6, 4, 4, 3), 250, np.uint8), np.zeros((6, 4, 4, 3), np.uint8)
    solution[:] = 250 - np.array([3, 4, 3, 4, 3, 4], np.uint8)[:, None, None, None]
    found = pixel_error(frames, solution, list("abcdef"))
    assert (found.metric, found.against) == (PIXEL_RMS, CONVERGED)
    assert found.value == pytest.approx(np.sqrt(12.5))
    assert 3 <= found.low < found.value < found.high <= 4
    for count in (2, MIN_RECORDINGS - 1, MIN_RECORDINGS):
        has_interval = np.isfinite(pixel_error(frames[:count], solution[:count], list("abcdef")[:count]).low)
        assert has_interval == (count == MIN_RECORDINGS)


def test_costs_are_medians():
    found = by_name(costs(np.array([1.0, 1.0, 1.0, 9.0]), np.array([2.0, 2.0, 2.0, 2.0]), np.array([5.0] * 4)))
    assert found[WALL, ""].value == 1 and found[CPU, ""].value == 2, "one batch that was disturbed does not count"
    seconds = np.arange(5.0)
    found = by_name(costs(seconds, 10 * seconds, seconds))
    assert [(found[name, ""].low, found[name, ""].high) for name in (WALL, CPU)] == [(1, 3), (10, 30)], "quartiles"
