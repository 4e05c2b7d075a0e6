"""The DVS pixel against closed forms, a slow reference, and the statistics its noise promises."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.sensor import PRESETS, SensorOptions, sample_pixel_maps, simulate_events
from data_contracts.errors import DataError
from data_contracts.events import check_events

IDEAL = PRESETS["ideal"]


def simulate(intensity, t_us, options=IDEAL, sensor_seed=0, seed=0):
    return simulate_events(
        np.asarray(intensity, dtype=np.float64),
        np.asarray(t_us, dtype=np.int64),
        options,
        sensor_seed=sensor_seed,
        seed=seed,
    )


def ramp(rate, t_us, start=0.1):
    """One pixel whose log intensity changes by `rate` a second."""
    return (start * np.exp(rate * 1e-6 * np.asarray(t_us)))[:, None, None]


@pytest.mark.parametrize("rate", [3.0, -2.5])
@pytest.mark.parametrize("frames", [2, 7, 400])
def test_crossing_times_of_a_ramp_do_not_depend_on_the_frame_rate(rate, frames):
    t_us = np.rint(np.linspace(0, 500_000, frames)).astype(np.int64)
    events = simulate(ramp(rate, t_us), t_us)
    expected = 1e6 * np.arange(1, int(abs(rate) * 0.5 / 0.2) + 1) * 0.2 / abs(rate)
    # Half a microsecond of rounding; float32 intensity adds 1e-7 / rate, at most 0.1 us.
    np.testing.assert_allclose(events.t, expected, atol=0.7)
    assert set(events.p) == {int(rate > 0)}


def test_many_crossings_in_one_interval_and_a_contrast_of_a_million():
    events = simulate([[[1e-0]], [[1e6]]], [0, 1000])
    assert len(events) == math.floor(math.log(1e6) / 0.2)
    assert (np.diff(events.t) >= 14).all()


def test_constant_light_sends_nothing():
    assert len(simulate(np.full((50, 4, 4), 0.3), 1000 * np.arange(50))) == 0


def test_one_frame_sends_nothing():
    assert len(simulate(np.full((1, 4, 4), 0.3), [5], PRESETS["noisy"])) == 0


def test_darkness_is_finite():
    events = simulate([[[0.0]], [[0.02]], [[0.0]]], [0, 1000, 2000])
    # Linear below the floor: from 0 to the floor the response rises by exactly 1, which is five thresholds of 0.2.
    assert events.p.tolist() in ([1] * 5 + [0] * 5, [1] * 4 + [0] * 4)


def test_low_pass_step_response():
    """After a step the filtered log intensity is 1 - exp(-t / lag), so crossing times are known."""
    options = SensorOptions(cutoff_dark_hz=50.0, cutoff_bright_hz=50.0, starts_settled=False)
    t_us = np.concatenate([[0, 1], 50 + 50 * np.arange(800)])
    light = np.where(t_us > 0, 0.1 * math.exp(0.9), 0.1)[:, None, None]
    lag_us = 1e6 / (2 * math.pi * 50.0)
    expected = -lag_us * np.log(1 - 0.2 * np.arange(1, 5) / 0.9)
    # Frames every 50 us: interpolating the exponential linearly errs by less than 50^2 / (8 lag) = 0.1 us there.
    np.testing.assert_allclose(simulate(light, t_us, options).t, expected, atol=1.5)


def test_low_pass_is_exact_on_a_ramp_whatever_the_frame_rate():
    options = SensorOptions(cutoff_dark_hz=20.0, cutoff_bright_hz=20.0, starts_settled=False)
    t_us = np.arange(0, 1_000_001, 50_000)
    events = simulate(ramp(2.0, t_us, start=0.05), t_us, options)
    lag_s = 1 / (2 * math.pi * 20.0)
    seconds = 1e-6 * events.t
    filtered = 2.0 * (seconds - lag_s * (1 - np.exp(-seconds / lag_s)))
    late = seconds > 8 * lag_s
    # In the steady state the filter only delays, so even frames six lags apart lose nothing.
    assert late.sum() >= 5
    steps = filtered[late] / 0.2
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)


def test_leak_sends_on_events_at_its_rate():
    options = SensorOptions(leak_rate_hz=4.0, starts_settled=False)
    events = simulate(np.full((101, 1, 1), 0.5), 10_000 * np.arange(101), options)
    np.testing.assert_allclose(events.t, [250_000, 500_000, 750_000, 1_000_000][: len(events)], atol=1)
    assert len(events) >= 3 and events.p.all()


def test_refractory_time_drops_events_and_moves_the_reference():
    t_us = [0, 100_000]
    all_events = simulate(ramp(10.0, t_us), t_us)
    some = simulate(ramp(10.0, t_us), t_us, SensorOptions(refractory_us=30_000, starts_settled=False))
    assert np.diff(all_events.t).max() < 30_000
    # Every second crossing falls into the silence after the one before: they are gone, not postponed.
    np.testing.assert_array_equal(some.t, all_events.t[::2])


def slow_reference(intensity, t_us, maps, options):
    """The model of the module's docstring without noise, pixel by pixel, in plain Python."""
    rows = []
    for (row, column), _ in np.ndenumerate(intensity[0]):
        on, off = maps.threshold_on[row, column], maps.threshold_off[row, column]
        leak = maps.leak[row, column]

        def response(light):
            floor = options.log_floor
            return math.log(light) if light > floor else math.log(floor) + (light - floor) / floor

        light = [float(np.float32(value)) for value in intensity[:, row, column]]
        filtered = response(light[0])
        level, last = filtered, -math.inf
        for frame in range(1, len(t_us)):
            span_s = 1e-6 * (t_us[frame] - t_us[frame - 1])
            before, after = response(light[frame - 1]), response(light[frame])
            start = filtered
            if options.cutoff_dark_hz is None:
                filtered = after
            else:
                middle = min(0.5 * (light[frame - 1] + light[frame]), 1.0)
                cutoff = options.cutoff_dark_hz + (options.cutoff_bright_hz - options.cutoff_dark_hz) * middle
                decay = math.exp(-2 * math.pi * cutoff * span_s)
                slope = (after - before) / (2 * math.pi * cutoff * span_s)
                filtered = after - slope + (start - before + slope) * decay
            begin_level, end_level = level, level - leak * span_s
            rise = (filtered - end_level) - (start - begin_level)
            moved, crossing = 0.0, 0
            while True:
                target = on if rise > 0 else -off
                if (
                    rise == 0
                    or abs(start - begin_level - moved + rise) < abs(target)
                    or ((start - begin_level - moved + rise) * target < 0)
                ):
                    break
                crossing = max((target - (start - begin_level - moved)) / rise, 0.0)
                moved += target
                now = int(t_us[frame - 1] + crossing * (t_us[frame] - t_us[frame - 1]) + 0.5)
                if now - last >= options.refractory_us:
                    last = now
                    rows.append((now, row, column, int(rise > 0)))
            level = end_level + moved
    return sorted(rows)


@settings(deadline=None, max_examples=40)
@given(
    st.integers(0, 10_000),
    st.sampled_from([None, 15.0]),
    st.sampled_from([0, 700]),
    st.sampled_from([0.0, 3.0]),
)
def test_equals_the_slow_reference(seed, cutoff_dark_hz, refractory_us, leak_rate_hz):
    rng = np.random.default_rng(seed)
    intensity = np.exp(np.cumsum(rng.normal(0, 0.3, (12, 2, 3)), axis=0) - 2.0)
    intensity[rng.random(intensity.shape) < 0.1] = 0.0
    t_us = np.cumsum(rng.integers(1, 5000, 12)).astype(np.int64)
    options = SensorOptions(
        threshold_sigma=0.05,
        cutoff_dark_hz=cutoff_dark_hz,
        refractory_us=refractory_us,
        leak_rate_hz=leak_rate_hz,
        rate_spread=0.4,
        starts_settled=False,
    )
    events = simulate(intensity, t_us, options, sensor_seed=3)
    expected = slow_reference(intensity, t_us, sample_pixel_maps((3, 2), options, 3), options)
    got = sorted(zip(events.t.tolist(), events.y.tolist(), events.x.tolist(), events.p.tolist(), strict=True))
    assert len(got) == len(expected)
    # The order of float operations may move a time across a rounding border: one microsecond.
    np.testing.assert_allclose(sorted(row[0] for row in got), [row[0] for row in expected], atol=1)
    assert sorted(row[1:] for row in got) == sorted(row[1:] for row in expected)


def test_shot_noise_is_poisson_and_weaker_in_the_light():
    options = SensorOptions(shot_rate_hz=5.0, shot_rate_bright=0.25)
    t_us = 20_000 * np.arange(101)
    counts = {}
    for light in (0.0, 1.0):
        events = simulate(np.full((101, 40, 40), light), t_us, options, seed=7)
        counts[light] = len(events)
        per_pixel = np.bincount(events.y.astype(int) * 40 + events.x, minlength=1600)
        expected = 5.0 * 2.0 * (1.0 if light == 0.0 else 0.25)
        # Mean and variance of a Poisson count agree; five standard errors each.
        assert abs(per_pixel.mean() - expected) < 5 * math.sqrt(expected / 1600)
        assert abs(per_pixel.var() / expected - 1) < 5 * math.sqrt(2.5 / 1600) + 5 * math.sqrt(1 / (1600 * expected))
        assert abs(events.p.mean() - 0.5) < 2.5 / math.sqrt(len(events))
    assert counts[1.0] < counts[0.0]


def test_shot_noise_does_not_depend_on_the_frame_rate():
    options = SensorOptions(shot_rate_hz=5.0)
    coarse = simulate(np.full((2, 8, 8), 0.4), [0, 1_000_000], options)
    fine = simulate(np.full((501, 8, 8), 0.4), 2_000 * np.arange(501), options)
    assert len(coarse) > 100
    np.testing.assert_allclose(coarse.t, fine.t, atol=1)


def test_hot_pixels_fire_at_their_rates_and_are_on():
    options = SensorOptions(hot_pixel_fraction=0.05, hot_rate_hz=(100.0, 100.0))
    events = simulate(np.full((3, 20, 20), 0.4), [0, 1_000_000, 2_000_000], options)
    counts = np.bincount(events.y.astype(int) * 20 + events.x, minlength=400)
    assert np.count_nonzero(counts) == 20 and events.p.all()
    assert abs(counts[counts > 0].mean() - 200) < 5 * math.sqrt(200 / 20)


def test_same_seeds_same_events_and_other_seeds_others():
    rng = np.random.default_rng(0)
    intensity = rng.uniform(0.05, 1.0, (20, 16, 16))
    t_us = 4000 * np.arange(20)
    first, again = (simulate(intensity, t_us, PRESETS["noisy"], 1, 2) for _ in range(2))
    for column in ("t", "x", "y", "p"):
        np.testing.assert_array_equal(getattr(first, column), getattr(again, column))
    for other in (simulate(intensity, t_us, PRESETS["noisy"], 1, 3), simulate(intensity, t_us, PRESETS["noisy"], 2, 2)):
        assert len(other) != len(first) or (other.t != first.t).any()
    check_events(first, "test")
    assert t_us[0] <= first.t[0] and first.t[-1] <= t_us[-1]


def test_maps_belong_to_the_sensor():
    maps, again = (sample_pixel_maps((30, 20), PRESETS["noisy"], 5) for _ in range(2))
    np.testing.assert_array_equal(maps.hot_rate_hz, again.hot_rate_hz)
    assert maps.threshold_on.shape == (20, 30)
    assert maps.threshold_on.min() >= PRESETS["noisy"].threshold_minimum
    assert abs(maps.threshold_on.std() / PRESETS["noisy"].threshold_sigma - 1) < 0.15
    assert np.count_nonzero(maps.hot_rate_hz) == round(600 * PRESETS["noisy"].hot_pixel_fraction)


def test_settled_pixels_start_anywhere_between_their_thresholds():
    light = np.stack([np.full((40, 40), 0.2), np.full((40, 40), 0.2 * math.exp(0.1))])
    events = simulate(light, [0, 1000], SensorOptions())
    # Half a threshold of change on 1,600 pixels: a quarter of them crosses, uniformly in time.
    assert abs(len(events) / 1600 - 0.25) < 5 * math.sqrt(0.25 * 0.75 / 1600)


@pytest.mark.parametrize(
    ("intensity", "t_us", "message"),
    [
        (np.full((2, 1, 1), np.nan), [0, 1], "finite"),
        (np.full((2, 1, 1), -0.1), [0, 1], "not negative"),
        (np.ones((2, 1, 1)), [5, 4], "must increase.*4 us at frame 1"),
        (np.ones((2, 1, 1)), [5, 5], "must increase"),
        (np.ones((2, 1, 1)), [-1, 5], "must increase from 0"),
        (np.ones((2, 1, 1)), [0, 1, 2], r"t_us must be \[2\]"),
        (np.ones((0, 1, 1)), [], "T, H, W"),
        (np.ones((2, 1)), [0, 1], "T, H, W"),
    ],
)
def test_bad_input_is_named(intensity, t_us, message):
    with pytest.raises(DataError, match=message):
        simulate(intensity, t_us)
