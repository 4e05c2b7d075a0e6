"""Which joints a camera sees, from the depth of the rendered body."""

from __future__ import annotations

import numpy as np

from ctlev_core.geometry.joint_sets import SMPL_JOINTS
from data_contracts.errors import DataError

_FLESH_M = {
    "pelvis": 0.20, "hip": 0.21, "spine1": 0.21, "spine2": 0.21, "spine3": 0.20, "neck": 0.21, "collar": 0.19,
    "head": 0.13, "shoulder": 0.14,
    "knee": 0.15, "ankle": 0.09, "foot": 0.07, "elbow": 0.10, "wrist": 0.06, "hand": 0.08,
}  # fmt: skip
SMPL_FLESH_M = np.array([_FLESH_M[joint.removeprefix("left_").removeprefix("right_")] for joint in SMPL_JOINTS])
"""How much of its own body may lie before a joint, [24] m: from the joint of the bundled body at rest to its skin, in
three of four directions for the trunk and nine of ten for limbs, along which one looks more often. In the rest one
looks along the bone, and what lies before the joint is the far end of the limb. For the hand, whose joint lies at its
back, as far as its palm."""


def joint_visibility(
    joints_cam: np.ndarray, depth_inverse: np.ndarray, intrinsics: np.ndarray, margin_m: np.ndarray | float
) -> np.ndarray:
    """Which joints are in front of the camera, inside the image, and not behind a surface other than their own flesh.

    A joint whose pixel shows no surface is hidden by nothing. One that is not finite is not visible.

    Args:
        joints_cam: [J, 3] m, camera frame.
        depth_inverse: [H, W] 1 / m, 0 where there is no surface; as `render_normals` returns it, of one frame.
        intrinsics: [4] (fx, fy, cx, cy) px.
        margin_m: how much nearer than the joint the surface may be; one for all or [J], such as `SMPL_FLESH_M`.
    Returns:
        [J] bool.
    Raises:
        DataError: shapes disagree, or a margin is negative or not finite.
    """
    joints = np.asarray(joints_cam, np.float64)
    if joints.ndim != 2 or joints.shape[1] != 3 or np.ndim(depth_inverse) != 2 or np.shape(intrinsics) != (4,):
        raise DataError(
            "joint_visibility needs joints_cam [J, 3], depth_inverse [H, W] and intrinsics [4], got "
            f"{joints.shape}, {np.shape(depth_inverse)} and {np.shape(intrinsics)}"
        )
    if np.shape(margin_m) not in ((), (len(joints),)):
        raise DataError(f"margin_m must be one number or [{len(joints)}], got {np.shape(margin_m)}")
    margins = np.broadcast_to(np.asarray(margin_m, np.float64), len(joints))
    if not (np.isfinite(margins) & (margins >= 0.0)).all():
        raise DataError("margin_m must be finite and not negative")
    height, width = depth_inverse.shape
    visible = np.isfinite(joints).all(axis=1) & (joints[:, 2] > 0.0)
    x, y, z = joints[visible].T
    fx, fy, cx, cy = np.asarray(intrinsics, np.float64)
    columns, rows = fx * x / z + cx, fy * y / z + cy
    inside = (columns >= 0.0) & (columns < width) & (rows >= 0.0) & (rows < height)
    surface = np.zeros(len(z))
    surface[inside] = depth_inverse[rows[inside].astype(int), columns[inside].astype(int)]
    # surface depth >= z - margin, without a division by the 0 of no surface
    visible[visible] = inside & ((z - margins[visible]) * surface <= 1.0)
    return visible
