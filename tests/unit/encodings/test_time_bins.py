"""Time bins: counts of the equal parts of a window, as colours."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.encodings import time_bins
from ctlev_core.events.image_grid import ImageFit, map_points
from ctlev_core.events.windows import time_bins as cut_bins
from data_contracts.errors import DataError
from data_contracts.events import Events


def events_at(t, x=None, y=None, sensor=(6, 5)):
    count = len(t)
    zeros = np.zeros(count, np.uint16)
    return Events(
        np.array(t, np.int64),
        zeros if x is None else np.array(x, np.uint16),
        zeros if y is None else np.array(y, np.uint16),
        np.zeros(count, np.uint8),
        sensor,
    )


def slow_bin(t, first, last, num_bins):
    return num_bins * (t - first) // (last - first + 1)


@given(st.lists(st.integers(0, 10**9), min_size=1, max_size=60), st.integers(1, 7))
def test_bins_are_those_of_the_formula(times, num_bins):
    t = np.sort(np.array(times, np.int64))
    ranges = cut_bins(t, np.array([[0, len(t)]]), num_bins)[0]
    expected = [slow_bin(int(time), int(t[0]), int(t[-1]), num_bins) for time in t]
    found = np.concatenate([np.full(stop - start, number) for number, (start, stop) in enumerate(ranges)])
    np.testing.assert_array_equal(found, expected)
    assert ranges[0, 0] == 0 and ranges[-1, 1] == len(t)
    np.testing.assert_array_equal(ranges[1:, 0], ranges[:-1, 1])


def test_empty_window_and_equal_times():
    t = np.array([5, 5, 5])
    assert cut_bins(t, np.array([[1, 1]]), 3).tolist() == [[[1, 1]] * 3]
    assert cut_bins(t, np.array([[0, 3]]), 3).tolist() == [[[0, 3], [3, 3], [3, 3]]]


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_counts_equal_a_slow_loop(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 200))
    t = np.sort(rng.integers(0, 1000, count))
    events = events_at(t, rng.integers(0, 6, count), rng.integers(0, 5, count))
    middle = int(rng.integers(0, count + 1))
    windows = np.array([[0, middle], [middle, count]])
    expected = np.zeros((2, 3, 5, 6), np.uint16)
    for row, (start, stop) in enumerate(windows):
        for event in range(start, stop):
            number = slow_bin(int(t[event]), int(t[start]), int(t[stop - 1]), 3)
            expected[row, number, events.y[event], events.x[event]] += 1
    np.testing.assert_array_equal(time_bins.encode(events, windows, time_bins.Options()), expected)


def test_bins_are_colours_of_one_scale():
    counts = np.zeros((1, 3, 5, 6), np.uint16)
    counts[0, :, 2, 3] = 1, 4, 8
    image = time_bins.render_image(counts, time_bins.Options(normalisation="count", full_scale_count=8))
    assert image[0, 2, 3].tolist() == [31, 127, 255]
    assert image.sum() == 31 + 127 + 255
    two = time_bins.render_image(counts[:, :2], time_bins.Options(num_bins=2, normalisation="count"))
    assert two[0, 2, 3].tolist() == [31, 127, 0]


def test_time_that_goes_back_is_refused():
    with pytest.raises(DataError, match="t decreases at event 1"):
        time_bins.encode(events_at([5, 4]), np.array([[0, 2]]), time_bins.Options())


@pytest.mark.parametrize(("sensor", "image"), [((34, 34), (32, 32)), ((6, 5), (9, 8)), ((7, 5), (4, 4))])
def test_centre_keeps_the_scale_and_whole_pixels(sensor, image):
    fit = {"fit": "centre", "image_size": image}
    counts = np.random.default_rng(0).integers(0, 9, (1, 3, sensor[1], sensor[0])).astype(np.uint16)
    options = time_bins.Options(normalisation="count", full_scale_count=8, **fit)
    made = time_bins.render_image(counts, options)[0]
    whole = time_bins.render_image(counts, time_bins.Options(normalisation="count", full_scale_count=8))[0]
    for y in range(sensor[1]):
        for x in range(sensor[0]):
            column, row = map_points(np.array([x + 0.5, y + 0.5]), sensor, ImageFit(**fit))
            if 0 <= column < image[0] and 0 <= row < image[1]:
                assert made[int(row), int(column)].tolist() == whole[y, x].tolist()
    inside = np.prod([min(pair) for pair in zip(sensor, image, strict=True)])
    assert (made.any(axis=-1)).sum() <= inside
