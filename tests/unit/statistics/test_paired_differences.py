"""Differences of two training sets on the same samples, against closed forms and simulated experiments."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from ctlev_core.statistics import paired_differences
from ctlev_core.statistics.bootstrap import bootstrap_interval
from ctlev_core.statistics.paired_differences import (
    Difference,
    Trainings,
    paired_difference,
    share_of_gain,
    unpaired_difference,
)


def trainings(values, recordings=None, digest="d"):
    values = np.atleast_2d(np.asarray(values, np.float64))
    names = tuple(f"s{row}" for row in range(values.shape[1]))
    return Trainings(values, names, tuple(recordings or names), digest)


def test_one_training_each_agrees_with_the_bootstrap_of_the_differences():
    random = np.random.default_rng(0)
    recordings = [f"r{row // 4}" for row in range(200)]
    before = random.normal(5, 1, 200)
    after = before + random.normal(-0.3, 0.5, 200) + np.repeat(random.normal(0, 0.3, 50), 4)
    found = paired_difference(trainings(before, recordings), trainings(after, recordings))
    assert found.value == pytest.approx((after - before).mean())
    low, high = bootstrap_interval(after - before, recordings, num_resamples=20_000, seed=1)
    # Quantiles of 4,000 replicates are known to about 3 % of the width.
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.05 * (high - low))
    assert found.is_certain == (high < 0)


def test_equal_scores_differ_by_exactly_zero():
    same = trainings(np.random.default_rng(0).normal(size=(1, 40)))
    assert paired_difference(same, same) == Difference(0.0, 0.0, 0.0)


@pytest.mark.parametrize("count", [3, 6])
def test_the_spread_between_trainings_is_covered(count):
    """Samples that are alike leave that spread alone: the interval is that of t with R - 1 degrees of freedom."""
    offsets = np.random.default_rng(count).normal(0, 1, count)
    before, after = trainings(np.zeros((1, 50))), trainings(np.repeat(offsets[:, None], 50, axis=1))
    found = paired_difference(before, after)
    error = offsets.std(ddof=1) / np.sqrt(count)
    assert found.value == pytest.approx(offsets.mean())
    # Few trainings give few different replicates, so that quantiles are coarse.
    assert found.high - found.low == pytest.approx(2 * student.ppf(0.975, count - 1) * error, rel=0.2)


def test_intervals_cover_the_truth_about_as_often_as_they_say():
    random, covered, runs = np.random.default_rng(5), 0, 60
    for run in range(runs):
        recordings = [f"r{row // 3}" for row in range(90)]
        shared = np.repeat(random.normal(0, 1, 30), 3) + random.normal(0, 1, 90)
        training_sets = []
        for effect in (0.0, -0.5):
            own = np.repeat(random.normal(0, 0.5, 30), 3)
            seeds = random.normal(0, 0.2, (5, 1))
            training_sets.append(trainings(shared + own + effect + seeds + random.normal(0, 0.3, (5, 90)), recordings))
        found = paired_difference(*training_sets, seed=run)
        covered += found.low <= -0.5 <= found.high
    # The binomial spread of 60 runs is 3 %.
    assert 0.88 <= covered / runs <= 1


# Percentiles alone cover the truth in 83, 91, 96 and 90 % of such studies. Of 1,000 the binomial spread is 0.7 %.
@pytest.mark.parametrize(
    "num_recordings, num_trainings, spread, least",
    [
        (5, 1, 0.0, 0.925),
        pytest.param(10, 1, 0.0, 0.925, marks=pytest.mark.slow),
        pytest.param(10, 2, 0.1, 0.94, marks=pytest.mark.slow),
        (10, 2, 0.5, 0.94),
    ],
)
def test_intervals_of_few_recordings_and_trainings_cover_the_truth(
    monkeypatch, num_recordings, num_trainings, spread, least
):
    monkeypatch.setattr(paired_differences, "NUM_RESAMPLES", 1000)
    random, covered, runs = np.random.default_rng(7), 0, 1000
    recordings = [f"r{row}" for row in range(num_recordings)]
    for run in range(runs):
        effects = (np.zeros(num_recordings), random.normal(0, 1, num_recordings))
        before, after = (
            trainings(
                effect
                + random.normal(0, spread, (num_trainings, 1))
                + random.normal(0, 0.3, (num_trainings, num_recordings)),
                recordings,
            )
            for effect in effects
        )
        found = paired_difference(before, after, seed=run)
        covered += found.low <= 0 <= found.high
    assert covered / runs >= least


def test_missing_scores_leave_the_pair_out():
    before, after = trainings([1.0, 2, 3, 4, 5, 6]), trainings([2.0, 3, np.nan, 5, 6, 7])
    found = paired_difference(before, after)
    assert (found.value, found.low, found.high) == pytest.approx((1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="none of the 2 samples"):
        paired_difference(trainings([np.nan, 1.0]), trainings([1.0, np.nan]))


def test_few_recordings_give_no_interval():
    found = paired_difference(trainings([1.0] * 8, list("aabbccdd")), trainings([2.0] * 8, list("aabbccdd")))
    assert found.value == 1 and np.isnan([found.low, found.high]).all() and not found.is_certain
    assert found.text() == "+1.000"
    one = paired_difference(trainings([1.0, 2.0], "aa"), trainings([3.0, 3.0], "aa"))
    assert one.value == 1.5 and np.isnan([one.low, one.high]).all()
    other = unpaired_difference(trainings([1.0, 2.0], "aa"), trainings([3.0, 3.0], "bb"))
    assert other.value == 1.5 and np.isnan([other.low, other.high]).all()


@pytest.mark.parametrize(
    "other", [trainings([1.0, 2.0, 3.0]), trainings([1.0, 2.0], digest="e"), trainings([1, 2], "ab")]
)
def test_other_samples_are_refused(other):
    with pytest.raises(ValueError, match="the same samples in the same order"):
        paired_difference(trainings([1.0, 2.0]), other)


def test_pairing_sees_what_separate_drawing_does_not():
    random = np.random.default_rng(0)
    before = random.normal(0, 3, 100)
    first, second = trainings(before), trainings(before - 0.2)
    assert paired_difference(first, second).is_certain
    apart = unpaired_difference(first, trainings(before - 0.2, digest="other"))
    assert not apart.is_certain and apart.value == pytest.approx(-0.2)
    # Two independent means of 100 values each.
    assert apart.high - apart.low == pytest.approx(2 * 1.96 * before.std() * np.sqrt(2 / 100), rel=0.1)


def test_the_share_of_a_gain_is_a_ratio_of_differences():
    random = np.random.default_rng(0)
    start = random.normal(10, 1, 60)
    gain = random.uniform(1, 3, 60)
    found = share_of_gain(trainings(start), trainings(start - 0.6 * gain), trainings(start - gain))
    assert found is not None and (found.value, found.low, found.high) == pytest.approx((0.6, 0.6, 0.6))
    noise = random.normal(0, 1, 60)
    assert share_of_gain(trainings(start), trainings(start - gain), trainings(start + noise - noise.mean())) is None


def test_what_is_hard_for_every_training_does_not_narrow_the_share_of_a_gain():
    random = np.random.default_rng(2)
    own = [score + random.normal(0, 0.1, (2, 1)) + random.normal(0, 0.2, (2, 40)) for score in (10.0, 9.3, 9.0)]
    common = random.normal(0, 10, 40)
    found = share_of_gain(*map(trainings, own))
    among_others = share_of_gain(*(trainings(values + common) for values in own))
    assert found is not None and found.low < found.value < found.high
    assert (among_others.low, among_others.high) == pytest.approx((found.low, found.high), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("num_trainings", [2, 3])
def test_intervals_of_shares_cover_the_truth(monkeypatch, num_trainings):
    monkeypatch.setattr(paired_differences, "NUM_RESAMPLES", 1000)
    random, covered, runs = np.random.default_rng(11), 0, 0
    for _ in range(300):
        common = random.normal(0, 3, 40)
        sets = [
            trainings(
                score + common + random.normal(0, 0.1, (num_trainings, 1)) + random.normal(0, 0.1, (num_trainings, 40))
            )
            for score in (10.0, 9.5, 9.0)
        ]
        found = share_of_gain(*sets)
        if found is not None:
            runs, covered = runs + 1, covered + (found.low <= 0.5 <= found.high)
    assert runs > 150 and covered / runs >= 0.94


def test_results_do_not_depend_on_the_order_of_trainings():
    random = np.random.default_rng(0)
    values, other = random.normal(size=(3, 40)), trainings(random.normal(size=(2, 40)))
    first, second = (paired_difference(trainings(rows), other) for rows in (values, values[::-1]))
    assert first.value == pytest.approx(second.value)
    assert (first.low, first.high) == pytest.approx((second.low, second.high), rel=1e-12)


def test_the_difference_is_that_of_the_weighted_means():
    """A little worse on whole people, better on those of whom two joints are in the picture: worse in all."""
    random = np.random.default_rng(0)
    weights = np.tile([13.0, 2.0], 100)
    before = 6 + random.normal(0, 0.1, 200)
    after = before + np.where(weights > 2, 0.5, -3.0)
    names, recordings = tuple(map(str, range(200))), tuple(str(row // 10) for row in range(200))
    one, other = (Trainings(values[None], names, recordings, "d", weights) for values in (before, after))
    found = paired_difference(one, other)
    expected = np.average(after, weights=weights) - np.average(before, weights=weights)
    assert found.value == pytest.approx(expected) and expected > 0 and found.low <= found.value <= found.high
    alike = paired_difference(replace(one, weights=None), replace(other, weights=None))
    assert alike.value == pytest.approx((after - before).mean()) and alike.value < 0
