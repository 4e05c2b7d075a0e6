"""DHP19's event filters against slow loops written from the authors' MATLAB, with their indices from 1."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.dataset_files import dhp19_filters as filters

COLUMNS, ROWS = 4 * 346, 260


def background_filter(column, y, t, dt):
    """BackgroundFilter.m, with a dict for the map of times and indices from 1."""
    last, kept = {}, []
    for x_i, y_i, t_i in zip(column + 1, y + 1, t, strict=True):
        # uint32 arithmetic of MATLAB: a difference below zero is zero.
        kept.append(max(t_i - last.get((x_i, y_i), 0), 0) <= dt)
        if not (x_i == 1 or x_i == COLUMNS or y_i == 1 or y_i == ROWS):
            for dx in (-1, 0, 1):
                for dy in (-1, 0, 1):
                    last[x_i + dx, y_i + dy] = t_i
    return np.array(kept, bool)


def hot_pixel_filter(column, y, threshold):
    """HotPixelFilter.m."""
    counts = {}
    for pixel in zip(column, y, strict=True):
        counts[pixel] = counts.get(pixel, 0) + 1
    return np.array([counts[pixel] < threshold for pixel in zip(column, y, strict=True)], bool)


def mask_filter(column, y):
    """Twice maskRegionFilter.m with the bounds of Generate_DHP19.m, indices from 1."""
    x, y = column + 1, y + 1
    first = (x > 780) & (x < 810) & (y > 115) & (y < 145)
    second = (x > 346 * 3 + 214) & (x < 346 * 3 + 221) & (y > 136) & (y < 144)
    return ~first & ~second


@st.composite
def events(draw):
    """Events that crowd a few pixels, at borders, seams and masks, with gaps around 70 ms."""
    count = draw(st.integers(0, 60))
    corner = st.sampled_from([(0, 0), (345, 1), (346, 2), (1380, 256), (779, 112), (807, 143), (1251, 134), (690, 100)])
    x0, y0 = draw(corner)
    steps = st.sampled_from([0, 1, 69_999, 70_000, 70_001, 200_000])
    column = x0 + np.array(draw(st.lists(st.integers(0, 3), min_size=count, max_size=count)), np.int64)
    y = y0 + np.array(draw(st.lists(st.integers(0, 3), min_size=count, max_size=count)), np.int64)
    t = np.cumsum(np.array(draw(st.lists(steps, min_size=count, max_size=count)), np.int64))
    return column, y, t


@settings(max_examples=150, deadline=None)
@given(events())
def test_background_activity_is_the_authors_loop(case):
    column, y, t = case
    np.testing.assert_array_equal(filters.keep_supported(column, y, t), background_filter(column, y, t, 70_000))


@settings(max_examples=50, deadline=None)
@given(events(), st.integers(1, 6))
def test_hot_pixels_are_those_at_the_threshold_and_above(case, threshold):
    column, y, _ = case
    np.testing.assert_array_equal(
        filters.keep_cool_pixels(column, y, threshold), hot_pixel_filter(column, y, threshold)
    )


def test_exactly_ten_thousand_events_make_a_pixel_hot():
    column = np.repeat(np.array([5, 6]), [10_000, 9_999])
    keep = filters.keep_cool_pixels(column, np.zeros_like(column))
    assert not keep[:10_000].any() and keep[10_000:].all()


def test_masks_cover_the_authors_pixels_and_no_others():
    column, y = (a.ravel() for a in np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)))
    keep = filters.keep_unmasked(column, y)
    np.testing.assert_array_equal(keep, mask_filter(column, y))
    masked = np.stack([column[~keep] // 346, column[~keep] % 346, y[~keep]], axis=1)
    assert np.unique(masked[:, 0]).tolist() == [2, 3]
    for channel, low, high in ((2, (88, 115), (116, 143)), (3, (214, 136), (219, 142))):
        of_channel = masked[masked[:, 0] == channel, 1:]
        assert tuple(of_channel.min(0)) == low and tuple(of_channel.max(0)) == high


def test_hot_pixels_are_gone_before_they_can_support_their_neighbours():
    num = 10_000
    column = np.append(np.full(num, 100), 101)
    y = np.full(num + 1, 50)
    t = 1_000_000 + np.arange(num + 1)
    assert filters.keep_supported(column, y, t)[-1]
    assert not filters.keep_events(column, y, t).any()


def test_masked_events_still_support_those_beside_them():
    column, y, t = np.array([780, 779]), np.array([120, 120]), np.array([1_000_000, 1_000_100])
    assert filters.keep_events(column, y, t).tolist() == [False, True]


@pytest.mark.parametrize("t", [[1_000_000, 1_000_100, 999_000], [70_000, 140_000, 140_001]])
def test_a_clock_that_goes_back_and_the_first_70_ms_are_as_in_the_authors_code(t):
    column, y, t = np.array([10, 10, 11]), np.array([10, 11, 10]), np.array(t)
    np.testing.assert_array_equal(filters.keep_supported(column, y, t), background_filter(column, y, t, 70_000))


def test_no_events():
    empty = np.zeros(0, np.int64)
    assert filters.keep_events(empty, empty, empty).shape == (0,)
