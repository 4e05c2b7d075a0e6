"""The data-copying test C_T: are generated frames nearer to the training frames than other recorded ones are?

The space is cut into cells, by k-means of the training frames. In each cell the distances of generated and of other
recorded frames to their nearest training frame are compared by Mann & Whitney's U, as a z-score: 0 = equally near, far
below 0 = nearer, as copies are, far above 0 = farther away, as where a generator has learnt too little. C_T is the mean
of the z-scores over cells, weighted by their numbers of other recorded frames. Cells are there because copying in one
place and poor frames in another would cancel.

Source: Meehan, Chaudhuri & Dasgupta, A Non-Parametric Test to Detect Data-Copying in Generative Models, AISTATS 2020,
sections 3 and 4. Differences: the variance is that with equal distances, which count half; the nearest training frame
need not lie in the cell; cells with fewer than `MIN_CELL_FRAMES` frames of either kind are left out; and there is an
interval. The z-score takes frames as independent. Those of one recording are not, so that |C_T| > 2 alone is no
evidence; an interval under resampling of whole recordings that excludes 0 is. It grows with the numbers of frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctlev_core.scoring.gaussians import scale_of
from ctlev_core.statistics.small_samples import percentile_levels

MIN_CELL_FRAMES = 20
_CELL_FRAMES, _MAX_CELLS = 100, 20
_MAX_KMEANS_FRAMES = 5000
_NUM_REPLICATES = 1000


@dataclass(frozen=True)
class CopyingTest:
    """C_T, and how sure it is.

    Attributes:
        value: C_T; NaN where no cell has frames enough.
        low: lower end of its 95 % interval, under resampling of the groups of both sets.
        high: upper end. Both NaN with fewer than two groups in either set.
        num_cells: cells that have frames enough.
    """

    value: float
    low: float
    high: float
    num_cells: int


def data_copying_test(
    distances: np.ndarray,
    real_distances: np.ndarray,
    *,
    cells: np.ndarray | None = None,
    real_cells: np.ndarray | None = None,
    groups: Sequence[str] | np.ndarray | None = None,
    real_groups: Sequence[str] | np.ndarray | None = None,
    seed: int = 0,
) -> CopyingTest:
    """C_T of distances to the nearest training frame.

    Args:
        distances: [N] of generated frames.
        real_distances: [M] of other recorded frames.
        cells: [N] cell of each generated frame; None = all in one.
        real_cells: [M] likewise.
        groups: [N] what generated frames are resampled by; None = each by itself.
        real_groups: [M] recording of each other recorded frame; None = each is its own.
        seed: of the resampling.
    """
    cells = np.zeros(len(distances), np.int64) if cells is None else cells
    real_cells = np.zeros(len(real_distances), np.int64) if real_cells is None else real_cells
    draws = [
        _draws(count, names, seed + number)
        for number, (count, names) in enumerate(((len(distances), groups), (len(real_distances), real_groups)))
    ]
    num_groups = [counts.shape[1] for counts, _ in draws]
    values, replicates, weights = [], [], []
    for cell in np.intersect1d(cells, real_cells):
        rows, real_rows = np.flatnonzero(cells == cell), np.flatnonzero(real_cells == cell)
        if min(len(rows), len(real_rows)) < MIN_CELL_FRAMES:
            continue
        own, real = distances[rows], real_distances[real_rows]
        to_z = _z_of_area(own, real)
        values.append(to_z * (_area(own, real, np.ones((1, len(rows))), np.ones((1, len(real_rows))))[0] - 0.5))
        weights.append(len(real_rows))
        if min(num_groups) > 1:
            drawn = [counts[:, index[some]] for (counts, index), some in zip(draws, (rows, real_rows), strict=True)]
            replicates.append(to_z * (_area(own, real, *drawn) - 0.5))
    if not values:
        return CopyingTest(float("nan"), float("nan"), float("nan"), 0)
    low = high = float("nan")
    if replicates:
        found = np.array(replicates)
        known = ~np.isnan(found)  # a replicate may have no frame in a cell
        shares = np.array(weights)[:, None] * known
        totals = shares.sum(axis=0)
        means = (np.where(known, found, 0.0) * shares).sum(axis=0)[totals > 0] / totals[totals > 0]
        low, high = map(float, np.quantile(means, percentile_levels(min(num_groups))))
    return CopyingTest(float(np.average(values, weights=weights)), low, high, len(values))


def assign_cells(training: np.ndarray, *others: np.ndarray, seed: int = 0) -> list[np.ndarray]:
    """The cell [N] int64 of each row of the other sets: the nearest of the means of k-means of the training set.

    There are as many cells as leave some 100 rows of each set to a cell, 20 at most.

    Args:
        training: [T, D].
        others: [N, D] each.
        seed: of the first means.
    """
    from scipy.cluster.vq import kmeans, vq  # here, because a cached run needs no scipy

    from ctlev_core.events.windows import spread

    origin = training[0].astype(np.float64)
    sets = [rows - origin for rows in (training[spread(len(training), _MAX_KMEANS_FRAMES)], *others)]
    scale = scale_of(*sets)
    # k-means stops at an absolute change.
    unit = scale * (float((sets[0] / scale).std()) or 1.0)
    learnt, *asked = (rows / unit for rows in sets)
    num_cells = min(_MAX_CELLS, max(1, min(map(len, sets)) // _CELL_FRAMES))
    # Means that no row is nearest to are left out.
    means, _ = kmeans(learnt, num_cells, iter=1, rng=np.random.default_rng(seed))
    return [vq(rows, means)[0].astype(np.int64) for rows in asked]


def _draws(count: int, names: Sequence[str] | np.ndarray | None, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """How often each group is drawn in each replicate, [replicates, groups], and the group of each of `count` rows."""
    _, index = np.unique(np.arange(count) if names is None else np.asarray(names), return_inverse=True)
    num_groups = int(index.max()) + 1
    shares = np.full(num_groups, 1 / num_groups)
    drawn = np.random.default_rng(seed).multinomial(num_groups, shares, size=_NUM_REPLICATES)
    return drawn.astype(np.float64), index


def _area(first: np.ndarray, second: np.ndarray, first_weights: np.ndarray, second_weights: np.ndarray) -> np.ndarray:
    """Share [R] of pairs in which the first [N] is larger than the second [M], ties half, for R sets of weights.

    It is U over the number of pairs; NaN where all weights of a set are 0.
    """
    order = np.argsort(second, kind="stable")
    below, upto = (np.searchsorted(second[order], first, side=side) for side in ("left", "right"))
    areas = np.empty(len(first_weights))
    step = max(1, 4_000_000 // (len(first) + len(second)))
    for start in range(0, len(areas), step):
        own, other = first_weights[start : start + step], second_weights[start : start + step][:, order]
        sums = np.concatenate([np.zeros((len(other), 1)), np.cumsum(other, axis=1)], axis=1)
        pairs = own.sum(axis=1) * other.sum(axis=1)
        larger = (own * (sums[:, below] + sums[:, upto])).sum(axis=1) / 2
        areas[start : start + step] = np.divide(larger, pairs, out=np.full_like(pairs, np.nan), where=pairs > 0)
    return areas


def _z_of_area(first: np.ndarray, second: np.ndarray) -> float:
    """What area - 1/2 is multiplied by to be a z-score; 0 where all distances are equal, which say nothing."""
    n, m = len(first), len(second)
    _, ties = np.unique(np.concatenate([first, second]), return_counts=True)
    total = n + m
    variance = n * m / 12 * (total + 1 - float((ties**3.0 - ties).sum()) / (total * (total - 1)))
    return n * m / float(np.sqrt(variance)) if variance > 1e-9 * n * m else 0.0
