"""Gaussians fitted to features, the covariance kept as a root: from arrays, or from stored statistics.

A root R of a covariance, R^T R = cov, is got from the centred features by QR, without forming the covariance. That
keeps what squaring loses: directions in which the features do not vary have length 0 rather than the square root of a
rounding error, and a feature of size 1e-6 beside one of 1e6 keeps its digits.

Source: Chan, Golub & LeVeque, The American Statistician 37, 1983 (merging of means); Demmel et al., SIAM J. Sci.
Comput. 34, 2012 (QR of tall matrices, block by block).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_contracts.errors import DataError

BLOCK_NUMBERS = 2**21
"""So many stay in the last cache."""


@dataclass(frozen=True, eq=False)
class GaussianFactor:
    """A Gaussian with D dimensions. Its mean is origin + offset: kept apart, a large offset of all data costs no digit.

    Attributes:
        count: rows it was fitted to; 0 where that is not known.
        origin: [D], a point among the data.
        offset: [D], the mean as seen from there.
        root: [R, D], R <= D or R = count; root^T root is the covariance (n - 1).
    """

    count: int
    origin: np.ndarray
    offset: np.ndarray
    root: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """[D]."""
        return self.origin + self.offset

    @property
    def covariance(self) -> np.ndarray:
        """[D, D]."""
        return self.root.T @ self.root


def check_features(features: np.ndarray, name: str, *, least_rows: int = 2, first_row: int = 0) -> np.ndarray:
    """The features themselves, of any recorded dtype.

    Raises:
        ValueError: not real [N, D], fewer rows than `least_rows`, or a value is not finite; names the first such row,
            counted from `first_row`.
    """
    features = np.asarray(features)
    if features.ndim != 2 or features.shape[1] == 0 or not np.isrealobj(features):
        raise ValueError(f"{name} set: features must be real [N, D], got {features.shape} {features.dtype}")
    if len(features) < least_rows:
        raise ValueError(f"{name} set: a covariance needs at least {least_rows} rows, got {len(features)}")
    # A sum of squares is finite only where all values are, and costs no array of flags.
    if features.dtype.kind == "f" and not np.isfinite(np.vdot(features, features)):
        finite = np.isfinite(features).all(axis=1)
        if not finite.all():
            raise ValueError(
                f"{name} set: features must be finite, but {np.count_nonzero(~finite)} of {len(features)} rows are "
                f"not, the first is row {first_row + int(np.argmin(finite))}"
            )
    return features


def check_same_width(first: np.ndarray, second: np.ndarray) -> None:
    """Raise `ValueError` unless both sets [N, D] and [M, D] have the same number of features."""
    if first.shape[1] != second.shape[1]:
        raise ValueError(f"both sets need the same number of features, got {first.shape[1]} and {second.shape[1]}")


def scale_of(*arrays: np.ndarray) -> float:
    """1, or a power of two near the largest magnitude where squares of the numbers might overflow or vanish."""
    size = max(max(float(array.max(initial=0)), -float(array.min(initial=0))) for array in arrays)
    if size == 0 or 1e-100 < size < 1e100:
        return 1.0
    return float(np.exp2(np.floor(np.log2(size))))


def centre(features: np.ndarray) -> np.ndarray:
    """Subtract the mean from [N, D] in place, and return it [D]."""
    mean = features.mean(axis=0)
    features -= mean
    # A second pass takes away what rounding of the first mean left behind.
    correction = features.mean(axis=0)
    features -= correction
    return mean + correction


def fit_gaussian(features: np.ndarray, name: str = "feature") -> GaussianFactor:
    """The Gaussian with the mean and the unbiased covariance of features [N, D], N >= 2.

    Raises:
        ValueError: see `check_features`; `name` says which set.
    """
    features = check_features(features, name)
    origin = features[0].astype(np.float64)
    rows = features - origin
    offset = centre(rows)
    return GaussianFactor(len(rows), origin, offset, triangular(rows) / np.sqrt(len(rows) - 1))


def mean_and_covariance(features: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean [D] as seen from `origin`, and the lower triangle of the unbiased covariance [D, D]. No copy is made.

    Args:
        features: [N, D], N >= 2.
        origin: [D] float64, near the features.
    """
    from scipy.linalg import get_blas_funcs

    width = features.shape[1]
    block = np.empty((min(len(features), max(256, BLOCK_NUMBERS // width)), width))
    chunks = [features[start : start + len(block)] for start in range(0, len(features), len(block))]
    mean, covariance = np.zeros(width), np.zeros((width, width), order="F")
    # Both add to the lower triangle of the matrix in place.
    syrk, syr = get_blas_funcs(("syrk", "syr"), (covariance,))
    for rows in chunks:
        mean += np.subtract(rows, origin, out=block[: len(rows)]).sum(axis=0)
    mean /= len(features)
    left_over = np.zeros(width)
    for rows in chunks:
        centred = np.subtract(rows, origin, out=block[: len(rows)])
        centred -= mean
        left_over += centred.sum(axis=0)
        covariance = syrk(1.0, centred.T, beta=1.0, c=covariance, overwrite_c=1, lower=1)
    left_over /= len(features)
    covariance = syr(-len(features), left_over, lower=1, a=covariance, overwrite_a=1)
    covariance /= len(features) - 1
    return mean + left_over, covariance


def triangular(rows: np.ndarray) -> np.ndarray:
    """At most D rows [min(N, D), D] with the same products of columns as `rows` [N, D]."""
    if len(rows) <= rows.shape[1]:
        return rows
    from scipy.linalg import qr

    return np.asarray(qr(rows, mode="r", overwrite_a=True, check_finite=False)[0])[: rows.shape[1]]


def gaussian_from_statistics(mean: np.ndarray, covariance: np.ndarray, count: int = 0) -> GaussianFactor:
    """A root of a given covariance, by eigenvectors of its correlations.

    Of directions without variance a covariance holds rounding errors alone, whose roots are a hundred million times
    larger: eigenvalues below D epsilon times the largest are taken as zero. They are those of the correlations, so that
    features of very different sizes are all kept. epsilon is that of the covariance's dtype.

    Args:
        mean: [D].
        covariance: [D, D], symmetric to rounding.
        count: rows they were computed from; 0 = not known.
    Raises:
        DataError: shapes do not fit, a value is not finite, or the matrix is not symmetric or has a negative variance
            or a negative eigenvalue.
    """
    mean, checked = check_statistics(mean, covariance)
    precision = np.finfo(np.float32 if np.asarray(covariance).dtype == np.float32 else np.float64).eps
    deviations = np.sqrt(np.diag(checked))
    divisor = np.where(deviations > 0, deviations, 1.0)
    values, vectors = np.linalg.eigh(checked / divisor / divisor[:, None])
    # What a covariance summed in float32 may have; a real negative direction is larger.
    if values[0] < -1e-3 * values[-1]:
        raise DataError(f"covariance must have no negative eigenvalue, its correlations have {values[0]:.3g}")
    kept = values > len(values) * precision * max(values[-1], 0.0)
    root = np.sqrt(values[kept])[:, None] * vectors[:, kept].T * deviations
    return GaussianFactor(count, mean, np.zeros(len(mean)), root)


def check_statistics(mean: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean [D] and exactly symmetric covariance [D, D], both float64.

    Raises:
        DataError: shapes do not fit, a value is not finite, the matrix is not symmetric or has a negative variance.
    """
    mean, covariance = np.asarray(mean), np.asarray(covariance)
    if mean.ndim != 1 or not len(mean) or covariance.shape != (len(mean), len(mean)):
        raise DataError(f"statistics must be a mean [D] and a covariance [D, D], got {mean.shape} {covariance.shape}")
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise DataError("mean and covariance must be finite")
    covariance = covariance.astype(np.float64)
    variances = np.diag(covariance)
    if variances.min() < 0:
        raise DataError(f"covariance must not have negative variances, got {variances.min():g}")
    deviations = np.sqrt(variances)
    difference = np.abs(covariance - covariance.T)
    if (difference > 1e-3 * deviations * deviations[:, None]).any():
        raise DataError(f"covariance must be symmetric, but two of its entries differ by {difference.max():.3g}")
    return mean.astype(np.float64), (covariance + covariance.T) / 2


def read_statistics(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Mean `mu` [D] and covariance `sigma` [D, D] of a .npz file, as pytorch-fid writes and reads them.

    The file does not say from which extractor or how many rows: that has to be known.

    Raises:
        DataError: the file cannot be read, lacks one of them, or their shapes do not fit.
    """
    from ctlev_core.safe_files.numpy_files import read_npz

    arrays = read_npz(Path(path), ("mu", "sigma"), "statistics of features")
    mean, covariance = arrays["mu"], arrays["sigma"]
    if mean.ndim != 1 or covariance.shape != (len(mean), len(mean)):
        raise DataError(f"{path}: mu must be [D] and sigma [D, D], got {mean.shape} and {covariance.shape}")
    # Numbers that float32 holds exactly come from float32, and have its rounding errors.
    single = covariance.astype(np.float32)
    return mean, single if np.array_equal(single, covariance) else covariance
