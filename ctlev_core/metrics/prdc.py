"""Precision, recall, density and coverage of features; see `ctlev_core.scoring.prdc` for what they are.

They tell apart what one distance mixes: images unlike any recorded one (precision, density) and recorded ones that
nothing resembles (recall, coverage). They depend on the sizes of both sets.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from ctlev_core.scoring.prdc import compute_prdc
from ctlev_core.scoring.score_info import ScoreInfo
from data_contracts.config import Frozen

VERSION = 1
INPUT = "features"
SCORES = (
    ScoreInfo("precision", is_share=True),
    ScoreInfo("recall", is_share=True),
    ScoreInfo("density"),
    ScoreInfo("coverage", is_share=True),
)


class Options(Frozen):
    """How far a ball reaches."""

    num_neighbours: int = Field(default=5, ge=1, description="a ball reaches to so many-th neighbour; Naeem et al.: 5")


def compute(predicted: np.ndarray, target: np.ndarray, options: Options) -> dict[str, float]:
    """`precision_k5`, `recall_k5`, `density_k5` and `coverage_k5`, or of another number of neighbours.

    Args:
        predicted: [N, D] features of the set to judge.
        target: [M, D] features of the reference set, from the same extractor.
        options: number of neighbours.
    Raises:
        ValueError: shapes do not fit, too few rows, or a value that is not finite.
    """
    found = compute_prdc(predicted, target, options.num_neighbours)
    return {f"{name}_k{options.num_neighbours}": value for name, value in found.items()}
