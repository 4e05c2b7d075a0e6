"""The area under the ROC curve of held-out scores, and its interval over recordings and trainings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctlev_core.statistics.small_samples import stretch, variance_of_mean, widening

NUM_REPLICATES = 1000


def area_under_roc(first: np.ndarray, second: np.ndarray) -> float:
    """Share of the pairs of scores, one of each set, of which the first's is larger; equal ones count half.

    Source: Mann & Whitney, Annals of Mathematical Statistics 18, 1947.

    Args:
        first: [N] scores, N > 0.
        second: [M] scores, M > 0.
    """
    return float(_wins(first, second).mean())


def _wins(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[N, M]: 1 where the first score is larger, 0.5 where both are equal, 0 else."""
    return (np.sign(first[:, None] - second[None]) + 1) / 2


@dataclass(frozen=True, eq=False)
class HeldOut:
    """What one training scored, added up by recording.

    Attributes:
        first: [A] the recordings of the first set that were held out.
        second: [B] those of the second set.
        wins: [A, B] pairs of frames of which the first set's has the larger score; half a pair where both are equal.
        pairs: [A, B] pairs of frames.
    """

    first: np.ndarray
    second: np.ndarray
    wins: np.ndarray
    pairs: np.ndarray

    @classmethod
    def make(cls, scores: Sequence[np.ndarray], groups: Sequence[np.ndarray]) -> HeldOut:
        """Of scores [N] and [M] of two sets, and the recording of each, an integer."""
        (first, of_first), (second, of_second) = (np.unique(of_set, return_inverse=True) for of_set in groups)
        members = np.eye(len(first))[of_first], np.eye(len(second))[of_second]
        wins = members[0].T @ _wins(scores[0], scores[1]) @ members[1]
        return cls(first, second, wins, np.outer(members[0].sum(axis=0), members[1].sum(axis=0)))

    @property
    def area(self) -> float:
        """Under the ROC curve of all frames."""
        return float(self.wins.sum() / self.pairs.sum())

    def areas(self, weights: np.ndarray) -> np.ndarray:
        """[R] areas where recording k counts as weights[R, k]; NaN where nothing is left of a set."""
        first, second = weights[:, self.first], weights[:, self.second]
        wins, pairs = (((first @ part) * second).sum(axis=1) for part in (self.wins, self.pairs))
        return np.divide(wins, pairs, out=np.full_like(wins, np.nan), where=pairs > 0)


def interval_of_mean_area(
    trainings: Sequence[HeldOut], kinds: np.ndarray, generator: np.random.Generator
) -> tuple[float, float]:
    """95 % interval of the trainings' mean area, under resampling of recordings and trainings.

    Args:
        trainings: two or more, with two recordings or more in each set.
        kinds: [K] of each recording 1 = of the first set, 2 = of the second, 3 = of both; those of one kind are drawn
            anew from one another, for all trainings alike.
        generator: of the draws.
    Returns:
        (low, high); NaN where no replicate has frames of both sets in all trainings.
    """
    weights = np.zeros((NUM_REPLICATES, len(kinds)))
    for kind in np.unique(kinds):
        members = np.flatnonzero(kinds == kind)
        shares = np.full(len(members), 1 / len(members))
        weights[:, members] = generator.multinomial(len(members), shares, NUM_REPLICATES)
    areas = np.stack([training.areas(weights) for training in trainings], axis=1)
    areas = areas[np.isfinite(areas).all(axis=1)]
    if not len(areas):
        return float("nan"), float("nan")
    found = np.array([training.area for training in trainings])
    fewest = int(min(np.count_nonzero(kinds & 1), np.count_nonzero(kinds & 2)))
    middle = areas.mean(axis=1)
    drawn = np.take_along_axis(areas, generator.integers(len(found), size=areas.shape), axis=1).mean(axis=1)
    of_recordings = stretch(fewest) * (middle - found.mean())
    parts = [(float(of_recordings.var()), fewest - 1.0), variance_of_mean(found)]
    deviations = widening(parts) * (of_recordings + stretch(len(found)) * (drawn - middle))
    low, high = np.clip(found.mean() + np.quantile(deviations, [0.025, 0.975]), 0, 1)
    return float(low), float(high)
