"""Rotations as axis-angle vectors, quaternions and matrices, safe at 0 and at pi.

Axis-angle [..., 3] rad; quaternions [..., 4] in the order (x, y, z, w), the sign is free; 6D [..., 6], the first two
columns of the matrix one after the other; matrices [..., 3, 3] acting on column vectors. A number that is not finite is
a `DataError` that tells where. `ctlev_core.body.torch_rotations` has the same with gradients.

The logarithm goes through quaternions (scipy), because acos of a trace loses half of all digits near pi and is NaN once
rounding pushes the trace below -1.

Source of the 6D form: Zhou et al., On the continuity of rotation representations in neural networks, CVPR 2019.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from data_contracts.errors import DataError

_PARALLEL = 1e-6
"""Sine of the angle between the two vectors of a 6D rotation below which they count as parallel."""


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


def rotation_6d_from_matrix(matrix: np.ndarray) -> np.ndarray:
    """The first two columns [..., 6] of rotation matrices [..., 3, 3], one after the other.

    Raises:
        ValueError: the last two axes are not 3 x 3.
    """
    matrices = _checked(matrix, (3, 3), "matrix")
    return np.swapaxes(matrices[..., :2], -1, -2).reshape(*matrices.shape[:-2], 6)


def matrix_from_rotation_6d(rotation_6d: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3] float64 of pairs of vectors [..., 6], by Gram-Schmidt (Zhou et al., sec. 4.2).

    Raises:
        ValueError: the last axis is not 6.
        DataError: a vector is 0 or not finite, or the two are parallel (sine of their angle below 1e-6); which one is
            told. The function of the same name in `torch_rotations` has a rotation for these.
    """
    vectors = _checked(rotation_6d, (6,), "rotation_6d")
    pair = vectors.reshape(*vectors.shape[:-1], 2, 3)
    largest = np.abs(pair).max(axis=-1, keepdims=True)
    _refuse((largest == 0).any(axis=(-1, -2)), "rotation_6d", "has a vector that is 0", vectors)
    pair = pair / largest
    pair /= np.linalg.norm(pair, axis=-1, keepdims=True)
    x, y = pair[..., 0, :], pair[..., 1, :]
    _refuse(np.linalg.norm(np.cross(x, y), axis=-1) < _PARALLEL, "rotation_6d", "has parallel vectors", vectors)
    # Twice: of nearly parallel vectors the first pass leaves little but rounding.
    for _ in range(2):
        y = y - np.sum(x * y, axis=-1, keepdims=True) * x
        y /= np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


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


def _refuse(wrong: np.ndarray, name: str, problem: str, values: np.ndarray) -> None:
    if np.any(wrong):
        where = tuple(int(n) for n in np.argwhere(wrong)[0])
        raise DataError(f"{name}{list(where) if where else ''} {problem}: {values[where].tolist()}")


def _checked(values: np.ndarray, trailing: tuple[int, ...], name: str) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64)
    if array.shape[-len(trailing) :] != trailing:
        raise ValueError(f"{name} must end in the shape {trailing}, got {array.shape}")
    wrong = np.asarray(~np.isfinite(array).all(axis=tuple(range(-len(trailing), 0))))
    _refuse(wrong, name, "is not finite", array)
    return array
