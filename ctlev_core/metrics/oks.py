"""Object keypoint similarity, and the share of frames above a threshold of it: AP@25 and AP@50.

Of one person, OKS = mean over the visible joints of exp(-d^2 / (2 A (2 sigma)^2)): 1 for a perfect pose, 0 for one far
off; A is the area of the person, sigma how far annotators disagree about a joint of a person of area 1.

The paper's Table 2 gives AP@25 and AP@50 without a definition. AP@25 is at or above AP@50 in each of its rows, so 25
and 50 are similarities that have to be reached, and no distances. With one person and one estimate a frame, ranked by
nothing, average precision is the share of frames that reach it; those are `oks_ap25` and `oks_ap50`.

Source: COCO keypoint evaluation (cocodataset/cocoapi, `cocoeval.py`, `computeOks`) with its sigmas of shoulders,
elbows, wrists, hips, knees and ankles; CrowdPose (Li et al., CVPR 2019) for head and neck. COCO's A is the area of a
segmentation. There is none here, and as in the evaluation of CrowdPose (xtcocotools) A is 0.53 of the area of a box;
theirs is around the person and ours around the visible joints, which is smaller and the score stricter.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field, field_validator

from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.scoring.pose import Sums, compute_joint_errors_px, quotients, row_means
from ctlev_core.scoring.score_info import ScoreInfo
from data_contracts.config import Frozen
from data_contracts.labels import Labels

VERSION = 1
INPUT = "joints2d"
SCORES = (
    ScoreInfo(
        "oks_ap", meaning="share of poses whose similarity to the truth reaches the limit it names", is_share=True
    ),
    ScoreInfo("oks_mean", is_share=True),
)
SIGMAS = {
    "head": 0.079, "neck": 0.079, "nose": 0.026, "eye": 0.025, "ear": 0.035,
    "shoulder": 0.079, "elbow": 0.072, "wrist": 0.062, "hand": 0.062,
    "hip": 0.107, "knee": 0.087, "ankle": 0.089, "foot": 0.089,
}  # fmt: skip
"""By the joint's name without its side. A hand of DHP19 and CDEHP is a marker at the wrist, a foot one at the ankle."""


class Options(Frozen):
    """Thresholds and scale."""

    thresholds: tuple[float, ...] = Field(default=(0.25, 0.5), min_length=1, description="similarities to be reached")
    area_fraction: float = Field(
        default=0.53, gt=0, description="area of the person, of that of the box around its visible joints"
    )

    @field_validator("thresholds")
    @classmethod
    def _check_thresholds(cls, thresholds: tuple[float, ...]) -> tuple[float, ...]:
        if not all(0 < threshold <= 1 for threshold in thresholds):
            raise ValueError("similarities lie above 0 and up to 1")
        return thresholds


def compute(predicted: Mapping[str, Any], target: Labels, options: Options) -> dict[str, float]:
    """`oks_ap25` and `oks_ap50` (shares of frames), or of other thresholds, and `oks_mean`; all in [0, 1].

    Args:
        predicted: `joints2d` [N, J, 2], px.
        target: labels with joints in the same image and order, of a joint set whose joints have sigmas.
        options: thresholds and scale. Rows whose visible joints span no area are left out.
    Raises:
        ValueError: shapes differ, no joint is visible, no row spans an area, or a joint has no sigma.
    """
    sums = compute_sums(predicted, target, options)
    if not sums["oks_mean"][1].any():
        raise ValueError(f"in none of the {len(target)} target rows do the visible joints span an area")
    return quotients(sums)


def compute_sums(predicted: Mapping[str, Any], target: Labels, options: Options) -> Sums:
    """Whether each row [N] reaches each threshold, and whether it counts; `compute` is the quotient over all rows."""
    similarity = compute_rows(predicted, target, options)
    counts = ~np.isnan(similarity)
    reached = {f"oks_ap{100 * threshold:g}": similarity >= threshold for threshold in options.thresholds}
    return {name: (rows.astype(np.float64), counts) for name, rows in reached.items()} | {
        "oks_mean": (np.where(counts, similarity, 0.0), counts)
    }


def compute_rows(predicted: Mapping[str, Any], target: Labels, options: Options) -> np.ndarray:
    """Similarity [N] of each row, NaN where it is left out: what intervals are made of."""
    errors_px = compute_joint_errors_px(predicted, target)
    area_px2 = options.area_fraction * _box_area_px2(target)
    exponent = errors_px**2 / (2 * (2 * _sigmas(target.joint_set)) ** 2)
    has_area = area_px2 > 0
    similarity = np.exp(-exponent / np.where(has_area, area_px2, 1.0)[:, None])
    return np.where(has_area, row_means(similarity), np.nan)


def check_joint_set(joint_set: str, options: Options) -> None:
    """Raise `ValueError` unless every joint of the set has a sigma."""
    _sigmas(joint_set)


def _box_area_px2(target: Labels) -> np.ndarray:
    """Area [N] of the box around the visible joints, 0 without any."""
    joints, visible = target.joints2d, target.visible
    if joints is None or visible is None:
        raise ValueError("the target labels have no joints2d")
    # Joints first: a maximum over few rows of many frames is far faster than over many rows of few joints.
    seen, points = visible.T[:, None], np.ascontiguousarray(joints.transpose(1, 2, 0), dtype=np.float64)
    size = np.where(seen, points, -np.inf).max(axis=0) - np.where(seen, points, np.inf).min(axis=0)
    return np.where(visible.any(axis=1), size[0] * size[1], 0.0)


def _sigmas(joint_set: str) -> np.ndarray:
    joints = JOINT_SETS[joint_set].joints if joint_set in JOINT_SETS else ()
    names = [name.removeprefix("left_").removeprefix("right_") for name in joints]
    missing = sorted(set(names) - set(SIGMAS))
    if missing or not joints:
        without = f", whose {', '.join(missing)} have none" if missing else ""
        raise ValueError(f"keypoint similarity needs a joint set whose joints have sigmas, got {joint_set!r}{without}")
    return np.array([SIGMAS[name] for name in names])
