"""Time surface: against a slow loop, closed forms and properties."""

from __future__ import annotations

from math import exp

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.encodings.time_surface import Options, encode, render_image
from data_contracts.errors import DataError
from data_contracts.events import Events

SENSOR = (5, 4)
ROWS = st.lists(
    st.tuples(st.integers(0, 1000), st.integers(0, 4), st.integers(0, 3), st.integers(0, 1)), max_size=40
).map(sorted)


def make_events(rows: list[tuple[int, int, int, int]]) -> Events:
    """Rows of (t, x, y, p)."""
    t, x, y, p = np.array(rows, np.int64).reshape(-1, 4).T
    return Events(t.copy(), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), SENSOR)


def surface_of(rows, **options) -> np.ndarray:
    return encode(make_events(rows), np.array([[0, len(rows)]]), Options(**options))[0]


@settings(max_examples=60, deadline=None)
@given(ROWS, st.floats(10, 1e5))
def test_surfaces_equal_a_slow_loop(rows, tau_us):
    expected = np.zeros((2, SENSOR[1], SENSOR[0]))
    for t, x, y, p in rows:
        expected[1 - p, y, x] = exp(-(rows[-1][0] - t) / tau_us)
    np.testing.assert_allclose(surface_of(rows, tau_us=tau_us), expected, rtol=1e-6, atol=1e-37)
    without = surface_of(rows, tau_us=tau_us, polarity=False)
    np.testing.assert_allclose(without[0], expected.max(axis=0), rtol=1e-6, atol=1e-37)


@settings(max_examples=60, deadline=None)
@given(ROWS, st.floats(1, 1e4))
def test_pixels_with_events_are_above_0_and_at_most_1(rows, tau_us):
    surface = surface_of(rows, tau_us=tau_us)
    fired = np.zeros(surface.shape, bool)
    for _, x, y, p in rows:
        fired[1 - p, y, x] = True
    assert ((surface > 0) == fired).all() and (surface <= 1).all()
    assert not rows or surface.max() == 1


def test_one_time_constant_fades_to_1_over_e():
    surface = surface_of([(0, 0, 0, 1), (50_000, 4, 3, 0)])
    assert (surface[0, 0, 0], surface[1, 3, 4]) == (pytest.approx(exp(-1)), 1)


def test_events_of_long_ago_are_not_lost():
    surface = surface_of([(0, 0, 0, 1), (2**62, 4, 3, 0)], tau_us=1e-3)
    assert surface[0, 0, 0] == np.finfo(np.float32).tiny


def test_hard_windows():
    assert not surface_of([]).any()
    assert encode(make_events([]), np.zeros((0, 2), np.int64), Options()).shape == (0, 2, 4, 5)
    assert surface_of([(9, 1, 1, 0)])[1, 1, 1] == 1
    assert (surface_of([(5, x, 0, 1) for x in range(5)])[0, 0] == 1).all()
    assert surface_of([(0, 2, 2, 1)] * (2**16 + 1)).sum() == 1


def test_windows_are_independent_and_end_at_their_own_last_event():
    rows = [(0, 0, 0, 1), (10, 1, 0, 1), (1000, 2, 0, 1), (1010, 3, 0, 1)]
    together = encode(make_events(rows), np.array([[0, 2], [2, 4]]), Options(tau_us=10))
    assert together[1, 0, 0].tolist() == pytest.approx([0, 0, exp(-1), 1, 0])
    assert together[0, 0, 0].tolist() == pytest.approx([exp(-1), 1, 0, 0, 0])


@pytest.mark.parametrize("position", [(5, 0), (0, 4)])
def test_an_event_outside_the_sensor(position):
    with pytest.raises(DataError, match=r"event 1 at x = .* lies outside the sensor of 5 x 4 px"):
        surface_of([(0, 4, 3, 1), (1, *position, 1), (2, *position, 1)])


def test_time_stamps_that_go_back():
    with pytest.raises(DataError, match="t decreases at event 2: 9 us, then 8 us"):
        surface_of([(0, 0, 0, 1), (9, 0, 0, 1), (8, 0, 0, 1)])


def test_a_window_that_is_no_range():
    with pytest.raises(ValueError, match="window 0 must be a range within 1 events"):
        encode(make_events([(0, 0, 0, 1)]), np.array([[0, 2]]), Options())


def test_the_newest_of_the_pixels_that_share_an_image_pixel_counts():
    rows = [(0, 0, 0, 1), (10, 1, 0, 1), (20, 4, 3, 1)]
    surface = surface_of(rows, image_size=(1, 1), fit="stretch", resampling="events")
    assert surface[0, 0, 0] == 1


def test_images():
    options = Options(tau_us=100)
    image = render_image(surface_of([(0, 0, 0, 1), (100, 1, 0, 0)], tau_us=100)[None], options)[0]
    assert image[0, :2].tolist() == [[int(255 * exp(-1)), 0, 0], [0, 0, 255]]
    options = Options(tau_us=100, polarity=False)
    image = render_image(surface_of([(0, 0, 0, 1)], tau_us=100, polarity=False)[None], options)[0]
    assert image[0, 0].tolist() == [255] * 3 and image.sum() == 765
    assert not render_image(surface_of([])[None], Options()).any()
    with pytest.raises(ValueError, match=r"must be \[N, 2, H, W\] float32"):
        render_image(np.zeros((1, 2, 2, 2), np.uint16), Options())
