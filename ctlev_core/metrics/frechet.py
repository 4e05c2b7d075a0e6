"""Frechet distance between the features of two sets of images; see `ctlev_core.scoring.frechet` for the formula.

The features come from the caller, who has to name the extractor beside the score: distances under different
extractors do not compare, and only Inception's may be called FID. Values of sets of different sizes do not compare
either; `fd_infinity` and `kid` do. How sure a value is says `ctlev_core.statistics.feature_distances`.

Instead of the recorded training frames, a file may be the reference: mean and covariance of features of a published
set, as pytorch-fid writes them. It does not say which extractor they are from, nor of how many images: that has to be
known.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from pydantic import Field, field_serializer

from ctlev_core.scoring.frechet import frechet_distance_of_gaussians
from ctlev_core.scoring.frechet_extended import refined_frechet_distance
from ctlev_core.scoring.gaussians import GaussianFactor, fit_gaussian, gaussian_from_statistics, read_statistics
from ctlev_core.scoring.score_info import ScoreInfo
from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.remembered_files import remembered_digest

VERSION = 3
INPUT = "features"
TO_STATISTICS = "fd_to_"
"""How the name of a distance to a file begins."""
SCORES = (ScoreInfo("fd", lower_is_better=True), ScoreInfo("fid", lower_is_better=True))


class Options(Frozen):
    """The reference."""

    statistics: str = Field(
        default="", description=".npz file with mu and sigma of the reference; empty = the recorded training frames"
    )

    @field_serializer("statistics", when_used="json")
    def _content_of_statistics(self, statistics: str) -> str:
        """What keys and records know of the file: its SHA-256."""
        return remembered_digest(Path(statistics)) if statistics else ""


def input_files(options: Options) -> list[Path]:
    """The file of statistics, if one is named.

    Raises:
        DataError: it is missing.
    """
    if options.statistics and not Path(options.statistics).is_file():
        raise DataError(f"frechet: expected option `statistics` to be an .npz file, got {options.statistics}")
    return [Path(options.statistics)] if options.statistics else []


def compute(predicted: np.ndarray, target: np.ndarray, options: Options) -> dict[str, float]:
    """`fd`, in squared units of the features; `fd_to_SHA8` where the reference is a file, SHA8 of its content.

    Args:
        predicted: [N, D] features of the set to judge.
        target: [M, D] features of the reference set, from the same extractor; not looked at where a file is given.
        options: the reference.
    Raises:
        ValueError: shapes do not fit, fewer than two rows, or a value that is not finite.
        DataError: the file holds no statistics.
    """
    if not options.statistics:
        return {"fd": refined_frechet_distance(predicted, target)}
    digest = remembered_digest(Path(options.statistics))
    reference = _reference(options.statistics, digest)
    return {f"{TO_STATISTICS}{digest[:8]}": frechet_distance_of_gaussians(fit_gaussian(predicted), reference)}


@lru_cache(maxsize=2)
def _reference(path: str, digest: str) -> GaussianFactor:
    """An interval asks for it dozens of times."""
    return gaussian_from_statistics(*read_statistics(Path(path)))
