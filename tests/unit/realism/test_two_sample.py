"""The two-sample test: exact areas, frames that can and cannot be told apart, bad input."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu

from ctlev_core.realism.roc import HeldOut, area_under_roc, interval_of_mean_area
from ctlev_core.realism.two_sample import (
    MIN_FRAMES,
    TwoSampleTest,
    choose_rows,
    compare_frames,
    compare_halves,
)
from data_contracts import tables

SCORES = st.lists(st.integers(0, 5).map(float), min_size=1, max_size=12).map(np.array)


@settings(max_examples=80, deadline=None)
@given(SCORES, SCORES)
def test_the_area_is_mann_whitneys_u_with_ties(first, second):
    pairs = [(a > b) + (a == b) / 2 for a in first for b in second]
    assert area_under_roc(first, second) == pytest.approx(np.mean(pairs), abs=1e-12)
    u = mannwhitneyu(first, second).statistic
    assert area_under_roc(first, second) == pytest.approx(u / (len(first) * len(second)), abs=1e-12)
    assert area_under_roc(second, first) == pytest.approx(1 - area_under_roc(first, second), abs=1e-12)
    assert area_under_roc(-second, -first) == pytest.approx(area_under_roc(first, second), abs=1e-12)


@settings(max_examples=30, deadline=None)
@given(SCORES, SCORES, st.integers(0, 2**31))
def test_recordings_drawn_several_times_count_as_often(first, second, seed):
    rng = np.random.default_rng(seed)
    groups = rng.integers(0, 4, len(first)), rng.integers(2, 6, len(second))
    held_out = HeldOut.make((first, second), groups)
    assert held_out.area == pytest.approx(area_under_roc(first, second))
    weights = rng.integers(0, 3, (1, 6)).astype(float)
    repeated = [np.repeat(s, weights[0, g].astype(int)) for s, g in zip((first, second), groups, strict=True)]
    (found,) = held_out.areas(weights)
    if min(map(len, repeated)) == 0:
        assert np.isnan(found)
    else:
        assert found == pytest.approx(area_under_roc(repeated[0], repeated[1]))


def test_the_interval_widens_with_the_spread_of_the_trainings():
    groups, kinds = (np.arange(0, 50), np.arange(50, 100)), np.repeat([1, 2], 50)

    def widths(shifts):
        rng = np.random.default_rng(0)
        scores = rng.normal(size=50), rng.normal(size=50)
        trainings = [HeldOut.make((scores[0] + shift, scores[1]), groups) for shift in shifts]
        low, high = interval_of_mean_area(trainings, kinds, np.random.default_rng(1))
        assert low < np.mean([training.area for training in trainings]) < high
        return high - low

    assert widths([0.5] * 4) < widths([-0.5, 0, 1, 1.5])


def noise(count: int, share: float, seed: int, side: int = 16) -> np.ndarray:
    """Frames of independent pixels."""
    active = np.random.default_rng(seed).random((count, side, side, 1)) < share
    return (active * np.uint8(120)).repeat(3, axis=-1)


def bars(count: int, seed: int, isolated: int = 0, side: int = 16) -> np.ndarray:
    """Frames of a bright upright bar at a random place, with some isolated pixels."""
    rng = np.random.default_rng(seed)
    frames = np.zeros((count, side, side, 3), np.uint8)
    for frame in frames:
        column = rng.integers(1, side - 2)
        frame[2:-2, column : column + 2] = 150
        for _ in range(isolated):
            frame[rng.integers(side), rng.integers(side)] = 150
    return frames


def names(count: int, start: int = 0, per_recording: int = 1) -> np.ndarray:
    return np.array([f"r{start + number // per_recording}" for number in range(count)])


def compare(first: np.ndarray, second: np.ndarray, seed: int = 0, per_recording: int = 1) -> TwoSampleTest:
    groups = names(len(first), 0, per_recording), names(len(second), 10_000, per_recording)
    return compare_frames(first, second, first_groups=groups[0], second_groups=groups[1], seed=seed)


@pytest.mark.slow
def test_frames_of_one_distribution_cannot_be_told_apart():
    found = [compare(noise(50, 0.1, 2 * seed), noise(50, 0.1, 2 * seed + 1), seed) for seed in range(3)]
    areas = [test.value for test in found]
    # One area varies by some 0.04; the interval says so.
    assert np.mean(areas) == pytest.approx(0.5, abs=0.06)
    assert all(test.low < 0.5 < test.high for test in found)


def test_the_floor_of_halves_is_a_half():
    found = compare_halves(bars(100, 0, isolated=3), names(100, per_recording=2))
    assert found.low < 0.5 < found.high and found.value == pytest.approx(0.5, abs=0.12)
    assert (found.num_first, found.num_second, found.note) == (50, 50, "")


@pytest.mark.usefixtures("quick_two_sample_tests")
def test_an_easy_difference_is_told_always():
    found = compare(noise(60, 0.1, 0), bars(60, 1))
    assert found.value > 0.99 and found.low > 0.95 and found.high <= 1


def test_isolated_pixels_are_told():
    """What a decoder smooths away, and no classifier of digits looks at."""
    found = compare(bars(120, 0, isolated=3), bars(120, 1))
    assert found.value > 0.9 and found.low > 0.5


@pytest.mark.usefixtures("quick_two_sample_tests")
def test_exchanging_the_sets_gives_the_same_area_up_to_noise():
    first, second = bars(80, 0, isolated=1), bars(80, 1)
    one, other = compare(first, second), compare(second, first)
    assert one.value == pytest.approx(other.value, abs=3 * max(one.deviation, other.deviation, 0.02))


@pytest.mark.usefixtures("quick_two_sample_tests")
def test_names_of_recordings_do_not_matter_and_mixed_sets_are_a_half():
    first, second = noise(45, 0.1, 0), bars(45, 1)
    found = compare(first, second)
    renamed = compare_frames(first, second, first_groups=names(45, 500), second_groups=names(45, 20_000))
    assert renamed.value == pytest.approx(found.value, abs=0.02)
    every = np.concatenate([first, second])[np.random.default_rng(0).permutation(90)]
    mixed = compare(every[:45], every[45:])
    assert mixed.low < 0.5 < mixed.high


def test_equal_seeds_give_equal_results_with_any_number_of_threads(monkeypatch):
    monkeypatch.setattr("ctlev_core.realism.two_sample_network.NUM_STEPS", 20)
    first, second = bars(45, 0, isolated=1), bars(45, 1)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        found = compare(first, second, seed=3)
        torch.set_num_threads(2)
        torch.manual_seed(9)
        state = torch.get_rng_state()
        assert compare(first, second, seed=3) == found
        assert torch.get_num_threads() == 2 and torch.equal(torch.get_rng_state(), state)
    finally:
        torch.set_num_threads(before)
    assert compare(first, second, seed=4) != found


def test_frames_of_a_recording_are_never_on_both_sides():
    """Each recording has a place of its own that gives it away: on both sides, it would be told."""
    places = np.random.default_rng(0).permutation(256)[:40]
    frames = np.zeros((120, 256, 3), np.uint8)
    frames[np.arange(120), np.repeat(places, 3)] = 200
    frames = frames.reshape(120, 16, 16, 3)
    found = compare(frames[:60], frames[60:], per_recording=3)
    assert found.value == pytest.approx(0.5, abs=0.25) and found.low < 0.5


def test_copies_are_learnt_from_with_their_originals():
    """A copy that names its original's recording is in the same half, and tells nothing."""
    frames = bars(60, 0, isolated=4)
    found = compare_frames(frames, frames, first_groups=names(60), second_groups=names(60))
    assert found.value == pytest.approx(0.5, abs=0.06) and found.low <= 0.5 <= found.high


def test_images_larger_than_64_px_and_of_odd_size_are_taken():
    first = np.zeros((40, 21, 70, 3), np.uint8)
    second = first.copy()
    rng = np.random.default_rng(0)
    second[np.arange(40), rng.integers(21, size=40), rng.integers(70, size=40)] = 255
    assert compare(first, second).value > 0.9
    assert compare(first[..., :1], second[..., :1]).value > 0.9


# What cannot be measured ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "second", "per_recording", "reason"),
    [
        (bars(MIN_FRAMES - 1, 0), bars(60, 1), 1, "fewer than 40 frames in a set"),
        (bars(0, 0), bars(60, 1), 1, "fewer than 40 frames in a set"),
        (bars(60, 0), bars(60, 1), 60, "of one recording"),
        (bars(60, 0), bars(60, 1), 55, "half of the recordings have fewer than 10 frames"),
        (bars(60, 0), bars(60, 1, side=12), 1, "different sizes"),
    ],
)
def test_what_cannot_be_measured_is_not_a_number_with_the_reason(first, second, per_recording, reason):
    found = compare(first, second, per_recording=per_recording)
    assert np.isnan([found.value, found.low, found.high, found.deviation]).all()
    assert reason in found.note and (found.num_first, found.num_second) == (len(first), len(second))
    row = found.row()
    assert row["value"] is None and {"group", "subject", *row} == {c.name for c in tables.TWO_SAMPLE_TESTS.columns}


@pytest.mark.usefixtures("quick_two_sample_tests")
def test_few_recordings_have_an_area_without_an_interval_and_cannot_be_halved_twice():
    found = compare(noise(40, 0.1, 0), bars(40, 1), per_recording=10)
    assert found.value > 0.9 and np.isnan([found.low, found.high]).all()
    assert "3 recordings, which cannot be halved twice" in compare_halves(bars(90, 0), names(90, 0, 30)).note
    assert "fewer than 40" in compare_halves(bars(60, 0), names(60)).note


@pytest.mark.usefixtures("quick_two_sample_tests")
def test_frames_that_are_all_equal_or_empty_are_told_in_the_note():
    black = np.zeros((40, 16, 16, 3), np.uint8)
    found = compare(black, black)
    assert found.value == 0.5 and (found.low, found.high) == (0.5, 0.5)
    assert found.note == "40 of 40 first frames are empty; 40 of 40 second frames are empty"
    found = compare(black + np.uint8(90), bars(40, 0))
    assert found.value > 0.99 and found.note == "all first frames are equal"


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match=r"frames must be \[N, H, W, channels\] uint8"):
        compare(np.zeros((50, 8, 8), np.uint8), bars(50, 0))
    with pytest.raises(ValueError, match=r"groups must be \[50\]"):
        compare_frames(bars(50, 0), bars(50, 1), first_groups=names(49), second_groups=names(50))


def test_rows_are_spread_over_all_and_do_not_follow_a_period():
    rows = choose_rows(500, 50)
    assert len(set(rows.tolist())) == 50 and (rows // 10 == np.arange(50)).all()
    assert len(set((rows % 10).tolist())) > 5
    assert choose_rows(5, 50).tolist() == [0, 1, 2, 3, 4]
