"""The DVS pixel: from linear intensity over time to events, with the faults of a real sensor.

Each pixel compares its logarithmic, low-passed photocurrent with the level of its last event. Between two frames the
log intensity is taken as linear in time, so the low-pass is exact at the frames and event times are interpolated
between them, not rounded to them.

Source: Lichtsteiner et al., A 128x128 120 dB 15 us latency asynchronous temporal contrast vision sensor, JSSC 2008;
noise after Hu et al., v2e, CVPRW 2021; linear interpolation after Rebecq et al., ESIM, CoRL 2018.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from pydantic import Field

from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize, check_events


class SensorOptions(Frozen):
    """One kind of sensor. The defaults are an ideal one; `PRESETS["noisy"]` is a real one."""

    threshold: float = Field(default=0.2, gt=0, description="Mean log-intensity step of an event, both polarities.")
    threshold_sigma: float = Field(default=0.0, ge=0, description="Standard deviation of the thresholds over pixels.")
    threshold_minimum: float = Field(default=0.05, gt=0, description="No pixel is more sensitive than this.")
    log_floor: float = Field(default=0.02, gt=0, description="Below this intensity the response is linear; white is 1.")
    cutoff_dark_hz: float | None = Field(
        default=None, gt=0, description="Photoreceptor bandwidth in the dark; None = none."
    )
    cutoff_bright_hz: float = Field(default=180.0, gt=0, description="Photoreceptor bandwidth at white.")
    refractory_us: int = Field(default=0, ge=0, description="Time after an event in which a pixel stays silent.")
    leak_rate_hz: float = Field(
        default=0.0, ge=0, description="ON events a second of a pixel that sees nothing happen."
    )
    shot_rate_hz: float = Field(
        default=0.0, ge=0, description="Noise events a second of a dark pixel, either polarity."
    )
    shot_rate_bright: float = Field(default=0.25, ge=0, le=1, description="Share of the shot noise left at white.")
    rate_spread: float = Field(default=0.0, ge=0, description="Log-normal spread of leak and shot rates over pixels.")
    hot_pixel_fraction: float = Field(default=0.0, ge=0, le=1, description="Pixels that fire on their own.")
    hot_rate_hz: tuple[float, float] = Field(default=(20.0, 150.0), description="Their rates, uniform in this range.")
    starts_settled: bool = Field(
        default=True, description="False: the first frame is the reference level of every pixel."
    )


PRESETS = {
    "ideal": SensorOptions(starts_settled=False),
    "noisy": SensorOptions(
        threshold=0.25,
        threshold_sigma=0.035,
        cutoff_dark_hz=20.0,
        refractory_us=500,
        leak_rate_hz=0.25,
        shot_rate_hz=0.6,
        rate_spread=0.5,
        hot_pixel_fraction=0.0034,
    ),
}


@dataclass(frozen=True, eq=False)
class PixelMaps:
    """What distinguishes the pixels of one sensor, all [H, W] float64.

    Attributes:
        threshold_on: log-intensity step of an ON event.
        threshold_off: log-intensity step of an OFF event, positive.
        leak: fall of the reference level, log intensity per second.
        shot_rate_hz: noise events a second in the dark.
        hot_rate_hz: ON events a second of a hot pixel, 0 elsewhere.
    """

    threshold_on: np.ndarray
    threshold_off: np.ndarray
    leak: np.ndarray
    shot_rate_hz: np.ndarray
    hot_rate_hz: np.ndarray


def sample_pixel_maps(sensor_size: SensorSize, options: SensorOptions, seed: int | list[int]) -> PixelMaps:
    """The pixels of the sensor `seed`: the same sensor has the same mismatch and hot pixels for ever."""
    rng = np.random.default_rng(seed)
    shape = sensor_size[::-1]

    def thresholds() -> np.ndarray:
        return np.maximum(rng.normal(options.threshold, options.threshold_sigma, shape), options.threshold_minimum)

    def rates(mean: float) -> np.ndarray:
        # exp(-s^2 / 2) keeps the mean of the log-normal at 1.
        return mean * np.exp(rng.normal(-(options.rate_spread**2) / 2, options.rate_spread, shape))

    threshold_on, threshold_off = thresholds(), thresholds()
    leak, shot_rate_hz = rates(options.leak_rate_hz) * threshold_on, rates(options.shot_rate_hz)
    hot = rng.choice(math.prod(shape), round(options.hot_pixel_fraction * math.prod(shape)), replace=False)
    hot_rate_hz = np.zeros(shape)
    hot_rate_hz.ravel()[hot] = rng.uniform(*options.hot_rate_hz, len(hot))
    return PixelMaps(threshold_on, threshold_off, leak, shot_rate_hz, hot_rate_hz)


def simulate_events(
    intensity: np.ndarray,
    t_us: np.ndarray,
    options: SensorOptions,
    *,
    sensor_seed: int | list[int],
    seed: int | list[int],
) -> Events:
    """The events a sensor sends while it watches `intensity`.

    Args:
        intensity: [T, H, W] linear, non-negative, white = 1.
        t_us: [T] int64, times of the frames, increasing, not negative.
        options: the kind of sensor.
        sensor_seed: which one of that kind: thresholds, rates, hot pixels.
        seed: of this recording: noise and reference levels.
    Returns:
        Events in the order of their time, each within [t_us[0], t_us[-1]].
    Raises:
        DataError: shapes disagree, times do not increase, or an intensity is negative or not finite.
    """
    if intensity.ndim != 3 or 0 in intensity.shape:
        raise DataError(f"sensor: intensity must be [T, H, W] with T, H, W >= 1, got {intensity.shape}")
    if t_us.shape != (len(intensity),) or t_us.dtype != np.int64:
        raise DataError(f"sensor: t_us must be [{len(intensity)}] int64, got {t_us.shape} {t_us.dtype}")
    late = t_us[1:] <= t_us[:-1]
    if t_us[0] < 0 or late.any():
        frame = int(np.argmax(late)) + 1 if late.any() else 0
        raise DataError(f"sensor: frame times must increase from 0 or later, got t = {t_us[frame]} us at frame {frame}")
    if not np.isfinite(intensity).all() or intensity.min() < 0.0:
        raise DataError("sensor: intensity must be finite and not negative")
    height, width = intensity.shape[1:]
    maps = sample_pixel_maps((width, height), options, sensor_seed)
    t, x, y, p = _simulate(
        np.ascontiguousarray(intensity.transpose(1, 2, 0), dtype=np.float32),
        t_us,
        maps.threshold_on,
        maps.threshold_off,
        maps.leak,
        maps.shot_rate_hz,
        maps.hot_rate_hz,
        options.log_floor,
        options.cutoff_dark_hz or 0.0,
        options.cutoff_bright_hz,
        options.shot_rate_bright,
        options.refractory_us,
        options.starts_settled,
        np.random.SeedSequence(seed).generate_state(1, np.uint64)[0],
    )
    # Events come pixel by pixel; a stable sort keeps simultaneous ones in raster order.
    order = np.argsort(t, kind="stable")
    return check_events(Events(t[order], x[order], y[order], p[order], (width, height)), "sensor")


@numba.njit(cache=True, nogil=True)
def _simulate(
    intensity, t_us, threshold_on, threshold_off, leak, shot_rate_hz, hot_rate_hz,
    log_floor, cutoff_dark_hz, cutoff_bright_hz, shot_rate_bright, refractory_us, starts_settled, seed,
):  # fmt: skip
    """All pixels one after the other; intensity is [H, W, T]. Returns the columns t, x, y, p in raster order."""
    height, width = intensity.shape[:2]
    t, p = np.empty(4096, np.int64), np.empty(4096, np.uint8)
    x, y = np.empty(4096, np.uint16), np.empty(4096, np.uint16)
    count = 0
    for row in range(height):
        for column in range(width):
            pixel_seed = _mix(seed ^ _mix(np.uint64(row * width + column)))
            while True:
                end = _simulate_pixel(
                    intensity[row, column], t_us, threshold_on[row, column], threshold_off[row, column],
                    leak[row, column], shot_rate_hz[row, column], hot_rate_hz[row, column], log_floor,
                    cutoff_dark_hz, cutoff_bright_hz, shot_rate_bright, refractory_us, starts_settled,
                    pixel_seed, t, p, count,
                )  # fmt: skip
                if end <= len(t):
                    break
                # Too little room: the pixel is run again in larger columns.
                t, x, y, p = _enlarged(t, end), _enlarged(x, end), _enlarged(y, end), _enlarged(p, end)
            x[count:end] = column
            y[count:end] = row
            count = end
    return t[:count], x[:count], y[:count], p[:count]


@numba.njit(cache=True, nogil=True)
def _simulate_pixel(
    intensity, t_us, on, off, leak, shot, hot, log_floor, cutoff_dark_hz, cutoff_bright_hz, shot_rate_bright,
    refractory_us, starts_settled, state, t, p, count,
):  # fmt: skip
    """One pixel through time. Writes from row `count` on, as far as there is room; returns the row after the last."""
    state, start = _uniform(state)
    # A pixel that has been running for long may be anywhere between its two thresholds.
    difference = start * (on + off) - off if starts_settled else 0.0
    # Noise is a Poisson process of varying rate: an event falls whenever the summed rate has used up this allowance.
    state, allowance = _exponential(state)
    light = intensity[0]
    signal = filtered = _log_response(light, log_floor)
    last_us = -refractory_us - 1
    for frame in range(1, len(t_us)):
        span_us = t_us[frame] - t_us[frame - 1]
        span_s = 1e-6 * span_us
        light_before, signal_before, filtered_before, light = light, signal, filtered, intensity[frame]
        if light != light_before:
            signal = _log_response(light, log_floor)
        middle = min(0.5 * (light_before + light), 1.0)
        cutoff_hz = cutoff_dark_hz + (cutoff_bright_hz - cutoff_dark_hz) * middle if cutoff_dark_hz > 0.0 else 0.0
        filtered = _low_pass(filtered_before, signal_before, signal, span_s, cutoff_hz)
        # The leak lowers the reference level, which is as good as a rising signal.
        change = filtered - filtered_before + leak * span_s
        expected = (shot * (1.0 - (1.0 - shot_rate_bright) * middle) + hot) * span_s
        noise_at = allowance / expected if expected > 0.0 else np.inf
        while True:
            crossing_at = _crossing(difference, change, on, off)
            at = min(crossing_at, noise_at)
            if at > 1.0:
                break
            rises = change > 0.0
            if noise_at < crossing_at:
                state, choice = _uniform(state)
                rises = choice * (shot + hot) < 0.5 * shot + hot
                state, allowance = _exponential(state)
                noise_at += allowance / expected
            else:
                difference -= on if rises else -off
            now_us = t_us[frame - 1] + np.int64(at * span_us + 0.5)
            if now_us - last_us >= refractory_us:
                last_us = now_us
                if count < len(t):
                    t[count] = now_us
                    p[count] = rises
                count += 1
        difference += change
        if expected > 0.0:
            allowance = (noise_at - 1.0) * expected
    return count


@numba.njit(cache=True, nogil=True)
def _crossing(difference, change, on, off):
    """Fraction of the interval at which the difference to the reference level reaches a threshold; inf = not."""
    if change > 0.0:
        return max((on - difference) / change, 0.0)
    if change < 0.0:
        return max((-off - difference) / change, 0.0)
    return np.inf


@numba.njit(cache=True, nogil=True)
def _log_response(light, log_floor):
    """Log above the floor, its tangent below: finite at zero, without a kink."""
    if light > log_floor:
        return math.log(light)
    return math.log(log_floor) + (light - log_floor) / log_floor


@numba.njit(cache=True, nogil=True)
def _low_pass(filtered, signal_before, signal, span_s, cutoff_hz):
    """First-order low-pass after a ramp from `signal_before` to `signal`, exactly; no filter at cutoff 0."""
    if cutoff_hz <= 0.0 or (filtered == signal_before and signal == signal_before):
        return signal
    lag_s = 1.0 / (2.0 * math.pi * cutoff_hz)
    lag = lag_s * (signal - signal_before) / span_s
    return signal - lag + (filtered - signal_before + lag) * math.exp(-span_s / lag_s)


@numba.njit(cache=True, nogil=True)
def _mix(value):
    """The finaliser of splitmix64: every bit of the result depends on every bit of the value."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@numba.njit(cache=True, nogil=True)
def _uniform(state):
    """The next state and a number in [0, 1). A generator a pixel: no result depends on what other pixels did."""
    state = state + np.uint64(0x9E3779B97F4A7C15)
    return state, (_mix(state) >> np.uint64(11)) * (1.0 / (1 << 53))


@numba.njit(cache=True, nogil=True)
def _exponential(state):
    state, uniform = _uniform(state)
    return state, -math.log1p(-uniform)


@numba.njit(cache=True, nogil=True)
def _enlarged(column, needed):
    larger = np.empty(max(needed, 2 * len(column)), column.dtype)
    larger[: len(column)] = column
    return larger
