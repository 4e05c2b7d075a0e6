"""Distances to training frames against a slow search, and the share of close frames where it is known."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.scoring import memorisation
from ctlev_core.scoring.memorisation import check_memorisation, nearest_rows, small_pictures


def slow_nearest(rows, references, row_groups=None, reference_groups=None):
    """Every pair, one by one."""
    distances, nearest = [], []
    for number, row in enumerate(rows):
        best = (np.inf, -1)
        for other, reference in enumerate(references):
            if not row_groups or not reference_groups or row_groups[number] != reference_groups[other]:
                distance = float(np.sqrt(((row.astype(np.float64) - reference.astype(np.float64)) ** 2).sum()))
                best = min(best, (distance, other))
        distances.append(best[0])
        nearest.append(best[1])
    return np.array(distances), np.array(nearest)


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 1000),
    shape=st.tuples(st.integers(1, 30), st.integers(1, 30), st.integers(1, 8)),
    offset=st.sampled_from([0.0, 1e6]),
    grid=st.booleans(),
    grouped=st.booleans(),
)
def test_nearest_rows_are_those_of_a_slow_search(seed, shape, offset, grid, grouped):
    rng = np.random.default_rng(seed)
    # On a grid many rows are equal or equally near, where the first must be named.
    draw = (lambda *size: rng.integers(0, 3, size).astype(float)) if grid else lambda *size: rng.standard_normal(size)
    rows, references = draw(shape[0], shape[2]) + offset, draw(shape[1], shape[2]) + offset
    groups = {}
    if grouped:
        groups = {
            "row_groups": [f"recording {number % 3}" for number in range(shape[0])],
            "reference_groups": ["other", *(f"recording {number % 3}" for number in range(1, shape[1]))],
        }
    distances, nearest = nearest_rows(rows, references, **groups)
    expected = slow_nearest(rows, references, *groups.values())
    # Ties in exact arithmetic on the grid are ties in float64 too; elsewhere there are none.
    np.testing.assert_array_equal(nearest, expected[1])
    np.testing.assert_allclose(distances, expected[0], rtol=1e-13)


@pytest.mark.parametrize("values", [3, 1000])
def test_blocks_change_nothing(monkeypatch, values):
    rng = np.random.default_rng(0)
    rows, references = rng.integers(0, values, (50, 3)), rng.integers(0, values, (40, 3))
    groups = {"row_groups": np.arange(50) % 4, "reference_groups": np.arange(40) // 10}
    expected = nearest_rows(rows, references, **groups)
    monkeypatch.setattr(memorisation, "_BLOCK_NUMBERS", 90)
    monkeypatch.setattr(memorisation, "_ROWS_AT_ONCE", 7)
    for found, wanted in zip(nearest_rows(rows, references, **groups), expected, strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_many_references_are_not_copied(monkeypatch):
    monkeypatch.setattr(memorisation, "_BLOCK_NUMBERS", 100_000)
    references = np.random.default_rng(0).random((10_000, 256), np.float32)
    tracemalloc.start()
    nearest_rows(references[:20], references)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < references.nbytes / 2


def test_equal_rows_have_distance_0_far_from_the_origin():
    """Squared distances from norms alone would be off by 1e-4 here."""
    rows = np.random.default_rng(0).standard_normal((20, 64)) + 1e6
    distances, nearest = nearest_rows(rows, rows[::-1])
    assert (distances == 0).all() and nearest.tolist() == list(range(19, -1, -1))


def recordings(count, per_recording=10):
    return [f"r{row // per_recording}" for row in range(count)]


def test_a_generator_that_does_not_copy_has_1_percent_of_close_frames():
    rng = np.random.default_rng(1)
    training, generated = rng.standard_normal((3000, 4)), rng.standard_normal((3000, 4))
    found = check_memorisation(
        generated, training, training, training_recordings=recordings(3000), real_recordings=recordings(3000)
    )
    # Tolerance: four standard deviations of a binomial share of 3,000, of both sets.
    assert found.close_share == pytest.approx(0.01, abs=4 * np.sqrt(2 * 0.01 * 0.99 / 3000))
    assert found.low < 0.01 < found.high and found.ratio == pytest.approx(1, abs=0.05) and found.num_duplicates == 0


def test_copies_are_found_and_shown():
    rng = np.random.default_rng(2)
    training, generated = rng.standard_normal((400, 8)), rng.standard_normal((300, 8))
    generated[40:100] = training[100:160]
    generated[100:130] = training[200:230] + 1e-3
    found = check_memorisation(
        generated, training, training, training_recordings=recordings(400), real_recordings=recordings(400)
    )
    assert found.num_duplicates == 60
    # 90 of 300, and of the rest the 1 to 3 % that a threshold from 400 frames lets through.
    assert 0.3 <= found.close_share <= 0.33 and found.low > 0.2
    assert found.nearest[40:100].tolist() == list(range(100, 160))
    closest = found.closest(5)
    assert [pair[0] for pair in closest] == [40, 41, 42, 43, 44] and closest[0] == (40, 100, 0.0)


def test_closest_pairs_show_a_training_frame_once():
    training = np.arange(6.0)[:, None] * 100
    generated = np.concatenate([np.full((5, 1), 1.0), [[203.0]]])
    found = check_memorisation(
        generated, training, training, training_recordings=list("abcdef"), real_recordings=list("abcdef")
    )
    assert found.closest(4) == [(0, 0, 1.0), (5, 2, 3.0)]


def test_a_real_frame_is_not_compared_with_its_own_recording():
    """Ten equal frames a recording, recordings 1 apart: 0 within, 1 across."""
    training = np.repeat(np.arange(5.0), 10)[:, None]
    found = check_memorisation(
        training, training, training, training_recordings=recordings(50), real_recordings=recordings(50)
    )
    assert (found.real_distances == 1).all() and found.threshold == 1
    assert found.close_share == 1 and found.num_duplicates == 50


def test_constant_frames_and_single_rows():
    constant = np.ones((6, 3))
    found = check_memorisation(
        constant, constant, constant, training_recordings=list("aabbcc"), real_recordings=list("aabbcc")
    )
    # Recorded frames of other recordings are as equal: no frame is nearer than those, and duplicates are counted apart.
    assert found.close_share == 0 and found.num_duplicates == 6 and np.isnan(found.ratio)
    single = check_memorisation(
        np.zeros((1, 3)), np.ones((1, 3)), np.ones((1, 3)) * 2, training_recordings=["a"], real_recordings=["b"]
    )
    assert (
        single.distances[0] == pytest.approx(np.sqrt(3)) and np.isnan(single.low) and single.ratio == pytest.approx(1)
    )


def test_wrong_features_are_refused():
    good = np.zeros((4, 2))
    bad = good.copy()
    bad[2, 1] = np.nan

    def check(generated, training):
        check_memorisation(generated, training, good, training_recordings=list("abcd"), real_recordings=list("abcd"))

    with pytest.raises(ValueError, match="first is row 2"):
        check(bad, good)
    with pytest.raises(ValueError, match="first is row 2"):
        check(good, bad)
    with pytest.raises(ValueError, match="same number of features"):
        check(np.zeros((4, 3)), good)
    with pytest.raises(ValueError, match="0"):
        check(good[:0], good)
    with pytest.raises(ValueError, match="row 0 has no reference of another group"):
        check_memorisation(good, good, good, training_recordings=["a"] * 4, real_recordings=["a"] * 4)
    with pytest.raises(ValueError, match=r"groups must be \[4\]"):
        check_memorisation(good, good, good, training_recordings=["a"], real_recordings=["a"] * 4)


def test_small_pictures_forgive_a_shift():
    frames = np.zeros((3, 64, 96, 3), np.uint8)
    frames[0, 20:40, 30:34, 0] = frames[1, 20:40, 31:35, 0] = frames[2, 20:40, 70:74, 0] = 255
    features = small_pictures(frames).reshape(3, -1)
    assert features.shape == (3, 21 * 32 * 3)
    shifted, elsewhere = np.linalg.norm(features[1:] - features[0], axis=1)
    assert shifted < 0.35 * elsewhere
    # Area means keep the mean, and so does a blur away from the border.
    assert features.mean() * 255 == pytest.approx(frames.mean(), rel=0.01)
    with pytest.raises(ValueError, match="not empty"):
        small_pictures(frames[:0])
