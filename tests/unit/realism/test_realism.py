"""Realism numbers on constructed data whose answers are known."""

from __future__ import annotations

from math import exp, log10

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.realism.summary import AXES, HOT_MIN_EVENTS, RADIUS_US, summarise_events, summarise_frames
from data_contracts.events import Events


def make_events(rows: list[tuple[int, int, int, int]], sensor_size: tuple[int, int] = (8, 6)) -> Events:
    """Rows of (t, x, y, p), in order of time."""
    t, x, y, p = np.array(sorted(rows), np.int64).reshape(-1, 4).T
    return Events(t.copy(), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), sensor_size)


def poisson_noise(rate_hz: float, seconds: float, sensor_size: tuple[int, int], seed: int = 0) -> list[tuple]:
    """Every pixel fires at random times of its own."""
    rng = np.random.default_rng(seed)
    count = rng.poisson(rate_hz * seconds * sensor_size[0] * sensor_size[1])
    columns = (
        rng.integers(0, round(seconds * 1e6), count),
        rng.integers(0, sensor_size[0], count),
        rng.integers(0, sensor_size[1], count),
        rng.integers(0, 2, count),
    )
    return list(zip(*(column.tolist() for column in columns), strict=True))


def test_noise_of_a_known_rate():
    rate, seconds, size = 2.0, 10.0, (64, 48)
    summary = summarise_events(make_events(poisson_noise(rate, seconds, size), size))
    count = rate * seconds * size[0] * size[1]
    # Tolerance: four standard deviations of a Poisson count.
    assert summary.numbers["noise_rate_hz"] == pytest.approx(rate, rel=4 / np.sqrt(count))
    assert summary.numbers["pixel_rate_hz"] == pytest.approx(rate, rel=4 / np.sqrt(count))
    assert summary.numbers["event_rate_mev_s"] == pytest.approx(rate * size[0] * size[1] / 1e6, rel=4 / np.sqrt(count))
    assert summary.numbers["positive_share"] == pytest.approx(0.5, abs=0.01)
    assert summary.numbers["spread"] == pytest.approx(1, abs=0.01)
    # No event of the 8 (at the border 5 or 3) pixels around within 10 ms before or after.
    inner, edge = 62 * 46, 2 * (62 + 46)
    windows = rate * 2 * RADIUS_US * 1e-6
    expected = (inner * exp(-8 * windows) + edge * exp(-5 * windows) + 4 * exp(-3 * windows)) / (64 * 48)
    assert summary.numbers["isolated_share"] == pytest.approx(expected, abs=0.01)


def test_the_noise_rate_is_found_beside_a_moving_edge():
    rate, size = 1.0, (64, 48)
    # A column of pixels fires at once and moves by one pixel every 20 ms: no event of it is isolated.
    edge = [(step * 20_000, step % 64, y, 1) for step in range(500) for y in range(48)]
    numbers = summarise_events(make_events(poisson_noise(rate, 10.0, size) + edge, size)).numbers
    assert numbers["pixel_rate_hz"] > 1.7 * rate
    assert numbers["noise_rate_hz"] == pytest.approx(rate, rel=0.03)


def slow_isolated(events: Events) -> list[bool]:
    rows = list(zip(events.t.tolist(), events.x.tolist(), events.y.tolist(), strict=True))

    def joins(a: tuple[int, int, int], b: tuple[int, int, int]) -> bool:
        return abs(a[0] - b[0]) <= RADIUS_US and max(abs(a[1] - b[1]), abs(a[2] - b[2])) == 1

    return [not any(joins(row, other) for other in rows) for row in rows]


def slow_covered_us(events: Events, step_us: int) -> int:
    """Pixel-microseconds in which an event would have a neighbour, by asking at every step."""
    width, height = events.sensor_size
    total = 0
    for moment in range(int(events.t[0]), int(events.t[-1]), step_us):
        near = (np.abs(events.t - moment - step_us // 2) <= RADIUS_US).nonzero()[0]
        covered = np.zeros((height + 2, width + 2), bool)
        for event in near:
            x, y = int(events.x[event]) + 1, int(events.y[event]) + 1
            own = covered[y, x]
            covered[y - 1 : y + 2, x - 1 : x + 2] = True
            covered[y, x] = own
        total += int(covered[1:-1, 1:-1].sum()) * step_us
    return total


ROWS = st.lists(
    st.tuples(st.integers(0, 40).map(lambda k: k * 2000), st.integers(0, 7), st.integers(0, 5), st.integers(0, 1)),
    min_size=2, max_size=25,
)  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(ROWS)
def test_isolated_events_and_the_space_between_equal_slow_searches(rows):
    events = make_events(rows)
    numbers = summarise_events(events).numbers
    isolated = slow_isolated(events)
    assert numbers["isolated_share"] == pytest.approx(np.mean(isolated))
    if events.duration_us > 0:
        free_us = 48 * events.duration_us - slow_covered_us(events, 2000)
        expected = sum(isolated) / (free_us * 1e-6) if free_us else None
        assert numbers.get("noise_rate_hz") == (expected if expected is None else pytest.approx(expected))


def test_a_hot_pixel_is_found_with_its_events():
    rows = poisson_noise(1.0, 5.0, (16, 12)) + [(k * 1000, 7, 0, 1) for k in range(4000)]
    events = make_events(rows, (16, 12))
    numbers = summarise_events(events).numbers
    of_pixel = int(((events.x == 7) & (events.y == 0)).sum())
    assert numbers["hot_pixel_share"] == 1 / (16 * 12)
    assert numbers["hot_event_share"] == pytest.approx(of_pixel / len(events))


def test_a_bright_area_and_few_events_are_not_hot():
    area = [(k, x, y, 1) for k in range(100) for x in (2, 3, 4) for y in (2, 3, 4)]
    assert summarise_events(make_events(area)).numbers["hot_pixel_share"] == 0
    few = [(k, 2, 2, 1) for k in range(HOT_MIN_EVENTS - 1)]
    assert summarise_events(make_events(few)).numbers["hot_pixel_share"] == 0
    assert summarise_events(make_events([*few, (99, 2, 2, 1)])).numbers["hot_pixel_share"] == 1 / 48


def test_two_hot_pixels_may_touch():
    pair = [(k, x, 0, 1) for k in range(100) for x in (0, 1)]
    assert summarise_events(make_events(pair)).numbers["hot_pixel_share"] == 2 / 48


def test_intervals_and_pixel_rates_by_hand():
    rows = [(0, 1, 1, 1), (1000, 1, 1, 0), (1000, 1, 1, 1), (101_000, 1, 1, 1), (1_000_000, 5, 5, 1)]
    distributions = summarise_events(make_events(rows)).distributions
    interval = distributions["interval"]
    where = {round((log10(us) - AXES["interval"].low) / 0.1): 1 / 3 for us in (1000, 100_000)}
    where[0] = 1 / 3  # two events at the same time
    assert {int(bin): interval[bin] for bin in np.flatnonzero(interval)} == pytest.approx(where)
    rate = distributions["pixel_rate"]
    centres = AXES["pixel_rate"].centres[np.flatnonzero(rate)]
    assert np.abs(centres - [log10(1), log10(4)]).max() <= 0.0501 and rate[rate > 0].tolist() == [0.5, 0.5]


def test_spread_of_one_pixel_is_0_and_of_the_sensor_1():
    assert summarise_events(make_events([(0, 3, 3, 1), (5, 3, 3, 0)])).numbers["spread"] == 0
    everywhere = [(0, x, y, 1) for x in range(200) for y in range(100)]
    assert summarise_events(make_events(everywhere, (200, 100))).numbers["spread"] == pytest.approx(1, abs=1e-3)


def test_what_is_not_defined_is_left_out():
    assert summarise_events(make_events([])).numbers == {}
    one = summarise_events(make_events([(5, 0, 0, 1)]))
    assert "event_rate_mev_s" not in one.numbers and "noise_rate_hz" not in one.numbers
    assert one.distributions == {} and one.numbers["isolated_share"] == 1
    standing = summarise_events(make_events([(5, 7, 5, 1), (5, 7, 4, 0)]))
    assert standing.numbers["isolated_share"] == 0 and "event_rate_mev_s" not in standing.numbers


def test_a_clock_that_jumps_by_centuries_stays_finite():
    rows = [(0, 0, 0, 1), (2**62, 7, 5, 1), (2**62, 7, 5, 0)]
    summary = summarise_events(make_events(rows))
    assert all(np.isfinite(value) for value in summary.numbers.values())
    assert sum(summary.distributions["interval"]) == 1


# Event images ------------------------------------------------------------------------------------------------------


def test_numbers_of_an_image_by_hand():
    frame = np.zeros((1, 6, 8, 3), np.uint8)
    frame[0, 0, 0, 0] = 200  # a speckle of one
    frame[0, 5, 6:8, 2] = 100  # a speckle of two
    frame[0, 2:4, 2:4, 0] = 50  # a block of four
    frame[0, 0, 7] = 24  # below the limit
    summary = summarise_frames(frame)
    assert summary.numbers["active_pixel_share"] == 7 / 48
    assert summary.numbers["speckle_share"] == 3 / 7
    assert summary.numbers["isolated_pixel_share"] == 1 / 7
    assert summary.numbers["hot_pixel_share"] == 1 / 48
    assert summary.numbers["value_mean"] == pytest.approx((200 + 2 * 100 + 4 * 50) / 7)
    assert summary.numbers["positive_share"] == pytest.approx(424 / (424 + 224))
    value = summary.distributions["value"]
    assert {int(v): value[v - 25] for v in (50, 100, 200)} == pytest.approx({50: 4 / 7, 100: 2 / 7, 200: 1 / 7})


def test_diagonal_neighbours_belong_together():
    frame = np.zeros((1, 5, 5, 3), np.uint8)
    for k in range(3):
        frame[0, k, k] = 255
    assert summarise_frames(frame).numbers["speckle_share"] == 0


def test_images_without_colour_have_no_polarity_and_black_ones_no_values():
    grey = summarise_frames(np.full((2, 4, 4, 3), 99, np.uint8))
    assert "positive_share" not in grey.numbers and grey.numbers["active_pixel_share"] == 1
    black = summarise_frames(np.zeros((2, 4, 4, 3), np.uint8))
    assert black.numbers == {"active_pixel_share": 0, "hot_pixel_share": 0, "rms_contrast": 0}
    assert black.distributions == {}
    assert summarise_frames(np.zeros((0, 4, 4, 3), np.uint8)).numbers == {}
    with pytest.raises(ValueError, match=r"frames must be \[N, H, W, 3\] uint8"):
        summarise_frames(np.zeros((1, 4, 4), np.uint8))
