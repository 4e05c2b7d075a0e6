"""Events marked as signal or noise: exact with respect to the simulator, and without any effect on the events."""

import numpy as np
import pytest

from ctlev_core.sensor.dvs_pixel import PRESETS, Sensor, SensorOptions

SIZE = (24, 20)
NOISY = SensorOptions(
    threshold_sigma=0.03,
    cutoff_dark_hz=20.0,
    leak_rate_hz=2.0,
    shot_noise_rate_hz=3.0,
    rate_spread=0.5,
    hot_pixel_fraction=0.02,
)


def film(num_frames=60, speed=0.6):
    """Waves that move over a dark and a bright half."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    base = np.where(x < SIZE[0] // 2, 0.08, 0.6)
    return np.stack([base * np.exp(0.5 * np.sin(0.5 * (x - speed * k) + 0.3 * y)) for k in range(num_frames)])


def simulate(options, frames, marks=True, interval_us=10_000):
    sensor = Sensor(SIZE, options, sensor_seed=1, seed=2, marks=marks)
    return sensor.push(frames, interval_us * np.arange(len(frames)))


def signal_of(events):
    """The marks, which are there."""
    assert events.signal is not None and events.signal.shape == events.t.shape
    return events.signal


def columns(events, chosen=None):
    chosen = np.ones(len(events), bool) if chosen is None else chosen
    return np.stack([getattr(events, name)[chosen].astype(np.int64) for name in "txyp"])


def test_the_first_frame_has_no_events_and_no_marks():
    events = Sensor(SIZE, NOISY, sensor_seed=1, seed=2, marks=True).push(film(1), np.array([0]))
    assert len(events) == 0 and signal_of(events).dtype == np.bool_


@pytest.mark.parametrize("name", PRESETS)
def test_marks_change_no_event(name):
    marked, plain = simulate(PRESETS[name], film()), simulate(PRESETS[name], film(), marks=False)
    assert plain.signal is None
    np.testing.assert_array_equal(columns(marked), columns(plain))
    both = np.concatenate([columns(marked, signal_of(marked)), columns(marked, ~signal_of(marked))], axis=1)
    assert sorted(both.T.tolist()) == sorted(columns(plain).T.tolist()) and len(plain) > 1000


def test_without_noise_all_is_signal():
    quiet = NOISY.model_copy(update={"leak_rate_hz": 0.0, "shot_noise_rate_hz": 0.0, "hot_pixel_fraction": 0.0})
    events = simulate(quiet, film())
    assert signal_of(events).all() and len(events) > 1000


@pytest.mark.parametrize("settled", [False, True])
@pytest.mark.parametrize("only", ["leak_rate_hz", "shot_noise_rate_hz", "hot_pixel_fraction", ""])
def test_a_still_scene_has_nothing_but_noise(only, settled):
    rates = ("leak_rate_hz", "shot_noise_rate_hz", "hot_pixel_fraction")
    changes = {name: 0.0 for name in rates if only and name != only} | {"starts_settled": settled}
    events = simulate(NOISY.model_copy(update=changes), np.repeat(film(1), 100, axis=0), interval_us=20_000)
    assert not signal_of(events).any() and len(events) > 100


def test_without_its_shot_noise_a_recording_is_that_of_a_sensor_without():
    """Noise leaves reference levels alone, so what is not noise is the recording of the same sensor that has none."""
    without = NOISY.model_copy(update={"leak_rate_hz": 0.0})
    events = simulate(without, film())
    expected = simulate(without.model_copy(update={"shot_noise_rate_hz": 0.0, "hot_pixel_fraction": 0.0}), film())
    assert 100 < (~signal_of(events)).sum() < len(events) / 2
    np.testing.assert_array_equal(columns(events, signal_of(events)), columns(expected))


def test_about_as_many_are_signal_as_a_sensor_without_leak_sends():
    leaking = SensorOptions(threshold_sigma=0.03, leak_rate_hz=4.0)
    frames = film(200, speed=0.1)
    frames[:, :, 12:] = frames[0, :, 12:]
    events = simulate(leaking, frames)
    expected = len(simulate(leaking.model_copy(update={"leak_rate_hz": 0.0}), frames))
    assert (~signal_of(events)).sum() > 1000
    assert not signal_of(events)[events.x >= 12].any()
    assert signal_of(events).sum() == pytest.approx(expected, rel=0.1)


def test_portions_of_frames_and_little_room_change_no_mark():
    whole = simulate(NOISY, film())
    sensor = Sensor(SIZE, NOISY, sensor_seed=1, seed=2, marks=True)
    sensor._rows = (np.empty(3), np.empty(3, np.int32), np.empty(3, np.uint8))
    parts = [sensor.push(film()[k : k + 7], 10_000 * np.arange(60)[k : k + 7]) for k in range(0, 60, 7)]
    np.testing.assert_array_equal(np.concatenate([*map(signal_of, parts)]), signal_of(whole))


def test_pixels_seen_between_frames_have_the_same_marks():
    frames, t_us = film(8), 10_000 * np.arange(8)
    moving = np.arange(0, SIZE[0] * SIZE[1], 3)
    others = np.setdiff1d(np.arange(SIZE[0] * SIZE[1]), moving)
    flat = frames.reshape(8, -1)
    flat[:, others] = flat[0, others]
    whole, some = (Sensor(SIZE, NOISY, sensor_seed=1, seed=2, marks=True) for _ in range(2))
    expected = whole.push(frames, t_us)
    some.push(frames[:1], t_us[:1])
    found = some.push_between(moving, flat[1:7, moving], t_us[1:7], frames[7], int(t_us[7]))
    rows = [np.vstack([columns(one), signal_of(one)]) for one in (found, expected)]
    orders = [np.lexsort(one[[3, 1, 2, 0]]) for one in rows]
    np.testing.assert_array_equal(rows[0][:, orders[0]], rows[1][:, orders[1]])
