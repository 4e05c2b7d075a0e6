"""Skeletons before, at and after a moment; where joints come from and go to, from the labels of their recording."""

import numpy as np
import pytest

from ctlev_core.conditions import moving_skeleton
from ctlev_core.labels.displacements import displacements
from ctlev_core.render.skeleton import draw_skeleton
from data_contracts.errors import DataError
from data_contracts.labels import Labels

SIZE = (48, 40)


def track(times, joints):
    joints = np.asarray(joints, np.float32)
    return Labels(("walk",) * len(times), np.asarray(times, np.int64), joints, np.ones(joints.shape[:2], bool), "dhp19")


def pose(seed=0):
    return np.random.default_rng(seed).uniform(8, 32, (13, 2)).astype(np.float32)


def test_displacements_of_a_steady_motion_are_its_velocity():
    """Also beyond the first and last label, where there is nothing to look up."""
    times, velocity = np.arange(0, 101, 10), np.array([0.3, -0.1])
    joints = pose()[None] + times[:, None, None] * velocity
    moved = displacements(track(times, joints), np.array([0, 7, 50, 100, 120]), 20, "r")
    assert moved.shape == (5, 2, 13, 2)
    assert np.abs(moved[:, 0] - -20 * velocity).max() < 1e-4
    assert np.abs(moved[:, 1] - 20 * velocity).max() < 1e-4


def test_displacements_lie_on_straight_lines_between_labels():
    joints = pose() + np.array([[0, 0], [4, 0], [4, 8]])[:, None]
    (before, after), *_ = displacements(track([0, 20, 40], joints), np.array([20]), 10, "r")
    assert np.allclose(before, [-2, 0], atol=1e-4) and np.allclose(after, [0, 4], atol=1e-4)


def test_short_tracks_and_unknown_joints():
    with pytest.raises(DataError, match="r: displacements need two labels with joints2d, got 1 label"):
        displacements(track([5], pose()[None]), np.array([5]), 10, "r")
    joints = np.stack([pose(), pose() + 1])
    moved = displacements(track([0, 10], joints), np.array([3, 8]), 1_000, "r")
    assert np.allclose(moved[:, 1], 1, atol=1e-4), "a reach beyond the track is cut to its length"
    joints[0, 4] = np.nan
    moved = displacements(track([0, 10], joints), np.array([3]), 10, "r")
    assert np.isnan(moved[0, :, 4]).all() and np.isfinite(np.delete(moved, 4, axis=2)).all()


@pytest.mark.parametrize("times", [[0, 0, 10, 20], [0, 10, 10, 20], [0, 10, 20, 20]])
def test_of_labels_of_one_time_the_first_counts(times):
    joints = pose() + np.array(times)[:, None, None]
    twice = 1 + int(np.argmin(np.diff(times)))
    joints[twice] += 99
    moved = displacements(track(times, joints), np.array([0, 4, 10, 20]), 10, "r")
    assert np.allclose(moved[:, 0], -10, atol=1e-4) and np.allclose(moved[:, 1], 10, atol=1e-4)


def test_three_skeletons_in_three_colours():
    labels = track([0, 1], np.stack([pose(1), pose(2)]))
    moved = np.zeros((2, 2, 13, 2))
    moved[0, 0], moved[0, 1] = [-6, 0], [0, 5]
    moved[1, :, 3] = np.nan
    made = moving_skeleton.render(labels, SIZE, moving_skeleton.Options(), [0, 1], moved)
    assert made.prompts == ("A moving human",) * 2

    def grey(joints):
        return draw_skeleton(joints.astype(np.float32), np.ones(13, bool), "dhp19", SIZE).max(axis=-1)

    for channel, offset in enumerate(([-6, 0], [0, 0], [0, 5])):
        assert np.array_equal(made.images[0, ..., channel], grey(pose(1) + offset))
    still = made.images[1]
    assert (still == still[..., :1]).all(), "what stands still, or may, is grey"


def test_what_does_not_fit_is_refused():
    labels = track([0, 1], np.stack([pose(1), pose(2)]))
    with pytest.raises(DataError, match=r"displacements of shape \(2, 2, 12, 2\), which must be \(2, 2, 13, 2\)"):
        moving_skeleton.render(labels, SIZE, moving_skeleton.Options(), [0, 1], np.zeros((2, 2, 12, 2)))
    classes = Labels(("cup",), np.zeros(1, np.int64))
    with pytest.raises(DataError, match="no joints2d"):
        moving_skeleton.render(classes, SIZE, moving_skeleton.Options(), [0], np.zeros((1, 2, 13, 2)))
