"""Frechet distance as others compute it, written anew, and references that are better than all of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg

from ctlev_core.scoring.frechet import frechet_distance, frechet_distance_of_gaussians
from ctlev_core.scoring.frechet_extended import refined_frechet_distance
from ctlev_core.scoring.gaussians import gaussian_from_statistics

Distance = Callable[[np.ndarray, np.ndarray], float]


def statistics(features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance as all packages take them."""
    return features.mean(axis=0), np.cov(features, rowvar=False)


def by_sqrtm(a: np.ndarray, b: np.ndarray) -> float:
    """pytorch-fid, clean-fid, edm2: SciPy's matrix square root; 1e-6 on the diagonal where it is not finite."""
    (mean_a, cov_a), (mean_b, cov_b) = statistics(a), statistics(b)
    root = np.asarray(scipy.linalg.sqrtm(cov_a @ cov_b))
    if not np.isfinite(root).all():
        offset = 1e-6 * np.eye(len(mean_a))
        root = np.asarray(scipy.linalg.sqrtm((cov_a + offset) @ (cov_b + offset)))
    if np.iscomplexobj(root) and not np.allclose(np.imag(np.diagonal(root)), 0, atol=1e-3):
        raise ValueError(f"imaginary component {np.abs(np.imag(root)).max():g}")
    difference = mean_a - mean_b
    return float(difference @ difference + np.trace(cov_a) + np.trace(cov_b) - 2 * np.trace(np.real(root)))


def by_eigenvalues(a: np.ndarray, b: np.ndarray) -> float:
    """torch-fidelity and torchmetrics: complex roots of the eigenvalues of the product."""
    (mean_a, cov_a), (mean_b, cov_b) = statistics(a), statistics(b)
    roots = np.real(np.sqrt(np.linalg.eigvals(cov_a @ cov_b).astype(np.complex128)))
    difference = mean_a - mean_b
    return float(difference @ difference + np.trace(cov_a) + np.trace(cov_b) - 2 * roots.sum())


def by_symmetric_eigenvalues(a: np.ndarray, b: np.ndarray) -> float:
    """Two symmetric eigenproblems, as many write it themselves; no threshold."""
    (mean_a, cov_a), (mean_b, cov_b) = statistics(a), statistics(b)
    values, vectors = np.linalg.eigh(cov_a)
    half = np.sqrt(np.maximum(values, 0))[:, None] * vectors.T
    roots = np.sqrt(np.maximum(np.linalg.eigvalsh(half @ cov_b @ half.T), 0))
    difference = mean_a - mean_b
    return float(difference @ difference + np.trace(cov_a) + np.trace(cov_b) - 2 * roots.sum())


def by_exact_route(a: np.ndarray, b: np.ndarray) -> float:
    """Ours, never by the faster route, and in float64 throughout."""
    return frechet_distance(a, b, tolerance=0)


def by_statistics(a: np.ndarray, b: np.ndarray) -> float:
    """Ours, from means and covariances alone."""
    return frechet_distance_of_gaussians(*(gaussian_from_statistics(*statistics(features)) for features in (a, b)))


PEERS: dict[str, Distance] = {"sqrtm": by_sqrtm, "eigvals": by_eigenvalues, "eigh": by_symmetric_eigenvalues}
OURS: dict[str, Distance] = {
    "ctlev": refined_frechet_distance,
    "exact route": by_exact_route,
    "statistics": by_statistics,
}


def exact_distance(a: np.ndarray, b: np.ndarray, digits: int = 60):
    """The textbook formula in multi-precision arithmetic (mpmath); what cancels and roots of zeros do no harm there."""
    import mpmath

    with mpmath.workdps(digits):
        means, covariances = [], []
        for features in (a, b):
            rows = mpmath.matrix(features.astype(np.float64).tolist())
            mean = [mpmath.fsum(rows[:, column]) / rows.rows for column in range(rows.cols)]
            for row in range(rows.rows):
                for column in range(rows.cols):
                    rows[row, column] -= mean[column]
            means.append(mean)
            covariances.append(rows.T * rows / (rows.rows - 1))
        values, vectors = mpmath.eigsy(covariances[0])
        half = mpmath.diag([mpmath.sqrt(max(value, 0)) for value in values]) * vectors.T
        squares = mpmath.eigsy(half * covariances[1] * half.T, eigvals_only=True)
        traces = mpmath.fsum(covariance[i, i] for covariance in covariances for i in range(a.shape[1]))
        shift = mpmath.fsum((x - y) ** 2 for x, y in zip(*means, strict=True))
        return shift + traces - 2 * mpmath.fsum(mpmath.sqrt(max(square, 0)) for square in squares)


def hard_cases(width: int, seed: int = 0) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Pairs of feature sets [N, width] that break one algorithm or another."""
    random = np.random.default_rng(seed)

    def normal(count: int, rank: int = width) -> np.ndarray:
        return random.normal(size=(count, rank)) @ random.normal(size=(rank, width)) + random.normal(size=width)

    many, more = 3 * width, 4 * width
    scales = np.logspace(-6, 6, width)
    constant = normal(many), normal(more)
    for features in constant:
        features[:, 1] = 0.3
    near = normal(many)
    return {
        "well conditioned": (normal(many), normal(more)),
        "identical": (near, near.copy()),
        "near-identical, 1e-6": (near, near * (1 + 1e-6)),
        "rank 1": (normal(many, 1), normal(more, 1)),
        "rank 5": (normal(many, 5), normal(more, 5)),
        "rank 5 against full": (normal(many, 5), normal(more)),
        "N = d / 4": (normal(width // 4), normal(width // 4)),
        "constant feature": constant,
        "column scales 1e-6 .. 1e6": (normal(many) * scales, normal(more) * scales),
        "offset 1e8": (normal(many) + 1e8, normal(more) + 1e8),
        "float32 features + 10": ((normal(many) + 10).astype(np.float32), (normal(more) + 10).astype(np.float32)),
        "one collapsed": (normal(many), np.tile(normal(1), (more, 1))),
    }


def closed_form_case(width: int, count: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Two sets whose covariances share their eigenvectors, and the distance: the sum of (s - t)^2 over deviations."""
    random = np.random.default_rng(1)
    rank = min(count - 1, width)
    basis = np.linalg.qr(random.normal(size=(width, rank)))[0].T
    signs = scipy.linalg.hadamard(count)[:, 1 : rank + 1] * np.sqrt((count - 1) / count)
    deviations = np.logspace(0, -3, rank), np.logspace(-1, -2, rank)
    a, b = (signs * deviation @ basis for deviation in deviations)
    return a, b, float(np.square(deviations[0] - deviations[1]).sum())
