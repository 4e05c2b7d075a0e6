"""SMPL sequences before a virtual camera: rigid motions move every point alike, and the camera sees what it should."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from ctlev_core.body.layer import joint_transforms, load_body
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.camera import Camera, is_inside, project
from ctlev_core.dataset_files.pose_sources import (
    REST_PELVIS,
    Z_UP_TO_Y_UP,
    PoseSourceOptions,
    SmplSequence,
    check_sequence,
    choose_frames,
    labels_before_camera,
    move_world,
)
from ctlev_core.skeletons import SMPL_JOINTS
from data_contracts.errors import DataError

FRONT = {"yaw_range_deg": (0.0, 0.0), "pitch_range_deg": (0.0, 0.0), "rate_hz": None}


def sequence(num_frames: int = 5, seed: int = 0, rate_hz: float = 60.0) -> SmplSequence:
    random = np.random.default_rng(seed)
    pose, transl = random.normal(0, 1, (num_frames, 72)), random.normal(0, 2, (num_frames, 3))
    return SmplSequence(pose, random.normal(0, 1, 10), transl, rate_hz)


def standing(num_frames: int = 1) -> SmplSequence:
    return SmplSequence(np.zeros((num_frames, 72)), np.zeros(10), np.zeros((num_frames, 3)), 60.0)


def points_of(root: np.ndarray, transl: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
    """Points fixed to the trunk, by SMPL's definition, one frame and point at a time."""
    rest = np.random.default_rng(9).normal(0, 1, (4, 3))
    turned = [
        [Rotation.from_rotvec(r).apply(x - pelvis) + pelvis + t for x in rest]
        for r, t in zip(root, transl, strict=True)
    ]
    return np.array(turned)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_rigid_motion_of_the_world_moves_every_point_of_the_body(seed):
    random = np.random.default_rng(seed)
    before = sequence(seed=seed)
    turn, shift = Rotation.random(rng=random), random.normal(0, 3, 3)
    after = move_world(before, turn.as_matrix(), shift)
    expected = turn.apply(points_of(before.pose[:, :3], before.transl, REST_PELVIS).reshape(-1, 3)) + shift
    got = points_of(after.pose[:, :3], after.transl, REST_PELVIS).reshape(-1, 3)
    np.testing.assert_allclose(got, expected, atol=1e-12)
    np.testing.assert_array_equal(after.pose[:, 3:], before.pose[:, 3:])


def test_another_body_is_shifted_by_the_stated_constant():
    pelvis = REST_PELVIS + np.array([0.01, -0.03, 0.02])
    before = sequence()
    turn, shift = Rotation.from_rotvec([0.3, -2.0, 1.0]), np.array([1.0, 2.0, 3.0])
    after = move_world(before, turn.as_matrix(), shift)
    expected = turn.apply(points_of(before.pose[:, :3], before.transl, pelvis).reshape(-1, 3)) + shift
    got = points_of(after.pose[:, :3], after.transl, pelvis).reshape(-1, 3)
    constant = (np.eye(3) - turn.as_matrix()) @ (pelvis - REST_PELVIS)
    np.testing.assert_allclose(got - expected, np.tile(constant, (len(got), 1)), atol=1e-12)


def test_z_up_becomes_y_up_without_a_mirror():
    np.testing.assert_array_equal(Z_UP_TO_Y_UP @ [0, 0, 1], [0, 1, 0])
    np.testing.assert_array_equal(Z_UP_TO_Y_UP @ [1, 0, 0], [1, 0, 0])
    assert np.linalg.det(Z_UP_TO_Y_UP) == 1


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


def test_a_still_camera_sees_the_whole_way_and_keeps_its_distance():
    walk = standing(50)
    walk = replace(walk, transl=np.linspace([-4, 0, 5], [2, 0.5, -6], 50))
    for seed in range(5):
        labels = labels_before_camera(walk, "", "a", PoseSourceOptions(rate_hz=None, distance_m=2.5, seed=seed))
        pelvis = labels.smpl_transl + REST_PELVIS
        assert pelvis[:, 2].min() == pytest.approx(2.5, abs=1e-5)
        np.testing.assert_allclose(pelvis.min(axis=0)[:2], -pelvis.max(axis=0)[:2], atol=1e-5)
        lengths = np.linalg.norm(np.diff(pelvis, axis=0), axis=1)
        np.testing.assert_allclose(lengths, np.linalg.norm(np.diff(walk.transl, axis=0), axis=1), atol=1e-5)


def test_a_centred_camera_has_every_pelvis_on_its_axis():
    labels = labels_before_camera(sequence(), "", "a", PoseSourceOptions(rate_hz=None, camera="centred"))
    np.testing.assert_allclose(labels.smpl_transl + REST_PELVIS, np.tile([0, 0, 3.0], (5, 1)), atol=1e-6)


def test_the_view_follows_seed_and_recording_and_not_the_moments_taken():
    def root(recording_id: str = "a", **options) -> np.ndarray:
        return labels_before_camera(sequence(60), "", recording_id, PoseSourceOptions(**options)).smpl_transl[0]

    np.testing.assert_array_equal(root(), root(rate_hz=None))
    assert (root() != root("b")).any() and (root() != root(seed=1)).any()


@settings(max_examples=50, deadline=None)
@given(
    st.integers(1, 300), st.sampled_from([60.0, 100.0, 120.0, 250.0, 59.94]), st.sampled_from([1.0, 7.5, 30.0, 59.0])
)
def test_each_moment_is_the_nearest_frame(count, rate_hz, wanted_hz):
    frames = choose_frames(count, rate_hz, PoseSourceOptions(rate_hz=wanted_hz), "a")
    assert len(np.unique(frames)) == len(frames) and frames[0] == 0 and frames[-1] < count
    for moment, frame in enumerate(frames):
        assert abs(frame / rate_hz - moment / wanted_hz) <= 0.5 / rate_hz + 1e-9
    assert (len(frames) + 0.5) / wanted_hz > (count - 1) / rate_hz - 1 / wanted_hz


def test_moments_can_be_limited_and_never_exceed_the_frames():
    assert choose_frames(100, 60.0, PoseSourceOptions(rate_hz=None, max_moments=4), "a").tolist() == [12, 37, 62, 87]
    assert choose_frames(3, 60.0, PoseSourceOptions(rate_hz=None, max_moments=4), "a").tolist() == [0, 1, 2]
    assert choose_frames(3, 60.0, PoseSourceOptions(rate_hz=60.0), "a").tolist() == [0, 1, 2]
    with pytest.raises(DataError, match=r"a: 120\.0 moments a second asked for, it has 60\.0 frames a second"):
        choose_frames(3, 60.0, PoseSourceOptions(rate_hz=120.0), "a")


def test_times_are_those_of_the_frames_taken():
    labels = labels_before_camera(sequence(100, rate_hz=120.0), "", "a", PoseSourceOptions(rate_hz=50.0))
    assert labels.t_us[:4].tolist() == [0, 16_667, 41_667, 58_333]  # frames 0, 2, 5, 7


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pose": np.zeros((0, 72)), "transl": np.zeros((0, 3))}, "zero frames"),
        ({"pose": np.full((5, 72), np.nan)}, "pose of frame 0 is not finite"),
        ({"transl": np.array([[0, 0, 0]] * 3 + [[0, np.inf, 0]] + [[0, 0, 0]])}, "transl of frame 3 is not finite"),
        ({"betas": np.full(10, np.nan)}, "betas are not finite"),
        ({"betas": np.zeros(16)}, r"betas must be \[10\], got \[16\]"),
        ({"transl": np.zeros((4, 3))}, r"transl must be \[5, 3\], got \[4, 3\]"),
        ({"rate_hz": 0.0}, "frame rate must be positive, got 0.0"),
        ({"rate_hz": float("nan")}, "frame rate must be positive, got nan"),
    ],
)
def test_sequences_that_are_wrong(change, message):
    with pytest.raises(DataError, match=f"walk: .*{message}"):
        check_sequence(replace(sequence(), **change), "walk")


def test_ranges_must_rise():
    with pytest.raises(ValidationError, match="yaw_range_deg must be"):
        PoseSourceOptions(yaw_range_deg=(10.0, -10.0))
