"""SMPL poses from joint positions, in closed form: every joint of a skeleton of the body's own proportions is met.

Positions leave the twist about a bone open. It is chosen so that knees and elbows bend about their hinges, the spine
shares what the chest turns against the pelvis, and everything else turns as little as possible. Of a limb that bends
through straight, the twist would jump; it is smoothed over a few frames, which moves no joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ctlev_core.body.layer import NUM_BETAS, NUM_JOINTS, BodyModel, joint_transforms, load_body
from ctlev_core.body.rotations import matrix_from_axis_angle, slerp
from ctlev_core.geometry.joint_sets import SMPL_JOINTS, SMPL_PARENTS
from data_contracts.errors import DataError

NUM_BODY_JOINTS = 22
"""SMPL's without the two hands: the joints of HumanML3D."""
MIN_BONE_M = 1e-6
MAX_UNEVENNESS = 0.1
"""Of the lengths of a limb, over time and left against right."""
STRAIGHT = 0.1
"""Sine of the bend, 6 degrees, below which the hinge has no more say than the smallest twist."""
SMOOTHING_FRAMES = 2.0
"""Standard deviation of the smoothing of twists over time."""
_PRIOR = 1e-9
"""Weight of the parent's orientation where positions do not determine one, as with hips in one place."""

# Axis [3] about which each hinge bends in the rest pose, and the joint after it.
_HINGES = {
    "left_hip": ("left_knee", "left_ankle", (1.0, 0.0, 0.0)),
    "right_hip": ("right_knee", "right_ankle", (1.0, 0.0, 0.0)),
    "left_shoulder": ("left_elbow", "left_wrist", (0.0, -1.0, 0.0)),
    "right_shoulder": ("right_elbow", "right_wrist", (0.0, 1.0, 0.0)),
}
_RIGID = {"pelvis": ("left_hip", "right_hip", "spine1"), "spine3": ("neck", "left_collar", "right_collar")}
_LEGS = (("left_hip", "left_knee", "left_ankle"), ("right_hip", "right_knee", "right_ankle"))


@dataclass(frozen=True, eq=False)
class FittedPose:
    """A body in the pose of given joints.

    Attributes:
        rotations: [T, 24, 3, 3] relative to the parent.
        transl: [T, 3] m, of the scaled skeleton.
        scale: what the positions were multiplied by, about the origin, to have legs as long as the body's.
        error_m: [T, J] float64, distance of the body's joints from the scaled positions: 0 where bones are as long as
            the body's, for which no pose can make up.
    """

    rotations: np.ndarray
    transl: np.ndarray
    scale: float
    error_m: np.ndarray


def fit_pose(joints: np.ndarray, body: BodyModel | None = None, where: str = "joints") -> FittedPose:
    """The pose of the body's mean shape whose joints lie where they are given.

    Args:
        joints: [T, 22, 3] or [T, 24, 3], SMPL's order (HumanML3D's has the first 22), y up. Hands that are not given
            are straight.
        body: the bundled one when None.
        where: names the source in messages.
    Returns:
        T poses. A bone of no length keeps its parent's direction.
    Raises:
        DataError: another shape, no frames, a position that is not finite, or legs of no length.
    """
    body, joints = body or load_body(), _checked(joints, where)
    rest = body.joints
    scale = leg_length(rest[None], where) / leg_length(joints, where)
    joints = scale * joints
    orientation = _orientations(joints, rest)
    rotations = orientation.copy()
    for joint, parent in enumerate(SMPL_PARENTS[1:], start=1):
        rotations[:, joint] = np.swapaxes(orientation[:, parent], -1, -2) @ orientation[:, joint]
    transl = joints[:, 0] - rest[0]
    _, reached = joint_transforms(body, rotations, np.zeros(NUM_BETAS), transl)
    error_m = np.linalg.norm(reached[:, : joints.shape[1]] - joints, axis=-1)
    return FittedPose(rotations, transl, scale, error_m)


def are_positions(array: np.ndarray) -> bool:
    """Are numbers [T, 22 or 24, 3] joint positions, and not axis-angle vectors or the joints of another skeleton?

    Positions keep the lengths of limbs, alike left and right, and in proportions of a body; a tenth more or less is
    what networks need.
    """
    lengths = {}
    for upper, lower in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist")):
        limbs = [_between(array, f"{side}_{upper}", f"{side}_{lower}") for side in ("left", "right")]
        both = np.linalg.norm(limbs, axis=-1)
        lengths[upper] = both.mean()
        if not np.abs(both - lengths[upper]).max(initial=0.0) < MAX_UNEVENNESS * lengths[upper]:
            return False
    shank, forearm = lengths["knee"] / lengths["hip"], lengths["elbow"] / lengths["shoulder"]
    return 0.6 < shank < 1.6 and 0.6 < forearm < 1.6 and lengths["hip"] > lengths["shoulder"]


def _checked(joints: np.ndarray, where: str) -> np.ndarray:
    joints = np.asarray(joints)
    if joints.ndim != 3 or joints.shape[1] not in (NUM_BODY_JOINTS, NUM_JOINTS) or joints.shape[2] != 3:
        raise DataError(f"{where}: expected joints [T, 22, 3] or [T, 24, 3] in SMPL's order, got {list(joints.shape)}")
    if not len(joints):
        raise DataError(f"{where}: expected a motion, got one of zero frames")
    if joints.dtype.kind not in "fiu":
        raise DataError(f"{where}: expected numbers, got {joints.dtype}")
    wrong = ~np.isfinite(joints).all(axis=-1)
    if wrong.any():
        frame, joint = np.argwhere(wrong)[0]
        raise DataError(f"{where}: frame {frame}: the {SMPL_JOINTS[joint]} is at {joints[frame, joint]}, not finite")
    return joints.astype(np.float64)


def leg_length(joints: np.ndarray, where: str) -> float:
    """Median over time of the mean of both legs, from hip to ankle, in the unit of `joints`."""
    bones = [
        np.linalg.norm(_between(joints, leg[k], leg[k + 1]), axis=-1) for leg in _LEGS for k in range(len(leg) - 1)
    ]
    length = float(np.median(np.sum(bones, axis=0))) / 2
    if length < MIN_BONE_M:
        raise DataError(f"{where}: the legs have no length, so the size of the person is unknown")
    return length


def _orientations(joints: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Orientation [T, 24, 3, 3] of every joint in the world."""
    count = len(joints)
    orientation = np.tile(np.eye(3), (count, NUM_JOINTS, 1, 1))
    pelvis, chest = SMPL_JOINTS.index("pelvis"), SMPL_JOINTS.index("spine3")
    orientation[:, pelvis] = _fit_rigid("pelvis", joints, rest, orientation[:, pelvis])
    orientation[:, chest] = _fit_rigid("spine3", joints, rest, orientation[:, pelvis])
    for joint, name in enumerate(SMPL_JOINTS):
        if name in _RIGID:
            continue
        prior = orientation[:, SMPL_PARENTS[joint]]
        if name in ("spine1", "spine2"):
            share = 1 / 3 if name == "spine1" else 2 / 3
            prior = slerp(orientation[:, pelvis], orientation[:, chest], share)
        child = SMPL_PARENTS.index(joint) if joint in SMPL_PARENTS else joints.shape[1]
        if child >= joints.shape[1]:
            orientation[:, joint] = prior
            continue
        orientation[:, joint] = _swing(prior, rest[child] - rest[joint], joints[:, child] - joints[:, joint])
        if name in _HINGES:
            orientation[:, joint] = _twist_to_hinge(name, orientation[:, joint], joints, rest)
    return orientation


def _fit_rigid(name: str, joints: np.ndarray, rest: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """The rotation [T, 3, 3] of a part with three joints on it (Kabsch 1976; Arun et al. 1987 for reflections)."""
    bones = np.stack([_between(rest[None], name, child)[0] for child in _RIGID[name]])
    seen = np.stack([_between(joints, name, child) for child in _RIGID[name]], axis=1)
    covariance = np.einsum("tka,kb->tab", seen, bones) + _PRIOR * np.sum(bones**2) * prior
    left, _, right = np.linalg.svd(covariance)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    return left @ right


def _swing(prior: np.ndarray, bone: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The orientation [T, 3, 3] nearest to `prior` that turns `bone` [3] into the direction of `seen` [T, 3]."""
    length = np.linalg.norm(seen, axis=-1, keepdims=True)
    start = prior @ (bone / np.linalg.norm(bone))
    end = np.where(length > MIN_BONE_M, seen / np.maximum(length, MIN_BONE_M), start)
    axis = np.cross(start, end)
    sine, cosine = np.linalg.norm(axis, axis=-1, keepdims=True), np.sum(start * end, axis=-1, keepdims=True)
    # Half a turn has no axis of its own: any that is perpendicular will do.
    aside = np.cross(start, np.eye(3)[np.argmin(np.abs(start), axis=-1)])
    axis = np.where(sine > 1e-9, axis / np.maximum(sine, 1e-9), aside / np.linalg.norm(aside, axis=-1, keepdims=True))
    return matrix_from_axis_angle(np.arctan2(sine, cosine) * axis) @ prior


def _twist_to_hinge(name: str, swung: np.ndarray, joints: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Twist about the upper bone, so that the lower one bends about the hinge; the less, the straighter the limb."""
    middle, end, rest_axis = _HINGES[name]
    axis = swung @ np.array(rest_axis)
    upper, lower = _directions(_between(joints, name, middle)), _directions(_between(joints, middle, end))
    at_rest = np.cross(
        _directions(_between(rest[None], name, middle)[0]), _directions(_between(rest[None], middle, end)[0])
    )
    # The bend beyond that of the rest pose, so that this comes out without any twist.
    bend = np.cross(upper, lower) - swung @ at_rest + STRAIGHT * axis
    sine = np.sum(upper * np.cross(axis, bend), axis=-1)
    across = np.sum(axis * upper, axis=-1) * np.sum(bend * upper, axis=-1)
    cosine = np.sum(axis * bend, axis=-1) - across
    # Over a few frames, weighted by how clearly the limb is bent: joints do not show a twist, so none must jump.
    sine, cosine = (gaussian_filter1d(part, SMOOTHING_FRAMES, mode="nearest") for part in (sine, cosine))
    return matrix_from_axis_angle(np.arctan2(sine, cosine)[:, None] * upper) @ swung


def _directions(bones: np.ndarray) -> np.ndarray:
    """Unit vectors; zero for bones of no length."""
    length = np.linalg.norm(bones, axis=-1, keepdims=True)
    return np.where(length > MIN_BONE_M, bones / np.maximum(length, MIN_BONE_M), 0.0)


def _between(joints: np.ndarray, start: str, end: str) -> np.ndarray:
    return joints[:, SMPL_JOINTS.index(end)] - joints[:, SMPL_JOINTS.index(start)]
