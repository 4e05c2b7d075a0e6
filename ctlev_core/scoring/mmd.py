"""Maximum mean discrepancy of two sets of features under a Gaussian kernel: the unbiased estimate of its square.

    k(x, y) = exp(-|x - y|^2 / (2 sigma^2)),    MMD^2 = E k(x, x') + E k(y, y') - 2 E k(x, y)

It is 0 only where both distributions are equal, whatever they are; a Frechet distance compares means and covariances
alone. The bandwidth sigma says at which distances the kernel tells rows apart. It is a number, or the median distance
of two rows of the reference set.

Sources: Gretton et al., A Kernel Two-Sample Test, JMLR 13, 2012 (eq. 3; the median heuristic); Jayasumana et al.,
Rethinking FID, CVPR 2024 (CMMD: sigma = 10 on CLIP embeddings, times 1,000). Differences from CMMD: the authors' code
has the biased estimate, with each row's kernel with itself, which is larger by about (1 - mean kernel) (1/N + 1/M) and
depends on the sizes of the sets. Their sigma is made for embeddings of CLIP; between other features all distances may
be far larger or smaller, where the kernel tells no two sets apart or only their means (for sigma far beyond all
distances MMD^2 is |m_a - m_b|^2 / sigma^2). The median is taken in the reference set alone, not in both as Gretton et
al. do, so that all sets are judged by the same kernel.

Numbers: 1 is subtracted from the kernel everywhere, which cancels but for rounding. Squared distances come from matrix
products, and where their rounding would show (rows far from one another beside the bandwidth) from differences.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Literal

import numpy as np

from ctlev_core.events.windows import spread
from ctlev_core.scoring.gaussians import check_features, check_same_width, scale_of
from ctlev_core.scoring.random_subsets import mean_over_subsets

Bandwidth = Literal["median"] | float
_BLOCK_NUMBERS = 4_000_000
_MAX_MEDIAN_ROWS = 2000
"""Of a larger reference set the median is that of so many rows, evenly spread."""
_MAX_ROUNDING = 1e-10
"""Of the exponent of the kernel, from which on squared distances are computed from differences."""


def compute_mmd(
    features_a: np.ndarray,
    features_b: np.ndarray,
    *,
    bandwidth: Bandwidth = "median",
    subset_size: int = 1000,
    num_subsets: int = 100,
    seed: int = 0,
) -> float:
    """Unbiased squared MMD, at most 2; about 0, and as often below as above, for sets of the same distribution.

    Args:
        features_a: [N, D], N >= 2, the set to judge.
        features_b: [M, D], M >= 2, the reference set.
        bandwidth: sigma in units of the features, > 0; `median` = see `median_distance`.
        subset_size: rows of each subset; 0, or where the subsets have as many pairs as the sets, all rows at once.
        num_subsets: how many subsets the mean is taken over.
        seed: of the drawing of subsets.
    Raises:
        ValueError: shapes do not fit, a set has fewer than two rows, a value is not finite (names the row), or the
            bandwidth is not above 0.
    """
    features_a, features_b = check_features(features_a, "first"), check_features(features_b, "second")
    check_same_width(features_a, features_b)
    if bandwidth != "median" and not (np.isfinite(bandwidth) and bandwidth > 0):
        raise ValueError(f"bandwidth must be 'median' or a number above 0, got {bandwidth}")
    origin = features_b[0].astype(np.float64)
    a, b = features_a - origin, features_b - origin
    scale = scale_of(a, b)
    a, b = a / scale, b / scale
    sigma = median_distance(b) if bandwidth == "median" else bandwidth / scale
    return mean_over_subsets(
        partial(_unbiased, sigma=sigma), a, b, subset_size=subset_size, num_subsets=num_subsets, seed=seed
    )


def median_distance(rows: np.ndarray) -> float:
    """The median distance of two different rows [M, D] float64; 0 where all rows are equal.

    Where more than half of the pairs are equal rows, the median of the other pairs.
    """
    from scipy.spatial.distance import pdist  # here, because a cached run needs no scipy

    distances = pdist(rows[spread(len(rows), _MAX_MEDIAN_ROWS)])
    median = float(np.median(distances))
    different = distances[distances > 0]
    if median > 0 or not len(different):
        return median
    return float(np.median(different))


def _unbiased(a: np.ndarray, b: np.ndarray, sigma: float) -> float:
    # A row with itself has kernel - 1 = 0, so that it is left out of the sums within a set.
    within = [_sum_of_kernel(rows, rows, sigma) / (len(rows) * (len(rows) - 1)) for rows in (a, b)]
    return within[0] + within[1] - 2 * _sum_of_kernel(a, b, sigma) / (len(a) * len(b))


def _sum_of_kernel(a: np.ndarray, b: np.ndarray, sigma: float) -> float:
    """Sum over all pairs of rows of the kernel minus 1; with sigma = 0 equal rows have kernel 1, others 0."""
    sums = []
    for squared in _squared_distances(a, b, sigma):
        if sigma == 0:
            sums.append(-float(np.count_nonzero(squared)))
        else:
            squared /= -2 * sigma * sigma
            sums.append(float(np.expm1(squared, out=squared).sum()))
    return float(np.sum(sums))


def _squared_distances(a: np.ndarray, b: np.ndarray, sigma: float) -> Iterator[np.ndarray]:
    """Blocks [n, M] of squared distances of rows of `a` [N, D] to all of `b` [M, D]; exactly 0 of a row and itself."""
    same, origin = a is b, b[0]
    a, b = a - origin, b - origin
    norms_a, norms_b = (np.einsum("nd,nd->n", rows, rows) for rows in (a, b))
    rounding = np.finfo(np.float64).eps * min(norms_a.max(), norms_b.max())
    by_product = sigma > 0 and rounding <= _MAX_ROUNDING * 2 * sigma * sigma
    step = max(1, _BLOCK_NUMBERS // len(b))
    for start in range(0, len(a), step):
        rows = a[start : start + step]
        if by_product:
            squared = norms_a[start : start + step, None] + norms_b
            squared -= 2 * (rows @ b.T)
            np.maximum(squared, 0, out=squared)
            if same:
                own = np.arange(len(rows))
                squared[own, start + own] = 0
        else:
            from scipy.spatial.distance import cdist

            squared = cdist(rows, b, "sqeuclidean")
        yield squared
