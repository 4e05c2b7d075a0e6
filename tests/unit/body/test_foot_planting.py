"""Feet on the ground stay where they stand while the body above them moves."""

import numpy as np
import pytest

from ctlev_core.body.layer import joint_transforms, load_body
from ctlev_core.body.motion.foot_planting import LEG_JOINTS, plant_feet
from ctlev_core.body.motion.ground_contact import GroundContact, body_path, find_contact
from ctlev_core.body.motion.procedural import MotionStyle, channels_at_phase, rotations_from_channels
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.geometry.joint_sets import SMPL_JOINTS

BODY = load_body()
STEP_S = 0.01
FEET = [SMPL_JOINTS.index(name) for name in ("left_ankle", "left_foot", "right_ankle", "right_foot")]
KNEES = [SMPL_JOINTS.index(name) for name in ("left_knee", "right_knee")]
NO_HABITS = MotionStyle(0.0, 1.0, 1.0, False, np.zeros((24, 3)), np.zeros((24, 3)))


def poses(name: str, phases: np.ndarray) -> np.ndarray:
    return rotations_from_channels(channels_at_phase(name, phases, 1.0, False), np.zeros(len(phases)), NO_HABITS)


def planted(rotations: np.ndarray, contact: GroundContact, transl: np.ndarray, grounded: np.ndarray) -> np.ndarray:
    turned = rotations.copy()
    turns = plant_feet(rotations, contact, transl, grounded, STEP_S)
    turned[:, LEG_JOINTS] = turned[:, LEG_JOINTS] @ matrix_from_axis_angle(turns)
    return turned


def joints_of(rotations: np.ndarray, transl: np.ndarray) -> np.ndarray:
    return joint_transforms(BODY, rotations, np.zeros(10), transl)[1]


def crouching() -> tuple[np.ndarray, GroundContact, np.ndarray]:
    """A pose with bent knees, held for a second, with the contact and the path that belong to it."""
    rotations = poses("squat", np.full(100, 0.25))
    contact = find_contact(rotations)
    return rotations, contact, body_path(contact, np.ones(100), STEP_S)


def test_a_body_at_rest_is_left_alone():
    rotations, contact, transl = crouching()
    turns = plant_feet(rotations, contact, transl, np.ones(100), STEP_S)
    # The hinge's share in the plane of the knee tilts it by the hundredth part of a degree.
    assert np.rad2deg(np.abs(turns)).max() < 0.5


def test_feet_stay_where_the_body_sways_over_them():
    rotations, contact, transl = crouching()
    swaying = transl + 0.04 * np.sin(np.linspace(0, np.pi, 100))[:, None] * [1.0, 0.0, 0.5]
    feet = joints_of(planted(rotations, contact, swaying, np.ones(100)), swaying)[:, FEET]
    # 45 mm without; what is left is the smoothing's.
    assert np.ptp(joints_of(rotations, swaying)[:, FEET], axis=0).max() > 0.03
    assert np.ptp(feet, axis=0).max() < 0.003


def test_knees_take_up_a_body_that_sinks():
    rotations, contact, transl = crouching()
    sinking = transl - 0.02 * np.linspace(0, 1, 100)[:, None] * [0.0, 1.0, 0.0]
    feet = joints_of(planted(rotations, contact, sinking, np.ones(100)), sinking)[:, FEET]
    assert np.ptp(feet[..., 1], axis=0).max() < 0.003


def test_feet_in_the_air_go_with_the_pose():
    rotations, contact, transl = crouching()
    moving = transl + np.linspace(0, 1, 100)[:, None] * [0.3, 0.0, 0.0]
    turns = plant_feet(rotations, contact, moving, np.zeros(100), STEP_S)
    assert np.rad2deg(np.abs(turns)).max() < 0.5


@pytest.mark.parametrize("name", ["walk", "march", "run"])
def test_legs_do_not_stretch_and_knees_do_not_bend_backwards(name):
    phases = np.linspace(0, 2, 200)
    rotations = poses(name, phases)
    contact = find_contact(rotations)
    transl = body_path(contact, np.ones(200), STEP_S)
    turned = planted(rotations, contact, transl, np.ones(200))
    assert np.isfinite(turned).all()
    joints = joints_of(turned, transl)
    for side, knee in zip(("left", "right"), KNEES, strict=True):
        hip, ankle = (joints[:, SMPL_JOINTS.index(f"{side}_{end}")] for end in ("hip", "ankle"))
        # Forward of the line from hip to ankle, seen by the pelvis; two centimetres for the rest pose's own bow.
        ahead = np.einsum("ta,ta->t", joints[:, knee] - (hip + ankle) / 2, turned[:, 0, :, 2])
        assert ahead.min() > -0.02


def test_a_body_in_the_air_keeps_its_speed():
    count = 200
    grounded = np.ones(count)
    grounded[80:120] = 0.0
    step = np.zeros((count, 2))
    step[:, 1] = 0.02
    # A leg that swings in the air is no reason to stop.
    step[80:120, 1] = -0.05
    contact = GroundContact(np.zeros(count), step, np.zeros((count, 2)), np.zeros((count, 2, 2)))
    speed = np.diff(body_path(contact, grounded, STEP_S)[:, 2]) / STEP_S
    np.testing.assert_allclose(speed, 2.0, atol=0.01)
