"""A screen before a moving camera: pictures are exact means, and nothing moves faster than is said."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctlev_core.sensor.adaptive_rendering import RenderingOptions, simulate_rendered
from ctlev_core.sensor.options import SensorOptions
from ctlev_core.studio.camera_paths import MOTIONS, CameraPath, sample_camera_path
from ctlev_core.studio.moving_screen import MovingScreen
from data_contracts.errors import DataError


def resting_at(x: float, y: float) -> CameraPath:
    return CameraPath(np.array([0.0, 1.0]), np.array([(x, y), (x, y)]))


def overlap(start: float, stop: float, count: int) -> np.ndarray:
    """How much of each of `count` unit intervals lies in [start, stop]."""
    edges = np.arange(count)
    return np.clip(np.minimum(edges + 1, stop) - np.maximum(edges, start), 0, None)


@given(
    texels=st.integers(1, 5),
    x=st.floats(-2, 2, allow_nan=False),
    y=st.floats(-2, 2, allow_nan=False),
    seed=st.integers(0, 10),
)
def test_a_pixel_sees_the_mean_over_its_area(texels, x, y, seed):
    width, height, margin = 5, 4, 2
    shape = (height + 2 * margin) * texels, (width + 2 * margin) * texels
    screen = np.random.default_rng(seed).uniform(0, 1, shape)
    picture = MovingScreen(screen, texels, (width, height), resting_at(x, y))(0.5)
    expected = np.empty((height, width))
    for row in range(height):
        for column in range(width):
            left, top = (margin + column + x) * texels, (margin + row + y) * texels
            weights = np.outer(overlap(top, top + texels, shape[0]), overlap(left, left + texels, shape[1]))
            expected[row, column] = (weights * screen).sum() / texels**2
    # float32 weights and means: a few units in the last place of numbers below 1.
    np.testing.assert_allclose(picture, expected, atol=1e-6)


def test_a_camera_that_looks_to_the_right_sees_the_picture_move_to_the_left():
    screen = np.zeros((8, 12))
    screen[4, 6] = 1.0
    path = CameraPath(np.array([0.0, 1.0]), np.array([(0.0, 0.0), (2.0, 1.0)]))
    seen = MovingScreen(screen, 1, (8, 6), path)
    assert np.argwhere(seen(0.0)).tolist() == [[3, 4]] and np.argwhere(seen(1.0)).tolist() == [[2, 2]]


def test_a_path_must_stay_on_the_screen():
    MovingScreen(np.ones((10, 10)), 2, (3, 3), resting_at(1.0, -1.0))(0.0)
    with pytest.raises(DataError, match=r"10 x 10 texels leave \[2.0, 2.0\] .* path goes \[2.2, 0.0\]"):
        MovingScreen(np.ones((10, 10)), 2, (3, 3), resting_at(1.1, 0.0))
    with pytest.raises(DataError, match=r"expected \[h, w\]"):
        MovingScreen(np.ones((10, 10, 3)), 2, (3, 3), resting_at(0.0, 0.0))


@pytest.mark.parametrize("motion", MOTIONS)
@given(
    seed=st.integers(0, 100),
    times=st.lists(st.floats(-0.1, 0.5, allow_nan=False), min_size=2, max_size=2),
)
def test_no_camera_is_faster_than_its_bound(motion, seed, times):
    path = sample_camera_path(np.random.default_rng(seed), motion, 4.0, 0.3)
    start, stop = sorted(times)
    moments = np.linspace(start, stop, 200)
    positions = np.array([path.position_px(t) for t in moments])
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    bound = path.speed_bound_px_s(start, stop)
    assert (steps <= bound * np.diff(moments) + 1e-9).all()


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_bound_is_reached_and_costs_no_needless_frames(motion):
    path = sample_camera_path(np.random.default_rng(3), motion, 4.0, 0.3)
    for start, stop in ((0.0, 0.3), (0.01, 0.04), (0.12, 0.13)):
        moments = np.linspace(start, stop, 500)
        positions = np.array([path.position_px(t) for t in moments])
        fastest = (np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.diff(moments)).max()
        # Samples lie beside the peak, and across the corners of a circle.
        assert path.speed_bound_px_s(start, stop) == pytest.approx(fastest, rel=0.01)


@pytest.mark.parametrize("motion", MOTIONS)
def test_paths_go_as_far_as_they_say_and_closed_ones_return(motion):
    path = sample_camera_path(np.random.default_rng(1), motion, 4.0, 0.3)
    positions = np.array([path.position_px(t) for t in np.linspace(0, 0.3, 500)])
    assert np.ptp(positions, axis=0).max() <= 4.0 + 1e-9 and path.extent_px.max() <= 2.0 + 1e-9
    closed = np.allclose(positions[0], positions[-1], atol=1e-9)
    assert closed == (motion != "drift")
    if closed:
        np.testing.assert_allclose(np.ptp(positions, axis=0), 4.0, rtol=0.02)


def test_saccades_are_three_and_rest_in_between():
    path = sample_camera_path(np.random.default_rng(0), "saccades", 4.0, 0.3)
    assert path.speed_bound_px_s(0.071, 0.099) == path.speed_bound_px_s(0.171, 0.199) == 0.0
    for start in (0.0, 0.1, 0.2):
        length = np.linalg.norm(path.position_px(start + 0.08) - path.position_px(start))
        assert 3.9 < length < 4.5
        # A raised cosine is twice as fast in the middle as on average.
        assert path.speed_bound_px_s(start, start + 0.07) == pytest.approx(2 * length / 0.07, rel=1e-9)
        assert path.speed_bound_px_s(start, start + 0.001) < 0.02 * length / 0.07


def test_paths_that_cannot_be_are_refused():
    with pytest.raises(DataError, match="times must ascend"):
        CameraPath(np.array([0.0, 0.0]), np.zeros((2, 2)))
    with pytest.raises(DataError, match="two or more times"):
        CameraPath(np.array([0.0, 1.0]), np.zeros((3, 2)))
    with pytest.raises(DataError, match="must be positive"):
        sample_camera_path(np.random.default_rng(0), "circle", 0.0, 1.0)


def test_an_edge_that_passes_sends_the_events_of_its_contrast():
    """A step of log intensity 1 and thresholds of 0.19 and 0.18: 5 ON events a pixel on the way, 5 OFF on the way back.

    The thresholds differ, so that the fifth OFF event does not hang on rounding: it comes at 5 x 0.19 - 5 x 0.18.
    """
    screen = np.full((40, 64), 0.2)
    screen[:, 32:] = 0.2 * np.e
    there_and_back = CameraPath(np.array([0.0, 0.05, 0.1]), np.array([(-3.0, 0.0), (3.0, 0.0), (-3.0, 0.0)]))
    seen = MovingScreen(screen, 4, (10, 10), there_and_back)
    sensor = SensorOptions(threshold=0.19, threshold_off=0.18, starts_settled=False)
    events, times_us = simulate_rendered(
        seen, 0, 100_000, sensor, RenderingOptions(), sensor_seed=0, seed=0, speed_bound=seen.speed_bound
    )
    # The edge lies at x = 5 in the middle and goes 3 px to either side: it passes columns 2 to 7.
    for polarity in (0, 1):
        at = events.p == polarity
        counts = np.bincount(events.y[at].astype(int) * 10 + events.x[at], minlength=100).reshape(10, 10)
        assert (counts[:, 2:8] == 5).all() and counts.sum() == 300
    assert (events.t[events.p == 1] <= 50_000).all() and (events.t[events.p == 0] >= 50_000).all()
    # 12 px of path, a quarter of a pixel at a time.
    assert 48 <= len(times_us) <= 52
