"""Bodies set on the ground: the skin's lowest places touch it and stick to it, whatever the pose.

`motions.py` does this with joints, which is enough for feet. Here it is the skin, so that a lying or sitting body does
not sink in by the thickness of its flesh. A body has inertia as well: its speed is that of what sticks to the ground,
smoothed over a tenth of a second, and feet that would slip by the difference are put back by `foot_planting.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ctlev_core.body.layer import NUM_BETAS, load_body, pose_vertices
from ctlev_core.geometry.joint_sets import SMPL_JOINTS

SOFTNESS_M = 0.004
"""How far above the lowest vertex another still carries weight: contact moves smoothly from place to place."""
INERTIA_S = 0.045
"""Standard deviation of the smoothing of the body's speed over the ground."""
SHOCK_S = 0.02
MAX_SHOCK_M = 0.015
"""Standard deviation, and largest effect, of the smoothing of its height: knees take up the shock of each step."""
SIDES = ("left", "right")
_CHUNK = 128


@dataclass(frozen=True, eq=False)
class GroundContact:
    """How a body that turns its joints so would touch the ground.

    Attributes:
        height_m: [T], to raise the body by, so that its lowest places are at y = 0.
        step_m: [T, 2], along x and z since the frame before, with which what touches the ground stays where it is.
        foot_gap_m: [T, 2], of each foot (left, right) above the ground.
        foot_step_m: [T, 2, 2], along x and z, of the sole of each foot since the frame before, if the body did not
            move.
    """

    height_m: np.ndarray
    step_m: np.ndarray
    foot_gap_m: np.ndarray
    foot_step_m: np.ndarray


def find_contact(rotations: np.ndarray) -> GroundContact:
    """The contact of a moving body with the ground.

    Each vertex carries a share of the weight that falls off exponentially with its height above the lowest one; the
    weighted mean height is 0, and so is the weighted mean horizontal step from frame to frame. Walking forward comes
    out of it: the foot on the ground stays, the body moves.

    Args:
        rotations: [T, 24, 3, 3] relative to the parent; the steps between frames must be small, 10 ms or so.
    """
    body, count = load_body(), len(rotations)
    soles = [np.flatnonzero(_is_foot(side)) for side in SIDES]
    height, gap = np.zeros(count), np.zeros((count, 2))
    step, foot_step = np.zeros((count, 2)), np.zeros((count, 2, 2))
    for start in range(0, count, _CHUNK):
        # One frame of the chunk before, for the step from it.
        first = max(start - 1, 0)
        rows, part = slice(first, start + _CHUNK), rotations[first : start + _CHUNK]
        vertices, _ = pose_vertices(body, part, np.zeros(NUM_BETAS), np.zeros((len(part), 3)))
        lowest, mean, moved = _touching(vertices)
        height[rows], step[first + 1 : start + _CHUNK] = -mean, -moved
        for foot, sole in enumerate(soles):
            foot_lowest, _, moved = _touching(vertices[:, sole])
            gap[rows, foot], foot_step[first + 1 : start + _CHUNK, foot] = foot_lowest - lowest, moved
    return GroundContact(height, step, gap, foot_step)


def body_path(contact: GroundContact, grounded: np.ndarray, step_s: float) -> np.ndarray:
    """Translations of a body on the ground.

    Args:
        contact: of T frames.
        grounded: [T], 1 where the body touches the ground, 0 where it is in the air and goes on as it went.
        step_s: time between frames.
    Returns:
        [T, 3] float64, m; x and z are 0 in the first frame.
    """
    transl = np.zeros((len(grounded), 3))
    # The first frame has no step.
    frames = np.arange(1, len(grounded))
    down = frames[grounded[1:] > 0.5]
    for column, axis in enumerate((0, 2)):
        steps = np.interp(frames, down, contact.step_m[down, column]) if len(down) else np.zeros(len(frames))
        # The ends go on as they are: who walks at the end does not stop there.
        transl[1:, axis] = np.cumsum(gaussian_filter1d(steps, INERTIA_S / step_s, mode="nearest"))
    smooth = gaussian_filter1d(contact.height_m, SHOCK_S / step_s, mode="nearest")
    transl[:, 1] = contact.height_m + MAX_SHOCK_M * np.tanh((smooth - contact.height_m) / MAX_SHOCK_M)
    return transl


def _is_foot(side: str) -> np.ndarray:
    return np.isin(
        load_body().weight_indices[:, 0], [SMPL_JOINTS.index(f"{side}_{name}") for name in ("ankle", "foot")]
    )


def _touching(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of vertices [T, V, 3] the height [T] of the lowest, mean height [T] and step [T - 1, 2] by weight carried."""
    height = vertices[..., 1]
    lowest = height.min(axis=1)
    load = np.exp((lowest[:, None] - height) / SOFTNESS_M)
    load /= load.sum(axis=1, keepdims=True)
    shared = (load[1:] + load[:-1]) / 2
    moved = np.einsum("tv,tva->ta", shared, np.diff(vertices[..., ::2], axis=0))
    return lowest, np.einsum("tv,tv->t", load, height), moved
