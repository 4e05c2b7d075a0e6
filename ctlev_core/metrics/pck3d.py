"""Fraction of correct joints in space and the area under its curve: PCK@25, PCK@50 and AUC of the paper's Table 3.

A joint exactly at the threshold is correct (Event-HPE's code asks for less than 100 mm; it shows in ties alone).
AUC is the mean of PCK over all thresholds from 0 to T, exactly: 1 - mean(min(error, T)) / T. With T = 150 mm it agrees
with the paper to 0.01 percentage points in five of the six rows of Table 3, from their 3D-MPJPE. The row of SMPL-ESIM
prints 36.44 where no errors of mean 53.53 mm can give less than 64.31. Others take the mean of 31 thresholds
(Mehta et al., 3DV 2017), which is lower by up to half a step, 1.7 percentage points.

Source: Event-HPE (Zou et al., ICCV 2021, `loss_funcs.py`): alignment by the middle of the hips, and PCKh, half of the
head's length. The paper does not name its alignment.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field, PositiveFloat

from ctlev_core.scoring.body_lengths import head_length
from ctlev_core.scoring.pose import (
    Alignment,
    Sums,
    check_length,
    compute_joint_errors_mm,
    hip_indices,
    quotients,
    row_means,
    row_sums,
)
from ctlev_core.scoring.score_info import ScoreInfo
from data_contracts.config import Frozen
from data_contracts.labels import Labels

VERSION = 1
INPUT = "joints3d"
SCORES = (
    ScoreInfo("pck3d_", meaning="share of joints predicted within the limit it names", is_share=True),
    ScoreInfo("pckh3d_", meaning="share of joints predicted within the limit it names", is_share=True),
    ScoreInfo("auc3d_", meaning="share of joints within a limit, averaged over limits", is_share=True),
)
TAGS: dict[Alignment, str] = {"pelvis": "pelvis_", "procrustes": "pa_", "none": ""}


class Options(Frozen):
    """Alignment and thresholds."""

    alignment: Alignment = Field(default="pelvis", description="before distances are taken, as for mpjpe3d")
    thresholds_mm: tuple[PositiveFloat, ...] = Field(default=(25.0, 50.0), min_length=1, description="of PCK, mm")
    auc_max_mm: float = Field(default=150.0, gt=0, description="end of the curve whose area is taken, mm")
    head_threshold: float = Field(default=0.0, ge=0, description="of PCKh, in lengths of the head; 0 = without PCKh")


def compute(predicted: Mapping[str, Any], target: Labels, options: Options) -> dict[str, float]:
    """`pck3d_pelvis_25mm`, `pck3d_pelvis_50mm` and `auc3d_pelvis_150mm`, and `pckh3d_pelvis_0.5` if asked for.

    Fractions in [0, 1]; every known joint counts alike. `pelvis_` becomes `pa_` or nothing with the alignment.

    Args:
        predicted: `joints3d` [N, J, 3], mm, camera frame.
        target: labels with joints in the same frame and order.
        options: alignment and thresholds.
    Raises:
        ValueError: see `compute_joint_errors_mm`; no row has the alignment, or none has a head to measure with.
    """
    sums = compute_sums(predicted, target, options)
    empty = [name for name, (_, count) in sums.items() if not count.any()]
    if empty:
        raise ValueError(f"none of the {len(target)} target rows has what {', '.join(empty)} needs")
    return quotients(sums)


def compute_sums(predicted: Mapping[str, Any], target: Labels, options: Options) -> Sums:
    """Of each row the number [N] of correct joints, or the area, and of scored ones; `compute` is their quotient."""
    errors_mm = compute_joint_errors_mm(predicted, target, options.alignment)
    tag = TAGS[options.alignment]
    total, count = row_sums(np.minimum(errors_mm, options.auc_max_mm))
    ones = np.ones(errors_mm.shape[1])
    # An unknown error, NaN, is not within any limit.
    sums = {f"pck3d_{tag}{limit:g}mm": ((errors_mm <= limit) @ ones, count) for limit in options.thresholds_mm}
    sums[f"auc3d_{tag}{options.auc_max_mm:g}mm"] = (count - total / options.auc_max_mm, count)
    if options.head_threshold and target.joints3d is not None:
        head_mm = head_length(target.joints3d, target.joint_set)[:, None]
        has_head = (head_mm > 0)[:, 0]
        correct = (errors_mm <= options.head_threshold * head_mm) @ ones
        sums[f"pckh3d_{tag}{options.head_threshold:g}"] = (correct * has_head, count * has_head)
    return sums


def check_joint_set(joint_set: str, options: Options) -> None:
    """Raise `ValueError` unless the set has what alignment and PCKh need."""
    if options.alignment == "pelvis":
        hip_indices(joint_set)
    if options.head_threshold:
        check_length(head_length, joint_set)


def compute_rows(predicted: Mapping[str, Any], target: Labels, options: Options) -> np.ndarray:
    """Fraction [N] of joints of each row within the first threshold, NaN for a row without a known joint."""
    errors_mm = compute_joint_errors_mm(predicted, target, options.alignment)
    return row_means(np.where(np.isnan(errors_mm), np.nan, errors_mm <= options.thresholds_mm[0]))
