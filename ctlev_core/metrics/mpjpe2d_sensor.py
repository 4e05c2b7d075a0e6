"""Mean per-joint position error on the sensor, px: that of `mpjpe2d`, as DHP19 and the paper's Table 2 state it.

An event image may be the sensor scaled, cropped or with borders. Predictions and labels are given here in px of the
sensor of their own recording, by the inverse of the map that its events went through, so that errors of images of
different sizes, and of sensors of different sizes, are in one unit. Which joints count is decided in the image: one
that the crop cut off is not visible. By the protocol of DHP19 a label moves to the centre of its sensor pixel.
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
IN_SENSOR_PX = True
SCORES = (
    ScoreInfo(
        "mpjpe2d_sensor",
        lower_is_better=True,
        meaning="mean distance between predicted and true joints in the image, in pixels of the sensor",
    ),
)


class Options(JointErrorOptions):
    """Which joints count, and how labels are read."""


def compute(predicted: Mapping[str, Any], target: Labels, options: Options) -> dict[str, float]:
    """`mpjpe2d_sensor_px`, every joint that counts with the same weight.

    By other options the name is `mpjpe2d_sensor_dhp19_px`, `mpjpe2d_sensor_known_px` or
    `mpjpe2d_sensor_dhp19_known_px`.

    Args:
        predicted: `joints2d` [N, J, 2], sensor px.
        target: labels with joints in the same unit and order.
        options: which joints count, and how labels are read.
    Raises:
        ValueError: shapes differ, or no joint counts.
    """
    return quotients(compute_sums(predicted, target, options))


def compute_sums(predicted: Mapping[str, Any], target: Labels, options: Options) -> Sums:
    """Of each row the sum [N] px and number [N] of its errors; `compute` is their quotient over all rows."""
    return {f"mpjpe2d_sensor{options.suffix}": row_sums(options.errors_px(predicted, target))}


def compute_rows(predicted: Mapping[str, Any], target: Labels, options: Options) -> np.ndarray:
    """Mean error [N] px of each row, NaN for a row without a joint that counts: what intervals are made of."""
    return row_means(options.errors_px(predicted, target))
