"""The similarity that brings one set of points closest to another, for many sets at once, safe for degenerate ones."""

from __future__ import annotations

import numpy as np

RELATIVE_SIZE = 1e-12
"""Points whose spread is less than this share of their distance from the origin are one point to float64."""


def align_similarity(points: np.ndarray, target: np.ndarray, known: np.ndarray) -> np.ndarray:
    """`points` turned, scaled and moved onto `target`, the sum of squared distances over known points at its least.

    Never a reflection. Points that all coincide keep no shape and come out at the mean of the target; collinear points
    leave the turn about their line open, and any of the best ones is taken. Where the best scale would be negative it
    is zero.

    Args:
        points: [N, J, 3] float.
        target: [N, J, 3] float; may be NaN where not known.
        known: [N, J] bool; points that count. A row without any is only returned as it is.
    Returns:
        [N, J, 3] float64, all points, known or not.
    Source: Umeyama, IEEE TPAMI 1991, eq. 34-43.
    """
    points, target = points.astype(np.float64), target.astype(np.float64)
    weight = known[..., None].astype(np.float64)
    count = np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    target = np.where(known[..., None], target, 0.0)
    centre_points = np.sum(weight * points, axis=1, keepdims=True) / count
    centre_target = np.sum(weight * target, axis=1, keepdims=True) / count
    from_centre, to_centre = points - centre_points, weight * (target - centre_target)
    # Scaled to unit size first: the product of coordinates in mm and in km alike stays far from overflow.
    size = np.sqrt(np.sum(weight * from_centre**2, axis=(1, 2), keepdims=True))
    shapeless = size <= RELATIVE_SIZE * np.abs(centre_points).max(axis=2, keepdims=True, initial=0.0)
    unit = from_centre / np.where(shapeless, 1.0, size)
    left, stretch, right = np.linalg.svd(np.swapaxes(weight * unit, 1, 2) @ to_centre)
    handed = np.ones_like(stretch)
    mirrored = np.asarray(np.linalg.det(left) * np.linalg.det(right)) < 0.0
    handed[:, 2] = np.where(mirrored, -1.0, 1.0)
    rotation = left * handed[:, None] @ right
    scale = np.maximum(np.sum(stretch * handed, axis=1), 0.0)[:, None, None]
    aligned = np.where(shapeless, 0.0, scale * unit @ rotation) + centre_target
    return np.where(np.any(known, axis=1, keepdims=True)[..., None], aligned, points)
