"""The DVS pixel against slow loops that share nothing with it: in multiple precision, and on real pictures."""

import itertools
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from mpmath import mp, mpf

from ctlev_core.sensor.dvs_pixel import PRESETS, Sensor, SensorOptions, sample_pixel_maps, simulate_events

mp.dps = 40
REAL_DATA = Path(__file__).resolve().parents[2].parent / "shared" / "real"


def precise_response(light, floor):
    """Log, and its tangent below the floor, to 40 digits of the float given."""
    light, floor = mpf(float(light)), mpf(floor)
    return mp.log(light) if light > floor else mp.log(floor) + (light - floor) / floor


def precise_pixel(light, t_us, on, off, leak_per_s, options):
    """Events (time in us after the first frame, polarity, whether light or leak made it) of one pixel without noise.

    Between two frames the low-passed response obeys f' = (signal - f) / lag with a signal that is linear in time. Its
    solution is evaluated as such, on a grid that no crossing pair can hide in, and each crossing is bisected.
    """
    on, off, leak = mpf(on), mpf(off), mpf(leak_per_s) / 10**6
    response = [precise_response(value, options.log_floor) for value in light]
    filtered = reference = response[0]
    last, events = -mp.inf, []
    turned, level = mpf(0), filtered  # when the reference moved last, and the low-passed light then
    for k in range(1, len(t_us)):
        begin, span = mpf(int(t_us[k - 1] - t_us[0])), mpf(int(t_us[k] - t_us[k - 1]))
        slope = (response[k] - response[k - 1]) / span
        middle = min((mpf(float(light[k - 1])) + mpf(float(light[k]))) / 2, 1)
        if options.cutoff_dark_hz is None:
            lag = mpf(0)
        else:
            dark, bright = mpf(options.cutoff_dark_hz), mpf(options.cutoff_bright_hz)
            lag = 10**6 / (2 * mp.pi * (dark + (bright - dark) * middle))

        def follow(s, k=k, slope=slope, lag=lag, filtered=filtered):
            ramp = response[k - 1] + slope * s
            if lag == 0:
                return ramp
            behind = slope * lag
            return ramp - behind + (filtered - response[k - 1] + behind) * mp.exp(-s / lag)

        grid = [span * i / 64 for i in range(65)] if lag else [mpf(0), span]
        for low, high in itertools.pairwise(grid):
            while True:
                # The reference falls by the leak; `reference` is what it would be without.
                difference = follow(high) + leak * (begin + high) - reference
                target = on if difference >= on else -off if difference <= -off else None
                if target is None:
                    break
                left, right = low, high
                for _ in range(90):
                    half = (left + right) / 2
                    reached = follow(half) + leak * (begin + half) - reference
                    left, right = (left, half) if (reached >= target) == (target > 0) else (half, right)
                reference += target
                now = begin + right
                by_light, by_leak = follow(right) - level, leak * (now - turned)
                turned, level = now, follow(right)
                if now - last >= options.refractory_us:
                    last = now
                    events.append((now, int(target > 0), bool(target < 0 or by_light >= by_leak)))
        filtered = follow(span)
    return events


def compare(intensity, t_us, options, sensor_seed=3):
    """Counts and polarities equal, times to 1e-9 of themselves; returns the number of events."""
    height, width = intensity.shape[1:]
    sensor = Sensor((width, height), options, sensor_seed=sensor_seed, seed=0, marks=True)
    events, exact_us = sensor.push_exact(intensity, t_us)
    maps = sample_pixel_maps((width, height), options, sensor_seed)
    for y, x in np.ndindex(height, width):
        mine = (events.y == y) & (events.x == x)
        expected = precise_pixel(
            intensity[:, y, x], t_us, maps.threshold_on[y, x], maps.threshold_off[y, x], maps.leak[y, x], options
        )
        assert events.p[mine].tolist() == [polarity for _, polarity, _ in expected]
        assert events.signal is not None and events.signal[mine].tolist() == [signal for _, _, signal in expected]
        np.testing.assert_allclose(exact_us[mine], [float(time) for time, _, _ in expected], rtol=1e-9, atol=0)
        rounded = np.floor(exact_us[mine] + 0.5) + t_us[0]
        np.testing.assert_array_equal(events.t[mine], rounded)
    return len(events)


@pytest.mark.parametrize("cutoff_dark_hz", [None, 15.0], ids=["no_lag", "lag"])
@pytest.mark.parametrize("refractory_us", [0, 700])
@pytest.mark.parametrize("leak_rate_hz", [0.0, 3.0])
def test_counts_and_times_of_random_light(cutoff_dark_hz, refractory_us, leak_rate_hz):
    rng = np.random.default_rng(int(refractory_us + 10 * leak_rate_hz))
    intensity = np.exp(np.cumsum(rng.normal(0, 0.4, (14, 2, 3)), axis=0) - 2.0)
    intensity[rng.random(intensity.shape) < 0.1] = 0.0
    intensity[5:9, 0] = intensity[5, 0]
    t_us = np.cumsum(rng.integers(1, 9000, 14)).astype(np.int64)
    options = SensorOptions(
        threshold=0.25,
        threshold_off=0.2,
        threshold_sigma=0.05,
        cutoff_dark_hz=cutoff_dark_hz,
        refractory_us=refractory_us,
        leak_rate_hz=leak_rate_hz,
        rate_spread=0.4,
        starts_settled=False,
    )
    assert compare(intensity, t_us, options) > 30


@pytest.mark.parametrize("cutoff_dark_hz", [None, 15.0], ids=["no_lag", "lag"])
def test_what_leak_and_light_did_together_is_told_apart(cutoff_dark_hz):
    """Light about as slow as leak: every share of the way to a threshold occurs, and `compare` looks at the marks."""
    rng = np.random.default_rng(8)
    intensity = np.exp(np.cumsum(rng.normal(0, 0.08, (40, 2, 3)), axis=0) - 2.0)
    options = SensorOptions(
        threshold_sigma=0.03, leak_rate_hz=8.0, cutoff_dark_hz=cutoff_dark_hz, rate_spread=0.5, starts_settled=False
    )
    assert compare(intensity, 20_000 * np.arange(40), options) > 30


@pytest.mark.parametrize("clock_us", [0, 10**9, 1_700_000_000_000_000])
def test_a_late_clock_costs_no_precision(clock_us):
    rng = np.random.default_rng(4)
    intensity = np.exp(rng.normal(-1, 1, (6, 1, 2)))
    assert compare(intensity, clock_us + 4000 * np.arange(6), SensorOptions(starts_settled=False)) > 20


def test_a_contrast_of_a_million_and_back():
    intensity = np.array([1.0, 1e6, 1.0, 1e-6, 1e6])[:, None, None]
    options = SensorOptions(log_floor=1e-7, starts_settled=False)
    assert compare(intensity, np.array([0, 3, 1000, 1010, 2000]), options) > 300


def test_overshoot_between_two_frames():
    """The low-passed signal goes on up for a while after the light has begun to fall: events of both signs."""
    options = SensorOptions(threshold=0.06, cutoff_dark_hz=20.0, cutoff_bright_hz=20.0, starts_settled=False)
    intensity = np.exp(np.array([-3.0, -1.5, -1.5, -4.5]))[:, None, None]
    t_us = np.array([0, 1000, 5000, 60_000])
    events = simulate_events(intensity, t_us, options, sensor_seed=3, seed=0)
    last = events.p[events.t > 5000]
    assert last[0] == 1 and last[-1] == 0
    assert compare(intensity, t_us, options) > 15


@pytest.mark.parametrize(("threshold", "num_events"), [(0.2, 3_000), (0.07, 20_000)])
def test_real_frames(threshold, num_events):
    """Eleven pictures of a real camera: counts and polarities of every pixel as a loop in plain Python finds them."""
    folder = REAL_DATA / "frames"
    if not folder.is_dir():
        pytest.skip("the real frames are not beside this checkout")
    rows = [line.split() for line in (folder / "info.txt").read_text().splitlines()]
    pictures = [cv2.imread(str(folder / name.rpartition("/")[2]), cv2.IMREAD_GRAYSCALE) for name, _ in rows]
    t_us = np.array([int(time) for _, time in rows])
    intensity = np.stack([picture for picture in pictures if picture is not None]) / 255
    assert intensity.shape == (11, 180, 240)
    changes = {"threshold": threshold, "starts_settled": False, "refractory_us": 300, "leak_rate_hz": 0.1}
    options = PRESETS["clean"].model_copy(update=changes)
    events = simulate_events(intensity, t_us, options, sensor_seed=1, seed=0)
    maps = sample_pixel_maps((240, 180), options, 1)
    got: dict[tuple[int, int], list] = {}
    for t, x, y, p in zip(events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True):
        got.setdefault((y, x), []).append((t, p))
    for place in np.ndindex(180, 240):
        on, off, leak = (float(plane[place]) for plane in (maps.threshold_on, maps.threshold_off, maps.leak))
        expected = plain_pixel(intensity[:, *place].tolist(), t_us.tolist(), on, off, leak, options)
        mine = got.get(place, [])
        assert [p for _, p in mine] == [p for _, p in expected]
        # Rounding to whole microseconds: half of one.
        assert all(abs(a - b) <= 0.5 + 1e-6 for (a, _), (b, _) in zip(mine, expected, strict=True))
    assert len(events) > num_events


def plain_pixel(light, t_us, on, off, leak_per_s, options):
    """As `precise_pixel`, in floats, for a pixel without low-pass."""
    floor = options.log_floor
    response = [math.log(v) if v > floor else math.log(floor) + (v - floor) / floor for v in light]
    reference, last, events = response[0], -math.inf, []
    for (t0, v0), (t1, v1) in itertools.pairwise(zip(t_us, response, strict=True)):
        while True:
            begin, end = (v + 1e-6 * leak_per_s * (t - t_us[0]) for v, t in ((v0, t0), (v1, t1)))
            step = on if end - reference >= on else -off if end - reference <= -off else 0.0
            if step == 0.0:
                break
            reference += step
            now = t0 + (t1 - t0) * (reference - begin) / (end - begin)
            if now - last >= options.refractory_us:
                last = now
                events.append((now, int(step > 0)))
    return events
