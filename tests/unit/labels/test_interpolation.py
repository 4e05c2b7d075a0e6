"""Labels between labels: against scipy's Slerp, straight lines by hand, and where there is nothing to say."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from ctlev_core.labels.interpolation import MAX_SPACING, interpolate_labels, is_between_labels
from data_contracts.labels import Labels, check_labels


def body_track(times, seed=0):
    random = np.random.default_rng(seed)
    count = len(times)
    return Labels(
        tuple("ab"[row % 2] for row in range(count)),
        np.asarray(times, np.int64),
        random.uniform(0, 60, (count, 24, 2)).astype(np.float32),
        random.random((count, 24)) < 0.7,
        "smpl",
        random.normal(0, 500, (count, 24, 3)).astype(np.float32),
        random.normal(0, 1.5, (count, 72)).astype(np.float32),
        random.normal(size=(count, 10)).astype(np.float32),
        random.normal(size=(count, 3)).astype(np.float32),
        random.uniform(100, 200, (count, 4)).astype(np.float32),
    )


@settings(deadline=None, max_examples=20)
@given(st.integers(2, 9), st.integers(0, 2**32 - 1))
def test_bodies_equal_scipys_slerp_and_straight_lines(count, seed):
    random = np.random.default_rng(seed)
    times = 1000 * np.arange(count) + random.integers(-150, 150, count)
    labels = body_track(times + 1000, seed)
    moments = random.integers(labels.t_us[0], labels.t_us[-1] + 1, 12)
    found = check_labels(interpolate_labels(labels, moments), "found")
    assert found.t_us.tolist() == moments.tolist()
    pose = found.smpl_pose.reshape(-1, 24, 3)
    for joint in range(24):
        keys = Rotation.from_rotvec(labels.smpl_pose.reshape(-1, 24, 3)[:, joint])
        expected = Slerp(labels.t_us, keys)(moments)
        between = (expected.inv() * Rotation.from_rotvec(pose[:, joint])).magnitude()
        assert between.max() < 1e-5
    for name in ("joints2d", "joints3d", "smpl_betas", "smpl_transl", "intrinsics"):
        track = getattr(labels, name).reshape(count, -1)
        expected = np.stack([np.interp(moments, labels.t_us, column) for column in track.T], axis=1)
        np.testing.assert_allclose(getattr(found, name).reshape(12, -1), expected, rtol=1e-4, atol=1e-3)
    for row, moment in enumerate(moments):
        around = [i for i, t in enumerate(labels.t_us) if t == moment] or [
            max(i for i, t in enumerate(labels.t_us) if t < moment),
            min(i for i, t in enumerate(labels.t_us) if t > moment),
        ]
        assert found.visible[row].tolist() == np.all(labels.visible[around], axis=0).tolist()
        nearest = min(range(count), key=lambda i: abs(labels.t_us[i] - moment))
        assert found.class_names[row] == labels.class_names[nearest]


def test_of_labels_of_one_time_the_first_counts():
    labels = body_track([0, 10, 10, 20, 20])
    once = labels.take([0, 1, 3])
    moments = np.array([0, 9, 10, 11, 15, 20])
    one, two = (interpolate_labels(track, moments) for track in (labels, once))
    for name, array in one.arrays.items():
        np.testing.assert_array_equal(array, two.arrays[name])
    assert one.class_names == two.class_names


def test_a_joint_turns_at_constant_speed_through_half_a_turn():
    pose = np.zeros((2, 72), np.float32)
    pose[:, 2] = 3.0, -3.0  # rad about z: 0.28 rad apart, through half a turn
    labels = Labels(
        ("",) * 2, np.array([0, 100]), smpl_pose=pose, smpl_betas=pose[:, :10] * 0, smpl_transl=pose[:, 3:6]
    )
    found = interpolate_labels(labels, np.array([0, 25, 50, 100])).smpl_pose[:, 2].astype(float)
    step = 2 * np.pi - 6
    expected = np.exp(1j * (3 + step * np.array([0, 0.25, 0.5, 1])))
    np.testing.assert_allclose(np.exp(1j * found), expected, atol=1e-6)
    assert found[[0, 3]].tolist() == [3.0, -3.0], "labels themselves, digit for digit"


def test_nothing_is_said_outside_and_in_gaps():
    labels = body_track([100, 110, 120, 135, 150, 176])  # the median is 15 us
    moments = np.array([99, 100, 105, 120, 127, 150, 151, 175, 176, 177])
    assert MAX_SPACING == 1.5
    assert is_between_labels(labels, moments).tolist() == [
        False, True, True, True, True, True, False, False, True, False,
    ]  # fmt: skip
    for moment in (99, 151, 177):
        with pytest.raises(ValueError, match=rf"{moment} us lies outside the labels, 100 .. 176 us, or in a gap"):
            interpolate_labels(labels, np.array([120, moment]))


def test_a_joint_that_is_unknown_in_one_label_is_unknown_between():
    joints = np.array([[[1, 2]], [[np.nan, np.nan]], [[5, 6]]], np.float32)
    labels = Labels(("",) * 3, np.array([0, 10, 20]), joints, np.isfinite(joints).all(-1), "x")
    found = interpolate_labels(labels, np.array([0, 5, 10, 20]))
    assert found.visible[:, 0].tolist() == [True, False, False, True]
    assert np.isnan(found.joints2d[1:3]).all() and found.joints2d[[0, 3], 0].tolist() == [[1, 2], [5, 6]]


def test_classes_alone_hold_throughout_and_a_single_pose_at_its_time():
    moments = np.array([0, 7, 9000])
    named = Labels(("dog",), np.array([7]))
    assert is_between_labels(named, moments).all()
    assert interpolate_labels(named, moments).class_names == ("dog",) * 3
    assert is_between_labels(body_track([7]), moments).tolist() == [False, True, False]
