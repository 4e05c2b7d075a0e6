"""Motions over time: rigid motions move every point alike, and between frames the way is the shortest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from ctlev_core.body.motion.clip import (
    REST_PELVIS,
    Y_UP_TO_Z_UP,
    Z_UP_TO_Y_UP,
    MotionClip,
    check_clip,
    move_world,
    resample,
    take,
    times_at_rate,
)
from data_contracts.errors import DataError

SEEDS = st.integers(0, 2**32 - 1)


def clip_of(num_frames: int = 5, seed: int = 0, rate_hz: float = 60.0) -> MotionClip:
    random = np.random.default_rng(seed)
    pose, transl = random.normal(0, 1, (num_frames, 72)), random.normal(0, 2, (num_frames, 3))
    return MotionClip(pose, random.normal(0, 1, 10), transl, np.arange(num_frames) / rate_hz)


def joint_rotations(clip: MotionClip) -> Rotation:
    return Rotation.from_rotvec(clip.pose.reshape(-1, 3))


def points_of(root: np.ndarray, transl: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
    """Points fixed to the trunk, by SMPL's definition, one frame and point at a time."""
    rest = np.random.default_rng(9).normal(0, 1, (4, 3))
    turned = [
        [Rotation.from_rotvec(r).apply(x - pelvis) + pelvis + t for x in rest]
        for r, t in zip(root, transl, strict=True)
    ]
    return np.array(turned)


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_a_rigid_motion_of_the_world_moves_every_point_of_the_body(seed):
    random = np.random.default_rng(seed)
    before = clip_of(seed=seed)
    turn, shift = Rotation.random(rng=random), random.normal(0, 3, 3)
    after = move_world(before, turn.as_matrix(), shift)
    expected = turn.apply(points_of(before.pose[:, :3], before.transl, REST_PELVIS).reshape(-1, 3)) + shift
    got = points_of(after.pose[:, :3], after.transl, REST_PELVIS).reshape(-1, 3)
    np.testing.assert_allclose(got, expected, atol=1e-12)
    np.testing.assert_array_equal(after.pose[:, 3:], before.pose[:, 3:])


def test_another_body_is_shifted_by_the_stated_constant():
    pelvis = REST_PELVIS + np.array([0.01, -0.03, 0.02])
    before = clip_of()
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
    np.testing.assert_array_equal(Y_UP_TO_Z_UP @ Z_UP_TO_Y_UP, np.eye(3))
    clip = clip_of()
    there_and_back = move_world(move_world(clip, Y_UP_TO_Z_UP, np.zeros(3)), Z_UP_TO_Y_UP, np.zeros(3))
    np.testing.assert_allclose(there_and_back.transl, clip.transl, atol=1e-12)
    np.testing.assert_allclose(
        joint_rotations(there_and_back).as_matrix(), joint_rotations(clip).as_matrix(), atol=1e-12
    )


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.integers(2, 9), st.integers(1, 12))
def test_resampling_follows_the_geodesics(seed, num_frames, num_moments):
    """Against SciPy's interpolation, at random times and with frames that are unevenly spaced."""
    random = np.random.default_rng(seed)
    clip = clip_of(num_frames, seed)
    clip = replace(clip, time_s=np.cumsum(random.uniform(0.01, 1, num_frames)))
    times = np.unique(random.uniform(clip.time_s[0], clip.time_s[-1], num_moments))
    got = resample(clip, times)
    check_clip(got, "resampled")
    for joint in range(24):
        columns = slice(3 * joint, 3 * joint + 3)
        expected = Slerp(clip.time_s, Rotation.from_rotvec(clip.pose[:, columns]))(times)
        # 1e-6 of a frame snaps to the frame, and a joint turns by at most pi within one.
        assert (Rotation.from_rotvec(got.pose[:, columns]) * expected.inv()).magnitude().max() < 4e-6
    straight = np.stack([np.interp(times, clip.time_s, clip.transl[:, axis]) for axis in range(3)], axis=1)
    np.testing.assert_allclose(got.transl, straight, atol=1e-4)
    np.testing.assert_array_equal(got.time_s, times)


def test_frames_are_kept_digit_for_digit():
    clip = clip_of(50, rate_hz=120.0)
    clip.pose[7, :3] = [0, 2 * np.pi + 0.1, 0]
    finer = resample(clip, times_at_rate(clip, 480.0))
    np.testing.assert_array_equal(finer.pose[::4], clip.pose)
    np.testing.assert_array_equal(finer.transl[::4], clip.transl)
    every_third = resample(clip, times_at_rate(clip, 40.0))
    np.testing.assert_array_equal(every_third.pose, clip.pose[::3])


def test_a_jump_of_the_axis_angle_vector_by_a_whole_turn_means_nothing():
    """pi - 0.1 and -(pi - 0.1) about y are 0.2 apart; halfway between them lies pi, and not 0."""
    clip = take(clip_of(2), np.arange(2))
    clip.pose[:, :3] = [[0, np.pi - 0.1, 0], [0, -np.pi + 0.1, 0]]
    middle = resample(clip, np.array([1 / 120]))
    expected = Rotation.from_rotvec([0, np.pi, 0])
    assert (Rotation.from_rotvec(middle.pose[0, :3]) * expected.inv()).magnitude() < 1e-9
    clip.pose[:, :3] = [[0, 0.3, 0], [0, 0.3 + 4 * np.pi, 0]]
    middle = resample(clip, np.array([1 / 120]))
    np.testing.assert_allclose(middle.pose[0, :3], [0, 0.3, 0], atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 400), st.floats(0.5, 300), st.floats(0.5, 1000))
def test_times_at_a_rate_stay_in_the_clip(num_frames, rate_hz, wanted_hz):
    clip = take(clip_of(1), np.zeros(num_frames, np.int64))
    clip = replace(clip, time_s=2.5 + np.arange(num_frames) / rate_hz)
    times = times_at_rate(clip, wanted_hz)
    assert times[0] == 2.5 and times[-1] <= clip.time_s[-1]
    assert clip.time_s[-1] - times[-1] < 1 / wanted_hz + 1e-9
    np.testing.assert_allclose(np.diff(times), 1 / wanted_hz, rtol=1e-5)


def test_one_frame_is_enough():
    clip = clip_of(1)
    assert times_at_rate(clip, 10.0).tolist() == [0.0]
    np.testing.assert_array_equal(resample(clip, np.zeros(1)).pose, clip.pose)
    assert len(resample(clip, np.zeros(0))) == 0
    assert len(move_world(clip, np.eye(3), np.ones(3))) == 1


@pytest.mark.parametrize("times", [[0.0, 0.0], [0.02, 0.01], [-0.01], [0.1], [np.nan], [[0.0]]])
def test_times_that_cannot_be(times):
    with pytest.raises(ValueError, match="time_s must"):
        resample(clip_of(5), np.array(times))
    with pytest.raises(ValueError, match="rate_hz must be positive"):
        times_at_rate(clip_of(5), 0.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pose": np.zeros((0, 72)), "transl": np.zeros((0, 3)), "time_s": np.zeros(0)}, "zero frames"),
        ({"pose": np.full((5, 72), np.nan)}, "pose of frame 0 is not finite"),
        ({"transl": np.array([[0, 0, 0]] * 3 + [[0, np.inf, 0]] + [[0, 0, 0]])}, "transl of frame 3 is not finite"),
        ({"pose": np.full((5, 72), 1e200)}, "pose of frame 0 is beyond 1e"),
        ({"betas": np.full(10, np.nan)}, "betas are not finite"),
        ({"betas": np.zeros(16)}, r"betas must be \[10\], got \[16\]"),
        ({"transl": np.zeros((4, 3))}, r"transl must be \[5, 3\], got \[4, 3\]"),
        ({"time_s": np.array([0, 1, 1, 2, 3.0])}, "times must rise, frame 2 follows 1.0 s at 1.0 s"),
        ({"time_s": np.array([0, 1, np.nan, 2, 3])}, "time_s of frame 2 is not finite"),
    ],
)
def test_clips_that_are_wrong(change, message):
    with pytest.raises(DataError, match=f"walk: .*{message}"):
        check_clip(replace(clip_of(), **change), "walk")
