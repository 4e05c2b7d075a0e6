"""The Frechet distance of features and of stored statistics against 60-digit arithmetic."""

import numpy as np
import pytest

from ctlev_core.scoring.frechet import frechet_distance, frechet_distance_of_gaussians
from ctlev_core.scoring.frechet_extended import refined_frechet_distance
from ctlev_core.scoring.gaussians import fit_gaussian, gaussian_from_statistics, read_statistics
from data_contracts.errors import DataError

mpmath = pytest.importorskip("mpmath")
D = 12


def exact_distance(a, b):
    """The textbook formula with 60 digits: its cancellation and its roots of zero eigenvalues then do no harm."""
    with mpmath.workdps(60):
        means, covariances = [], []
        for features in (a, b):
            rows = mpmath.matrix(features.astype(np.float64).tolist())
            mean = [mpmath.fsum(rows[:, column]) / rows.rows for column in range(rows.cols)]
            centred = mpmath.matrix(rows.rows, rows.cols)
            for row in range(rows.rows):
                for column in range(rows.cols):
                    centred[row, column] = rows[row, column] - mean[column]
            means.append(mean)
            covariances.append(centred.T * centred / (rows.rows - 1))
        values, vectors = mpmath.eigsy(covariances[0])
        roots = mpmath.diag([mpmath.sqrt(max(value, 0)) for value in values])
        half = roots * vectors.T
        squares = mpmath.eigsy(half * covariances[1] * half.T, eigvals_only=True)
        traces = mpmath.fsum(c[i, i] for c in covariances for i in range(D))
        cross = mpmath.fsum(mpmath.sqrt(max(square, 0)) for square in squares)
        return mpmath.fsum((x - y) ** 2 for x, y in zip(*means, strict=True)) + traces - 2 * cross


def normal(seed, count, rank=D):
    random = np.random.default_rng(seed)
    return random.normal(size=(count, rank)) @ random.normal(size=(rank, D)) + random.normal(size=D)


def constant_feature(seed, count):
    features = normal(seed, count)
    features[:, 3] = 0.7
    return features


SCALES = np.logspace(-6, 6, D)
CASES = {
    "well conditioned": (normal(0, 40), normal(1, 50)),
    "fewer rows than features": (normal(2, 5), normal(3, 6)),
    "fewer rows against many": (normal(4, 5), normal(5, 50)),
    "rank 1": (normal(6, 40, 1), normal(7, 50, 1)),
    "rank 3 against full": (normal(8, 40, 3), normal(9, 50)),
    "constant feature": (constant_feature(10, 40), constant_feature(11, 50)),
    "column scales 1e-6 to 1e6": (normal(12, 40) * SCALES, normal(13, 50) * SCALES),
    "opposite column scales": (normal(12, 40) * SCALES, normal(13, 50) * SCALES[::-1]),
    "offset 1e8": (normal(14, 40) + 1e8, normal(15, 50) + 1e8),
    "two rows": (normal(16, 2), normal(17, 2)),
    "one collapsed": (normal(18, 40), np.tile(normal(19, 1), (50, 1))),
    "float32": (normal(20, 40).astype(np.float32) + np.float32(10), normal(21, 50).astype(np.float32) + np.float32(10)),
    "tiny": (normal(22, 40) * 1e-145, normal(23, 50) * 1e-145),
    "huge": (normal(24, 40) * 1e150, normal(25, 50) * 1e150),
}


def distance_of_statistics(mean_a, covariance_a, mean_b, covariance_b):
    first, second = gaussian_from_statistics(mean_a, covariance_a), gaussian_from_statistics(mean_b, covariance_b)
    return frechet_distance_of_gaussians(first, second)


@pytest.mark.parametrize("name", CASES)
def test_relative_error_is_below_1e_12(name):
    a, b = CASES[name]
    exact = exact_distance(a, b)
    for found in (frechet_distance(a, b), frechet_distance(b, a), frechet_distance(a, b, tolerance=0)):
        assert abs(mpmath.mpf(found) - exact) <= 1e-12 * exact


@pytest.mark.parametrize("name", [name for name in CASES if name not in ("tiny", "huge", "offset 1e8")])
def test_statistics_keep_what_a_covariance_can_hold(name):
    a, b = (features.astype(np.float64) for features in CASES[name])
    exact = float(exact_distance(a, b))
    statistics = [number for f in (a, b) for number in (f.mean(axis=0), np.cov(f, rowvar=False))]
    # Not 1e-12: np.cov has rounded. A direction dropped or kept wrongly would cost 1e-8 of the traces.
    size = float(np.trace(statistics[1]) + np.trace(statistics[3]))
    assert distance_of_statistics(*statistics) == pytest.approx(exact, rel=1e-11, abs=1e-12 * size)


def test_nearly_identical_sets_lose_only_what_their_own_rounding_does():
    a = normal(30, 60)
    b = a * (1 + 1e-6)
    exact = exact_distance(a, b)
    assert abs(frechet_distance(a, b) - exact) <= 1e-9 * exact


@pytest.mark.parametrize("apart", [1e-4, 1e-6, 1e-8])
@pytest.mark.parametrize("counts", [(60, 60), (7, 7), (60, 61), (8, 7)])
def test_nearly_identical_sets_keep_their_digits_in_extended_precision(counts, apart):
    if np.finfo(np.longdouble).eps >= np.finfo(np.float64).eps:
        pytest.skip("long double is float64 here")
    a = normal(30, counts[0])
    b = a[: counts[1]] * (1 + apart)
    if counts[1] > counts[0]:
        b = np.concatenate([b, a.mean(axis=0, keepdims=True)])
    for first, second in ((a, b), (b, a)):
        exact = exact_distance(first, second)
        # 1e-19, long double's rounding, of the features' size over their difference.
        assert abs(mpmath.mpf(refined_frechet_distance(first, second)) - exact) <= max(1e-12, 2e-18 / apart) * exact


def test_extended_precision_is_for_sets_that_need_it_alone():
    a, b = normal(31, 60), normal(33, 60)
    assert refined_frechet_distance(a, b) == frechet_distance(a, b)
    assert refined_frechet_distance(a, a.copy()) == 0
    assert refined_frechet_distance(a * 1e-150, a * (1 + 1e-6) * 1e-150) >= 0
    near = a * (1 + 1e-6)
    assert refined_frechet_distance(a, near) == pytest.approx(frechet_distance(a, near), rel=1e-8)
    with pytest.raises(ValueError, match="first set: a covariance needs at least 2 rows, got 1"):
        refined_frechet_distance(a[:1], a)


def test_the_fast_route_is_left_where_its_own_estimate_says_so():
    """Sets so near one another that the traces cancel: both routes are asked, and the answers are the same."""
    a = normal(31, 60)
    for near in (a * (1 + 1e-5), a[::-1]):
        assert frechet_distance(a, near) == frechet_distance(a, near, tolerance=0)
    easy = normal(33, 60), normal(34, 60)
    assert frechet_distance(*easy) != frechet_distance(*easy, tolerance=0)


@pytest.mark.parametrize("smallest", [1e-2, 1e-5, 1e-8, 1e-12])
def test_no_condition_number_gets_past_the_estimates(smallest):
    """Deviations from 1 down to `smallest`, each set in directions of its own; Cholesky alone would lose digits."""
    rotation = np.linalg.qr(np.random.default_rng(35).normal(size=(D, D)))[0]
    deviations = np.logspace(0, np.log10(smallest), D)
    random = np.random.default_rng(36)
    a, b = (random.normal(size=(60, D)) * deviations @ turn for turn in (np.eye(D), rotation))
    exact = exact_distance(a, b)
    assert abs(frechet_distance(a, b) - exact) <= 1e-12 * exact


def test_statistics_of_pytorch_fid_files(tmp_path):
    a, b = normal(43, 300), normal(44, 200)
    np.savez(tmp_path / "a.npz", mu=a.mean(axis=0), sigma=np.cov(a, rowvar=False))
    mean, covariance = read_statistics(tmp_path / "a.npz")
    found = frechet_distance_of_gaussians(gaussian_from_statistics(mean, covariance), fit_gaussian(b))
    assert found == pytest.approx(frechet_distance(a, b), rel=1e-11)


@pytest.mark.parametrize("dimensions", [256, pytest.param(2048, marks=pytest.mark.slow)])
def test_the_vector_of_pytorch_fid(dimensions):
    """Distance of N(0, I) and N(1, I): the number of dimensions (mseitzer/pytorch-fid, tests/test_fid_score.py)."""
    identity = np.eye(dimensions)
    found = distance_of_statistics(np.zeros(dimensions), identity, np.ones(dimensions), identity)
    assert found == dimensions


def test_statistics_stored_in_single_precision_have_its_null_directions_dropped(tmp_path):
    """Kept, the rounding errors of 1e-7 in ten null directions would each count as a deviation of 3e-4."""
    a, b = normal(45, 60, 2) * 100, normal(46, 60, 2) * 100
    statistics = []
    for features in (a, b):
        arrays = {"mu": features.mean(axis=0), "sigma": np.cov(features, rowvar=False).astype(np.float32)}
        np.savez(tmp_path / "s.npz", **arrays)
        statistics += read_statistics(tmp_path / "s.npz")
    assert gaussian_from_statistics(*statistics[:2]).root.shape == (2, D)
    assert distance_of_statistics(*statistics) == pytest.approx(frechet_distance(a, b), rel=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma": np.eye(2)}, r"must be \[D\] and sigma \[D, D\], got \(3,\) and \(2, 2\)"),
        ({"sigma": -np.eye(3)}, "negative variances, got -1"),
        ({"sigma": np.eye(3) + np.triu(np.full((3, 3), 0.5), 1)}, "must be symmetric"),
        ({"sigma": 2 * np.ones((3, 3)) - np.eye(3) * 1.0 + np.fliplr(np.eye(3))}, "no negative eigenvalue"),
        ({"mu": np.array([0, np.nan, 0])}, "must be finite"),
    ],
)
def test_statistics_that_are_none_are_refused(change, message, tmp_path):
    np.savez(tmp_path / "s.npz", **({"mu": np.zeros(3), "sigma": np.eye(3)} | change))
    with pytest.raises(DataError, match=message):
        statistics = read_statistics(tmp_path / "s.npz")
        distance_of_statistics(*statistics, np.zeros(3), np.eye(3))
    np.savez(tmp_path / "t.npz", mu=np.zeros(3))
    with pytest.raises(DataError, match="lacks sigma; found mu"):
        read_statistics(tmp_path / "t.npz")
