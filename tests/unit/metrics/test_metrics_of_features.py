"""KID, FD-infinity, precision and coverage against slow loops and closed forms; intervals by counting."""

import hashlib
import math
import subprocess
import sys
from dataclasses import asdict
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import t

from ctlev_core.metrics import fd_infinity, frechet, kid, mmd, prdc
from ctlev_core.scoring.frechet import frechet_distance
from ctlev_core.scoring.frechet_extended import refined_frechet_distance
from ctlev_core.scoring.kid import compute_kid
from ctlev_core.scoring.prdc import compute_prdc
from ctlev_core.statistics.feature_distances import DISTANCE_ESTIMATES, estimate_distances, estimates_table
from data_contracts.config import cache_material
from data_contracts.errors import DataError
from data_contracts.tables import check_table


def normal(seed, count, width=6, scale=1.0, offset=0.0):
    return scale * np.random.default_rng(seed).normal(size=(count, width)) + offset


def slow_kid(a, b):
    """Binkowski et al., eq. 4, pair by pair."""

    def kernel(x, y):
        return (float(x @ y) / len(x) + 1) ** 3

    within = [
        sum(kernel(x, y) for i, x in enumerate(rows) for j, y in enumerate(rows) if i != j)
        / (len(rows) * (len(rows) - 1))
        for rows in (a, b)
    ]
    return sum(within) - 2 * sum(kernel(x, y) for x in a for y in b) / (len(a) * len(b))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 12), st.integers(2, 12), st.integers(1, 5), st.floats(-3, 3))
def test_kid_agrees_with_a_loop_over_pairs(seed, n, m, width, offset):
    a, b = normal(seed, n, width, 1.5, offset), normal(seed + 1, m, width, 1.0, offset)
    # The loop cancels numbers of the size of the kernel.
    size = max(1.0, (max(np.abs(a).max(), np.abs(b).max()) ** 2 + 1) ** 3)
    assert compute_kid(a, b) == pytest.approx(slow_kid(a, b), rel=1e-9, abs=1e-13 * size)


def test_the_reference_may_be_a_file_of_statistics(tmp_path):
    a, b = normal(1, 50), normal(2, 60, offset=0.3)
    file = tmp_path / "reference.npz"
    np.savez(file, mu=b.mean(axis=0), sigma=np.cov(b, rowvar=False))
    options = frechet.Options(statistics=str(file))
    assert frechet.input_files(options) == [file]
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    assert cache_material(options) == {"statistics": digest} and cache_material(frechet.Options()) == {"statistics": ""}
    # No matter which recorded frames there are.
    expected = {f"fd_to_{digest[:8]}": pytest.approx(frechet_distance(a, b), rel=1e-11)}
    assert frechet.compute(a, a[:3], options) == expected
    with pytest.raises(ValueError, match="same number of features, got 6 and 5"):
        frechet.compute(a, a, frechet.Options(statistics=str(_statistics(tmp_path / "five.npz", b[:, :5]))))
    assert frechet.compute(a, a, frechet.Options(statistics=str(_statistics(file, a)))).popitem()[1] < 1e-25
    with pytest.raises(DataError, match=r"expected option `statistics` to be an \.npz file, got .*absent"):
        frechet.input_files(frechet.Options(statistics=str(tmp_path / "absent")))


def _statistics(file, features):
    np.savez(file, mu=features.mean(axis=0), sigma=np.cov(features, rowvar=False))
    return file


def test_kid_of_large_offsets_keeps_its_digits():
    """Integers, so that a loop over Python's exact fractions of them is the truth."""
    from fractions import Fraction

    random = np.random.default_rng(0)
    a, b = (random.integers(-9, 9, size=(count, 4)) + 2**20 for count in (7, 9))
    rows = [[[Fraction(int(v)) for v in row] for row in features] for features in (a, b)]

    def mean(first, second, without_self):
        kernel = [
            (sum(x * y for x, y in zip(p, q, strict=True)) / 4 + 1) ** 3
            for i, p in enumerate(first)
            for j, q in enumerate(second)
            if not (without_self and i == j)
        ]
        return sum(kernel) / len(kernel)

    exact = mean(rows[0], rows[0], True) + mean(rows[1], rows[1], True) - 2 * mean(rows[0], rows[1], False)
    assert compute_kid(a, b) == pytest.approx(float(exact), rel=1e-10)


def test_subsets_of_kid_have_the_same_mean_and_a_seed():
    a, b = normal(1, 400), normal(2, 300, offset=0.5)
    whole = compute_kid(a, b, subset_size=0)
    drawn = [compute_kid(a, b, subset_size=100, num_subsets=12, seed=seed) for seed in (0, 0, 1)]
    assert drawn[0] == drawn[1] != drawn[2]
    assert drawn[0] == pytest.approx(whole, rel=0.15)
    assert kid.compute(a, b, kid.Options()) == {"kid": whole}  # 100 subsets of 1,000 rows have more pairs
    assert compute_kid(np.full((5, 3), 2.0), np.full((7, 3), 2.0)) == 0
    with pytest.raises(ValueError, match="at least 2 rows"):
        compute_kid(a, b, subset_size=1)


def test_kid_of_equal_distributions_lies_around_zero():
    values = [compute_kid(normal(seed, 60), normal(seed + 1000, 40)) for seed in range(60)]
    assert abs(np.mean(values)) < 3 * np.std(values) / np.sqrt(60)
    assert min(values) < 0 < max(values)


def slow_prdc(judged, reference, k):
    def radius(rows, i):
        return sorted(np.linalg.norm(rows - rows[i], axis=1))[k]

    real = [radius(reference, i) for i in range(len(reference))]
    made = [radius(judged, i) for i in range(len(judged))]
    inside = np.array([[np.linalg.norm(x - y) for y in judged] for x in reference])
    in_real = inside <= np.array(real)[:, None]
    return {
        "precision": in_real.any(axis=0).mean(),
        "recall": (inside <= np.array(made)).any(axis=1).mean(),
        "density": in_real.sum(axis=0).mean() / k,
        "coverage": in_real.any(axis=1).mean(),
    }


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(6, 25), st.integers(6, 25), st.integers(1, 5), st.floats(0, 3))
def test_neighbour_scores_agree_with_a_loop(seed, n, m, k, offset):
    judged, reference = normal(seed, n, 4, 1.0, offset), normal(seed + 1, m, 4)
    assert compute_prdc(judged, reference, k) == pytest.approx(slow_prdc(judged, reference, k))


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), st.integers(200, 700), st.integers(1, 5), st.sampled_from([0.1, 1.0, 8.0]))
def test_neighbours_among_many_rows_are_the_nearest(seed, n, k, steps):
    judged, reference = np.round(steps * normal(seed, n, 3)), np.round(steps * normal(seed + 1, 431, 3))
    squared = [
        np.square(a[:, None] - b).sum(axis=2)
        for a, b in ((judged, judged), (reference, reference), (reference, judged))
    ]
    made, real = (np.sort(each, axis=1)[:, k] for each in squared[:2])
    inside = squared[2] <= real[:, None]
    expected = {
        "precision": inside.any(axis=0).mean(),
        "recall": (squared[2] <= made).any(axis=1).mean(),
        "density": inside.sum() / (k * n),
        "coverage": inside.any(axis=1).mean(),
    }
    assert compute_prdc(judged, reference, k) == pytest.approx(expected)


def test_neighbour_scores_where_rows_repeat_and_far_from_the_origin():
    a = normal(3, 50)
    identical = compute_prdc(a, a.copy(), 3)
    assert identical["precision"] == identical["recall"] == identical["coverage"] == 1
    constant = np.full((9, 2), 5.0)
    everything = {"precision": 1.0, "recall": 1.0, "coverage": 1.0}
    assert compute_prdc(constant, constant, 3) == everything | {"density": 3.0}
    assert set(compute_prdc(constant + 1, constant, 3).values()) == {0.0}
    judged, reference = np.round(64 * normal(4, 60)), np.round(64 * normal(5, 50))
    far = compute_prdc(judged + 2.0**40, reference + 2.0**40, 5)
    assert far == compute_prdc(judged, reference, 5)
    with pytest.raises(ValueError, match=r"5 neighbours need .* got 60 and 5"):
        compute_prdc(judged, reference[:5], 5)


@pytest.mark.parametrize(("count", "width"), [(7, 64), (7, 301), (33, 301), (7, 2048)])
def test_rounding_puts_no_copy_out_of_the_ball_of_its_original(count, width):
    """Where rows repeat, balls have no radius, and distances of 0 come out as differences of rounded numbers."""
    for seed in range(6):
        rows = normal(seed, count, width, offset=3)
        found = compute_prdc(rows, np.repeat(rows, 7, axis=0), 5)
        assert found["precision"] == found["coverage"] == 1


def test_prdc_names_its_neighbours():
    a, b = normal(6, 40), normal(7, 40)
    found = prdc.compute(a, b, prdc.Options(num_neighbours=3))
    assert found == {f"{name}_k3": value for name, value in compute_prdc(a, b, 3).items()}


def test_fd_infinity_takes_away_the_bias_of_small_sets():
    """Both Gaussians have a standard deviation of 1 in each of 16 directions, half a unit apart in one: 0.25."""
    plain, extrapolated = [], []
    for seed in range(40):
        a, b = normal(seed, 120, 16), normal(seed + 500, 120, 16)
        a[:, 0] += 0.5
        plain.append(frechet_distance(a, b))
        extrapolated.append(fd_infinity.compute(a, b, fd_infinity.Options())["fd_infinity"])
    assert np.mean(plain) > 0.25 + 0.5
    # The second order of the bias is left: a few per cent of the first at 60 rows a half and 16 features.
    assert np.mean(extrapolated) == pytest.approx(0.25, abs=0.06)


def test_fd_infinity_is_a_line_through_the_distances_of_parts():
    a, b = normal(8, 90), normal(9, 60, offset=1)
    options = fd_infinity.Options(max_parts=3, num_divisions=2)
    found = fd_infinity.compute(a, b, options)["fd_infinity"]
    assert found == fd_infinity.compute(a, b, options)["fd_infinity"]
    assert found != fd_infinity.compute(a, b, options.model_copy(update={"seed": 1}))["fd_infinity"]
    assert 0 < found < frechet_distance(a, b)
    with pytest.raises(ValueError, match="3 parts need 6 rows or more, got 90 and 5"):
        fd_infinity.compute(a, b[:5], options)


@pytest.mark.parametrize("metric", [frechet, kid, mmd, fd_infinity, prdc])
def test_distances_name_bad_rows(metric):
    a = normal(10, 30)
    broken = a.copy()
    broken[7, 2] = np.nan
    with pytest.raises(ValueError, match=r"second set: .* 1 of 30 rows are not, the first is row 7"):
        metric.compute(a, broken, metric.Options())
    with pytest.raises(ValueError, match=r"first set: .* at least 2 rows, got 1"):
        metric.compute(a[:1], a, metric.Options())
    with pytest.raises(ValueError, match="same number of features, got 6 and 4"):
        metric.compute(a, a[:, :4], metric.Options())


def score(a, b):
    return {"fd": frechet_distance(a, b), "kid": compute_kid(a, b)}


@pytest.mark.parametrize(
    ("shift", "frames"),
    [pytest.param(0.5, 1, marks=pytest.mark.slow), (0.5, 4), pytest.param(0.0, 1, marks=pytest.mark.slow)],
)
def test_intervals_cover_the_mean_score_as_often_as_they_say(shift, frames):
    """The mean over 200 draws is what sets of these sizes score on average; frames of a recording resemble another."""

    def draw(seed):
        random = np.random.default_rng(seed)
        scenes = random.normal(size=(60, 1, 4)) + 0.3 * random.normal(size=(60, frames, 4))
        return scenes.reshape(-1, 4) + shift, random.normal(size=(70, 4)) * 1.05

    truth = {name: np.mean([score(*draw(10_000 + seed))[name] for seed in range(200)]) for name in ("fd", "kid")}
    hits = {"fd": 0, "kid": 0}
    for seed in range(40):
        a, b = draw(seed)
        found = estimate_distances(score, a, b, predicted_groups=np.repeat(np.arange(60), frames), num_splits=10)
        for name, estimate in found.items():
            hits[name] += int(estimate.low <= truth[name] <= estimate.high)
    # 95 % of 40 is 38; three deviations are 4, and equal distributions have intervals that are too wide.
    assert min(hits.values()) >= 34


def test_a_percentile_bootstrap_would_miss_the_value_itself():
    """Why halves are used: a resampled set holds fewer different rows, and lies further away."""
    a, b = normal(11, 60, 20), normal(12, 60, 20)
    random = np.random.default_rng(0)
    resampled = [frechet_distance(a[random.integers(60, size=60)], b[random.integers(60, size=60)]) for _ in range(60)]
    value = frechet_distance(a, b)
    assert np.quantile(resampled, 0.025) > value
    estimate = estimate_distances(lambda x, y: {"fd": frechet_distance(x, y)}, a, b)["fd"]
    assert estimate.low < value == estimate.value < estimate.high


def test_floor_and_halves_say_what_small_sets_do():
    same = estimate_distances(score, normal(13, 100), normal(14, 100))["fd"]
    far = estimate_distances(score, normal(13, 100, offset=2), normal(14, 100))["fd"]
    assert same.halved > same.value and same.floor_low < same.floor < same.floor_high
    # A perfect set lies at the floor, another above it; both floors are of the same reference set and splits.
    assert same.halved == pytest.approx(same.floor, rel=0.2)
    assert far.floor == same.floor and far.halved > 5 * far.floor
    assert (same.num_predicted, same.num_target, same.num_features) == (100, 100, 6)
    assert estimate_distances(score, normal(13, 100), normal(14, 100))["fd"] == same


@pytest.mark.parametrize(("recordings", "degrees"), [(5, 4), (60, 19)])
def test_t_has_the_degrees_of_freedom_of_splits_or_recordings_whichever_are_fewer(recordings, degrees):
    seen = []

    def mean_difference(a, b):
        seen.append(float(a.mean() - b.mean()))
        return {"difference": seen[-1]}

    groups = np.arange(60) % recordings
    found = estimate_distances(mean_difference, normal(1, 60), normal(2, 60), predicted_groups=groups)["difference"]
    # The whole sets, then for each of 20 splits both pairs of halves and the halves of the second set.
    halves = np.array(seen[1:]).reshape(20, 3)
    deviation = np.sqrt(np.mean((halves[:, 0] - halves[:, 1]) ** 2)) / 2
    assert found.high - found.value == pytest.approx(t.ppf(0.975, degrees) * deviation)


def test_either_half_of_an_odd_number_of_recordings_is_the_larger():
    sizes = []

    def count(a, b):
        sizes.append(len(a))
        return {"rows": 0.0}

    estimate_distances(count, normal(1, 7), normal(2, 8))
    assert set(sizes[1::3]) == set(sizes[2::3]) == {3, 4}


def test_intervals_do_without_the_slow_import():
    code = (
        "import sys, numpy as np; from ctlev_core.statistics.feature_distances import estimate_distances; "
        "found = estimate_distances(lambda a, b: {'sum': a.sum()}, np.diag(np.arange(8.0)), np.eye(8)); "
        "print(found['sum'].high > found['sum'].value, 'scipy.stats' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["True", "False"]


def test_estimates_become_rows_with_what_they_have_to_be_read_with():
    full = estimate_distances(score, normal(13, 100), normal(14, 90))
    alone = estimate_distances(score, normal(13, 4), normal(14, 3))
    table = estimates_table("made", {"x": full["fd"], "y": alone["fd"]})
    rows = check_table(table, DISTANCE_ESTIMATES, "here").to_pylist()
    expected = [
        {"subject": "made", "metric": name, **{k: None if math.isnan(v) else v for k, v in asdict(found["fd"]).items()}}
        for name, found in (("x", full), ("y", alone))
    ]
    assert rows == expected and rows[1]["floor"] is None and (rows[0]["num_target"], rows[0]["num_features"]) == (90, 6)


def test_too_few_recordings_leave_the_value_alone():
    a, b = normal(15, 40), normal(16, 30)
    few = estimate_distances(score, a, b, predicted_groups=np.repeat(list("abcd"), 10))["fd"]
    assert few.value == frechet_distance(a, b) and np.isnan([few.low, few.high, few.halved, few.floor]).all()
    # Halves of eight rows have no ten neighbours.
    short = estimate_distances(lambda x, y: compute_prdc(x, y, 6), a[:12], b)["precision"]
    assert 0 <= short.value <= 1 and np.isnan(short.low)
    with pytest.raises(ValueError, match=r"groups must be \[30\]"):
        estimate_distances(score, a, b, target_groups=["a"])
    with pytest.raises(ValueError, match="level"):
        estimate_distances(score, a, b, level=1.0)
    with pytest.raises(ValueError, match="at least 2 rows"):
        estimate_distances(score, a[:1], b)


@pytest.mark.parametrize("size", [1e49, 1e52, 1e60, 1e150, 1e200, 1e300])
def test_kid_of_huge_features_is_a_number_or_an_error(size):
    a, b = normal(0, 20) * size, normal(1, 20) * size
    if size < 1e50:
        value = compute_kid(a, b)
        exact = [[[Fraction(x) for x in row] for row in rows] for rows in (a, b)]
        assert np.isclose(value, float(exact_kid(*exact)), rtol=1e-9)
        return
    with pytest.raises(DataError, match="are too large for KID: their kernel is beyond 1e308"):
        compute_kid(a, b)


def exact_kid(a, b):
    """Unbiased MMD in fractions."""

    def mean(rows, others, pairs):
        width = len(rows[0])
        return sum(
            (sum(x * y for x, y in zip(p, q, strict=True)) / width + 1) ** 3 for p, q in pairs(rows, others)
        ) / len(list(pairs(rows, others)))

    def different(rows, _):
        return [(p, q) for i, p in enumerate(rows) for j, q in enumerate(rows) if i != j]

    def all_pairs(rows, others):
        return [(p, q) for p in rows for q in others]

    return mean(a, a, different) + mean(b, b, different) - 2 * mean(a, b, all_pairs)


@pytest.mark.parametrize("size", [1e-200, 1e120, 1e150])
def test_frechet_distance_scales_with_the_square_of_the_features(size):
    a, b = normal(0, 20), normal(1, 20)
    assert np.isclose(frechet_distance(a * size, b * size) / size, frechet_distance(a, b) * size, rtol=1e-9)


@pytest.mark.parametrize("size", [1e160, 1e200, 1e300])
def test_a_frechet_distance_beyond_float64_is_an_error(size):
    with pytest.raises(DataError, match="the squared distance is beyond 1e308"):
        refined_frechet_distance(normal(0, 20) * size, normal(1, 20) * size)


@pytest.mark.parametrize("size", [1e-200, 1e160, 1e300])
def test_neighbours_do_not_change_with_the_scale(size):
    a, b = normal(0, 40), normal(1, 40, offset=0.5)
    assert compute_prdc(a * size, b * size) == compute_prdc(a, b)
