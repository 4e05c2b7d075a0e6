"""The DVS pixel against closed forms, its promises about chunks and budgets, hard cases, and its noise's statistics."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.sensor.dvs_pixel import (
    PRESETS,
    EventBudgetError,
    PixelMaps,
    Sensor,
    SensorOptions,
    join,
    read_preset,
    sample_pixel_maps,
    simulate_events,
)
from ctlev_core.sensor.kernels import _one_minus_exp
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
    # Half a microsecond of rounding; the frames are exact.
    np.testing.assert_allclose(events.t, expected, atol=0.5 + 1e-6)
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
    events = simulate(
        [[[0.0]], [[0.02]], [[0.001]]], [0, 1000, 2000], SensorOptions(threshold=0.15, starts_settled=False)
    )
    # Linear below the floor: up by 1, to the sixth threshold at 0.9; then down by 0.95 to 0.05.
    assert events.p.tolist() == [1] * 6 + [0] * 5


def test_low_pass_step_response():
    """After a step the filtered log intensity is 1 - exp(-t / lag), so crossing times are known."""
    options = SensorOptions(cutoff_dark_hz=50.0, cutoff_bright_hz=50.0, starts_settled=False)
    t_us = np.concatenate([[0, 1], 50 + 50 * np.arange(800)])
    light = np.where(t_us > 0, 0.1 * math.exp(0.9), 0.1)[:, None, None]
    lag_us = 1e6 / (2 * math.pi * 50.0)
    expected = -lag_us * np.log(1 - 0.2 * np.arange(1, 5) / 0.9)
    # The step is a ramp of 1 us, half of which it comes late, and half a microsecond is rounding.
    np.testing.assert_allclose(simulate(light, t_us, options).t, expected, atol=1.001)
    few = [0, 1, 2, -1]
    np.testing.assert_array_equal(simulate(light[few], t_us[few], options).t, simulate(light, t_us, options).t)


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


def same_events(first, second):
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in "txyp")


def flicker(seed, num_frames=24, height=3, width=4):
    """Light that jumps, stands still and goes out, at uneven times."""
    rng = np.random.default_rng(seed)
    intensity = np.exp(np.cumsum(rng.normal(0, 0.5, (num_frames, height, width)), axis=0) - 1.5)
    intensity[rng.random(intensity.shape) < 0.1] = 0.0
    for frame in range(1, num_frames):
        still = rng.random((height, width)) < 0.4
        intensity[frame][still] = intensity[frame - 1][still]
    return intensity, np.cumsum(rng.integers(1, 30_000, num_frames)).astype(np.int64)


RESTLESS = PRESETS["noisy"].model_copy(
    update={"leak_rate_hz": 8.0, "shot_noise_rate_hz": 20.0, "hot_pixel_fraction": 0.2}
)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000), st.lists(st.integers(1, 23), max_size=6), st.booleans())
def test_any_chunks_give_the_same_events(seed, cuts, is_float32):
    intensity, t_us = flicker(seed)
    intensity = intensity.astype(np.float32 if is_float32 else np.float64)
    whole, whole_exact_us = make_sensor(RESTLESS).push_exact(intensity, t_us)
    sensor = make_sensor(RESTLESS)
    parts = [
        sensor.push_exact(intensity[first:last], t_us[first:last])
        for first, last in itertools.pairwise(sorted({0, *cuts, 24}))
    ]
    assert len(whole) > 20 and sensor.num_events == len(whole) and sensor.num_frames == 24
    assert same_events(join([events for events, _ in parts], (4, 3)), whole)
    np.testing.assert_array_equal(np.concatenate([exact_us for _, exact_us in parts]), whole_exact_us)
    assert same_events(simulate_events(intensity, t_us, RESTLESS, sensor_seed=1, seed=2), whole)


def make_sensor(options, max_events=None):
    return Sensor((4, 3), options, sensor_seed=1, seed=2, max_events=max_events)


@pytest.mark.parametrize("cutoff_dark_hz", [None, 20.0])
def test_a_pixel_sends_the_same_whatever_others_do(cutoff_dark_hz):
    """Pixels are advanced in groups: some still, some with one crossing, with many, or with a turn between frames."""
    options = SensorOptions(
        threshold_sigma=0.03, cutoff_dark_hz=cutoff_dark_hz, refractory_us=700, leak_rate_hz=5.0, starts_settled=False
    )
    intensity, t_us = flicker(11, height=40, width=61)  # a group of 512 pixels ends within a row
    rng = np.random.default_rng(0)
    intensity[12] = intensity[11]
    intensity[20, rng.random((40, 61)) < 0.05] *= 1e5
    maps = sample_pixel_maps((61, 40), options, 3)
    events, exact_us = Sensor((61, 40), options, sensor_seed=3, seed=4, maps=maps).push_exact(intensity, t_us)
    assert len(events) > 100_000
    for y, x in rng.integers(0, (40, 61), (60, 2)):
        own = PixelMaps(*(getattr(maps, field.name)[y : y + 1, x : x + 1] for field in dataclasses.fields(maps)))
        alone = Sensor((1, 1), options, sensor_seed=3, seed=4, maps=own)
        expected, expected_us = alone.push_exact(np.ascontiguousarray(intensity[:, y : y + 1, x : x + 1]), t_us)
        here = (events.x == x) & (events.y == y)
        np.testing.assert_array_equal(exact_us[here], expected_us)
        np.testing.assert_array_equal(events.p[here], expected.p)


def test_events_of_one_microsecond_are_in_raster_order():
    """Also where one pixel of a group is followed by itself and the others together."""
    intensity, _ = flicker(12, num_frames=24, height=20, width=30)
    options = SensorOptions(cutoff_dark_hz=1e5, cutoff_bright_hz=2e5, starts_settled=False)
    events = simulate(intensity, np.arange(24) * 3, options)
    pixel = events.y.astype(int) * 30 + events.x
    together = (events.t[1:] == events.t[:-1]) & (events.t[1:] % 3 != 0)  # intervals end at multiples of 3
    assert together.sum() > 500
    assert (np.diff(pixel)[together] >= 0).all()


def test_the_exponential_of_the_low_pass_is_that_of_the_library():
    x = np.concatenate([[0.0], np.geomspace(1e-300, 1e300, 4001), np.linspace(0.3, 0.4, 1001), np.arange(1, 70)])
    found = np.array([_one_minus_exp(value) for value in x])
    np.testing.assert_allclose(found, -np.expm1(-x), rtol=4.5e-16, atol=0)


def test_a_chunk_may_end_in_the_middle_of_a_crossing():
    """A ramp takes 100 ms for a threshold; chunks end at 60 % of it, and the event still comes at 100 ms."""
    sensor = Sensor((1, 1), IDEAL, sensor_seed=0, seed=0)
    early = sensor.push(ramp(2.0, [0, 60_000]), np.array([0, 60_000]))
    late = sensor.push(ramp(2.0, [120_000]), np.array([120_000]))
    assert len(early) == 0 and late.t.tolist() == [100_000]


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10_000))
def test_frames_that_show_nothing_new_change_nothing(seed):
    """A still scene may be sampled as rarely as one likes, noise, leak and lag included."""
    rng = np.random.default_rng(seed)
    first, second = np.exp(rng.normal(-1, 1, (2, 3, 4)))
    knots_us = np.array([0, 3_000, 200_000, 205_000, 400_000])
    still_us = np.unique(np.concatenate([knots_us, rng.integers(3_000, 200_000, 9), rng.integers(205_000, 400_000, 9)]))
    frames = np.where((still_us < 3_000)[:, None, None] | (still_us > 200_000)[:, None, None], first, second)
    dense, dense_us = make_sensor(RESTLESS).push_exact(frames, still_us)
    sparse, sparse_us = make_sensor(RESTLESS).push_exact(np.stack([first, second, second, first, first]), knots_us)
    assert len(sparse) == len(dense) > 20
    assert same_events(sparse, dense)
    # The same numbers in another order of operations.
    np.testing.assert_allclose(sparse_us, dense_us, rtol=1e-12)


def test_all_kinds_of_floats_and_layouts_are_the_same_light():
    intensity, t_us = flicker(5)
    intensity = intensity.astype(np.float32)
    expected = make_sensor(RESTLESS).push(intensity, t_us)
    views = [intensity.astype(np.float64), np.asfortranarray(intensity), intensity.astype(">f8")]
    assert all(same_events(make_sensor(RESTLESS).push(view, t_us), expected) for view in views)
    sensor = make_sensor(RESTLESS)
    mixed = [
        sensor.push(intensity[k : k + 1].astype(np.float64 if k % 3 else np.float32), t_us[k : k + 1])
        for k in range(24)
    ]
    assert same_events(join(mixed, (4, 3)), expected)


def test_the_caller_may_render_into_the_same_array_again():
    intensity, t_us = flicker(6)
    sensor, canvas, parts = make_sensor(RESTLESS), np.empty((1, 3, 4)), []
    for k in range(24):
        canvas[0] = intensity[k]
        parts.append(sensor.push(canvas, t_us[k : k + 1]))
    assert same_events(join(parts, (4, 3)), make_sensor(RESTLESS).push(intensity, t_us))


# Hard cases ----------------------------------------------------------------------------------------------------------


def test_zero_light_for_ever_sends_noise_alone():
    intensity, t_us = np.zeros((5, 3, 4)), 250_000 * np.arange(5)
    assert len(simulate(intensity, t_us)) == 0
    events = simulate(intensity, t_us, SensorOptions(shot_noise_rate_hz=30.0))
    assert 250 < len(events) < 480  # 12 pixels x 30 Hz x 1 s, six standard deviations


def test_thresholds_near_zero_are_clipped():
    options = SensorOptions(threshold=0.01, threshold_sigma=0.02, threshold_minimum=0.004, starts_settled=False)
    maps = sample_pixel_maps((4, 3), options, 0)
    assert maps.threshold_on.min() == 0.004
    events = simulate(np.stack([np.full((3, 4), 0.1), np.full((3, 4), 0.1 * math.e)]), [0, 10], options)
    counts = np.bincount(events.y.astype(int) * 4 + events.x, minlength=12).reshape(3, 4)
    np.testing.assert_allclose(counts, 1 / maps.threshold_on, atol=1)


def test_refractory_time_longer_than_the_frame_interval():
    """It is counted from event to event, whatever frames come between."""
    options = SensorOptions(refractory_us=30_000, starts_settled=False)
    t_us = np.arange(0, 100_001, 500)
    np.testing.assert_array_equal(
        simulate(ramp(10.0, t_us), t_us, options).t, simulate(ramp(10.0, t_us[[0, -1]]), t_us[[0, -1]], options).t
    )


def test_one_frame_in_each_chunk():
    sensor = Sensor((1, 1), IDEAL, sensor_seed=0, seed=0)
    counts = [len(sensor.push(np.array([[[light]]]), np.array([t]))) for t, light in ((5, 0.1), (9, 0.5), (10, 0.102))]
    assert counts == [0, 8, 7]


def test_a_long_interval_with_few_events_and_a_short_one_with_many():
    rng = np.random.default_rng(0)
    frames = np.exp(rng.normal(-2, 1, (3, 30, 40)))
    frames[1] = frames[0]
    frames[1, 3:5, 7] *= 4
    events = simulate(frames, [0, 10**9, 10**9 + 20])
    check_events(events, "test")
    assert (events.t < 10**9).sum() == 12 and len(events) > 5_000
    rows = events.y[events.t == 10**9 + 7].astype(int) * 40 + events.x[events.t == 10**9 + 7]
    assert (np.diff(rows) >= 0).all() and len(rows) > 50


def test_nothing_is_lost_when_the_budget_is_exceeded():
    intensity, t_us = flicker(8)
    whole = make_sensor(RESTLESS).push(intensity, t_us)
    sensor = make_sensor(RESTLESS, max_events=len(whole) - 1)
    first = sensor.push(intensity[:10], t_us[:10])
    with pytest.raises(EventBudgetError, match=f"more than max_events = {len(whole) - 1} events by t = "):
        sensor.push(intensity[10:], t_us[10:])
    assert sensor.num_events == len(first) and sensor.num_frames == 10
    sensor.max_events = len(whole)
    assert same_events(join([first, sensor.push(intensity[10:], t_us[10:])], (4, 3)), whole)


def test_a_budget_bounds_memory_and_the_error_carries_what_there_was():
    intensity = np.ones((130, 2, 2))
    intensity[60], intensity[100:] = 1.5, 1e300
    t_us = 1000 * np.arange(130)
    options = SensorOptions(threshold=1e-6, threshold_minimum=1e-6, starts_settled=False)
    with pytest.raises(EventBudgetError, match="max_events = 4000000") as caught:
        simulate_events(intensity, t_us, options, sensor_seed=0, seed=0, max_events=4_000_000)
    expected = simulate_events(intensity[:64], t_us[:64], options, sensor_seed=0, seed=0)
    assert same_events(caught.value.events, expected) and len(expected) > 3_000_000


def test_bad_frames_leave_the_sensor_as_it_was():
    intensity, t_us = flicker(9)
    bad = intensity.copy()
    bad[20, 1, 2] = np.nan
    sensor = make_sensor(RESTLESS)
    first = sensor.push(intensity[:7], t_us[:7])
    with pytest.raises(DataError, match="got nan at frame 13, x = 2, y = 1"):
        sensor.push(bad[7:], t_us[7:])
    with pytest.raises(DataError, match=f"got t = {t_us[6]} us after the frame of {t_us[6]} us"):
        sensor.push(intensity[7:], t_us[6:23])
    with pytest.raises(DataError, match=r"\[T, 3, 4\]"):
        sensor.push(intensity[7:, :2], t_us[7:])
    rest = sensor.push(intensity[7:], t_us[7:])
    assert same_events(join([first, rest], (4, 3)), make_sensor(RESTLESS).push(intensity, t_us))


# Noise ---------------------------------------------------------------------------------------------------------------


def test_shot_noise_is_poisson_and_weaker_in_the_light():
    options = SensorOptions(shot_noise_rate_hz=5.0, shot_noise_rate_bright=0.25)
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
    options = SensorOptions(shot_noise_rate_hz=5.0)
    coarse = simulate(np.full((2, 8, 8), 0.4), [0, 1_000_000], options)
    fine = simulate(np.full((501, 8, 8), 0.4), 2_000 * np.arange(501), options)
    assert len(coarse) > 100
    np.testing.assert_array_equal(coarse.t, fine.t)


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
        (np.full((2, 1, 1), np.nan), [0, 1], "finite.*nan at frame 0, x = 0, y = 0"),
        (np.full((2, 1, 1), np.inf), [0, 1], "finite"),
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


def test_presets_are_files_too(tmp_path):
    path = tmp_path / "preset.yaml"
    path.write_text("threshold: 0.3\nhot_rate_hz: [5, 6]\n")
    assert read_preset(path) == SensorOptions(threshold=0.3, hot_rate_hz=(5, 6))
    for content, message in (
        ("threshold: -1", "threshold"),
        ("hot_rate_hz: [6, 5]", "lower first"),
        ("treshold: 1", "treshold"),
        ("- 1", "table of options, got list"),
        ("{", "not a sensor preset"),
        ("1: 2", "not a sensor preset"),
    ):
        path.write_text(content)
        with pytest.raises(DataError, match=message):
            read_preset(path)
    with pytest.raises(DataError, match="No such file"):
        read_preset(tmp_path / "none.yaml")


@pytest.mark.parametrize("name", ["threshold", "threshold_off"])
def test_a_mean_below_the_least_threshold_is_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be at least threshold_minimum, 0.05, got 0.03"):
        SensorOptions(**{name: 0.03})
    assert SensorOptions(**{name: 0.03}, threshold_minimum=0.03).threshold_minimum == 0.03
