"""Distances between predicted and labelled joints in the image: what the 2D pose metrics share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from data_contracts.labels import Labels


def compute_joint_errors_px(predicted: Mapping[str, Any], target: Labels) -> np.ndarray:
    """Euclidean distance of each joint, NaN where the label is not visible.

    Args:
        predicted: `joints2d` [N, J, 2], px.
        target: labels with `joints2d` [N, J, 2], px, and `visible` [N, J].
    Returns:
        [N, J] float64, px.
    Raises:
        ValueError: shapes differ, no joint is visible, or a prediction for a visible joint is not finite.
    """
    if target.joints2d is None or target.visible is None:
        raise ValueError("the target labels have no joints2d")
    points = np.asarray(predicted["joints2d"], dtype=np.float64)
    if points.shape != target.joints2d.shape:
        raise ValueError(f"predicted joints2d must be {target.joints2d.shape}, got {points.shape}")
    if not target.visible.any():
        raise ValueError(f"no joint is visible in any of the {len(target)} target rows")
    distance = np.linalg.norm(points - target.joints2d, axis=-1)
    wrong = target.visible & ~np.isfinite(distance)
    if wrong.any():
        row, joint = np.argwhere(wrong)[0]
        raise ValueError(
            f"predicted joint {joint} of row {row} is {points[row, joint].tolist()}, not a finite position"
        )
    return np.where(target.visible, distance, np.nan)


def row_means(values: np.ndarray) -> np.ndarray:
    """Mean over the last axis of [N, J] without the NaN entries; NaN for a row of nothing else."""
    known = ~np.isnan(values)
    count = known.sum(axis=-1)
    total = np.where(known, values, 0.0).sum(axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
