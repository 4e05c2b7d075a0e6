"""Rotations as axis-angle vectors, quaternions and matrices, safe at 0 and at pi.

Axis-angle [..., 3] rad; quaternions [..., 4] in the order (x, y, z, w), the sign is free; matrices [..., 3, 3] acting
on column vectors. The logarithm goes through quaternions (scipy), because acos of a trace loses half of all digits
near pi and is NaN once rounding pushes the trace below -1.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def matrix_from_axis_angle(axis_angle: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3] float64 of axis-angle vectors [..., 3] rad (exponential map).

    Raises:
        ValueError: the last axis is not 3.
    """
    vectors = _checked(axis_angle, (3,), "axis_angle")
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape[:-1], 3, 3)


def axis_angle_from_matrix(matrix: np.ndarray) -> np.ndarray:
    """Axis-angle vectors [..., 3] rad, of length at most pi, of rotation matrices [..., 3, 3] (logarithm map).

    Raises:
        ValueError: the last two axes are not 3 x 3, or a matrix is a reflection.
    """
    matrices = _checked(matrix, (3, 3), "matrix")
    return Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec().reshape(*matrices.shape[:-2], 3)


def quaternion_from_matrix(matrix: np.ndarray) -> np.ndarray:
    """Unit quaternions [..., 4] (x, y, z, w) with w >= 0 of rotation matrices [..., 3, 3].

    Raises:
        ValueError: the last two axes are not 3 x 3, or a matrix is a reflection.
    """
    matrices = _checked(matrix, (3, 3), "matrix")
    quaternions = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_quat(canonical=True)
    return quaternions.reshape(*matrices.shape[:-2], 4)


def matrix_from_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] (x, y, z, w) of any non-zero length.

    Raises:
        ValueError: the last axis is not 4, or a quaternion is zero.
    """
    quaternions = _checked(quaternion, (4,), "quaternion")
    return Rotation.from_quat(quaternions.reshape(-1, 4)).as_matrix().reshape(*quaternions.shape[:-1], 3, 3)


def matrix_from_euler(order: str, angles_deg: np.ndarray) -> np.ndarray:
    """Rotation matrices [N, 3, 3] of intrinsic Euler angles [N, len(order)] in degrees.

    `order` "YXZ" is R_y(first) R_x(second) R_z(third).
    """
    return Rotation.from_euler(order.upper(), angles_deg, degrees=True).as_matrix()


def slerp(start: np.ndarray, end: np.ndarray, fraction: np.ndarray | float) -> np.ndarray:
    """Point on the shortest path from `start` to `end` on SO(3), at constant angular speed.

    Args:
        start: [..., 3, 3] rotation matrices, at fraction 0.
        end: [..., 3, 3] rotation matrices, at fraction 1; broadcasts with `start`.
        fraction: scalar or an array that broadcasts with the leading axes.
    Returns:
        [..., 3, 3] float64.
    """
    step = axis_angle_from_matrix(np.swapaxes(start, -1, -2) @ end)
    return start @ matrix_from_axis_angle(np.asarray(fraction, dtype=np.float64)[..., None] * step)


def _checked(values: np.ndarray, trailing: tuple[int, ...], name: str) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64)
    if array.shape[-len(trailing) :] != trailing:
        raise ValueError(f"{name} must end in the shape {trailing}, got {array.shape}")
    return array
