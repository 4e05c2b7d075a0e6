"""The Frechet distance of nearly equal sets, in extended precision where it is small beside the features' variance.

Float64 keeps a root of a covariance to about 1e-16 of its size; the difference of the roots of two sets that differ by
a millionth of their size is then wrong by 1e-10 of itself. Here the roots are computed in long double, of 64 bits on
x86. The orthogonal matrix between them may stay as it comes from float64: at the minimum the distance does not change
with it to first order.

Source: Procrustes form and notation as in `ctlev_core.scoring.frechet`; Golub & Van Loan, Matrix Computations, 2013,
section 5.2 (Householder QR).
"""

from __future__ import annotations

import numpy as np

from ctlev_core.scoring.frechet import frechet_distance

CLOSE = 1e-6
"""Distances below this share of the summed variances are wrong by more than about 1e-13 in float64."""
MAX_WORK = 2 * 10**8
"""Largest (N + M) D^2: long double has no BLAS, and more would take more than seconds."""


def refined_frechet_distance(features_a: np.ndarray, features_b: np.ndarray) -> float:
    """`frechet.frechet_distance`, with more digits where two sets nearly coincide and are not too large.

    Args:
        features_a: [N, D] real numbers, N >= 2.
        features_b: [M, D] real numbers, M >= 2.
    Returns:
        The distance in squared units of the features, never negative.
    Raises:
        ValueError: as `frechet_distance`.
    """
    found = frechet_distance(features_a, features_b)
    # Squares are no smaller than variances, and are added up in a hundredth of the time.
    squares = sum(float(np.vdot(rows, rows)) / (len(rows) - 1) for rows in (features_a, features_b))
    if found >= CLOSE * squares:
        return found
    variance = sum(float(np.var(rows, axis=0, dtype=np.float64).sum()) for rows in (features_a, features_b))
    work = (len(features_a) + len(features_b)) * features_a.shape[1] ** 2
    if not 0 < found < CLOSE * variance or not 1e-100 < variance < 1e100 or work > MAX_WORK:
        return found
    if np.finfo(np.longdouble).eps >= np.finfo(np.float64).eps:
        return found
    origin = features_a[0].astype(np.longdouble)
    (mean_a, a), (mean_b, b) = (_mean_and_root(rows, origin) for rows in (features_a, features_b))
    if len(a) < len(b):
        a, b = b, a
    left, _, right = np.linalg.svd((a @ b.T).astype(np.float64), full_matrices=False)
    turn = (left @ right).astype(np.longdouble)
    # Orthogonal to float64's last digit; one step of Newton and Schulz takes it to that of long double.
    turn = turn @ (3 * np.eye(len(b), dtype=np.longdouble) - turn.T @ turn) / 2
    apart, shift = a - turn @ b, mean_a - mean_b
    return float(np.vdot(apart, apart) + np.vdot(shift, shift))


def _mean_and_root(features: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean [D] as seen from `origin`, and a root [min(N, D), D] of the covariance (n - 1), in long double."""
    rows = features.astype(np.longdouble) - origin
    mean = rows.mean(axis=0)
    rows -= mean
    count, width = rows.shape
    for column in range(min(count - 1, width)):
        mirror = rows[column:, column].copy()
        length = np.sqrt(mirror @ mirror)
        if length > 0:
            mirror[0] += np.copysign(length, mirror[0])
            mirror /= np.sqrt(mirror @ mirror)
            rows[column:, column:] -= 2 * np.outer(mirror, mirror @ rows[column:, column:])
    return mean, np.triu(rows[:width]) / np.sqrt(np.longdouble(count - 1))
