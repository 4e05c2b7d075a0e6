"""Mean per-joint position error in space, mm: as predicted, from the pelvis, or up to a similarity.

Source: 3D-MPJPE of the paper's Table 3 and of Event-HPE (Zou et al., ICCV 2021, `event_pose_estimation/loss_funcs.py`):
MPJPE in the camera frame, PEL-MPJPE with both bodies moved to the middle of their hips, PA-MPJPE after a similarity
(Umeyama 1991). The three are always given together; a number without its alignment says little.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field

from ctlev_core.scoring.pose import (
    Alignment,
    Sums,
    compute_joint_errors_mm,
    hip_indices,
    quotients,
    row_means,
    row_sums,
)
from ctlev_core.scoring.score_info import ScoreInfo
from data_contracts.config import Frozen
from data_contracts.labels import Labels

VERSION = 2
INPUT = "joints3d"
SCORES = (
    ScoreInfo(
        "mpjpe3d",
        lower_is_better=True,
        meaning="mean distance between predicted and true joints in space, in millimetres",
    ),
)
NAMES: dict[Alignment, str] = {"pelvis": "mpjpe3d_pelvis_mm", "procrustes": "mpjpe3d_pa_mm", "none": "mpjpe3d_mm"}


class Options(Frozen):
    """Which of the three is compared row by row."""

    alignment: Alignment = Field(
        default="pelvis", description="the one that comes first and that models are compared by"
    )


def compute(predicted: Mapping[str, Any], target: Labels, options: Options) -> dict[str, float]:
    """`mpjpe3d_pelvis_mm`, `mpjpe3d_pa_mm` and `mpjpe3d_mm`, the chosen one first; every known joint counts alike.

    An alignment that no row has (the pelvis, where no row knows both hips) is left out unless it is the chosen one.

    Args:
        predicted: `joints3d` [N, J, 3], mm, camera frame.
        target: labels with joints in the same frame and order.
        options: which comes first.
    Raises:
        ValueError: see `compute_joint_errors_mm`; or no row has the chosen alignment.
    """
    return quotients(compute_sums(predicted, target, options))


def compute_sums(predicted: Mapping[str, Any], target: Labels, options: Options) -> Sums:
    """Of each row the sum [N] mm and number [N] of its errors; `compute` is their quotient over all rows."""
    order = sorted(NAMES, key=lambda alignment: alignment != options.alignment)
    sums = {NAMES[a]: row_sums(compute_joint_errors_mm(predicted, target, a)) for a in order}
    if not sums[NAMES[options.alignment]][1].any():
        raise ValueError(f"none of the {len(target)} target rows has what alignment {options.alignment!r} needs")
    return {name: (total, count) for name, (total, count) in sums.items() if count.any()}


def check_joint_set(joint_set: str, options: Options) -> None:
    """Raise `ValueError` unless the set has hips."""
    hip_indices(joint_set)


def compute_rows(predicted: Mapping[str, Any], target: Labels, options: Options) -> np.ndarray:
    """Mean error [N] mm of each row in the chosen alignment, NaN for a row without a known joint."""
    return row_means(compute_joint_errors_mm(predicted, target, options.alignment))
