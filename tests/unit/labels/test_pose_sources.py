"""Motions before a virtual camera, which sees what it should at the moments it should."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation, Slerp

from ctlev_core.body.layer import joint_transforms, load_body
from ctlev_core.body.motion.clip import REST_PELVIS, MotionClip, take
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.dataset_files.pose_sources import (
    PoseSourceOptions,
    choose_times,
    labels_before_camera,
)
from ctlev_core.geometry.camera import Camera, is_inside, project
from ctlev_core.geometry.joint_sets import SMPL_JOINTS
from ctlev_core.labels.body_views import with_joints

FRONT = {"yaw_range_deg": (0.0, 0.0), "pitch_range_deg": (0.0, 0.0), "rate_hz": None}


def clip(num_frames: int = 5, seed: int = 0, rate_hz: float = 60.0) -> MotionClip:
    random = np.random.default_rng(seed)
    pose, transl = random.normal(0, 1, (num_frames, 72)), random.normal(0, 2, (num_frames, 3))
    return MotionClip(pose, random.normal(0, 1, 10), transl, np.arange(num_frames) / rate_hz)


def standing(num_frames: int = 1) -> MotionClip:
    return MotionClip(np.zeros((num_frames, 72)), np.zeros(10), np.zeros((num_frames, 3)), np.arange(num_frames) / 60)


def in_camera(labels, offset) -> np.ndarray:
    """Where a point at `offset` from the pelvis of the rest pose comes to lie, first moment, camera frame."""
    root = Rotation.from_rotvec(labels.smpl_pose[0, :3].astype(float))
    return root.apply(offset) + REST_PELVIS + labels.smpl_transl[0]


def test_the_camera_sees_a_standing_body_upright_from_the_front():
    labels = labels_before_camera(standing(), "stand", "a", PoseSourceOptions(**FRONT, distance_m=4.0))
    pelvis = in_camera(labels, [0, 0, 0])
    np.testing.assert_allclose(pelvis, [0, 0, 4], atol=1e-6)
    np.testing.assert_allclose(in_camera(labels, [0, 0.6, 0]) - pelvis, [0, -0.6, 0], atol=1e-6)  # head: image up
    np.testing.assert_allclose(in_camera(labels, [0.2, 0, 0]) - pelvis, [0.2, 0, 0], atol=1e-6)  # left: image right
    np.testing.assert_allclose(in_camera(labels, [0, 0, 0.1]) - pelvis, [0, 0, -0.1], atol=1e-6)  # front: nearer


def test_the_project_s_own_body_stands_in_the_middle_of_the_picture():
    """Through the body layer and the pinhole camera, which know nothing of pose sources."""
    labels = labels_before_camera(standing(), "", "a", PoseSourceOptions(**FRONT, distance_m=3.0))
    assert labels.smpl_pose is not None and labels.smpl_transl is not None
    rotations = matrix_from_axis_angle(labels.smpl_pose.reshape(1, 24, 3))
    _, joints = joint_transforms(load_body(), rotations, np.zeros(10), labels.smpl_transl)
    camera = Camera(np.array([[300.0, 0, 128], [0, 300, 128], [0, 0, 1]]), np.eye(3), np.zeros(3), (256, 256))
    pixels = dict(zip(SMPL_JOINTS, project(camera, joints)[0], strict=True))
    np.testing.assert_allclose(pixels["pelvis"], [128, 128], atol=0.5)
    assert pixels["head"][1] < pixels["pelvis"][1] < pixels["left_knee"][1] < pixels["left_foot"][1]
    assert pixels["left_wrist"][0] > 128 > pixels["right_wrist"][0]
    assert is_inside(project(camera, joints), (256, 256)).all()


def test_yaw_turns_about_the_vertical_and_pitch_looks_down():
    side = labels_before_camera(standing(), "", "a", PoseSourceOptions(**{**FRONT, "yaw_range_deg": (90, 90)}))
    np.testing.assert_allclose(in_camera(side, [0, 0, 0.1])[:2], [0.1, 0], atol=1e-6)
    above = labels_before_camera(standing(), "", "a", PoseSourceOptions(**{**FRONT, "pitch_range_deg": (30, 30)}))
    head, feet = in_camera(above, [0, 0.6, 0]), in_camera(above, [0, -0.9, 0])
    assert head[2] < 3 < feet[2] and head[1] < 0 < feet[1]


@pytest.mark.parametrize("size", [(64, 64), (346, 260)])
def test_a_still_camera_sees_the_whole_body_all_the_way(size):
    walk = standing(50)
    walk = replace(walk, transl=np.linspace([-4, 0, 5], [2, 0.5, -6], 50))
    for seed in range(5):
        labels = labels_before_camera(walk, "", "a", PoseSourceOptions(rate_hz=None, distance_m=2.5, seed=seed))
        pelvis = labels.smpl_transl + REST_PELVIS
        assert pelvis[:, 2].min() >= 2.5
        assert with_joints(labels, size, "smpl").visible.all()
        np.testing.assert_allclose(pelvis.min(axis=0)[:2], -pelvis.max(axis=0)[:2], atol=1e-5)
        lengths = np.linalg.norm(np.diff(pelvis, axis=0), axis=1)
        np.testing.assert_allclose(lengths, np.linalg.norm(np.diff(walk.transl, axis=0), axis=1), atol=1e-5)


def test_a_still_camera_is_no_further_than_asked_where_nobody_leaves_its_axis():
    labels = labels_before_camera(standing(50), "", "a", PoseSourceOptions(rate_hz=None, distance_m=2.5))
    assert (labels.smpl_transl + REST_PELVIS)[:, 2].min() == pytest.approx(2.5, abs=1e-5)


def test_a_centred_camera_has_every_pelvis_on_its_axis():
    labels = labels_before_camera(clip(), "", "a", PoseSourceOptions(rate_hz=None, camera="centred"))
    np.testing.assert_allclose(labels.smpl_transl + REST_PELVIS, np.tile([0, 0, 3.0], (5, 1)), atol=1e-6)


def test_the_view_follows_seed_and_recording_and_not_the_moments_taken():
    def root(recording_id: str = "a", **options) -> np.ndarray:
        return labels_before_camera(clip(60), "", recording_id, PoseSourceOptions(**options)).smpl_transl[0]

    np.testing.assert_array_equal(root(), root(rate_hz=None))
    assert (root() != root("b")).any() and (root() != root(seed=1)).any()


@settings(max_examples=50, deadline=None)
@given(
    st.integers(1, 300), st.sampled_from([60.0, 100.0, 120.0, 250.0, 59.94]), st.sampled_from([1.0, 7.5, 30.0, 600.0])
)
def test_moments_follow_the_rate_from_the_first_frame_to_the_last(count, rate_hz, wanted_hz):
    times = choose_times(standing(count) if rate_hz == 60 else clip(count, 0, rate_hz), asked(wanted_hz))
    last = (count - 1) / rate_hz
    np.testing.assert_allclose(times, np.arange(len(times)) / wanted_hz, atol=1e-7)
    assert times[-1] <= last < times[-1] + 1 / wanted_hz + 1e-7


def asked(rate_hz: float | None, **options) -> PoseSourceOptions:
    return PoseSourceOptions(**{**FRONT, "rate_hz": rate_hz}, **options)


def test_moments_can_be_limited():
    frames = [round(60 * t) for t in choose_times(standing(100), asked(None, max_moments=4))]
    assert frames == [12, 37, 62, 87]
    assert len(choose_times(standing(3), asked(None, max_moments=4))) == 3
    assert choose_times(standing(1), asked(10.0, max_moments=4)).tolist() == [0]


@pytest.mark.parametrize("rate_hz", [60.0, 30.0, 20.0, None])
def test_moments_at_frames_are_those_frames(rate_hz):
    whole, step = clip(61), 1 if rate_hz is None else round(60 / rate_hz)
    labels = labels_before_camera(whole, "", "a", asked(rate_hz))
    few = labels_before_camera(take(whole, np.arange(0, 61, step)), "", "a", asked(None))
    np.testing.assert_array_equal(labels.smpl_pose, few.smpl_pose)
    assert labels.t_us.tolist() == np.rint(np.arange(0, 61, step) * 1e6 / 60).tolist()


@pytest.mark.parametrize("camera", ["still", "centred"])
@pytest.mark.parametrize("rate_hz", [25.0, 240.0])
def test_moments_between_frames_lie_on_the_shortest_way(rate_hz, camera):
    """Against SciPy's own interpolation; the root is compared after the camera, whose rotation is half a turn."""
    whole = clip(13)
    labels = labels_before_camera(whole, "", "a", asked(rate_hz, camera=camera))
    times = labels.t_us / 1e6
    assert len(times) == np.floor(0.2 * rate_hz) + 1
    for joint in range(24):
        columns = slice(3 * joint, 3 * joint + 3)
        expected = Slerp(whole.time_s, Rotation.from_rotvec(whole.pose[:, columns]))(np.minimum(times, 0.2))
        if joint == 0:
            expected = Rotation.from_rotvec([np.pi, 0, 0]) * expected
        got = Rotation.from_rotvec(labels.smpl_pose[:, columns].astype(float))
        # float32 labels, times in whole microseconds: a joint turns by up to pi a frame, 190 rad a second.
        assert (got * expected.inv()).magnitude().max() < 3e-4


def test_ranges_must_rise():
    with pytest.raises(ValidationError, match="yaw_range_deg must be"):
        PoseSourceOptions(yaw_range_deg=(10.0, -10.0))
