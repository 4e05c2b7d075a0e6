"""Poses to sample from: farthest points and nearest neighbours against loops, and what they promise."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.labels import pose_choice
from ctlev_core.labels.pose_choice import NUM_NEIGHBOURS, farthest_points, hardest, pose_vectors, predict_errors
from data_contracts.errors import DataError
from data_contracts.labels import Labels


def labels(joints):
    joints = np.asarray(joints, np.float32)
    return Labels(("",) * len(joints), np.arange(len(joints)), joints, ~np.isnan(joints).any(axis=-1), "dhp19")


def test_distances_of_poses_are_those_of_their_joints_within_the_image():
    rng = np.random.default_rng(0)
    joints = rng.uniform(5, 60, (4, 13, 2))
    vectors = pose_vectors(labels(joints), (64, 64))
    for i, j in itertools.combinations(range(4), 2):
        squared = ((joints[i] - joints[j]) ** 2).sum(axis=-1)
        assert np.linalg.norm(vectors[i] - vectors[j]) == pytest.approx(np.sqrt(squared.mean()), rel=1e-6)
    outside = np.repeat(joints[:1], 3, axis=0)
    outside[1, 2], outside[2, 2] = (-500, 30), (0, 30)
    outside[0, 2] = np.nan
    found = pose_vectors(labels(outside), (64, 64))
    np.testing.assert_array_equal(found[1], found[2])
    known = np.delete(outside[0], 2, axis=0).mean(axis=0)
    np.testing.assert_allclose(found[0].reshape(13, 2)[2] * np.sqrt(13), known, rtol=1e-6)
    assert np.isnan(pose_vectors(labels(np.full((1, 13, 2), np.nan)), (64, 64))).all()
    with pytest.raises(DataError, match="expected labels with 2D joints"):
        pose_vectors(Labels(("cat",), np.arange(1)), (64, 64))


def slow_farthest(candidates, covered, count):
    chosen, at = [], []
    for _ in range(count):
        centres = [*covered, *candidates[chosen]]
        if centres:
            nearest = [min(float(np.linalg.norm(row - centre)) for centre in centres) for row in candidates]
        else:
            nearest = [float(np.linalg.norm(row - candidates.mean(axis=0))) for row in candidates]
        left = [row for row in range(len(candidates)) if row not in chosen]
        best = max(left, key=lambda row: (nearest[row], -row))
        chosen.append(best)
        at.append(nearest[best])
    return chosen, at


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 1000),
    sizes=st.tuples(st.integers(1, 20), st.integers(0, 10), st.integers(1, 4)),
    grid=st.booleans(),
)
def test_each_point_is_the_farthest_from_those_before(seed, sizes, grid):
    rng = np.random.default_rng(seed)
    candidates, covered = rng.normal(size=(sizes[0], sizes[2])), rng.normal(size=(sizes[1], sizes[2]))
    if grid:  # points repeat, and are equally far
        candidates, covered = np.round(candidates), np.round(covered)
    chosen, at = farthest_points(candidates, covered, sizes[0])
    expected = slow_farthest(candidates, covered, sizes[0])
    assert chosen.tolist() == expected[0]
    np.testing.assert_allclose(at, expected[1], rtol=1e-12, atol=1e-12)
    assert sorted(chosen) == list(range(sizes[0]))
    # What is left only shrinks, once something is covered, and fewer are the first of more.
    assert (np.diff(at[0 if len(covered) else 1 :]) <= 1e-12).all()
    few, _ = farthest_points(candidates, covered, (sizes[0] + 1) // 2)
    np.testing.assert_array_equal(few, chosen[: len(few)])


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 4))
def test_what_is_left_uncovered_is_at_most_twice_the_smallest_possible(seed, count):
    """Gonzalez 1985, against all choices of so many of nine."""
    candidates = np.random.default_rng(seed).normal(size=(9, 2))
    between = np.linalg.norm(candidates[:, None] - candidates, axis=2)
    best = min(between[:, list(some)].min(axis=1).max() for some in itertools.combinations(range(9), count))
    chosen, _ = farthest_points(candidates, np.empty((0, 2)), count)
    assert between[:, chosen].min(axis=1).max() <= 2 * best + 1e-12


def test_expected_errors_are_means_of_the_nearest(monkeypatch):
    rng = np.random.default_rng(1)
    candidates, known, errors = rng.normal(size=(30, 3)), rng.normal(size=(40, 3)), rng.uniform(size=40)
    expected = []
    for row in candidates:
        order = sorted(range(40), key=lambda other: (float(np.linalg.norm(row - known[other])), other))
        expected.append(np.mean([errors[other] for other in order[:NUM_NEIGHBOURS]]))
    np.testing.assert_allclose(predict_errors(candidates, known, errors), expected, rtol=1e-12)
    monkeypatch.setattr(pose_choice, "_BLOCK_NUMBERS", 100)
    np.testing.assert_allclose(predict_errors(candidates, known, errors), expected, rtol=1e-12)
    # Of fewer known poses than neighbours all count.
    np.testing.assert_allclose(predict_errors(candidates, known[:3], errors[:3]), errors[:3].mean(), rtol=1e-12)


def test_the_hardest_are_the_largest_errors():
    assert hardest(np.array([1.0, 5.0, 3.0, 5.0, 2.0, 0.0, 5.0, 4.0]), 0.25).tolist() == [1, 3]
    assert hardest(np.array([1.0, 2.0]), 0.01).tolist() == [1]
