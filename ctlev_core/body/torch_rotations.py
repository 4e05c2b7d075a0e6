"""Rotations in torch, with gradients that are finite and right everywhere: at 0, near pi and past it.

The maps of `ctlev_core.body.rotations` for any leading axes, device and floating dtype, under the same names.
Axis-angle [..., 3] rad; 6D [..., 6], the first two columns of the matrix one after the other; matrices [..., 3, 3]
acting on column vectors.

Where the logarithm jumps, at an angle of pi, the gradient is that of the side the result is on. Nothing here looks at
values on the host: a degenerate 6D vector gets a stated rotation instead of an error.

Source: Grassia, Practical parameterization of rotations using the exponential map, J. Graphics Tools 1998 (series at
0); Shepperd, Quaternion from rotation matrix, J. Guidance and Control 1978; Zhou et al., On the continuity of rotation
representations in neural networks, CVPR 2019 (6D).
"""

from __future__ import annotations

import math

import torch

_SERIES_BELOW = 0.25
"""Squared angle, rad^2, below which series replace quotients that are 0 / 0 at 0."""
_PARALLEL = 1e-6
"""Sine of the angle between the two vectors of a 6D rotation below which they count as parallel."""


def matrix_from_axis_angle(axis_angle: torch.Tensor) -> torch.Tensor:
    """Rotation matrices [..., 3, 3] of axis-angle vectors [..., 3] rad (exponential map, Rodrigues' formula).

    Of the derivatives all orders exist at 0. Rounding of the angle counts: the error is about eps times (1 + angle).

    Raises:
        ValueError: the last axis is not 3.
    """
    _check(axis_angle, (3,), "axis_angle")
    squared = (axis_angle * axis_angle).sum(-1)
    small = squared < _SERIES_BELOW
    # Both branches of `where` are differentiated: the quotients must not see 0, nor the series a large angle.
    near, far = torch.where(small, squared, 0.0), torch.where(small, 1.0, squared)
    angle = far.sqrt()
    half = torch.sin(angle / 2)
    sine = torch.where(small, _series(near, 1), torch.sin(angle) / angle)
    versine = torch.where(small, _series(near, 2), 2 * half * half / far)
    cross = _cross_matrix(axis_angle)
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return identity + sine[..., None, None] * cross + versine[..., None, None] * (cross @ cross)


def quaternion_from_matrix(matrix: torch.Tensor) -> torch.Tensor:
    """Unit quaternions [..., 4] (x, y, z, w) with w >= 0 of rotation matrices [..., 3, 3].

    Of the four ways to take a quaternion from a matrix each row uses the one that divides by the largest component, so
    that no digits are lost and no root of 0 is differentiated.

    Raises:
        ValueError: the last two axes are not 3 x 3.
    """
    _check(matrix, (3, 3), "matrix")
    (a, b, c), (d, e, f), (g, h, i) = (matrix[..., row, :].unbind(-1) for row in range(3))
    # The rows are 4 q_k q for each component q_k of q.
    candidates = torch.stack(
        [
            torch.stack([1 + a - e - i, b + d, c + g, h - f], -1),
            torch.stack([b + d, 1 - a + e - i, f + h, c - g], -1),
            torch.stack([c + g, f + h, 1 - a - e + i, d - b], -1),
            torch.stack([h - f, c - g, d - b, 1 + a + e + i], -1),
        ],
        -2,
    )
    largest = candidates.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None].expand(*matrix.shape[:-2], 1, 4)
    row = candidates.gather(-2, largest).squeeze(-2)
    quaternion = row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)
    return torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)


def axis_angle_from_matrix(matrix: torch.Tensor) -> torch.Tensor:
    """Axis-angle vectors [..., 3] rad, of length at most pi, of rotation matrices [..., 3, 3] (logarithm map).

    At pi exactly both signs of the axis are right; the one whose largest component is positive is given.

    Raises:
        ValueError: the last two axes are not 3 x 3.
    """
    quaternion = quaternion_from_matrix(matrix)
    vector, w = quaternion[..., :3], quaternion[..., 3]
    squared = (vector * vector).sum(-1)
    # Sine of half the angle; its square below 1/64 keeps the series of arcsin(s) / s short.
    small = squared < _SERIES_BELOW / 16
    near, sine = torch.where(small, squared, 0.0), torch.where(small, 1.0, squared).sqrt()
    scale = torch.where(small, 2 * _arcsine_series(near), 2 * torch.atan2(sine, w) / sine)
    return scale[..., None] * vector


def rotation_6d_from_matrix(matrix: torch.Tensor) -> torch.Tensor:
    """The first two columns [..., 6] of rotation matrices [..., 3, 3], one after the other.

    Raises:
        ValueError: the last two axes are not 3 x 3.
    """
    _check(matrix, (3, 3), "matrix")
    return matrix[..., :2].transpose(-1, -2).flatten(-2)


def matrix_from_rotation_6d(rotation_6d: torch.Tensor) -> torch.Tensor:
    """Rotation matrices [..., 3, 3] of any two vectors [..., 6] by Gram-Schmidt (Zhou et al., sec. 4.2).

    Where the first vector is 0 the x axis takes its place; where the second is 0 or parallel to the first (sine of the
    angle below 1e-6), or either is not finite, the coordinate axis least along the first does. What was replaced gets
    no gradient.

    Raises:
        ValueError: the last axis is not 6.
    """
    _check(rotation_6d, (6,), "rotation_6d")
    first, second = rotation_6d[..., :3], rotation_6d[..., 3:]
    axes = torch.eye(3, dtype=rotation_6d.dtype, device=rotation_6d.device)
    x = _unit(first, axes[0].expand_as(first))
    spare = axes[x.detach().abs().argmin(-1)]
    second = _unit(second, spare)
    parallel = (torch.linalg.cross(x, second, dim=-1).detach() ** 2).sum(-1) < _PARALLEL**2
    second = torch.where(parallel[..., None], spare, second)
    y = second - (x * second).sum(-1, keepdim=True) * x
    y = y / torch.linalg.vector_norm(y, dim=-1, keepdim=True)
    # Once more: of nearly parallel vectors the first pass leaves little but rounding.
    y = y - (x * y).sum(-1, keepdim=True) * x
    y = y / torch.linalg.vector_norm(y, dim=-1, keepdim=True)
    return torch.stack([x, y, torch.linalg.cross(x, y, dim=-1)], -1)


def slerp(start: torch.Tensor, end: torch.Tensor, fraction: torch.Tensor | float) -> torch.Tensor:
    """Point on the shortest path from `start` to `end` on SO(3), at constant angular speed.

    Args:
        start: [..., 3, 3] rotation matrices, at fraction 0.
        end: [..., 3, 3] rotation matrices, at fraction 1; broadcasts with `start`.
        fraction: number, or a tensor that broadcasts with the leading axes.
    Returns:
        [..., 3, 3].
    """
    step = axis_angle_from_matrix(start.transpose(-1, -2) @ end)
    fraction = torch.as_tensor(fraction, dtype=step.dtype, device=step.device)
    return start @ matrix_from_axis_angle(fraction[..., None] * step)


def _series(squared: torch.Tensor, offset: int) -> torch.Tensor:
    """Sum of (-x)^n / (2 n + offset)!, x the squared angle: sin(a) / a for offset 1, (1 - cos(a)) / a^2 for 2."""
    total = torch.zeros_like(squared)
    for n in reversed(range(8)):
        total = total * -squared + 1 / math.factorial(2 * n + offset)
    return total


def _arcsine_series(squared: torch.Tensor) -> torch.Tensor:
    """arcsin(s) / s of s^2 below 1/64, to float64's last bit: coefficients (2 n)! / (4^n n!^2 (2 n + 1))."""
    total = torch.zeros_like(squared)
    for n in reversed(range(9)):
        total = total * squared + math.comb(2 * n, n) / (4**n * (2 * n + 1))
    return total


def _unit(vectors: torch.Tensor, instead: torch.Tensor) -> torch.Tensor:
    """Vectors [..., 3] of length 1; `instead` for those without a direction."""
    largest = vectors.detach().abs().amax(-1)
    usable = ((largest > 0) & torch.isfinite(largest))[..., None]
    # Scaled by the largest component first, so that squares neither overflow nor vanish.
    scaled = torch.where(usable, vectors, instead) / torch.where(usable, largest[..., None], 1.0)
    return scaled / torch.linalg.vector_norm(scaled, dim=-1, keepdim=True)


def _cross_matrix(vectors: torch.Tensor) -> torch.Tensor:
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def _check(tensor: torch.Tensor, trailing: tuple[int, ...], name: str) -> None:
    if tuple(tensor.shape[-len(trailing) :]) != trailing:
        raise ValueError(f"{name} must end in the shape {trailing}, got {tuple(tensor.shape)}")
    if not tensor.is_floating_point():
        raise ValueError(f"{name} must be floating point, got {tensor.dtype}")
