"""Fraction of correct keypoints in the image: joints at most a threshold away from their label.

The threshold is in px, or a fraction of a length of the labelled person. A joint exactly at the threshold is correct.
Source: Yang & Ramanan, Articulated Human Detection with Flexible Mixtures of Parts, TPAMI 2013 (bounding box); Sapp &
Taskar, MODEC, CVPR 2013 (torso: left shoulder to right hip); Andriluka et al., CVPR 2014 (PCKh: a threshold of 0.5 with
the normaliser `head`, see `ctlev_core.scoring.body_lengths` for what is a head here).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field

from ctlev_core.scoring.body_lengths import head_length, torso_length
from ctlev_core.scoring.pose import Sums, check_length, compute_joint_errors_px, quotients
from ctlev_core.scoring.score_info import ScoreInfo
from data_contracts.config import Frozen
from data_contracts.labels import Labels

VERSION = 1
INPUT = "joints2d"
SCORES = (ScoreInfo("pck_", meaning="share of joints predicted within the limit it names", is_share=True),)
_LENGTHS = {"torso": torso_length, "head": head_length}


class Options(Frozen):
    """What counts as correct."""

    threshold: float = Field(default=0.2, gt=0, description="px, or a fraction of the normaliser's length")
    normaliser: Literal["px", "torso", "bbox", "head"] = Field(
        default="torso",
        description="px; torso = left shoulder to right hip; bbox = longer side of the box around the visible joints; "
        "head = length of the head",
    )


def compute(predicted: Mapping[str, Any], target: Labels, options: Options) -> dict[str, float]:
    """One fraction in [0, 1], named after normaliser and threshold, for example `pck_px4` or `pck_torso0.2`.

    Args:
        predicted: `joints2d` [N, J, 2], px.
        target: labels with joints in the same image and order.
        options: threshold and normaliser. Rows whose normaliser is unknown or zero are left out.
    Raises:
        ValueError: shapes differ, no joint is visible, or no row has a normaliser.
    """
    sums = compute_sums(predicted, target, options)
    if not any(count.any() for _, count in sums.values()):
        raise ValueError(f"no row with a visible joint has a {options.normaliser} length to measure the threshold with")
    return quotients(sums)


def compute_sums(predicted: Mapping[str, Any], target: Labels, options: Options) -> Sums:
    """Of each row the number [N] of correct joints and of scored ones; `compute` is their quotient over all rows."""
    errors_px = compute_joint_errors_px(predicted, target)
    limit_px = options.threshold * _normaliser_px(target, options)
    has_limit, ones = limit_px > 0, np.ones(errors_px.shape[1])
    # An error that is unknown, NaN, is not within any limit.
    correct, count = (errors_px <= limit_px[:, None]) @ ones, ~np.isnan(errors_px) @ ones
    return {f"pck_{options.normaliser}{options.threshold:g}": (correct * has_limit, count * has_limit)}


def compute_rows(predicted: Mapping[str, Any], target: Labels, options: Options) -> np.ndarray:
    """Fraction [N] of correct joints of each row, NaN where the row is left out: what intervals are made of."""
    ((correct, count),) = compute_sums(predicted, target, options).values()
    return np.where(count > 0, correct / np.maximum(count, 1), np.nan)


def check_joint_set(joint_set: str, options: Options) -> None:
    """Raise `ValueError` unless the set has the joints of the normaliser."""
    if options.normaliser in _LENGTHS:
        check_length(_LENGTHS[options.normaliser], joint_set)


def _normaliser_px(target: Labels, options: Options) -> np.ndarray:
    """Length [N] in px that a threshold of 1 stands for; NaN where unknown."""
    if target.joints2d is None or target.visible is None:
        raise ValueError("the target labels have no joints2d")
    if options.normaliser == "px":
        return np.ones(len(target))
    if options.normaliser == "bbox":
        points = target.joints2d.astype(np.float64)
        points[~target.visible] = np.nan
        size = np.full(len(target), np.nan)
        seen = target.visible.any(axis=1)
        size[seen] = (np.nanmax(points[seen], axis=1) - np.nanmin(points[seen], axis=1)).max(axis=-1)
        return size
    return _LENGTHS[options.normaliser](target.joints2d, target.joint_set, target.visible)
