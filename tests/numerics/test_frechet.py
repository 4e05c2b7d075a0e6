"""The Frechet distance against SciPy's matrix square root, closed forms, and the cases that break other forms."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.scoring.frechet import frechet_distance


def distance_by_sqrtm(a: np.ndarray, b: np.ndarray) -> float:
    """The textbook formula."""
    difference = a.mean(axis=0) - b.mean(axis=0)
    cov_a, cov_b = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    root = np.asarray(scipy.linalg.sqrtm(cov_a @ cov_b)).real
    return float(difference @ difference + np.trace(cov_a + cov_b - 2 * root))


def gaussian(seed: int, n: int, d: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return generator.normal(size=(n, d)) @ generator.normal(size=(d, d)) + generator.normal(size=d)


def with_covariance(root: np.ndarray, n: int) -> np.ndarray:
    """n rows (a power of two) with mean exactly 0 and covariance exactly root^T root: scaled Hadamard columns."""
    signs = scipy.linalg.hadamard(n)[:, 1 : len(root) + 1]
    return signs @ root * np.sqrt((n - 1) / n)


@pytest.mark.parametrize(("n", "m", "d"), [(200, 150, 8), (400, 40, 32), (33, 400, 32)])
def test_agrees_with_scipy_where_covariances_are_regular(n, m, d):
    a, b = gaussian(1, n, d), gaussian(2, m, d)
    assert frechet_distance(a, b) == pytest.approx(distance_by_sqrtm(a, b), rel=1e-9)


def test_fewer_samples_than_features_agrees_with_scipy_to_its_accuracy():
    a, b = gaussian(1, 8, 32), gaussian(2, 20, 32)
    # Null directions of the covariance cost sqrtm the square root of the machine precision: about 1e-8 of the traces.
    assert frechet_distance(a, b) == pytest.approx(distance_by_sqrtm(a, b), rel=1e-6)


def test_one_feature_has_a_closed_form():
    generator = np.random.default_rng(0)
    a, b = generator.normal(1, 2, size=(50, 1)), generator.normal(-3, 0.1, size=(70, 1))
    expected = (a.mean() - b.mean()) ** 2 + (a.std(ddof=1) - b.std(ddof=1)) ** 2
    assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-13)


def test_diagonal_covariances_have_a_closed_form_over_twelve_decades():
    deviations_a = np.logspace(-6, 6, 13)
    deviations_b = deviations_a[::-1].copy()
    a, b = with_covariance(np.diag(deviations_a), 16), with_covariance(np.diag(deviations_b), 16)
    expected = float(((deviations_a - deviations_b) ** 2).sum())
    assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-12)


def test_scaled_copy_has_a_closed_form_down_to_nearly_identical_sets():
    a = gaussian(3, 300, 16)
    a -= a.mean(axis=0)
    trace = float(np.cov(a, rowvar=False).trace())
    for epsilon in (1.0, 1e-2, 1e-4, 1e-6):
        # sqrtm gives this to 2e-2 only at 1e-6; here rounding of the inputs, 1e-16 / epsilon, is what is left.
        assert frechet_distance(a, a * (1 + epsilon)) == pytest.approx(epsilon**2 * trace, rel=1e-8)


def test_orthogonal_subspaces_share_nothing():
    a, b = np.zeros((30, 6)), np.zeros((40, 6))
    a[:, :3], b[:, 3:] = gaussian(4, 30, 3), gaussian(5, 40, 3)
    difference = a.mean(axis=0) - b.mean(axis=0)
    expected = difference @ difference + np.cov(a, rowvar=False).trace() + np.cov(b, rowvar=False).trace()
    assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-12)


def test_rank_five_covariances_in_many_dimensions():
    """Both covariances are multiples of one projection, so the distance is rank x (difference of deviations)^2."""
    basis = np.linalg.qr(np.random.default_rng(6).normal(size=(64, 5)))[0].T
    a, b = with_covariance(2.0 * basis, 128), with_covariance(0.5 * basis, 256)
    assert frechet_distance(a, b) == pytest.approx(5 * 1.5**2, rel=1e-12)


def test_large_common_offset_costs_no_digits():
    a, b = np.round(gaussian(7, 60, 8) * 64), np.round(gaussian(8, 60, 8) * 64)
    # Integers with an integer offset of 2^40 are exact in float64, so the true distance does not change.
    assert frechet_distance(a + 2.0**40, b + 2.0**40) == pytest.approx(frechet_distance(a, b), rel=1e-12)


def test_collapsed_and_constant_sets():
    a = gaussian(9, 50, 4)
    collapsed = np.tile([1.0, 2.0, 3.0, 4.0], (20, 1))
    expected = ((a.mean(axis=0) - collapsed[0]) ** 2).sum() + np.cov(a, rowvar=False).trace()
    assert frechet_distance(a, collapsed) == pytest.approx(expected, rel=1e-12)
    assert frechet_distance(collapsed, collapsed + 1) == pytest.approx(4.0, rel=1e-15)
    b = gaussian(10, 60, 4)
    a[:, 2], b[:, 2] = 5.0, 7.0
    others = [0, 1, 3]
    assert frechet_distance(a, b) == pytest.approx(4.0 + distance_by_sqrtm(a[:, others], b[:, others]), rel=1e-9)


@pytest.mark.parametrize(("n", "d"), [(100, 8), (8, 100)])
def test_identical_sets_are_at_distance_zero(n, d):
    a = gaussian(11, n, d)
    assert frechet_distance(a, a.copy()) == 0.0
    shuffled = np.random.default_rng(0).permutation(a)
    assert 0.0 <= frechet_distance(a, shuffled) < 1e-24 * np.square(a).sum()


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10_000), st.integers(2, 30), st.integers(2, 30), st.integers(1, 12), st.floats(-5, 5), st.booleans()
)
def test_symmetric_non_negative_and_invariant_under_rotation(seed, n, m, d, exponent, same):
    scale = 10.0**exponent
    a = gaussian(seed, n, d) * scale
    b = a[::-1] if same and n == m else gaussian(seed + 1, m, d) * scale
    distance = frechet_distance(a, b)
    size = np.square(a).sum() + np.square(b).sum()
    assert distance >= 0
    assert frechet_distance(b, a) == pytest.approx(distance, rel=1e-9, abs=1e-14 * size)
    rotation = np.linalg.qr(np.random.default_rng(seed).normal(size=(d, d)))[0]
    assert frechet_distance(a @ rotation, b @ rotation) == pytest.approx(distance, rel=1e-9, abs=1e-14 * size)


def test_inputs_are_left_alone_and_single_precision_is_accepted():
    a, b = gaussian(12, 40, 6).astype(np.float32), gaussian(13, 40, 6).astype(np.float32)
    copies = a.copy(), b.copy()
    assert frechet_distance(a, b) == frechet_distance(a.astype(np.float64), b.astype(np.float64))
    assert np.array_equal(a, copies[0]) and np.array_equal(b, copies[1])


def test_bad_input_is_named():
    a = gaussian(14, 10, 3)
    broken = a.copy()
    broken[4, 1] = np.nan
    with pytest.raises(ValueError, match=r"second set: .* 1 of 10 rows .* the first is row 4"):
        frechet_distance(a, broken)
    with pytest.raises(ValueError, match="first set: a covariance needs at least 2 rows, got 1"):
        frechet_distance(a[:1], a)
    with pytest.raises(ValueError, match="same number of features, got 3 and 2"):
        frechet_distance(a, a[:, :2])
    with pytest.raises(ValueError, match=r"real \[N, D\]"):
        frechet_distance(a[0], a)
