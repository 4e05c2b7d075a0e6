"""MMD under a Gaussian kernel against loops over pairs and the closed form of two Gaussians."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mpmath import mp, mpf

from ctlev_core.metrics import mmd
from ctlev_core.scoring import mmd as scoring
from ctlev_core.scoring.mmd import compute_mmd, median_distance


def normal(seed, count, width=6, scale=1.0, offset=0.0):
    return scale * np.random.default_rng(seed).normal(size=(count, width)) + offset


def slow_mmd(a, b, sigma):
    """Gretton et al., eq. 3, pair by pair, with 60 digits."""
    with mp.workdps(60):
        rows = [[[mpf(float(value)) for value in row] for row in features] for features in (a, b)]

        def kernel(x, y):
            squared = sum((p - q) ** 2 for p, q in zip(x, y, strict=True))
            return mp.exp(-squared / (2 * mpf(float(sigma)) ** 2))

        def within(features):
            count = len(features)
            pairs = [kernel(features[i], features[j]) for i in range(count) for j in range(count) if i != j]
            return sum(pairs) / (count * (count - 1))

        between = sum(kernel(x, y) for x in rows[0] for y in rows[1]) / (len(a) * len(b))
        return float(within(rows[0]) + within(rows[1]) - 2 * between)


def slow_median(rows):
    return float(np.median([np.linalg.norm(x - y) for i, x in enumerate(rows) for y in rows[:i]]))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    sizes=st.tuples(st.integers(2, 7), st.integers(2, 7), st.integers(1, 4)),
    sigma=st.sampled_from([None, 0.1, 1.0, 10.0, 1e4]),
    offset=st.sampled_from([0.0, 1e3, 2.0**30]),
    grid=st.booleans(),
)
def test_mmd_agrees_with_a_loop_over_pairs(seed, sizes, sigma, offset, grid):
    n, m, width = sizes
    a, b = normal(seed, n, width, 1.5), normal(seed + 1, m, width)
    if grid:  # rows repeat
        a, b = np.round(a), np.round(b)
    a, b = a + offset, b + offset
    median = slow_median(b)
    if sigma is None and median == 0:
        return
    found = compute_mmd(a, b, bandwidth="median" if sigma is None else sigma)
    # What is summed is the kernel minus 1. Of wide kernels it is small, and so is its rounding: digits are kept, too.
    sigma = sigma or median
    largest = max(np.linalg.norm(x - y) for x in np.concatenate([a, b]) for y in b)
    rounding = 1e-15 * min(1.0, (largest / sigma) ** 2)
    assert found == pytest.approx(slow_mmd(a, b, sigma), rel=1e-7, abs=rounding)


def gaussian_mmd(difference, variance_a, variance_b, sigma, width):
    """E k of Gaussians with covariances v I: (1 + v / sigma^2)^(-D/2) exp(-|d|^2 / (2 (sigma^2 + v))), v the sum."""

    def mean_kernel(squared, variance):
        return (1 + variance / sigma**2) ** (-width / 2) * np.exp(-squared / (2 * (sigma**2 + variance)))

    within = mean_kernel(0, 2 * variance_a) + mean_kernel(0, 2 * variance_b)
    return within - 2 * mean_kernel(width * difference**2, variance_a + variance_b)


@pytest.mark.parametrize(
    ("offset", "scale", "sigma"), [(0.0, 1.0, 2.0), (0.3, 1.0, 2.0), (0.0, 1.3, 2.0), (0.5, 0.7, 10.0)]
)
def test_the_mean_over_draws_is_the_closed_form_of_two_gaussians(offset, scale, sigma):
    """Unbiased: 400 sets as small as 12 and 9 rows. A biased estimate would be off by many standard errors."""
    values = [
        compute_mmd(normal(seed, 12, 4, scale, offset), normal(seed + 5000, 9, 4), bandwidth=sigma)
        for seed in range(400)
    ]
    expected = gaussian_mmd(offset, scale**2, 1.0, sigma, 4)
    assert np.mean(values) == pytest.approx(expected, abs=4 * np.std(values) / np.sqrt(len(values)))
    bias = (1 - (1 + 2 / sigma**2) ** -2) * (1 / 12 + 1 / 9)  # of equal variances
    assert bias > 5 * np.std(values) / np.sqrt(len(values))


def test_a_wide_kernel_sees_the_means_alone():
    """As sigma = 10 does with embeddings of length 1: sigma^2 MMD^2 is the squared difference of means, unbiased."""
    a, b = (
        rows / np.linalg.norm(rows, axis=1, keepdims=True)
        for rows in (normal(1, 80, 30, offset=0.2), normal(2, 70, 30))
    )
    trace = sum(float(rows.var(axis=0, ddof=1).sum()) / len(rows) for rows in (a, b))
    means = float(((a.mean(axis=0) - b.mean(axis=0)) ** 2).sum()) - trace
    assert compute_mmd(a, b, bandwidth=10.0) * 100 == pytest.approx(means, rel=0.02)
    assert compute_mmd(a, b, bandwidth=1e5) * 1e10 == pytest.approx(means, rel=1e-6)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.floats(1e-3, 1e3), st.floats(-50, 50))
def test_the_median_bandwidth_knows_neither_units_nor_origin(seed, unit, offset):
    a, b = normal(seed, 20, 3, 1.4), normal(seed + 1, 15, 3)
    value = compute_mmd(a, b)
    assert compute_mmd(a * unit + offset, b * unit + offset) == pytest.approx(value, rel=1e-6, abs=1e-9)
    order = np.random.default_rng(seed).permutation(20)
    assert compute_mmd(a[order], b) == pytest.approx(value, rel=1e-9, abs=1e-12)
    assert compute_mmd(b, a, bandwidth=2.0) == pytest.approx(compute_mmd(a, b, bandwidth=2.0), rel=1e-9, abs=1e-12)
    assert -1 < value <= 2


def test_duplicates_constant_features_and_two_rows():
    constant = np.full((5, 3), 2.0)
    assert compute_mmd(constant, constant[:4]) == 0
    assert compute_mmd(constant + 1, constant) == 2  # no kernel reaches from one set to the other
    # Two rows each, at 0 and 1, and at 3 and 4; sigma = 1.
    a, b = np.array([[0.0], [1.0]]), np.array([[3.0], [4.0]])
    kernel = {d: np.exp(-(d**2) / 2) for d in (1, 2, 3, 4)}
    expected = 2 * kernel[1] - 2 * (2 * kernel[3] + kernel[2] + kernel[4]) / 4
    assert compute_mmd(a, b) == compute_mmd(a, b, bandwidth=1.0) == pytest.approx(expected, rel=1e-14)
    # More than half of the pairs are equal rows: the median of the others.
    mostly = np.array([[0.0]] * 9 + [[3.0]])
    assert median_distance(mostly) == 3 and median_distance(np.zeros((4, 2))) == 0
    # A set against itself: the pairs of a row with itself are in the mean between the sets alone.
    rows = normal(3, 30)
    assert -0.2 < compute_mmd(rows, rows.copy()) < 0


def test_huge_tiny_and_far_features():
    a, b = normal(4, 20), normal(5, 25, offset=0.5)
    value = compute_mmd(a, b)
    for size in (1e-200, 1e150, 1e300):
        assert compute_mmd(a * size, b * size) == pytest.approx(value, rel=1e-9)
    assert compute_mmd(a.astype(np.float32), b.astype(np.float32)) == pytest.approx(value, rel=1e-5)
    # One row a billion bandwidths away: squared distances of the others must not be lost beside its own.
    outlier = np.concatenate([a, [np.full(6, 1e12)]])
    assert compute_mmd(outlier, b, bandwidth=3.0) == pytest.approx(slow_mmd(outlier, b, 3.0), rel=1e-9)


def test_memory_does_not_grow_with_pairs(monkeypatch):
    monkeypatch.setattr(scoring, "_BLOCK_NUMBERS", 50_000)
    a, b = normal(6, 3000, 4), normal(7, 3000, 4)
    tracemalloc.start()
    value = compute_mmd(a, b, bandwidth=2.0, subset_size=0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3000 * 3000 * 8 / 20
    monkeypatch.undo()
    assert value == pytest.approx(compute_mmd(a, b, bandwidth=2.0, subset_size=0), rel=1e-9)


def test_subsets_have_the_same_mean_and_the_bandwidth_of_all_rows():
    a, b = normal(8, 400), normal(9, 300, offset=0.5)
    whole = compute_mmd(a, b, subset_size=0)
    drawn = [compute_mmd(a, b, subset_size=100, num_subsets=12, seed=seed) for seed in (0, 0, 1)]
    assert drawn[0] == drawn[1] != drawn[2] and drawn[0] == pytest.approx(whole, rel=0.15)
    assert mmd.compute(a, b, mmd.Options()) == {"mmd": whole}  # 100 subsets of 1,000 rows have more pairs


def test_scores_are_named_after_a_given_bandwidth_and_bad_options_are_refused():
    a, b = normal(10, 30), normal(11, 30)
    assert mmd.compute(a, b, mmd.Options(bandwidth=10)) == {"mmd_sigma10": compute_mmd(a, b, bandwidth=10.0)}
    for bad in (0, -1, float("inf"), float("nan"), "mean"):
        with pytest.raises(ValueError, match="bandwidth"):
            mmd.Options(bandwidth=bad)
    with pytest.raises(ValueError, match="bandwidth must be 'median' or a number above 0, got 0"):
        compute_mmd(a, b, bandwidth=0.0)
    with pytest.raises(ValueError, match="2 rows or more"):
        mmd.Options(subset_size=1)
