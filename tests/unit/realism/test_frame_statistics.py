"""Statistics of single event images against slow definitions and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.realism.frame_statistics import (
    count_hot,
    count_isolated,
    neighbour_correlation,
    power_shares,
    radial_frequencies,
    rms_contrast,
)
from ctlev_core.realism.summary import AXES, summarise_frames

SEEDS = st.integers(0, 2**31)


def sparse_image(seed: int, share: float = 0.3, size: tuple[int, int] = (7, 9)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.integers(25, 256, size) * (rng.random(size) < share)).astype(np.uint8)


def neighbours(image: np.ndarray, row: int, column: int) -> list[int]:
    near = image[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].reshape(-1).tolist()
    near.remove(image[row, column])
    return near


@settings(max_examples=50, deadline=None)
@given(SEEDS)
def test_isolated_and_hot_pixels_equal_loops_over_neighbours(seed):
    image = sparse_image(seed)
    active = image > 0
    places = list(np.ndindex(*image.shape))
    assert count_isolated(active) == sum(active[place] and not any(neighbours(active, *place)) for place in places)
    hot = [image[place] >= 128 and image[place] > 4 * max(1, sorted(neighbours(image, *place))[-2]) for place in places]
    assert count_hot(image) == sum(hot)


def test_two_hot_pixels_may_touch_and_a_bright_area_is_not_hot():
    image = np.zeros((8, 8), np.uint8)
    image[2, 2:4] = 255
    assert count_hot(image) == 2
    image[2:5, 2:5] = 255
    assert count_hot(image) == 0


@settings(max_examples=30, deadline=None)
@given(SEEDS)
def test_the_correlation_is_numpys_over_pairs_both_ways_round(seed):
    image = sparse_image(seed, 0.6).astype(float)
    pairs = [(image[r, c], image[r + dr, c + dc]) for r in range(7) for c in range(9) for dr, dc in ((0, 1), (1, 0))
             if r + dr < 7 and c + dc < 9]  # fmt: skip
    both = np.array(pairs + [pair[::-1] for pair in pairs])
    expected = np.corrcoef(both.T)[0, 1]
    assert neighbour_correlation(image.astype(np.uint8)) == pytest.approx(expected, abs=1e-12)


def test_correlation_of_noise_a_slope_and_a_chequerboard():
    rows, columns = np.indices((64, 64))
    assert neighbour_correlation(((rows + columns) % 2 * 200).astype(np.uint8)) == pytest.approx(-1)
    assert neighbour_correlation((rows + columns).astype(np.uint8)) > 0.99
    # Of independent values: four standard deviations.
    assert abs(neighbour_correlation(sparse_image(0, 0.5, (64, 64)))) < 4 / np.sqrt(2 * 64 * 63)


def test_contrast_of_half_black_half_white_is_a_half():
    image = np.zeros((4, 4), np.uint8)
    assert rms_contrast(image) == 0
    image[:2] = 255
    assert rms_contrast(image) == 0.5


@pytest.mark.parametrize(("axis", "cycles"), [(0, 4), (1, 10), (1, 16)])
def test_the_power_of_a_wave_lies_at_its_frequency(axis, cycles):
    wave = 100 + 90 * np.cos(2 * np.pi * cycles / 32 * np.indices((32, 32))[axis])
    shares = power_shares(np.rint(wave).astype(np.uint8))
    assert shares is not None and shares.sum() == pytest.approx(1)
    near = np.isclose(radial_frequencies((32, 32)), cycles / 32)
    # Rounding to whole grey levels puts a little elsewhere.
    assert shares[near].sum() > 0.999
    found = summarise_frames(np.rint(wave).astype(np.uint8)[None, ..., None].repeat(3, -1))
    centre = AXES["power_spectrum"].centres[found.distributions["power_spectrum"].argmax()]
    assert abs(centre - cycles / 32) <= 0.015 + 1e-9


def test_white_noise_has_power_where_frequencies_are():
    size = (32, 48)
    images = np.random.default_rng(0).integers(0, 256, (200, *size, 1)).astype(np.uint8).repeat(3, -1)
    axis = AXES["power_spectrum"]
    found = summarise_frames(images).distributions["power_spectrum"]
    counts = np.histogram(radial_frequencies(size).reshape(-1)[1:], axis.low + axis.width * np.arange(25))[0]
    np.testing.assert_allclose(found, counts / counts.sum(), atol=0.003)


def test_images_of_one_value_have_neither_correlation_nor_spectrum():
    grey = np.full((4, 5), 99, np.uint8)
    assert np.isnan(neighbour_correlation(grey)) and power_shares(grey) is None and count_hot(grey) == 0
    assert np.isnan(neighbour_correlation(np.zeros((1, 1), np.uint8)))
    frames = np.stack([grey, np.eye(4, 5, dtype=np.uint8) * 200])[..., None].repeat(3, -1)
    both, alone = summarise_frames(frames), summarise_frames(frames[1:])
    assert both.numbers["neighbour_correlation"] == alone.numbers["neighbour_correlation"]
    np.testing.assert_array_equal(both.distributions["power_spectrum"], alone.distributions["power_spectrum"])
    assert both.numbers["rms_contrast"] == alone.numbers["rms_contrast"] / 2
