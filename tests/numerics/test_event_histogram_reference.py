"""The compiled event histogram against slow references that share no code with it."""

from __future__ import annotations

import statistics
from fractions import Fraction
from math import floor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.encodings.event_histogram import Options, encode, render_image
from ctlev_core.events.files import read_events_file
from ctlev_core.events.windows import cut
from data_contracts.config import Windows
from data_contracts.events import Events


def random_events(seed: int, num_events: int, sensor_size: tuple[int, int]) -> Events:
    """Events crowded around the middle, so that counts differ."""
    rng = np.random.default_rng(seed)
    width, height = sensor_size
    x = np.clip(rng.normal(width / 2, width / 8, num_events), 0, width - 1).astype(np.uint16)
    y = np.clip(rng.normal(height / 2, height / 8, num_events), 0, height - 1).astype(np.uint16)
    p = rng.integers(0, 2, num_events).astype(np.uint8)
    return Events(np.sort(rng.integers(0, 10**6, num_events)), x, y, p, sensor_size)


def slow_bin(pixel: int, num_sensor: int, num_image: int, scale: Fraction) -> int:
    """Image pixel that holds the centre of a sensor pixel, both axes centred on one another; may lie outside."""
    return floor((pixel + Fraction(1, 2) - Fraction(num_sensor, 2)) * scale + Fraction(num_image, 2))


def slow_encode(events: Events, windows: np.ndarray, image_size: tuple[int, int], fit: str) -> np.ndarray:
    width, height = image_size
    scales = [Fraction(width, events.sensor_size[0]), Fraction(height, events.sensor_size[1])]
    if fit != "stretch":
        scales = [min(scales) if fit == "pad" else max(scales)] * 2
    bins = [
        np.array([slow_bin(pixel, num_sensor, num_image, scale) for pixel in range(num_sensor)])
        for num_sensor, num_image, scale in zip(events.sensor_size, image_size, scales, strict=True)
    ]
    result = np.zeros((len(windows), 2, height, width), np.int64)
    for window, (start, stop) in enumerate(windows):
        part = events.slice(start, stop)
        column, row = bins[0][part.x], bins[1][part.y]
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        np.add.at(result[window], (1 - part.p[inside].astype(int), row[inside], column[inside]), 1)
    return np.minimum(result, 65535)


@pytest.mark.parametrize("fit", ["pad", "crop", "stretch"])
@pytest.mark.parametrize(
    ("sensor_size", "image_size"),
    [
        ((346, 260), (346, 260)),
        ((346, 260), (344, 260)),
        ((346, 260), (256, 256)),
        ((64, 48), (96, 31)),
        ((5, 7), (1, 1)),
    ],
)
def test_counts_equal_the_slow_loop(sensor_size, image_size, fit):
    events = random_events(1, 20_000, sensor_size)
    windows = np.array([[0, 7500], [7500, 15000], [3, 3], [19_999, 20_000], [0, 20_000]])
    expected = slow_encode(events, windows, image_size, fit)
    counts = encode(events, windows, Options(image_size=image_size, fit=fit, resampling="events"))
    assert (counts == expected).all()
    options = Options(image_size=image_size, fit=fit, polarity=False, resampling="events")
    without = encode(events, windows, options)
    assert (without[:, 0] == expected.sum(axis=1)).all()


@pytest.mark.parametrize("name", ["person", "spot", "street"])
def test_real_windows_equal_the_slow_loop(name, real_recordings):
    events = read_events_file(next((real_recordings / name).iterdir()))
    windows = cut(events, Windows.model_validate({"max_windows": 5}))
    expected = slow_encode(events, windows, events.sensor_size, "pad")
    assert (encode(events, windows, Options()) == expected).all()
    assert (expected.sum(axis=(1, 2, 3)) == 7500).all()


def slow_three_sigma(counts: np.ndarray) -> np.ndarray:
    """DHP19's normalizeImage3Sigma.m, extended to channels [C, H, W] that share the sigma of their sum."""
    total = [int(value) for value in counts.sum(axis=0, dtype=np.int64).ravel() if value > 0]
    sigma = statistics.stdev(total) if len(total) > 1 else 0.0  # exact rational arithmetic inside
    full_scale = 3 * max(sigma, 0.1 / 255)
    return np.array([min(255, floor(255 * int(count) / full_scale)) for count in counts.ravel()]).reshape(counts.shape)


def check_three_sigma(counts: np.ndarray) -> None:
    """Equal to the reference, except where 255 n / (3 sigma) is a whole number and the last bit of sigma decides."""
    images = render_image(counts[None], Options(polarity=len(counts) == 2))
    expected = slow_three_sigma(counts)
    got = np.stack([images[0, ..., 0], images[0, ..., 2]])[: len(counts)].astype(int)
    assert np.abs(got - expected).max() <= 1
    assert (got != expected).mean() < 0.01


@pytest.mark.parametrize("polarity", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_three_sigma_equals_the_slow_reference(seed, polarity):
    events = random_events(seed, 7500, (86, 65))
    check_three_sigma(encode(events, np.array([[0, 7500]]), Options(polarity=polarity))[0])


@settings(max_examples=100, deadline=None)
@given(st.lists(st.sampled_from([0, 0, 1, 2, 3, 50, 65535]), min_size=12, max_size=12), st.sampled_from([1, 2]))
def test_three_sigma_on_a_few_pixels(values, channels):
    counts = np.array(values, np.uint16).reshape(channels, 3, -1)
    images = render_image(counts[None], Options(polarity=channels == 2))
    got = np.stack([images[0, ..., 0], images[0, ..., 2]])[:channels].astype(int)
    assert np.abs(got - slow_three_sigma(counts)).max() <= 1


def test_three_sigma_keeps_small_differences_of_large_counts():
    # Counts 65,534 and 65,535: with sums of squares in 32-bit floats their sigma would come out as 0 or NaN.
    counts = np.full((1, 1, 512, 512), 65535, np.uint16)
    counts[0, 0, ::2] = 65534
    from ctlev_core.events.histogram_kernels import full_scales

    scales = np.empty(1)
    full_scales(counts, scales)
    n = 512 * 512
    assert scales[0] == pytest.approx(3 * np.sqrt(0.25 * n / (n - 1)), rel=1e-12)
