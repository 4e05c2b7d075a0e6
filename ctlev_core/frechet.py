"""The Frechet distance between two sets of feature vectors, in a form that cannot go negative.

The distance of the Gaussians fitted to both sets is |mean_a - mean_b|^2 + tr(Sa + Sb - 2 (Sa Sb)^(1/2)). Its second
term is the squared Bures distance, which is an orthogonal Procrustes problem: with Sa = A^T A and Sb = B^T B it equals
the smallest |A - Q B|_F^2 over matrices Q with orthonormal columns, and U V^T of the singular value decomposition
A B^T = U s V^T attains it. A sum of squares needs no matrix square root, has no imaginary part, loses nothing
to cancellation between nearly equal sets, and a rank-deficient covariance is no special case.

Source: Dowson & Landau, J. Multivariate Analysis 12, 1982 (the distance); Masarotto, Panaretos & Zemel, Sankhya A 81,
2019 (Procrustes form).
"""

from __future__ import annotations

import numpy as np


def frechet_distance(features_a: np.ndarray, features_b: np.ndarray) -> float:
    """Squared Frechet distance between the Gaussians fitted to two sets of features; 0 for identical sets.

    Covariances are the unbiased ones (n - 1). The estimate is biased upwards for small sets: give n and d beside it.

    Args:
        features_a: [N, D] real numbers, N >= 2.
        features_b: [M, D] real numbers, M >= 2.
    Returns:
        The distance in squared units of the features, never negative.
    Raises:
        ValueError: shapes do not fit, a set has fewer than two rows, or a value is not finite (the message
            names the row).
    """
    features_a, features_b = _check(features_a, "first"), _check(features_b, "second")
    if features_a.shape[1] != features_b.shape[1]:
        raise ValueError(
            f"both sets need the same number of features, got {features_a.shape[1]} and {features_b.shape[1]}"
        )
    if np.array_equal(features_a, features_b):
        return 0.0
    # One common origin near the data: the distance does not change, and a large offset costs no digits.
    origin = features_a[0]
    mean_a, root_a = _mean_and_root(features_a - origin)
    mean_b, root_b = _mean_and_root(features_b - origin)
    if len(root_a) < len(root_b):
        root_a, root_b = root_b, root_a
    left, _, right = np.linalg.svd(root_a @ root_b.T, full_matrices=False)
    difference = mean_a - mean_b
    residual = root_a - left @ (right @ root_b)
    return float(difference @ difference + np.vdot(residual, residual))


def _check(features: np.ndarray, name: str) -> np.ndarray:
    features = np.asarray(features)
    if features.ndim != 2 or features.shape[1] == 0 or not np.isrealobj(features):
        raise ValueError(f"{name} set: features must be real [N, D], got {features.shape} {features.dtype}")
    if len(features) < 2:
        raise ValueError(f"{name} set: a covariance needs at least 2 rows, got {len(features)}")
    features = features.astype(np.float64)
    finite = np.isfinite(features).all(axis=1)
    if not finite.all():
        raise ValueError(
            f"{name} set: features must be finite, but {np.count_nonzero(~finite)} of {len(features)} rows are not, "
            f"the first is row {int(np.argmin(finite))}"
        )
    return features


def _mean_and_root(features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean [D] and a root R [min(N, D), D] of the covariance, R^T R = cov, without ever forming the covariance."""
    mean = features.mean(axis=0)
    centred = features - mean
    # A second pass takes away what rounding of the first mean left behind.
    correction = centred.mean(axis=0)
    centred -= correction
    root = centred / np.sqrt(len(features) - 1)
    if len(root) > root.shape[1]:
        root = np.asarray(np.linalg.qr(root, mode="r"))
    return mean + correction, root
