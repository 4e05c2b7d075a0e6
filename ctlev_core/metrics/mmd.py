"""Maximum mean discrepancy under a Gaussian kernel between features of two sets of images; see
`ctlev_core.scoring.mmd`.

Unbiased, so that sets of different and small sizes compare; it may be negative, and is given as it is. The features
come from the caller, who has to name the extractor beside the score: it is not CMMD, whose embeddings are CLIP's and
whose estimate is biased.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, field_validator

from ctlev_core.scoring.mmd import compute_mmd
from ctlev_core.scoring.score_info import ScoreInfo
from data_contracts.config import Frozen

VERSION = 1
INPUT = "features"
SCORES = (ScoreInfo("mmd", lower_is_better=True),)


class Options(Frozen):
    """The kernel, and subsets as of `kid`."""

    bandwidth: Literal["median"] | float = Field(
        default="median",
        description="sigma of the kernel, in units of the features; median = the median distance of two rows of the "
        "reference set",
    )
    subset_size: int = Field(default=1000, ge=0, description="rows of a subset; 0 = all rows at once")
    num_subsets: int = Field(default=100, ge=1, description="subsets the mean is taken over")
    seed: int = Field(default=0, ge=0, description="of the drawing of subsets")

    @field_validator("bandwidth")
    @classmethod
    def _is_a_width(cls, bandwidth: Literal["median"] | float) -> Literal["median"] | float:
        if bandwidth != "median" and not 0 < bandwidth < float("inf"):
            raise ValueError(f"bandwidth must be 'median' or a number above 0, got {bandwidth}")
        return bandwidth

    @field_validator("subset_size")
    @classmethod
    def _subsets_have_pairs(cls, size: int) -> int:
        if size == 1:
            raise ValueError("a subset must have 2 rows or more, or 0 for all rows at once")
        return size


def compute(predicted: np.ndarray, target: np.ndarray, options: Options) -> dict[str, float]:
    """`mmd`, or `mmd_sigma10` with a bandwidth of 10: the square of the discrepancy, 0 to 2.

    Args:
        predicted: [N, D] features of the set to judge.
        target: [M, D] features of the reference set, from the same extractor.
        options: kernel and subsets.
    Raises:
        ValueError: shapes do not fit, fewer than two rows, or a value that is not finite.
    """
    value = compute_mmd(
        predicted,
        target,
        bandwidth=options.bandwidth,
        subset_size=options.subset_size,
        num_subsets=options.num_subsets,
        seed=options.seed,
    )
    return {"mmd" if options.bandwidth == "median" else f"mmd_sigma{options.bandwidth:g}": value}
