"""The best similarity against SciPy and closed forms, and the cases that have no best one."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import orthogonal_procrustes
from scipy.spatial.transform import Rotation

from ctlev_core.geometry.procrustes import align_similarity

ALL = np.ones((1, 13), bool)


def errors(points, target, known=ALL):
    return np.linalg.norm(align_similarity(points[None], target[None], known)[0] - target, axis=-1)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-6, 1e6), st.floats(0, 1e5))
def test_a_similar_copy_is_brought_back(seed, scale, distance):
    random = np.random.default_rng(seed)
    target = 300 * random.normal(size=(13, 3))
    copy = scale * target @ Rotation.random(random_state=seed % 2**31).as_matrix() + distance * random.normal(size=3)
    # What float64 keeps of a shape `scale` large at `distance`.
    assert errors(copy, target).max() < 1e-9 * (1 + distance / scale)


def test_it_is_the_optimum_scipy_finds():
    random = np.random.default_rng(0)
    points, target = random.normal(size=(2, 40, 13, 3))
    for row in range(40):
        a, b = points[row] - points[row].mean(axis=0), target[row] - target[row].mean(axis=0)
        rotation, _ = orthogonal_procrustes(a, b)
        if np.linalg.det(rotation) < 0:
            continue  # SciPy's may reflect; see below
        scale = np.sum((a @ rotation) * b) / np.sum(a * a)
        expected = scale * a @ rotation + target[row].mean(axis=0)
        got = align_similarity(points[row : row + 1], target[row : row + 1], ALL)[0]
        np.testing.assert_allclose(got, expected, atol=1e-12)


def test_no_rotation_near_the_one_found_does_better():
    """Also where the best orthogonal map is a reflection: the best rotation is then another one."""
    random = np.random.default_rng(1)
    target = random.normal(size=(13, 3)) * [1.0, 0.7, 0.3]
    mirrored = target * [1, 1, -1]
    best = np.sum(errors(mirrored, target) ** 2)
    assert best > 0.1
    a, b = mirrored - mirrored.mean(axis=0), target - target.mean(axis=0)
    for rotation in Rotation.random(2000, random_state=0).as_matrix():
        turned = a @ rotation
        scale = max(np.sum(turned * b) / np.sum(turned * turned), 0)
        assert np.sum((scale * turned - b) ** 2) >= best - 1e-9


def test_a_collapsed_pose_lands_on_the_mean():
    target = np.random.default_rng(2).normal(size=(13, 3))
    for collapsed in (np.zeros((13, 3)), np.full((13, 3), 1e6)):
        got = align_similarity(collapsed[None], target[None], ALL)[0]
        np.testing.assert_allclose(got, np.tile(target.mean(axis=0), (13, 1)), atol=1e-12)


@pytest.mark.parametrize("direction", [[1.0, 0, 0], [1.0, 1, 1]])
def test_collinear_points_find_their_line(direction):
    target = np.linspace(0, 1, 13)[:, None] * np.array([0.0, 2, 0])
    points = np.linspace(0, 1, 13)[:, None] * np.array(direction)
    assert errors(points, target).max() < 1e-12


@pytest.mark.parametrize("rank", [0, 1, 2, 3])
def test_no_rank_of_either_set_breaks_it(rank):
    """Points on a line, in a plane or in one place, and their mirror images: never NaN, never a reflection."""
    random = np.random.default_rng(rank)
    target = 200 * random.normal(size=(50, 13, rank)) @ random.normal(size=(50, rank, 3)) + 1000
    points = 200 * random.normal(size=(50, 13, 3))
    known = np.ones((50, 13), bool)
    for source, goal in ((points, target), (target, points), (target, -target), (target, target * [1, 1, -1])):
        aligned = align_similarity(source, goal, known)
        assert np.isfinite(aligned).all()
        # A similarity without reflection: distances scale alike, and volumes keep their sign.
        before, after = source - source.mean(axis=1, keepdims=True), aligned - aligned.mean(axis=1, keepdims=True)
        lengths = np.linalg.norm(before, axis=(1, 2)), np.linalg.norm(after, axis=(1, 2))
        volumes = [np.linalg.det(array[:, :3]) for array in (before, after)]
        scales = lengths[1] / np.where(lengths[0] > 1e-9, lengths[0], 1)
        sizes = [np.linalg.norm(array[:, :3], axis=(1, 2)) ** 3 for array in (before, after)]
        assert (np.abs(volumes[1] - scales**3 * volumes[0]) <= 1e-11 * np.maximum(*sizes)).all()


def test_it_is_the_similarity_of_an_independent_rotation_solver():
    """SciPy's align_vectors, a quaternion solver, gives the best rotation also where a reflection would be better."""
    random = np.random.default_rng(4)
    for seed in range(30):
        points, target = random.normal(size=(2, 13, 3)) * random.uniform(0.1, 1, size=3)
        if seed % 2:
            target = points * [1, 1, -1] + 0.1 * target
        a, b = points - points.mean(axis=0), target - target.mean(axis=0)
        turned = Rotation.align_vectors(b, a)[0].apply(a)
        expected = max(np.sum(turned * b), 0) / np.sum(a * a) * turned + target.mean(axis=0)
        np.testing.assert_allclose(align_similarity(points[None], target[None], ALL)[0], expected, atol=1e-10)


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_rows_do_not_depend_on_the_size_of_their_batch(size):
    """Event-HPE's own function takes batches of two or three poses for transposed ones."""
    points, target = np.random.default_rng(5).normal(size=(2, 12, 13, 3))
    known = np.ones((12, 13), bool)
    whole = align_similarity(points, target, known)
    parts = [slice(start, start + size) for start in range(0, 12, size)]
    got = np.concatenate([align_similarity(points[part], target[part], known[part]) for part in parts])
    assert np.array_equal(got, whole)


def test_single_precision_far_away_loses_no_more_than_its_own_digits():
    """With float32 sums at 10 m this loses 0.7 um; what the rounded points say is found to 1e-9 mm."""
    target = 300 * np.random.default_rng(6).normal(size=(13, 3))
    points = (target + 1e4).astype(np.float32)
    best = errors(points, target)
    assert best.max() < 2 * np.spacing(np.float32(1e4))
    again = errors(points.astype(np.float64) - 1e4, target)
    np.testing.assert_allclose(best, again, atol=1e-9)


def test_shapes_that_differ_are_refused():
    with pytest.raises(ValueError, match=r"points and target must be \[N, J, 3\] .* got \(1, 13, 3\), \(1, 12, 3\)"):
        align_similarity(np.zeros((1, 13, 3)), np.zeros((1, 12, 3)), ALL)


def test_what_is_not_known_has_no_say():
    random = np.random.default_rng(3)
    target = random.normal(size=(13, 3))
    points = 2 * target @ Rotation.random(random_state=3).as_matrix() + 1
    known = ALL.copy()
    known[0, 4:6] = False
    target[4:6], points[4:6] = np.nan, 1e3
    assert errors(points, target, known)[known[0]].max() < 1e-12
    nothing = align_similarity(points[None], target[None], np.zeros((1, 13), bool))[0]
    np.testing.assert_array_equal(nothing, points)
