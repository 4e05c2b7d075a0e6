"""Mean per-joint position error in the image, px.

Source: 2D-MPJPE of DHP19 (Calabrese et al., CVPR Workshops 2019, SensorsINI/DHP19) and of the paper's Table 2: the mean
of the Euclidean distance over all joints inside the image, of all frames. DHP19's own code truncates labels to whole
pixels first and compares them with the index of the highest pixel of the heatmap: `protocol="dhp19"`. That moves each
label by up to half a pixel; by default labels stay where they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ctlev_core.scoring.pose import JointErrorOptions, Sums, quotients, row_means, row_sums
from ctlev_core.scoring.score_info import ScoreInfo
from data_contracts.labels import Labels

VERSION = 1
INPUT = "joints2d"
SCORES = (
    ScoreInfo(
        "mpjpe2d",
        lower_is_better=True,
        meaning="mean distance between predicted and true joints in the image, in pixels",
    ),
)


class Options(JointErrorOptions):
    """Which joints count, and how labels are read."""


def compute(predicted: Mapping[str, Any], target: Labels, options: Options) -> dict[str, float]:
    """`mpjpe2d_px`, every joint that counts with the same weight.

    By other options the name is `mpjpe2d_dhp19_px`, `mpjpe2d_known_px` or `mpjpe2d_dhp19_known_px`.

    Args:
        predicted: `joints2d` [N, J, 2], px.
        target: labels with joints in the same image and order.
        options: which joints count, and how labels are read.
    Raises:
        ValueError: shapes differ, or no joint counts.
    """
    return quotients(compute_sums(predicted, target, options))


def compute_sums(predicted: Mapping[str, Any], target: Labels, options: Options) -> Sums:
    """Of each row the sum [N] px and number [N] of its errors; `compute` is their quotient over all rows."""
    return {f"mpjpe2d{options.suffix}": row_sums(options.errors_px(predicted, target))}


def compute_rows(predicted: Mapping[str, Any], target: Labels, options: Options) -> np.ndarray:
    """Mean error [N] px of each row, NaN for a row without a joint that counts: what intervals are made of."""
    return row_means(options.errors_px(predicted, target))
