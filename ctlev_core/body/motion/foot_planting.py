"""Feet that stay where they stand: legs are bent a little, so that soles on the ground do not slip.

Key poses have feet slip: two legs on the ground that move against one another, or one that is slower or faster than the
body. How far a sole would have slipped since it came down is taken back by moving the ankle, with hip and knee in
closed form; once the foot is in the air, it returns to the pose.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ctlev_core.body.layer import NUM_BETAS, joint_transforms, load_body
from ctlev_core.body.motion.ground_contact import SIDES, GroundContact
from ctlev_core.body.rotations import axis_angle_from_matrix
from ctlev_core.geometry.joint_sets import SMPL_JOINTS, SMPL_PARENTS

PLANTED_M, LIFTED_M = 0.006, 0.02
"""Gap under a foot below which it is held, and above which it is free; between, a bit of both."""
RETURN_S = 0.07
"""Time constant of a free foot's return to the pose."""
MAX_OFFSET_M = 0.25
KNEE_CLEAR_M = 0.12
"""A leg whose knee is this low kneels; its ankle has no say."""
SMOOTHING_S = 0.02
"""Standard deviation of the smoothing of what is changed."""
LONGEST = 0.9995
"""Of the sum of thigh and shank: legs do not stretch further."""
LEG_JOINTS = tuple(SMPL_JOINTS.index(f"{side}_{name}") for side in SIDES for name in ("hip", "knee", "ankle"))
_STRAIGHT = 0.05
_HINGE = np.array([1.0, 0.0, 0.0])
"""Axis of a knee in the rest pose."""


def plant_feet(
    rotations: np.ndarray, contact: GroundContact, transl: np.ndarray, grounded: np.ndarray, step_s: float
) -> np.ndarray:
    """How hips, knees and ankles must turn for feet to stay where they stand.

    Args:
        rotations: [T, 24, 3, 3] relative to the parent.
        contact: of these T frames.
        transl: [T, 3] m, of the body, without jumps.
        grounded: [T], 0 where the body is in the air.
        step_s: time between frames.
    Returns:
        [T, 6, 3] rad axis-angle, to turn `LEG_JOINTS` by after their own rotation.
    """
    moved = _move_feet(rotations, _foot_offsets(contact, transl, grounded, step_s), transl)
    turns = axis_angle_from_matrix(np.swapaxes(rotations[:, LEG_JOINTS], -1, -2) @ moved)
    # A leg that is all but straight bends by degrees for a millimetre: knees would jerk.
    return gaussian_filter1d(turns, SMOOTHING_S / step_s, axis=0, mode="nearest")


def _foot_offsets(contact: GroundContact, transl: np.ndarray, grounded: np.ndarray, step_s: float) -> np.ndarray:
    """How far each foot must be from where the pose has it, [T, 2, 3] m: left and right."""
    held = np.clip((LIFTED_M - contact.foot_gap_m) / (LIFTED_M - PLANTED_M), 0.0, 1.0) * grounded[:, None]
    slip = contact.foot_step_m[1:] + np.diff(transl[:, ::2], axis=0)[:, None]
    offsets = np.zeros((*held.shape, 3))
    for frame in range(1, len(offsets)):
        hold = ((held[frame] + held[frame - 1]) / 2)[:, None]
        kept = offsets[frame - 1, :, ::2] * np.exp(-(1 - hold) * step_s / RETURN_S)
        offset = kept - hold * slip[frame - 1]
        length = np.linalg.norm(offset, axis=-1, keepdims=True)
        offsets[frame, :, ::2] = offset * np.minimum(1.0, MAX_OFFSET_M / np.maximum(length, 1e-9))
    above = contact.foot_gap_m + (transl[:, 1] - contact.height_m)[:, None]
    offsets[..., 1] = np.where(above < 0, -above, -held * above)
    return offsets


def _move_feet(rotations: np.ndarray, offsets: np.ndarray, transl: np.ndarray) -> np.ndarray:
    """Rotations [T, 6, 3, 3] of `LEG_JOINTS` that move the ankles by `offsets` [T, 2, 3]; feet point as before.

    Where a leg is too short, its ankle is as near as it gets.
    """
    transforms, joints = joint_transforms(load_body(), rotations, np.zeros(NUM_BETAS), transl)
    orientation = transforms[..., :3]
    moved = []
    for number in range(len(SIDES)):
        leg = LEG_JOINTS[3 * number : 3 * number + 3]
        stands = np.clip((joints[:, leg[1], 1] - KNEE_CLEAR_M) / KNEE_CLEAR_M, 0.0, 1.0)
        turned = orientation[:, leg].copy()
        turned[:, 0], turned[:, 1] = _reach(
            joints[:, leg], turned[:, 0], turned[:, 1], stands[:, None] * offsets[:, number]
        )
        parents = np.stack([orientation[:, SMPL_PARENTS[leg[0]]], turned[:, 0], turned[:, 1]], axis=1)
        moved.append(np.swapaxes(parents, -1, -2) @ turned)
    return np.concatenate(moved, axis=1)


def _reach(leg: np.ndarray, thigh: np.ndarray, shank: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orientations [T, 3, 3] of thigh and shank that bring the ankle to where it is plus `shift` [T, 3].

    The knee stays in the plane in which the leg bends, or would bend if it were not straight.
    """
    hip, knee, ankle = leg[:, 0], leg[:, 1], leg[:, 2]
    upper, lower = _unit(knee - hip), _unit(ankle - knee)
    lengths = np.linalg.norm(knee - hip, axis=-1), np.linalg.norm(ankle - knee, axis=-1)
    normal = _unit(np.cross(upper, lower) + _STRAIGHT * thigh @ _HINGE)
    target = ankle + shift - hip
    shortest, longest = np.abs(lengths[0] - lengths[1]) + 1e-3, LONGEST * (lengths[0] + lengths[1])
    distance = _soften(np.linalg.norm(ankle - hip, axis=-1), np.linalg.norm(target, axis=-1), longest)
    distance = np.maximum(distance, shortest)
    toward = _unit(target)
    # The normal, carried along from the old direction of the ankle to the new one.
    new_normal = _unit(np.cross(np.cross(toward, normal), toward))
    cosine = (lengths[0] ** 2 + distance**2 - lengths[1] ** 2) / (2 * lengths[0] * distance)
    cosine = np.clip(cosine, -1.0, 1.0)[:, None]
    new_upper = cosine * toward + np.sqrt(1 - cosine**2) * np.cross(toward, new_normal)
    new_lower = _unit(distance[:, None] * toward - lengths[0][:, None] * new_upper)
    return (
        _frame(new_upper, new_normal) @ np.swapaxes(_frame(upper, normal), -1, -2) @ thigh,
        _frame(new_lower, new_normal) @ np.swapaxes(_frame(lower, normal), -1, -2) @ shank,
    )


def _soften(length: np.ndarray, wanted: np.ndarray, longest: np.ndarray) -> np.ndarray:
    """Lengths [T] of a leg that nears its longest, but does not pass it."""
    room = np.maximum(longest - length, 1e-6)
    longer = length + room * (1 - np.exp(-np.maximum(wanted - length, 0.0) / room))
    return np.where(wanted > length, longer, wanted)


def _frame(along: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Orthonormal axes [T, 3, 3] as columns, the first along a bone, the second as near the normal as it gets."""
    second = _unit(normal - np.sum(normal * along, axis=-1, keepdims=True) * along)
    return np.stack([along, second, np.cross(along, second)], axis=-1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
