"""Distances between predicted and labelled joints, in the image and in space: what the pose metrics share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, get_args

import numpy as np
from pydantic import Field

from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.geometry.procrustes import align_similarity
from data_contracts.config import Frozen
from data_contracts.labels import Labels

Alignment = Literal["none", "pelvis", "procrustes"]
Counted = Literal["visible", "known"]
Sums = dict[str, tuple[np.ndarray, np.ndarray]]
"""Of each score, by name, numerators [N] and denominators [N] of the rows."""


class JointErrorOptions(Frozen):
    """Which joints count in the image, and how labels are read."""

    joints: Counted = Field(
        default="visible", description="joints that count: those visible, or all whose position is known"
    )
    protocol: Literal["exact", "dhp19"] = Field(
        default="exact", description="labels as they are, or moved to the centre of their pixel as DHP19's code does"
    )

    @property
    def suffix(self) -> str:
        """What the name of a score says of them."""
        return ("_dhp19" if self.protocol == "dhp19" else "") + ("_known" if self.joints == "known" else "") + "_px"

    def errors_px(self, predicted: Mapping[str, Any], target: Labels) -> np.ndarray:
        """`compute_joint_errors_px` by these options."""
        return compute_joint_errors_px(predicted, target, self.joints, whole_pixels=self.protocol == "dhp19")


def compute_joint_errors_px(
    predicted: Mapping[str, Any], target: Labels, counted: Counted = "visible", *, whole_pixels: bool = False
) -> np.ndarray:
    """Euclidean distance of each joint, NaN where the label does not count.

    Args:
        predicted: `joints2d` [N, J, 2], px.
        target: labels with `joints2d` [N, J, 2], px, and `visible` [N, J].
        counted: joints that count: those visible, or all whose position is known, also outside the image and occluded.
        whole_pixels: measure from the centre of the pixel that a label lies in rather than from the label.
    Returns:
        [N, J] float64, px.
    Raises:
        ValueError: shapes differ, no joint counts, or a prediction for one that does is not finite.
    """
    if target.joints2d is None or target.visible is None:
        raise ValueError("the target labels have no joints2d")
    points = np.asarray(predicted["joints2d"], dtype=np.float64)
    if points.shape != target.joints2d.shape:
        raise ValueError(f"predicted joints2d must be {target.joints2d.shape}, got {points.shape}")
    joints = target.joints2d.astype(np.float64)
    counts = target.visible if counted == "visible" else _is_finite(joints)
    if not counts.any():
        raise ValueError(f"no joint is {counted} in any of the {len(target)} target rows")
    distance = _lengths(points - (np.floor(joints) + 0.5 if whole_pixels else joints))
    wrong = counts & ~np.isfinite(distance)
    if wrong.any():
        row, joint = np.argwhere(wrong)[0]
        raise ValueError(
            f"predicted joint {joint} of row {row} is {points[row, joint].tolist()}, not a finite position"
        )
    return np.where(counts, distance, np.nan)


def compute_joint_errors_mm(predicted: Mapping[str, Any], target: Labels, alignment: Alignment) -> np.ndarray:
    """Euclidean distance of each joint in space, NaN where the label is not known.

    Args:
        predicted: `joints3d` [N, J, 3], mm, camera frame.
        target: labels with `joints3d` [N, J, 3], mm, and a joint set; occluded joints count as well.
        alignment: of each row before distances are taken. pelvis: both are moved until the middle of their hips is the
            origin, and a row whose hips are not both known has no distance; procrustes: the prediction is turned,
            scaled and moved to fit best.
    Returns:
        [N, J] float64, mm.
    Raises:
        ValueError: shapes differ, no joint is known, a prediction is not finite, or the joint set has no hips.
    """
    if alignment not in get_args(Alignment):
        raise ValueError(f"alignment must be one of {', '.join(get_args(Alignment))}, got {alignment!r}")
    if target.joints3d is None:
        raise ValueError("the target labels have no joints3d")
    points, joints = np.asarray(predicted["joints3d"], dtype=np.float64), target.joints3d.astype(np.float64)
    if points.shape != joints.shape:
        raise ValueError(f"predicted joints3d must be {joints.shape}, got {points.shape}")
    if not np.isfinite(points).all():
        row, joint = np.argwhere(~_is_finite(points))[0]
        raise ValueError(
            f"predicted joint {joint} of row {row} is {points[row, joint].tolist()}, not a finite position"
        )
    known = _is_finite(joints)
    if not known.any():
        raise ValueError(f"no joint is known in any of the {len(target)} target rows")
    if alignment == "procrustes":
        points = align_similarity(points, joints, known)
    apart = points - joints
    if alignment == "pelvis":
        left, right = hip_indices(target.joint_set)
        # Both moved by their own hips: their difference moves by the difference of the hips.
        apart -= (apart[:, [left]] + apart[:, [right]]) / 2
    return _lengths(apart)


def _is_finite(points: np.ndarray) -> np.ndarray:
    """[N, J] of [N, J, 2 or 3]: are all coordinates finite?"""
    finite = np.isfinite(points)
    return np.ones(points.shape[:-1], bool) if finite.all() else np.logical_and.reduce(finite, axis=-1)


def _lengths(vectors: np.ndarray) -> np.ndarray:
    """Lengths of vectors [..., 2 or 3]; several times faster than `numpy.linalg.norm` for so short ones."""
    return np.sqrt(np.einsum("...c,...c->...", vectors, vectors))


def hip_indices(joint_set: str) -> list[int]:
    """Left and right hip in a joint set.

    Raises:
        ValueError: it has none, or is not known.
    """
    names = JOINT_SETS[joint_set].joints if joint_set in JOINT_SETS else ()
    if not {"left_hip", "right_hip"} <= set(names):
        raise ValueError(f"joint set {joint_set!r} has no hips to align by; known sets: {', '.join(JOINT_SETS)}")
    return [names.index("left_hip"), names.index("right_hip")]


def check_length(length: Callable[[np.ndarray, str], np.ndarray], joint_set: str) -> None:
    """Raise `ValueError` unless the set has the joints of a length of `ctlev_core.scoring.body_lengths`."""
    count = len(JOINT_SETS[joint_set].joints) if joint_set in JOINT_SETS else 0
    length(np.empty((0, count, 3)), joint_set)


def row_sums(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum and number [N] of the entries of [N, J] that are not NaN: what means over any rows are made of."""
    known = ~np.isnan(values)
    # Rows are short: a matrix product adds them up several times faster than a sum over an axis.
    ones = np.ones(values.shape[-1])
    return np.where(known, values, 0.0) @ ones, known @ ones


def quotients(sums: Sums) -> dict[str, float]:
    """Scores over all rows: sum of the numerators by sum of the denominators."""
    return {name: float(total.sum() / count.sum()) for name, (total, count) in sums.items()}


def row_means(values: np.ndarray) -> np.ndarray:
    """Mean over the last axis of [N, J] without the NaN entries; NaN for a row of nothing else."""
    total, count = row_sums(values)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
