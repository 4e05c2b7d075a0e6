"""The Frechet distance between two sets of feature vectors, in a form that cannot go negative.

The distance of the Gaussians fitted to both sets is |mean_a - mean_b|^2 + tr(Sa + Sb - 2 (Sa Sb)^(1/2)). Its second
term is the squared Bures distance, which is an orthogonal Procrustes problem: with Sa = A^T A and Sb = B^T B it equals
the smallest |A - Q B|_F^2 over matrices Q with orthonormal columns, and U V^T of the singular value decomposition
A B^T = U s V^T attains it. A sum of squares needs no matrix square root, has no imaginary part, loses nothing
to cancellation between nearly equal sets, and a rank-deficient covariance is no special case.

Two routes are faster where sets are not nearly equal. The trace of (Sa Sb)^(1/2) is the sum of s alone; and with many
rows and well-conditioned covariances it is the sum of the roots of the eigenvalues of La^T Sb La, La and Lb the
Cholesky factors. Both estimate their own error, and a result is taken only where the estimate is below a tolerance.

FID is this distance between Inception's features; pytorch-fid and torch-fidelity compute (Sa Sb)^(1/2) by a Schur
decomposition or by the eigenvalues of the product, and subtract. Those lose half the digits where a covariance is
singular, as it is with fewer rows than features (`benchmarks/metrics.py`).

Source: Dowson & Landau, J. Multivariate Analysis 12, 1982 (the distance); Masarotto, Panaretos & Zemel, Sankhya A 81,
2019 (Procrustes form); Heusel et al., NeurIPS 2017 (FID).
"""

from __future__ import annotations

import numpy as np

from ctlev_core.scoring.gaussians import (
    GaussianFactor,
    check_features,
    check_same_width,
    fit_gaussian,
    mean_and_covariance,
    scale_of,
)
from data_contracts.errors import DataError

TOLERANCE = 1e-12
_POWER_ITERATIONS = 12
_EPSILON = float(np.finfo(np.float64).eps)


def frechet_distance(features_a: np.ndarray, features_b: np.ndarray, *, tolerance: float = TOLERANCE) -> float:
    """Squared Frechet distance between the Gaussians fitted to two sets of features; 0 for identical sets.

    Covariances are the unbiased ones (n - 1). The estimate is biased upwards for small sets: give n and d beside it
    (`ctlev_core.statistics.feature_distances`).

    Args:
        features_a: [N, D] real numbers, N >= 2.
        features_b: [M, D] real numbers, M >= 2.
        tolerance: relative error up to which faster routes are taken, by their own estimates; 0 = never.
    Returns:
        The distance in squared units of the features, never negative.
    Raises:
        ValueError: shapes do not fit, a set has fewer than two rows, or a value is not finite (the message
            names the row).
        DataError: the distance is too large for a float64.
    """
    features_a, features_b = check_features(features_a, "first"), check_features(features_b, "second")
    check_same_width(features_a, features_b)
    if np.array_equal(features_a[0], features_b[0]) and np.array_equal(features_a, features_b):
        return 0.0
    # One common origin near the data: the distance does not change, and a large offset costs no digits.
    origin = features_a[0].astype(np.float64)
    if tolerance > 0 and min(len(features_a), len(features_b)) > len(origin) and scale_of(features_a, features_b) == 1:
        (mean_a, cov_a), (mean_b, cov_b) = (mean_and_covariance(rows, origin) for rows in (features_a, features_b))
        shift = _squared(mean_a - mean_b)
        bures = _bures_by_cholesky(cov_a, cov_b, shift, tolerance)
        if bures is not None:
            return shift + bures
    return frechet_distance_of_gaussians(fit_gaussian(features_a), fit_gaussian(features_b), tolerance=tolerance)


def frechet_distance_of_gaussians(a: GaussianFactor, b: GaussianFactor, *, tolerance: float = TOLERANCE) -> float:
    """Squared Frechet distance of two Gaussians given by roots of their covariances; never negative.

    Args:
        a: D dimensions.
        b: as many.
        tolerance: as for `frechet_distance`.
    Raises:
        ValueError: they have different numbers of dimensions.
        DataError: the distance is too large for a float64.
    """
    check_same_width(a.root, b.root)
    # Origins are data: the difference of close ones is exact.
    difference = (a.origin - b.origin) + (a.offset - b.offset)
    scale = scale_of(difference, a.root, b.root)
    shift = _squared(difference / scale)
    # As a product of floats: beyond 1e308 it is infinite, where a power would raise an error of Python's.
    found = (shift + _bures(a.root / scale, b.root / scale, shift, tolerance)) * scale * scale
    if not np.isfinite(found):
        raise DataError(f"features of sizes up to {scale:.0e} are too far apart: the squared distance is beyond 1e308")
    return found


def _bures(root_a: np.ndarray, root_b: np.ndarray, shift: float, tolerance: float) -> float:
    """Squared Bures distance of covariances with roots [R, D] and [S, D].

    Singular values are wrong by about epsilon times the largest each, whatever the condition number is: only where
    their sum nearly cancels against the traces is the sum of squares needed, which takes three times as long.
    """
    if np.array_equal(root_a, root_b):
        return 0.0
    if len(root_a) < len(root_b):
        root_a, root_b = root_b, root_a
    product = root_a @ root_b.T
    if tolerance > 0:
        traces, singular = _squared(root_a) + _squared(root_b), np.linalg.svd(product, compute_uv=False)
        bures = traces - 2 * float(singular.sum())
        error = _EPSILON * (np.sqrt(len(singular)) * traces + len(singular) * singular.max(initial=0.0))
        if error <= tolerance * (shift + bures):
            return bures
    left, _, right = np.linalg.svd(product, full_matrices=False)
    return _squared(root_a - (left @ right) @ root_b)


def _bures_by_cholesky(cov_a: np.ndarray, cov_b: np.ndarray, shift: float, tolerance: float) -> float | None:
    """The same by Cholesky factors of the lower triangles; None where the distance, with `shift`, may be too wrong.

    Rounding of a covariance changes the trace of the root by up to about epsilon sqrt(condition number) times the
    traces, and rounding of the product changes each eigenvalue s^2 by epsilon times the largest: s by that / (2 s).
    """
    from scipy.linalg import cholesky, eigvalsh, get_blas_funcs

    traces = float(np.trace(cov_a) + np.trace(cov_b))
    try:
        root_a, root_b = (cholesky(covariance, lower=True, check_finite=False) for covariance in (cov_a, cov_b))
    except np.linalg.LinAlgError:
        return None
    error = _EPSILON * np.sqrt(max(_condition(root_a), _condition(root_b))) * traces
    if error > tolerance * (shift + traces):
        return None
    # BLAS's own triangular and symmetric products take half as long as general ones.
    trmm, syrk = get_blas_funcs(("trmm", "syrk"), (root_a, root_b))
    product = trmm(1.0, root_a, root_b, lower=1, trans_a=1, overwrite_b=1)
    squares = eigvalsh(syrk(1.0, product, lower=1), lower=True, overwrite_a=True, check_finite=False)
    if squares[0] <= 0:
        return None
    singular = np.sqrt(squares)
    bures = traces - 2 * float(singular.sum())
    error += _EPSILON * float(np.sum(squares[-1] / singular))
    return bures if error <= tolerance * (shift + bures) else None


def _condition(root: np.ndarray) -> float:
    """Estimate of the condition number of root root^T, of a lower triangular root, by power iterations."""
    from scipy.linalg import solve_triangular

    vectors = np.random.default_rng(0).normal(size=(2, len(root)))
    sizes = np.ones(2)
    for _ in range(_POWER_ITERATIONS):
        vectors[0] = root @ (root.T @ vectors[0])
        half = solve_triangular(root, vectors[1], lower=True, check_finite=False)
        vectors[1] = solve_triangular(root, half, lower=True, trans=1, check_finite=False)
        sizes = np.linalg.norm(vectors, axis=1)
        if not np.isfinite(sizes).all():
            return float("inf")
        vectors /= sizes[:, None]
    return float(sizes[0] * sizes[1])


def _squared(array: np.ndarray) -> float:
    return float(np.vdot(array, array))
