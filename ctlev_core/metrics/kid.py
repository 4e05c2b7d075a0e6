"""Kernel inception distance between the features of two sets of images; see `ctlev_core.scoring.kid`.

Unbiased, so that sets of different and small sizes compare; it may be negative, and is given as it is. The features
come from the caller, who has to name the extractor beside the score.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field, field_validator

from ctlev_core.scoring.kid import compute_kid
from ctlev_core.scoring.score_info import ScoreInfo
from data_contracts.config import Frozen

VERSION = 2
INPUT = "features"
SCORES = (ScoreInfo("kid", lower_is_better=True),)


class Options(Frozen):
    """Subsets, as torch-fidelity and clean-fid draw them, where they are fewer pairs than all rows at once."""

    subset_size: int = Field(default=1000, ge=0, description="rows of a subset; 0 = all rows at once")
    num_subsets: int = Field(default=100, ge=1, description="subsets the mean is taken over")
    seed: int = Field(default=0, ge=0, description="of the drawing of subsets")

    @field_validator("subset_size")
    @classmethod
    def _subsets_have_pairs(cls, size: int) -> int:
        if size == 1:
            raise ValueError("a subset must have 2 rows or more, or 0 for all rows at once")
        return size


def compute(predicted: np.ndarray, target: np.ndarray, options: Options) -> dict[str, float]:
    """`kid`; papers often print 1,000 times as much.

    Args:
        predicted: [N, D] features of the set to judge.
        target: [M, D] features of the reference set, from the same extractor.
        options: subsets.
    Raises:
        ValueError: shapes do not fit, fewer than two rows, or a value that is not finite.
    """
    value = compute_kid(
        predicted,
        target,
        subset_size=options.subset_size,
        num_subsets=options.num_subsets,
        seed=options.seed,
    )
    return {"kid": value}
