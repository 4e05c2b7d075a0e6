"""Voxel grid: against a slow loop over exact fractions, closed forms and properties."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.encodings.voxel_grid import Options, encode, map_points, render_image
from data_contracts.errors import DataError
from data_contracts.events import Events

SENSOR = (5, 4)
ROWS = st.lists(
    st.tuples(st.integers(0, 1000), st.integers(0, 4), st.integers(0, 3), st.integers(0, 1)), max_size=40
).map(sorted)


def make_events(rows: list[tuple[int, int, int, int]], sensor_size: tuple[int, int] = SENSOR) -> Events:
    """Rows of (t, x, y, p)."""
    t, x, y, p = np.array(rows, np.int64).reshape(-1, 4).T
    return Events(t.copy(), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), sensor_size)


def grid_of(rows, sensor_size=SENSOR, **options) -> np.ndarray:
    return encode(make_events(rows, sensor_size), np.array([[0, len(rows)]]), Options(**options))[0]


def slow_grid(rows: list[tuple[int, int, int, int]], num_bins: int) -> np.ndarray:
    """Zhu et al., equations 1 to 3, term by term in exact arithmetic; positive and negative apart [2, B, H, W]."""
    grid = np.zeros((2, num_bins, SENSOR[1], SENSOR[0]), object)
    for t, x, y, p in rows:
        span = rows[-1][0] - rows[0][0]
        position = Fraction((num_bins - 1) * (t - rows[0][0]), span) if span else Fraction(0)
        for b in range(num_bins):
            grid[1 - p, b, y, x] += max(Fraction(0), 1 - abs(b - position))
    return grid.astype(float)


@settings(max_examples=60, deadline=None)
@given(ROWS, st.integers(1, 6))
def test_grids_equal_the_formula(rows, num_bins):
    expected = slow_grid(rows, num_bins)
    np.testing.assert_allclose(grid_of(rows, num_bins=num_bins), expected[0] - expected[1], atol=1e-6)
    separate = grid_of(rows, num_bins=num_bins, polarity="separate")
    np.testing.assert_allclose(separate, np.concatenate(list(expected)), atol=1e-6)
    np.testing.assert_allclose(grid_of(rows, num_bins=num_bins, polarity="discarded"), expected.sum(axis=0), atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(ROWS, st.integers(1, 9))
def test_the_sum_is_the_signed_or_the_whole_number_of_events(rows, num_bins):
    signed = sum(2 * row[3] - 1 for row in rows)
    assert grid_of(rows, num_bins=num_bins).sum(dtype=float) == pytest.approx(signed, abs=1e-4)
    for polarity in ("separate", "discarded"):
        grid = grid_of(rows, num_bins=num_bins, polarity=polarity)
        assert grid.sum(dtype=float) == pytest.approx(len(rows), abs=1e-4)
        assert (grid >= 0).all()


def test_an_event_between_two_bins_is_shared_by_distance():
    rows = [(0, 0, 0, 1), (250, 2, 1, 0), (1000, 4, 3, 1)]
    grid = grid_of(rows, num_bins=3)
    assert (grid[0, 0, 0], grid[2, 3, 4]) == (1, 1)
    assert grid[:, 1, 2].tolist() == [-0.5, -0.5, 0]


def test_one_event_and_equal_time_stamps_are_in_the_first_bin():
    assert grid_of([(7, 1, 1, 0)])[:, 1, 1].tolist() == [-1, 0, 0, 0, 0]
    assert grid_of([(2**62, 1, 1, 1)] * 3)[:, 1, 1].tolist() == [3, 0, 0, 0, 0]


def test_a_clock_that_jumps_by_centuries():
    grid = grid_of([(0, 0, 0, 1), (2**61, 1, 0, 1), (2**62, 2, 0, 1)], num_bins=5)
    assert (grid[0, 0, 0], grid[2, 0, 1], grid[4, 0, 2], grid.sum()) == (1, 1, 1, 3)


def test_no_events_and_no_windows():
    assert not grid_of([]).any()
    assert encode(make_events([]), np.zeros((0, 2), np.int64), Options()).shape == (0, 5, 4, 5)


def test_many_events_on_one_pixel_lose_none():
    rows = [(0, 1, 1, 1)] * (2**16 + 1)
    assert grid_of(rows, polarity="discarded")[0, 1, 1] == 2**16 + 1


@pytest.mark.parametrize("polarity", ["signed", "separate"])
def test_short_and_long_windows_leave_nothing_behind(polarity):
    # 5 x 90 x 100 cells: the short windows copy what they touch, the long one everything.
    rng = np.random.default_rng(0)
    size = (100, 90)
    rows = sorted(zip(*(rng.integers(0, n, 9000).tolist() for n in (10**6, *size, 2)), strict=True))
    events, options = make_events(rows, size), Options(polarity=polarity)
    windows = np.array([[0, 100], [100, 9000], [8900, 9000], [50, 50], [50, 51]])
    together = encode(events, windows, options)
    for window, grid in zip(windows, together, strict=True):
        part = events.slice(*window)
        touched = np.zeros(size[::-1], bool)
        touched[part.y, part.x] = True
        assert not grid[:, ~touched].any()
        total = np.where(part.p, 1, -1 if polarity == "signed" else 1).sum()
        assert grid.sum(dtype=float) == pytest.approx(total, abs=1e-3)
        assert (encode(events, window[None], options)[0] == grid).all()


def test_windows_have_their_own_time():
    rows = [(t, 0, 0, 1) for t in (0, 10, 500, 510)]
    grids = encode(make_events(rows), np.array([[0, 2], [2, 4]]), Options(num_bins=2))
    assert (grids[0] == grids[1]).all() and grids[0, :, 0, 0].tolist() == [1, 1]


def test_max_and_mean_std_normalisation():
    rows = [(0, 0, 0, 1), (0, 0, 0, 1), (0, 1, 0, 0), (0, 2, 0, 1)]
    grid = grid_of(rows, num_bins=1, normalisation="max")
    assert grid[0, 0].tolist() == [1, -0.5, 0.5, 0, 0]
    values = np.array([2, -1, 1.0])
    scaled = grid_of(rows, num_bins=1, normalisation="mean_std")[0, 0]
    np.testing.assert_allclose(scaled, [*((values - values.mean()) / values.std()), 0, 0], rtol=1e-6)
    for normalisation in ("max", "mean_std"):
        assert not grid_of([], normalisation=normalisation).any()
    assert grid_of(rows[:1], normalisation="mean_std").max() == 0
    assert grid_of(rows[:1], normalisation="max").max() == 1


@pytest.mark.parametrize("position", [(5, 0), (0, 4)])
def test_an_event_outside_the_sensor(position):
    with pytest.raises(DataError, match=r"event 1 at x = .* lies outside the sensor of 5 x 4 px"):
        grid_of([(0, 4, 3, 1), (1, *position, 1)])


def test_time_stamps_that_go_back():
    with pytest.raises(DataError, match="t decreases at event 2: 9 us, then 8 us"):
        grid_of([(0, 0, 0, 1), (9, 0, 0, 1), (8, 0, 0, 1)])


def test_a_window_that_is_no_range():
    with pytest.raises(ValueError, match="window 0 must be a range within 1 events"):
        encode(make_events([(0, 0, 0, 1)]), np.array([[0, 2]]), Options())


def test_scaled_images_keep_every_event_where_its_point_maps_to():
    rows = [(0, 4, 3, 1), (5, 0, 0, 1)]
    options = Options(image_size=(10, 8), polarity="discarded", resampling="events")
    grid = encode(make_events(rows), np.array([[0, 2]]), options)[0].sum(axis=0)
    x, y = map_points(np.array([4.5, 3.5]), SENSOR, options)
    assert grid[int(y), int(x)] == 1 and grid.sum() == 2


def test_images_are_red_where_positive_and_blue_where_negative():
    rows = [(0, 0, 0, 1), (0, 0, 0, 1), (0, 1, 0, 0), (0, 2, 0, 1), (0, 2, 0, 0)]
    for polarity, both in (("signed", [0, 0, 0]), ("separate", [127, 0, 127])):
        options = Options(num_bins=2, polarity=polarity, full_scale=2)
        image = render_image(grid_of(rows, **options.model_dump())[None], options)[0]
        assert image[0, :3].tolist() == [[255, 0, 0], [0, 0, 127], both] and image.sum() == 382 + sum(both)
    options = Options(num_bins=2, polarity="discarded", full_scale=4)
    image = render_image(grid_of(rows, **options.model_dump())[None], options)[0]
    assert image[0, :3].tolist() == [[127] * 3, [63] * 3, [127] * 3]
    assert not render_image(grid_of([])[None], Options()).any()


def test_full_scale_is_three_standard_deviations_of_the_pixels():
    rows = [(0, 0, 0, 1)] * 9 + [(0, 1, 0, 0)] * 2 + [(0, 2, 0, 1)] * 4
    image = render_image(grid_of(rows)[None], Options())[0, 0]
    full_scale = 3 * np.std([9, 2, 4], ddof=1)
    nine, two, four = (int(255 * count / full_scale) for count in (9, 2, 4))
    assert image[:4].tolist() == [[nine, 0, 0], [0, 0, two], [four, 0, 0], [0, 0, 0]]
    equal = render_image(grid_of([(0, 0, 0, 1), (0, 3, 1, 0)])[None], Options())[0]
    assert equal[0, 0].tolist() == [255, 0, 0] and equal[1, 3].tolist() == [0, 0, 255]


def test_images_of_other_arrays_are_refused():
    with pytest.raises(ValueError, match=r"must be \[N, 5, H, W\] float32"):
        render_image(np.zeros((1, 5, 2, 2), np.uint16), Options())
