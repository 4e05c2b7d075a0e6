"""Mean per-joint position error in the image, px.

Source: 2D-MPJPE of DHP19 (Calabrese et al., CVPR Workshops 2019) and of the paper's Table 2: the mean of the Euclidean
distance over all visible joints of all frames. DHP19's own code truncates labels to whole pixels first; this does not.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ctlev_core.joint_errors import compute_joint_errors_px, row_means, row_sums
from data_contracts.config import Frozen
from data_contracts.labels import Labels

VERSION = 1
INPUT = "joints2d"


class Options(Frozen):
    """None: the error has no parameters."""


def compute(predicted: Mapping[str, Any], target: Labels, options: Options) -> dict[str, float]:
    """`mpjpe2d_px`, every visible joint with the same weight.

    Args:
        predicted: `joints2d` [N, J, 2], px.
        target: labels with joints in the same image and order.
        options: none.
    Raises:
        ValueError: shapes differ, or no joint is visible.
    """
    return {"mpjpe2d_px": float(np.nanmean(compute_joint_errors_px(predicted, target)))}


def compute_sums(
    predicted: Mapping[str, Any], target: Labels, options: Options
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Of each row the sum [N] px and number [N] of its errors; `compute` is their quotient over all rows."""
    return {"mpjpe2d_px": row_sums(compute_joint_errors_px(predicted, target))}


def compute_rows(predicted: Mapping[str, Any], target: Labels, options: Options) -> np.ndarray:
    """Mean error [N] px of each row, NaN for a row without a visible joint: what intervals are made of."""
    return row_means(compute_joint_errors_px(predicted, target))
