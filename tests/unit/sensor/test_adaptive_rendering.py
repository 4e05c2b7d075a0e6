"""Scenes that are rendered on demand: few frames, the events of many, the same seeds."""

import numpy as np
import pytest

from ctlev_core.sensor.adaptive_rendering import Patch, RenderingOptions, simulate_rendered
from ctlev_core.sensor.dvs_pixel import PRESETS, EventBudgetError, Sensor, SensorOptions, simulate_events
from data_contracts.errors import DataError
from data_contracts.events import check_events

IDEAL = PRESETS["ideal"]
WIDTH, HEIGHT, STOP_US = 40, 4, 400_000
KNOTS_S = np.array([0.0, 0.1, 0.12, 0.3, 0.31, 0.4])
PLACES_PX = np.array([0.0, 0.0, 25.0, 25.0, 36.0, 36.5])
BACKGROUND = np.full((HEIGHT, WIDTH), 0.1)


def place(t_s):
    return np.interp(t_s, KNOTS_S, PLACES_PX)


def render(t_s):
    """An edge that rests, leaps, rests, leaps and creeps."""
    row = 0.1 + 0.7 * np.clip(place(t_s) - np.arange(WIDTH), 0.0, 1.0)
    return np.repeat(row[None], HEIGHT, axis=0)


def render_patch(t_s):
    """The same, without the part that is still dark."""
    return Patch(0, 0, render(t_s)[:, : int(place(t_s)) + 1])


def speed_bound(begin_s, end_s):
    speeds = np.diff(PLACES_PX) / np.diff(KNOTS_S)
    return float(speeds[(KNOTS_S[1:] > begin_s) & (KNOTS_S[:-1] < end_s)].max())


def same_events(first, second):
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in "txyp")


@pytest.mark.parametrize("way", ["by_speed", "by_pictures", "patches"])
@pytest.mark.parametrize("preset", ["ideal", "noisy"])
def test_few_frames_give_the_events_of_many(way, preset):
    options = RenderingOptions(max_displacement_px=0.125, tolerance=0.02, min_interval_us=20)
    events, times_us = simulate_rendered(
        render_patch if way == "patches" else render,
        0,
        STOP_US,
        PRESETS[preset],
        options,
        sensor_seed=1,
        seed=2,
        speed_bound=None if way == "by_pictures" else speed_bound,
        background=BACKGROUND,
    )
    check_events(events, "test")
    assert times_us[0] == 0 and times_us[-1] == STOP_US and (np.diff(times_us) >= 20).all()
    dense_us = np.arange(0, STOP_US + 1, 20)
    dense = simulate_events(
        np.stack([render(1e-6 * t) for t in dense_us]), dense_us, PRESETS[preset], sensor_seed=1, seed=2
    )
    assert len(times_us) < len(dense_us) / 20
    for pixel in range(WIDTH * HEIGHT):
        few, many = (e.t[e.y.astype(int) * WIDTH + e.x == pixel] for e in (events, dense))
        if preset == "ideal":
            # In px, for what creeps takes its time: the chord of an eighth of a pixel may miss the curve
            # by a quarter of that where the edge enters the pixel, and elsewhere by far less.
            assert len(few) == len(many)
            assert np.abs(place(1e-6 * few) - place(1e-6 * many)).max(initial=0) < 0.125 / 4
    assert abs(len(events) - len(dense)) <= 0.01 * len(dense)


def test_movement_between_frames_is_bounded():
    options = RenderingOptions(max_displacement_px=0.5, min_interval_us=10, max_interval_us=40_000)
    _, times_us = simulate_rendered(render, 0, STOP_US, IDEAL, options, sensor_seed=0, seed=0, speed_bound=speed_bound)
    assert np.diff(place(1e-6 * times_us)).max() <= 0.5 + 1e-9
    assert np.diff(times_us).max() <= 40_000
    # 36.5 px at half a pixel, and little more for what rests.
    assert 73 <= len(times_us) < 110


def test_a_still_scene_costs_next_to_nothing_and_noise_goes_on():
    calls = []

    def still(t_s):
        calls.append(t_s)
        return BACKGROUND

    options, noisy = RenderingOptions(max_interval_us=100_000), SensorOptions(shot_noise_rate_hz=50.0, leak_rate_hz=9.0)
    events, times_us = simulate_rendered(
        still, 0, STOP_US, noisy, options, sensor_seed=3, seed=4, speed_bound=lambda begin_s, end_s: 0.0
    )
    assert times_us.tolist() == [0, 100_000, 200_000, 300_000, 400_000] and len(calls) == 5
    assert same_events(
        events,
        simulate_events(np.stack([BACKGROUND] * 2), np.array([0, STOP_US]), noisy, sensor_seed=3, seed=4),
    )


def test_the_times_are_all_that_differs_from_a_plain_simulation():
    events, times_us = simulate_rendered(
        render, 1_000, STOP_US, PRESETS["noisy"], RenderingOptions(), sensor_seed=3, seed=4, speed_bound=speed_bound
    )
    frames = np.stack([render(1e-6 * t) for t in times_us])
    assert same_events(events, simulate_events(frames, times_us, PRESETS["noisy"], sensor_seed=3, seed=4))
    assert Sensor((WIDTH, HEIGHT), IDEAL, sensor_seed=0, seed=0).push(frames, times_us).t.min() > 1_000


def test_without_a_speed_what_moves_below_the_floor_is_seen_as_the_sensor_does():
    """Its response is linear there: a pulse of 0.8 floors is one of 0.8 in log intensity."""
    floor = IDEAL.log_floor

    def pulse(t_s):
        return np.full((HEIGHT, WIDTH), 0.8 * floor * np.sin(np.pi * np.clip((t_s - 0.1) / 0.05, 0, 1)) ** 2)

    options = RenderingOptions(tolerance=0.02)
    events, times_us = simulate_rendered(pulse, 0, STOP_US, IDEAL, options, sensor_seed=1, seed=2)
    dense_us = np.arange(0, STOP_US + 1, 200)
    dense = simulate_events(np.stack([pulse(1e-6 * t) for t in dense_us]), dense_us, IDEAL, sensor_seed=1, seed=2)
    assert len(events) == len(dense) > 0 and np.abs(events.t - dense.t).max() < 1_000
    during = np.diff(times_us[(times_us >= 100_000) & (times_us <= 150_000)])
    assert during.max() < options.max_interval_us / 2


def test_every_picture_is_rendered_once():
    calls = []

    def counted(t_s):
        calls.append(round(1e6 * t_s))
        return render(t_s)

    _, times_us = simulate_rendered(counted, 0, STOP_US, IDEAL, RenderingOptions(), sensor_seed=0, seed=0)
    assert sorted(calls) == times_us.tolist()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"start_us": 7, "stop_us": 7}, "0 <= start < stop, got 7 and 7"),
        ({"start_us": -1}, "0 <= start < stop"),
        ({"speed_bound": lambda begin_s, end_s: -1.0}, "finite and >= 0, got -1.0"),
        ({"speed_bound": lambda begin_s, end_s: float("nan")}, "finite and >= 0, got nan"),
        ({"render": lambda t_s: np.ones((2, 2 + int(t_s > 0.1)))}, r"got \(1, 2, 3\)|pictures of"),
        ({"render": lambda t_s: np.ones(3)}, r"\[H, W\]"),
        ({"render": lambda t_s: np.full((2, 2), np.nan)}, "finite"),
        ({"render": lambda t_s: Patch(0, 0, np.ones((2, 2)))}, "background of None"),
        ({"render": lambda t_s: Patch(3, 0, np.ones((2, 2))), "background": np.ones((4, 4))}, "column 3 does not fit"),
        ({"render": lambda t_s: Patch(0, -1, np.ones((2, 2))), "background": np.ones((4, 4))}, "row -1"),
    ],
)
def test_bad_scenes_are_named(changes, message):
    arguments = {"render": render, "start_us": 0, "stop_us": STOP_US, "speed_bound": None, "background": None} | changes
    with pytest.raises(DataError, match=message):
        simulate_rendered(
            **arguments, sensor_options=IDEAL, options=RenderingOptions(max_interval_us=90_000), sensor_seed=0, seed=0
        )


def test_the_budget_is_kept():
    with pytest.raises(EventBudgetError, match="max_events = 50") as caught:
        simulate_rendered(
            render, 0, STOP_US, IDEAL, RenderingOptions(), sensor_seed=0, seed=0, speed_bound=speed_bound, max_events=50
        )
    assert 0 < len(caught.value.events) <= 50


def test_a_bound_that_rounds_to_the_same_interval_again_ends():
    """250 px/s / 0.7: the interval's path rounds to more than is allowed, the allowed interval to the same interval."""
    options = RenderingOptions(max_displacement_px=0.25)
    still = np.full((4, 4), 0.5)
    _, times_us = simulate_rendered(
        lambda t: still, 0, 100_000, IDEAL, options, sensor_seed=0, seed=0, speed_bound=lambda a, b: 250 / 0.7
    )
    assert np.diff(times_us).max() <= 700 and len(times_us) < 160
