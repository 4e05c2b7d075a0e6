"""One label per window: against a plain loop, and at the edges."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctlev_core.labels.labelling import has_label, labels_at_windows
from data_contracts.labels import Labels


def track(times, joints, visible=None):
    joints = np.asarray(joints, np.float32)
    visible = np.isfinite(joints).all(-1) if visible is None else np.asarray(visible)
    return Labels(("walk",) * len(times), np.asarray(times, np.int64), joints, visible, "dhp19")


def test_mean_over_the_window_ignores_unknown_positions():
    labels = track([0, 10, 20, 30], [[[0, 0]], [[2, 4]], [[np.nan, np.nan]], [[100, 100]]])
    found = labels_at_windows(labels, np.array([5]), np.array([25]))
    assert found.joints2d[0, 0].tolist() == [2, 4]
    assert found.visible[0, 0]  # visible in one of two rows


def test_window_between_labels_takes_the_nearest():
    labels = track([0, 100], [[[0, 0]], [[9, 9]]])
    found = labels_at_windows(labels, np.array([40, 60, 300, -50]), np.array([45, 65, 310, -40]))
    assert found.joints2d[:, 0, 0].tolist() == [0, 9, 9, 0]


def test_a_label_holds_as_long_as_labels_usually_follow():
    labels = track([0, 10, 20, 30, 100], [[[0, 0]]] * 5)
    start, end = np.array([-30, -12, 12, 41, 50, 85, 91, 111]), np.array([-11, -10, 13, 42, 85, 89, 92, 120])
    assert has_label(labels, start, end).tolist() == [False, True, True, False, False, False, True, False]
    assert has_label(labels.take([4]), start, end).all(), "a single row labels the whole recording"


def test_joint_never_known_is_invisible():
    found = labels_at_windows(track([0, 1], [[[np.nan, 1]], [[np.nan, 1]]]), np.array([0]), np.array([1]))
    assert not found.visible.any()


def test_class_only_track_labels_every_window():
    labels = Labels(("spot",), np.array([1000], np.int64))
    found = labels_at_windows(labels, np.array([0, 5000]), np.array([10, 6000]))
    assert found.class_names == ("spot", "spot") and found.joints2d is None


def test_bodies_and_classes_are_those_of_the_middle_as_means_of_joints_are():
    times = np.arange(0, 100, 10)
    joints = np.repeat(times.astype(np.float32)[:, None, None], 2, axis=2)
    labels = replace(
        track(times, joints),
        class_names=("walk",) * 5 + ("run",) * 5,
        smpl_pose=np.repeat(times.astype(np.float32)[:, None], 72, axis=1),
        smpl_betas=np.zeros((10, 10), np.float32),
        smpl_transl=np.repeat(times.astype(np.float32)[:, None], 3, axis=1),
    )
    found = labels_at_windows(labels, np.array([10, 50]), np.array([70, 90]))
    assert found.joints2d[:, 0, 0].tolist() == [40, 70]
    assert found.smpl_pose[:, 0].tolist() == found.smpl_transl[:, 0].tolist() == found.t_us.tolist() == [40, 70]
    assert found.class_names == ("walk", "run")


@given(st.integers(1, 30), st.integers(1, 20), st.integers(0, 2**32 - 1))
def test_equals_a_plain_loop(num_labels, num_windows, seed):
    random = np.random.default_rng(seed)
    times = np.sort(random.choice(1000, num_labels, replace=False))
    joints = random.uniform(-5, 70, (num_labels, 3, 2))
    labels = track(times, joints)
    start = random.integers(0, 1000, num_windows)
    end = start + random.integers(0, 200, num_windows)
    found = labels_at_windows(labels, start, end)
    for row in range(num_windows):
        inside = [i for i in range(num_labels) if start[row] <= times[i] <= end[row]]
        if inside:
            expected = sum(labels.joints2d[i].astype(float) for i in inside) / len(inside)
            assert found.joints2d[row] == pytest.approx(expected, rel=1e-5, abs=1e-4)
