"""Frechet distance between the features of two sets of images; see `ctlev_core.frechet` for the formula.

The features come from the caller, who has to name the extractor beside the score: distances under different
extractors do not compare, and only Inception's may be called FID. Values of sets of different sizes do not compare
either; `fd_infinity` and `kid` do. How sure a value is says `ctlev_core.feature_distances`.
"""

from __future__ import annotations

import numpy as np

from ctlev_core.frechet import frechet_distance
from data_contracts.config import Frozen

VERSION = 2
INPUT = "features"


class Options(Frozen):
    """None: the distance has no parameters."""


def compute(predicted: np.ndarray, target: np.ndarray, options: Options) -> dict[str, float]:
    """`fd`, in squared units of the features.

    Args:
        predicted: [N, D] features of the set to judge.
        target: [M, D] features of the reference set, from the same extractor.
        options: none.
    Raises:
        ValueError: shapes do not fit, fewer than two rows, or a value that is not finite.
    """
    return {"fd": frechet_distance(predicted, target)}
