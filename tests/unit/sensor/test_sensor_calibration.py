"""Sensors of known options are recovered from the events they send."""

from pathlib import Path

import numpy as np
import pytest

from ctlev_core.realism.summary import summarise_events
from ctlev_core.sensor.calibration import calibrate, main
from ctlev_core.sensor.dvs_pixel import PRESETS, SensorOptions, read_preset, sample_pixel_maps, simulate_events
from data_contracts.errors import DataError
from data_contracts.events import Events

REAL_DATA = Path(__file__).resolve().parents[3].parent / "shared" / "real"
WIDTH, HEIGHT, SECONDS = 96, 72, 6


def scene():
    """A pattern swings to and fro on the left third, and comes back to where it was; the rest is still."""
    t_us = np.arange(0, SECONDS * 1_000_000 + 1, 5_000)
    column = np.arange(WIDTH)
    place = 6.0 * np.sin(2 * np.pi * 1.0 * 1e-6 * t_us)[:, None]
    waves = 0.9 * np.sin((column + place) / 2.0) + 0.5 * np.sin((column + place) / 4.3 + 1)
    row = np.where(column < WIDTH // 3, np.exp(waves - 1.6), 0.3)
    return np.repeat(row[:, None].astype(np.float32), HEIGHT, axis=1), t_us


@pytest.fixture(scope="module")
def frames():
    return scene()


def events_of(frames, **options):
    intensity, t_us = frames
    return simulate_events(intensity, t_us, SensorOptions(**options), sensor_seed=5, seed=6)


@pytest.mark.parametrize("sigma", [0.0, 0.02, 0.05])
@pytest.mark.parametrize("threshold_off", [0.2, 0.26])
def test_spread_and_imbalance_of_thresholds(frames, sigma, threshold_off):
    options = SensorOptions(
        threshold=0.2, threshold_off=threshold_off, threshold_sigma=sigma, shot_noise_rate_hz=0.3, leak_rate_hz=0.2
    )
    events = events_of(frames, **options.model_dump())
    calibration = calibrate(events, SensorOptions(threshold=0.2))
    # 2,300 pixels: the median is known to a hundredth. Polarities differ in relative spread; the mean square counts.
    assert calibration.measured["off_to_on_threshold"] == pytest.approx(threshold_off / 0.2, rel=0.02)
    assert calibration.options.threshold_off == pytest.approx(threshold_off, rel=0.02)
    maps = sample_pixel_maps((WIDTH, HEIGHT), options, 5)
    relative = np.std(np.log(maps.threshold_off / maps.threshold_on)[:, : WIDTH // 3]) / np.sqrt(2)
    assert calibration.measured["threshold_spread"] == pytest.approx(relative, rel=0.1, abs=0.01)


def test_off_thresholds_far_below_those_of_on(frames):
    """The base's least threshold, 0.05, lies above them."""
    options = SensorOptions(threshold=0.5, threshold_off=0.06, starts_settled=False)
    calibration = calibrate(events_of(frames, **options.model_dump()))
    assert calibration.options.threshold_off == pytest.approx(0.25 * 0.06 / 0.5, rel=0.05)
    assert calibration.options.threshold_minimum == pytest.approx(0.05 * 0.06 / 0.5, rel=0.05)
    assert "base" in calibration.assumed["threshold_minimum"]


def test_noise_and_leak(frames):
    events = events_of(frames, shot_noise_rate_hz=0.8, shot_noise_rate_bright=1.0, leak_rate_hz=0.3, rate_spread=0.5)
    options = calibrate(events).options
    # About 4,500 pixels x 6 s; their rates have a spread of their own, 0.5 / sqrt(4,500).
    assert options.shot_noise_rate_hz == pytest.approx(0.8, rel=0.06)
    # A leak starts anywhere between the thresholds: half an event a pixel is missing at the beginning.
    assert options.leak_rate_hz == pytest.approx(0.3 - 0.5 / SECONDS, rel=0.1)
    assert options.rate_spread == pytest.approx(0.5, rel=0.15)


def test_a_sensor_without_noise(frames):
    options = calibrate(events_of(frames)).options
    assert options.leak_rate_hz == options.shot_noise_rate_hz == options.hot_pixel_fraction == 0


@pytest.mark.parametrize("refractory_us", [2_000, 7_000])
def test_refractory_time(frames, refractory_us):
    calibration = calibrate(events_of(frames, refractory_us=refractory_us, threshold=0.02, threshold_minimum=0.02))
    assert calibration.options.refractory_us == pytest.approx(refractory_us, rel=0.02)
    assert calibration.measured["interval_on_grid_share"] < 0.3


def test_hot_pixels(frames):
    events = events_of(frames, hot_pixel_fraction=0.004, hot_rate_hz=(40.0, 90.0), shot_noise_rate_hz=0.2)
    calibration = calibrate(events)
    # Those in the pattern may hide among its events: two thirds of 28 are certain.
    assert 18 / 6912 <= calibration.options.hot_pixel_fraction <= 28 / 6912
    low, high = calibration.options.hot_rate_hz
    assert 33 < low < high < 100  # four standard deviations of a count of 240 and 540
    assert calibration.measured["hot_on_share"] > 0.97
    # The neighbourhood of hot pixels is no source of noise.
    assert calibration.options.shot_noise_rate_hz == pytest.approx(0.2 * (1 - 0.75 * 0.3), rel=0.1)


@pytest.mark.slow
def test_a_sensor_that_is_read_out_at_fixed_times(frames):
    events = events_of(frames, threshold=0.01, threshold_minimum=0.01)
    t = events.t // 1000 * 1000
    order = np.argsort(t, kind="stable")
    read_out = Events(t[order], events.x[order], events.y[order], events.p[order], events.sensor_size)
    one_a_period = np.unique(np.stack([read_out.t, read_out.y, read_out.x], axis=1), axis=0, return_index=True)[1]
    one_a_period.sort()
    t, x, y, p = (getattr(read_out, name)[one_a_period] for name in "txyp")
    kept = Events(t, x, y, p, events.sensor_size)
    assert calibrate(kept).measured["interval_on_grid_share"] > 0.99


def test_what_a_short_recording_does_not_tell_is_taken_from_the_base_and_named():
    events = Events(
        np.array([0, 5000, 9000]),
        np.array([1, 5, 9], np.uint16),
        np.array([1, 5, 9], np.uint16),
        np.ones(3, np.uint8),
        (12, 12),
    )
    base = PRESETS["dvs346"]
    calibration = calibrate(events, base)
    for name in (
        "threshold",
        "threshold_sigma",
        "refractory_us",
        "leak_rate_hz",
        "shot_noise_rate_hz",
        "cutoff_dark_hz",
    ):
        assert name in calibration.assumed and getattr(calibration.options, name) == getattr(base, name)
    for bad in (events.slice(0, 0), events.slice(0, 1)):
        with pytest.raises(DataError, match="over some time"):
            calibrate(bad)


def test_a_short_interval_bounds_the_refractory_time_however_rare_it_is():
    pixels = np.array([1, 1, 5], np.uint16)
    events = Events(np.array([0, 90, 9000]), pixels, pixels, np.ones(3, np.uint8), (12, 12))
    base = PRESETS["dvs346"]
    assert base.refractory_us > 90 and calibrate(events, base).options.refractory_us == 90


def test_a_missing_folder_is_said_before_anything_is_read(tmp_path):
    with pytest.raises(DataError, match=r"no folder .*absent to write into"):
        main([str(tmp_path / "none.raw"), "--out", str(tmp_path / "absent" / "preset.yaml")])


def test_the_real_person(tmp_path, capsys):
    """The preset of the real recording is read again, and a still scene before it is as noisy as the recording."""
    recording = REAL_DATA / "events" / "person" / "tonic_sample.aedat4"
    if not recording.is_file():
        pytest.skip("the real recordings are not beside this checkout")
    main([str(recording), "--out", str(tmp_path / "preset.yaml"), "--base", "dvs346"])
    assert "isolated_off_events" in capsys.readouterr().out
    options = read_preset(tmp_path / "preset.yaml")
    assert 0.05 < options.shot_noise_rate_hz < 0.12 and 0.005 < options.leak_rate_hz < 0.015
    assert options.refractory_us == 197
    assert options.hot_pixel_fraction == pytest.approx(60 / 76_800)
    options = options.model_copy(update={"hot_pixel_fraction": 0.0, "leak_rate_hz": 0.0})
    still = np.full((2, 240, 320), 0.3, np.float32)
    events = simulate_events(still, np.array([0, 590_000]), options, sensor_seed=0, seed=0)
    # 45,000 s of pixel time, 3,600 events; but rates of pixels differ by factors, sqrt(exp(1.84^2) / 76,800) = 2 %.
    noise_rate_hz = summarise_events(events).numbers["noise_rate_hz"]
    assert noise_rate_hz == pytest.approx(options.shot_noise_rate_hz, rel=0.15)
