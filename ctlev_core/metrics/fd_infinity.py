"""The Frechet distance that sets without end would have, extrapolated from those there are.

The distance of finite sets is too large, by about a number of features over a number of rows: 1/N to first order. So
it is computed of the whole sets and of disjoint parts of them, and the straight line through the means, against the
number of parts, is followed to zero parts.

Source: Chong & Forsyth, Effectively Unbiased FID and Inception Score, CVPR 2020. Theirs takes 15 sizes of one set, from
5,000 rows upwards, with the other set whole. Here both sets are divided, so that the bias of both goes, and the rows
of a division are all used. The line fits where a part has more rows than features; with fewer the value is too large.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from ctlev_core.scoring.frechet import frechet_distance
from ctlev_core.scoring.gaussians import check_features
from ctlev_core.scoring.score_info import ScoreInfo
from data_contracts.config import Frozen

VERSION = 1
INPUT = "features"
SCORES = (ScoreInfo("fd_infinity", lower_is_better=True), ScoreInfo("fid_infinity", lower_is_better=True))


class Options(Frozen):
    """How sets are divided."""

    max_parts: int = Field(
        default=2, ge=2, description="most parts a set is divided into; more follow small sets less well"
    )
    num_divisions: int = Field(default=5, ge=1, description="random divisions into each number of parts")
    seed: int = Field(default=0, ge=0, description="of the divisions")


def compute(predicted: np.ndarray, target: np.ndarray, options: Options) -> dict[str, float]:
    """`fd_infinity`, in squared units of the features; negative values are sets that cannot be told apart.

    Args:
        predicted: [N, D] features of the set to judge.
        target: [M, D] features of the reference set, from the same extractor.
        options: how sets are divided; both need at least two rows for each part.
    Raises:
        ValueError: shapes do not fit, too few rows, or a value that is not finite.
    """
    sets = check_features(predicted, "first"), check_features(target, "second")
    least = 2 * options.max_parts
    if min(len(rows) for rows in sets) < least:
        raise ValueError(f"{options.max_parts} parts need {least} rows or more, got {len(sets[0])} and {len(sets[1])}")
    generator = np.random.default_rng(options.seed)
    means = [frechet_distance(*sets)]
    for num_parts in range(2, options.max_parts + 1):
        values = []
        for _ in range(options.num_divisions):
            parts = [np.array_split(generator.permutation(len(rows)), num_parts) for rows in sets]
            values += [frechet_distance(sets[0][a], sets[1][b]) for a, b in zip(*parts, strict=True)]
        means.append(float(np.mean(values)))
    _, intercept = np.polyfit(np.arange(1, options.max_parts + 1), means, 1)
    return {"fd_infinity": float(intercept)}
