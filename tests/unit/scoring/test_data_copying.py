"""C_T against SciPy's Mann-Whitney test and loops over pairs; authenticity against loops and mutual neighbours."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu, norm

from ctlev_core.scoring.data_copying import MIN_CELL_FRAMES, assign_cells, data_copying_test
from ctlev_core.scoring.memorisation import check_memorisation, find_authentic, nearest_rows


def names(count, per_recording=10, start="r"):
    return np.array([f"{start}{row // per_recording}" for row in range(count)])


def slow_z(first, second):
    """Pair by pair, with the variance of Siegel & Castellan: ties half, sum of t^3 - t over groups of ties."""
    larger = sum(1.0 if a > b else 0.5 if a == b else 0.0 for a in first for b in second)
    n, m = len(first), len(second)
    values = [*first.tolist(), *second.tolist()]
    ties = sum(values.count(value) ** 3 - values.count(value) for value in set(values))
    total = n + m
    variance = n * m * (total + 1) / 12 - n * m * ties / (12 * total * (total - 1))
    return (larger - n * m / 2) / math.sqrt(variance) if variance > 1e-9 else 0.0


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 1000),
    sizes=st.tuples(st.integers(20, 40), st.integers(20, 40)),
    shift=st.floats(-2, 2),
    grid=st.booleans(),
)
def test_one_cell_is_the_mann_whitney_test(seed, sizes, shift, grid):
    rng = np.random.default_rng(seed)
    first, second = rng.normal(size=sizes[0]) + shift, rng.normal(size=sizes[1])
    if grid:
        first, second = np.round(first), np.round(second)
    found = data_copying_test(first, second)
    assert found.value == pytest.approx(slow_z(first, second), abs=1e-9) and found.num_cells == 1
    p = mannwhitneyu(first, second, use_continuity=False, alternative="less", method="asymptotic").pvalue
    assert norm.cdf(found.value) == pytest.approx(p, abs=1e-9)
    # The other way round it has the other sign.
    assert data_copying_test(second, first).value == pytest.approx(-found.value, abs=1e-9)


def test_cells_are_weighted_by_their_recorded_frames_and_small_ones_left_out():
    rng = np.random.default_rng(1)
    first, second = rng.normal(size=150), rng.normal(size=160)
    cells, real_cells = np.repeat([0, 1, 2], [60, 80, 10]), np.repeat([0, 1, 2], [30, 100, 30])
    found = data_copying_test(first, second, cells=cells, real_cells=real_cells)
    parts = [slow_z(first[cells == cell], second[real_cells == cell]) for cell in (0, 1)]
    assert found.num_cells == 2 and found.value == pytest.approx((30 * parts[0] + 100 * parts[1]) / 130, abs=1e-9)
    few = data_copying_test(first[: MIN_CELL_FRAMES - 1], second)
    assert few.num_cells == 0 and np.isnan([few.value, few.low, few.high]).all()


def test_copying_in_one_cell_is_not_hidden_by_poor_frames_in_another():
    """Meehan et al., figure 1: what the cells are for."""
    rng = np.random.default_rng(2)
    centres = np.array([[0.0, 0.0], [100.0, 0.0]])
    training, real = (np.concatenate([rng.normal(size=(150, 2)) + centre for centre in centres]) for _ in range(2))
    copies = training[:150] + 0.01 * rng.normal(size=(150, 2))
    poor = centres[1] + 3 * rng.normal(size=(150, 2))
    generated = np.concatenate([copies, poor])
    distances, real_distances = (nearest_rows(rows, training)[0] for rows in (generated, real))
    whole = data_copying_test(distances, real_distances)
    assert abs(whole.value) < 3
    cells, real_cells = assign_cells(training, generated, real)
    assert len(set(cells)) > 1
    left = cells[0]
    alone = data_copying_test(distances[cells == left], real_distances[real_cells == left])
    assert alone.value < -9


@pytest.mark.parametrize("per_recording", [1, 10])
def test_intervals_hold_zero_as_often_as_they_say_and_z_alone_does_not(per_recording):
    """Frames of a recording share their distance almost, and z takes them for independent."""
    held, far = 0, 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        first, second = (
            np.repeat(rng.normal(size=40), per_recording) + 0.1 * rng.normal(size=40 * per_recording) for _ in range(2)
        )
        groups = names(len(first), per_recording)
        found = data_copying_test(first, second, groups=groups, real_groups=groups, seed=seed)
        held += found.low <= 0 <= found.high
        far += abs(found.value) > 1.96
    # 95 % of 60 is 57, three deviations are 5.
    assert held >= 52
    assert far >= 20 if per_recording == 10 else far <= 8


def test_equal_distances_single_groups_and_huge_ones():
    same = data_copying_test(np.zeros(30), np.zeros(40))
    assert (same.value, same.low, same.high) == (0, 0, 0)
    single = data_copying_test(np.arange(30.0), np.arange(30.0), real_groups=["r"] * 30)
    assert single.value == 0 and np.isnan([single.low, single.high]).all()
    farther = data_copying_test(np.full(30, 1e300), np.arange(30.0))
    assert farther.value == pytest.approx(slow_z(np.full(30, 1e300), np.arange(30.0))) and farther.value > 6


def test_cells_of_constant_and_far_features():
    constant = np.full((400, 3), 5.0)
    assert {cell for cells in assign_cells(constant, constant, constant) for cell in cells} == {0}
    rng = np.random.default_rng(3)
    rows = rng.normal(size=(400, 4))
    cells = assign_cells(rows, rows, rows)
    assert 2 <= len(np.unique(cells[0])) <= 4
    far = assign_cells(rows + 1e9, rows + 1e9, rows + 1e9)
    assert np.mean(far[0] == cells[0]) > 0.99
    np.testing.assert_array_equal(assign_cells(rows * 1e300, rows * 1e300)[0], assign_cells(rows, rows)[0])
    assert assign_cells(rows, rows[:1])[0].tolist() == [0]


def slow_authentic(generated, training, recordings):
    found = []
    for frame in generated:
        to_training = [float(np.linalg.norm(frame - other)) for other in training]
        nearest = int(np.argmin(to_training))
        others = [
            float(np.linalg.norm(training[nearest] - training[row]))
            for row in range(len(training))
            if recordings[row] != recordings[nearest]
        ]
        found.append(min(others) < to_training[nearest])
    return found


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 1000),
    sizes=st.tuples(st.integers(1, 15), st.integers(4, 20), st.integers(1, 4)),
    grid=st.booleans(),
)
def test_authentic_frames_are_those_of_a_loop(seed, sizes, grid):
    rng = np.random.default_rng(seed)
    generated, training = rng.normal(size=(sizes[0], sizes[2])), rng.normal(size=(sizes[1], sizes[2]))
    if grid:
        generated, training = np.round(generated), np.round(training)
    recordings = names(len(training), 3)
    distances, nearest = nearest_rows(generated, training)
    expected = slow_authentic(generated, training, recordings)
    assert find_authentic(distances, nearest, training, recordings).tolist() == expected
    # Of one recording alone: every other frame counts.
    alone = find_authentic(distances, nearest, training, ["r"] * len(training)).tolist()
    assert alone == slow_authentic(generated, training, np.arange(len(training)))


@pytest.mark.parametrize(("width", "mutual"), [(1, 2 / 3), (2, 6 * math.pi / (8 * math.pi + 3 * math.sqrt(3)))])
def test_without_copying_authentic_frames_are_those_that_are_no_mutual_nearest_neighbours(width, mutual):
    """A frame that is not authentic and its nearest training frame are each other's nearest.

    The share of points whose nearest neighbour has them for its own: Pickard, J. Appl. Prob. 19, 1982.
    """
    rng = np.random.default_rng(4)
    training, generated = rng.uniform(size=(20_000, width)), rng.uniform(size=(4000, width))
    distances, nearest = nearest_rows(generated, training)
    share = find_authentic(distances, nearest, training, np.arange(20_000)).mean()
    assert share == pytest.approx(1 - mutual, abs=4 * math.sqrt(mutual * (1 - mutual) / 4000))


def check(generated, training, **more):
    recordings = names(len(training))
    return check_memorisation(
        generated, training, training, training_recordings=recordings, real_recordings=recordings, **more
    )


def test_copies_are_neither_authentic_nor_as_far_as_other_frames():
    rng = np.random.default_rng(5)
    training = rng.normal(size=(600, 4))
    fresh, copied = rng.normal(size=(400, 4)), training[:400] + 0.02 * rng.normal(size=(400, 4))
    honest, copying = check(fresh, training), check(copied, training)
    assert honest.copying.low < 0 < honest.copying.high and abs(honest.copying.value) < 3
    assert copying.copying.high < -5 and copying.copying.num_cells == 4
    assert 0.35 < honest.authentic_share < 0.55 and copying.authentic_share < 0.02
    assert honest.authentic_low < honest.authentic_share < honest.authentic_high
    poor = check(3 * fresh, training)
    assert poor.copying.low > 5 and poor.authentic_share > 0.8


def test_held_out_recordings_in_the_place_of_generated_frames_are_the_floor():
    """Resampled by recording, and not compared with frames of their own recording."""
    rng = np.random.default_rng(6)
    scenes = np.repeat(rng.normal(size=(90, 4)), 10, axis=0) + 0.05 * rng.normal(size=(900, 4))
    training, held_out = scenes[:600], scenes[600:]
    by_frame = check(held_out, training)
    floor = check(held_out, training, generated_recordings=names(300, start="test"))
    assert floor.copying.value == by_frame.copying.value and floor.authentic_share == by_frame.authentic_share
    assert floor.authentic_high - floor.authentic_low > 1.5 * (by_frame.authentic_high - by_frame.authentic_low)
    assert floor.copying.low < 0 < floor.copying.high
    # Of recordings split in time: frames of the same recording are near, and say nothing.
    later = training + 0.05 * rng.normal(size=training.shape)
    split = check(later, training, generated_recordings=names(600))
    assert abs(split.copying.value) < 1 and check(later, training).copying.value < -10


def test_a_single_training_frame_has_no_other():
    one = check_memorisation(
        np.zeros((2, 3)), np.ones((1, 3)), np.ones((1, 3)) * 2, training_recordings=["a"], real_recordings=["b"]
    )
    assert np.isnan([one.authentic_share, one.authentic_low, one.copying.value]).all()
    with pytest.raises(ValueError, match="row 0 has no reference of another group"):
        check(np.zeros((2, 3)), np.ones((3, 3)), generated_recordings=["r0", "r0"])
