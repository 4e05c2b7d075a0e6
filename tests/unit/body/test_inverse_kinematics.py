"""Poses from joint positions: forward kinematics gives the positions back, and what they leave open is sensible."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctlev_core.body.layer import joint_transforms, load_body
from ctlev_core.body.motion import procedural
from ctlev_core.body.motion.inverse_kinematics import are_positions, fit_pose
from ctlev_core.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from ctlev_core.geometry.joint_sets import SMPL_JOINTS
from data_contracts.errors import DataError

BODY = load_body()
KNEE, ELBOW, WRIST = (SMPL_JOINTS.index(f"left_{name}") for name in ("knee", "elbow", "wrist"))
EXACT_M = 1e-8
"""The weight of the parent's orientation (1e-9 of the bones') tilts a pelvis by so much over a metre, no more."""


def joints_of(rotations: np.ndarray, transl: np.ndarray | None = None, betas: np.ndarray | None = None) -> np.ndarray:
    transl = np.zeros((len(rotations), 3)) if transl is None else transl
    return joint_transforms(BODY, rotations, np.zeros(10) if betas is None else betas, transl)[1]


def performed(name: str) -> tuple[np.ndarray, np.ndarray]:
    return procedural.sample_pose(name, np.linspace(0, 2, 30), np.random.default_rng(1))


def angles_deg(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.linalg.norm(axis_angle_from_matrix(np.swapaxes(first, -1, -2) @ second), axis=-1))


@pytest.mark.parametrize("count", [22, 24])
@pytest.mark.parametrize("name", ["walk", "cartwheel", "get_up", "dance", "push_up", "throw"])
def test_joints_come_back_exactly(name, count):
    rotations, transl = performed(name)
    joints = joints_of(rotations, transl)[:, :count]
    fitted = fit_pose(joints)
    np.testing.assert_allclose(joints_of(fitted.rotations, fitted.transl)[:, :count], joints, atol=EXACT_M)
    assert fitted.error_m.max() < EXACT_M and fitted.scale == pytest.approx(1.0, abs=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_any_pose_is_met(seed):
    # Up to half a turn in every joint, which no person can do.
    vectors = np.random.default_rng(seed).uniform(-1.8, 1.8, (3, 24, 3))
    joints = joints_of(matrix_from_axis_angle(vectors))
    fitted = fit_pose(joints)
    assert fitted.error_m.max() < EXACT_M
    identity = np.broadcast_to(np.eye(3), fitted.rotations.shape)
    np.testing.assert_allclose(fitted.rotations @ np.swapaxes(fitted.rotations, -1, -2), identity, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(fitted.rotations), 1.0, atol=1e-12)


def test_the_rest_pose_is_no_rotation():
    fitted = fit_pose(BODY.joints[None])
    np.testing.assert_allclose(fitted.rotations[0], np.broadcast_to(np.eye(3), (24, 3, 3)), atol=1e-8)
    np.testing.assert_allclose(fitted.transl, 0, atol=1e-12)


@pytest.mark.parametrize("name", ["walk", "squat", "wave", "run"])
def test_rotations_themselves_are_near_where_limbs_bend_about_hinges(name):
    rotations, transl = performed(name)
    error = angles_deg(rotations, fit_pose(joints_of(rotations, transl)).rotations)
    # Habits turn every joint by 7 degrees on average about axes that positions cannot show, and toes point 6 outwards.
    assert error.mean() < 6.0


def test_a_bent_elbow_bends_about_its_hinge():
    vectors = np.zeros((1, 24, 3))
    vectors[0, SMPL_JOINTS.index("left_shoulder")] = [1.2, 0, 0]
    vectors[0, ELBOW] = [0, -1.3, 0]
    fitted = fit_pose(joints_of(matrix_from_axis_angle(vectors)))
    found = axis_angle_from_matrix(fitted.rotations)[0]
    # The smallest twist would leave the shoulder at rest and bend the elbow downwards.
    np.testing.assert_allclose(found[ELBOW], [0, -1.3, 0], atol=0.12)
    np.testing.assert_allclose(found[SMPL_JOINTS.index("left_shoulder")], [1.2, 0, 0], atol=0.12)


def test_poses_follow_joints_smoothly_through_a_straight_limb():
    bend = np.linspace(-0.03, 1.0, 200)
    vectors = np.zeros((len(bend), 24, 3))
    vectors[:, KNEE, 0] = bend
    rotations = fit_pose(joints_of(matrix_from_axis_angle(vectors))).rotations
    # The knee itself turns 0.3 degrees a frame.
    assert angles_deg(rotations[1:], rotations[:-1]).max() < 1.0


@pytest.mark.parametrize("name", ["spin_kick", "throw", "run", "crawl"])
def test_poses_do_not_jump_where_joints_do_not(name):
    rotations, transl = procedural.sample_pose(name, np.arange(0, 1.3, 1 / 60), np.random.default_rng(2))
    fitted = fit_pose(joints_of(rotations, transl)).rotations
    steps = [angles_deg(turns[1:], turns[:-1]).max() for turns in (rotations, fitted)]
    # An elbow that straightens loses its hinge over some frames: a dozen degrees each; 80 in one without smoothing.
    assert steps[1] < max(2 * steps[0], 15.0)


def test_the_spine_shares_a_twist():
    vectors = np.zeros((1, 24, 3))
    vectors[0, SMPL_JOINTS.index("spine3"), 1] = 0.9
    found = axis_angle_from_matrix(fit_pose(joints_of(matrix_from_axis_angle(vectors))).rotations)[0]
    # Not a third each, for a turn of the chest about the vertical moves the slanted bones between, too.
    for name in ("spine1", "spine2", "spine3"):
        assert 0.15 < found[SMPL_JOINTS.index(name), 1] < 0.5


def test_another_size_is_scaled_and_other_proportions_are_told():
    rotations, transl = performed("walk")
    joints = joints_of(rotations, transl)
    fitted = fit_pose(1.3 * joints)
    assert fitted.scale == pytest.approx(1 / 1.3) and fitted.error_m.max() < EXACT_M
    other = joints_of(rotations, transl, betas=np.array([0, 0, 2.0, 0, 1.0, 0, 0, 0, 0, 0]))
    fitted = fit_pose(other)
    assert 1e-3 < fitted.error_m.mean() < 0.1
    # Directions of limbs are kept all the same.
    reached = joints_of(fitted.rotations, fitted.transl)
    for start, end in ((ELBOW, WRIST), (SMPL_JOINTS.index("left_hip"), KNEE)):
        bones = [points[:, end] - points[:, start] for points in (reached, other)]
        first, second = (bone / np.linalg.norm(bone, axis=-1, keepdims=True) for bone in bones)
        np.testing.assert_allclose(first, second, atol=1e-6)


def test_collapsed_and_collinear_bones_are_no_trouble():
    joints = np.tile(BODY.joints, (5, 1, 1))
    joints[1, WRIST] = joints[1, ELBOW]
    joints[2, [1, 2]] = joints[2, 0]  # both hips in the pelvis
    joints[3, [12, 13, 14]] = joints[3, 9]  # neck and collars in the chest
    joints[4, 16] = joints[4, 13] - 2 * (BODY.joints[13] - BODY.joints[16]) * -0.5  # collar turned right round
    fitted = fit_pose(joints)
    assert np.isfinite(fitted.rotations).all() and np.isfinite(fitted.transl).all()
    np.testing.assert_allclose(np.linalg.det(fitted.rotations), 1.0, atol=1e-9)
    np.testing.assert_allclose(fitted.rotations[1, ELBOW], np.eye(3), atol=1e-6)


def test_bad_joints_are_named():
    good = np.tile(BODY.joints, (4, 1, 1))
    broken = good.copy()
    broken[2, KNEE, 1] = np.nan
    with pytest.raises(DataError, match=r"file: frame 2: the left_knee is at .*not finite"):
        fit_pose(broken, where="file")
    with pytest.raises(DataError, match="legs have no length"):
        fit_pose(np.zeros((3, 22, 3)))
    for shape in ((22, 3), (4, 21, 3), (4, 22, 2)):
        with pytest.raises(DataError, match=r"expected joints \[T, 22, 3\]"):
            fit_pose(np.zeros(shape))
    with pytest.raises(DataError, match="zero frames"):
        fit_pose(good[:0])


def test_positions_are_told_from_rotations():
    rotations, transl = performed("walk")
    assert are_positions(joints_of(rotations, transl))
    assert are_positions(joints_of(rotations, transl)[:, :22])
    assert not are_positions(axis_angle_from_matrix(rotations))
    assert not are_positions(np.zeros((3, 24, 3)))
