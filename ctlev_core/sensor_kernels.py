"""The loops of the DVS pixel, compiled.

Between two frames the light of a pixel has a log response that is linear in time, so its low-passed signal, and with it
the difference to the level of the last event, is a line and a decaying exponential:

    difference(s) = difference + slope s + gain (1 - exp(-s / lag_us)),        s in us since the pixel's `knot`.

That is followed exactly, also between frames: crossings are roots of this expression. The state of a pixel is its knot,
the last moment at which its light began or ceased to change. While light stands still, the knot stays where it is, and
a pixel is not looked at before something can happen (`due_us`): a still pixel costs two comparisons a frame.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

PIXEL_STATE = np.dtype(
    [
        ("knot_us", np.float64),  # since the first frame
        ("signal", np.float64),  # log response to the light at the knot
        ("lag", np.float64),  # low-passed signal less signal, at the knot
        ("difference", np.float64),  # low-passed signal less reference level, at the knot; thresholds are taken off it
        ("allowance", np.float64),  # noise strikes when the rate summed since the knot has used up this
        ("sent_us", np.float64),  # time of the last event that was not suppressed
        ("random", np.uint64),  # a generator a pixel: no result depends on what other pixels did
    ]
)


class Physics(NamedTuple):
    """What all pixels of a sensor share; `cutoff_dark_hz` 0 = no low-pass."""

    log_floor: float
    cutoff_dark_hz: float
    cutoff_bright_hz: float
    shot_rate_bright: float
    refractory_us: float


class FlatMaps(NamedTuple):
    """`PixelMaps` in raster order, [P] float64 each; the leak in log intensity per us."""

    threshold_on: np.ndarray
    threshold_off: np.ndarray
    leak: np.ndarray
    shot_rate_hz: np.ndarray
    hot_rate_hz: np.ndarray


@numba.njit(cache=True, nogil=True)
def first_bad(intensity):
    """Index of the first value of [P] that is not finite or negative; P = there is none."""
    for i in range(len(intensity)):
        if not (intensity[i] >= 0.0 and intensity[i] < np.inf):
            return i
    return len(intensity)


@numba.njit(cache=True, nogil=True)
def start(intensity, maps, physics, starts_settled, seed, state, due_us):
    """The state of all pixels at the first frame, [P] intensity."""
    for i in range(len(intensity)):
        on, off = maps.threshold_on[i], maps.threshold_off[i]
        random, share = _uniform(_mix(seed ^ _mix(np.uint64(i))))
        random, allowance = _exponential(random)
        # A pixel that has been running for long may be anywhere between its two thresholds.
        difference = share * (on + off) - off if starts_settled else 0.0
        light = np.float64(intensity[i])
        state[i].knot_us = 0.0
        state[i].signal = _log_response(light, physics.log_floor)
        state[i].lag = 0.0
        state[i].difference = difference
        state[i].allowance = allowance
        state[i].sent_us = -np.inf
        state[i].random = random
        rate, _ = _noise(light, i, maps, physics)
        due_us[i] = _due_us(0.0, difference, 0.0, maps.leak[i], on, off, allowance, rate)


@numba.njit(cache=True, nogil=True)
def advance(before, after, begin_us, end_us, maps, physics, state, due_us, pixel, exact_us, pixels, polarity, count):
    """All pixels, from `pixel` on, from one frame to the next.

    Args:
        before: [P] intensity at `begin_us`, float32 or float64.
        after: [P] intensity at `end_us`, of the same dtype.
        begin_us: since the first frame.
        end_us: since the first frame.
        maps: of the sensor.
        physics: of its kind.
        state: [P] of `PIXEL_STATE`, updated.
        due_us: [P], updated.
        pixel: where to begin.
        exact_us: [R] the times of the events found, since the first frame.
        pixels: [R] their pixels.
        polarity: [R] 1 = ON.
        count: rows that are filled already.
    Returns:
        The pixel to go on with, the rows filled, and the rows needed. When the first is P, all is done. Otherwise there
        was no room: that pixel was left as it is, and wants so many rows.
    """
    room = len(exact_us)
    span_us = end_us - begin_us
    for i in range(pixel, len(after)):
        light_before, light = np.float64(before[i]), np.float64(after[i])
        if light == light_before and end_us < due_us[i]:
            continue
        here = state[i]
        knot_us, signal, lag, difference, allowance = (
            here.knot_us, here.signal, here.lag, here.difference, here.allowance,
        )  # fmt: skip
        on, off, leak = maps.threshold_on[i], maps.threshold_off[i], maps.leak[i]
        rate, on_share = _noise(light_before, i, maps, physics)
        still_us = begin_us - knot_us
        if light == light_before:
            s, s_end, slope, gain, lag_us = still_us, end_us - knot_us, leak, -lag, _lag_us(light, physics)
            signal_after = signal
        else:
            if still_us > 0.0:
                settled = lag * _arrived(still_us, _lag_us(light_before, physics), lag)
                difference += leak * still_us - settled
                lag -= settled
                allowance -= rate * still_us
            signal_after = _log_response(light, physics.log_floor)
            middle = 0.5 * (light_before + light)
            rate, on_share = _noise(middle, i, maps, physics)
            ramp, lag_us = (signal_after - signal) / span_us, _lag_us(middle, physics)
            knot_us, s, s_end, slope, gain = begin_us, 0.0, span_us, ramp + leak, -(lag + ramp * lag_us)
        arrived = _arrived(s_end, lag_us, gain)
        difference, allowance, sent_us, random, end = _follow(
            knot_us, s, s_end, slope, gain, lag_us, arrived, on, off, difference, allowance, rate, on_share,
            physics.refractory_us, here.sent_us, here.random, exact_us, polarity, count,
        )  # fmt: skip
        if end > room:
            return i, count, end
        if light != light_before:
            difference += slope * s_end + gain * arrived
            lag += gain * arrived
            allowance -= rate * s_end
            knot_us, signal = end_us, signal_after
            rate, _ = _noise(light, i, maps, physics)
        pixels[count:end] = i
        count = end
        here.knot_us, here.signal, here.lag, here.difference = knot_us, signal, lag, difference
        here.allowance, here.sent_us, here.random = allowance, sent_us, random
        due_us[i] = _due_us(knot_us, difference, lag, leak, on, off, allowance, rate)
    return len(after), count, count


@numba.njit(cache=True, nogil=True)
def _follow(
    knot_us, s, s_end, slope, gain, lag_us, arrived, on, off, difference, allowance, rate, on_share, refractory_us,
    sent_us, random, exact_us, polarity, count,
):  # fmt: skip
    """Events of one pixel from s to s_end after its knot; writes as far as there is room, counts on all the same.

    `arrived` is 1 - exp(-s_end / lag_us). Thresholds that are crossed are taken off the `difference` at the knot.
    """
    curve_end = slope * s_end + gain * arrived
    reach = abs(slope) * s_end + abs(gain)
    seeks = reach > 0.0 and (difference + reach >= on or difference - reach <= -off)
    turn, curve_turn, rises_first, rises_last = s_end, curve_end, slope > 0.0, slope > 0.0
    if seeks and gain != 0.0:
        turn, curve_turn, rises_first, rises_last = _turn(slope, gain, lag_us, arrived, s_end, curve_end)
    crossing_at, rises = np.inf, False
    while True:
        if seeks:
            crossing_at, rises = _seek(
                difference, slope, gain, lag_us, on, off, s, turn, curve_turn, rises_first, s_end, curve_end, rises_last
            )
            seeks = False
        noise_at = max(allowance / rate, s) if rate > 0.0 else np.inf
        at = min(crossing_at, noise_at)
        if at > s_end:
            return difference, allowance, sent_us, random, count
        is_on = rises
        if noise_at < crossing_at:
            random, choice = _uniform(random)
            random, more = _exponential(random)
            is_on = choice < on_share
            allowance += more
        else:
            difference -= on if rises else -off
            seeks = True
        s = at
        if knot_us + at - sent_us >= refractory_us:
            sent_us = knot_us + at
            if count < len(exact_us):
                exact_us[count] = sent_us
                polarity[count] = is_on
            count += 1


@numba.njit(cache=True, nogil=True)
def _seek(
    difference, slope, gain, lag_us, on, off, s, turn, curve_turn, rises_first, s_end, curve_end, rises_last
):  # fmt: skip
    """When from s on the difference reaches a threshold, and whether it rises to it; inf = not before s_end."""
    if s < turn:
        target = (on if rises_first else -off) - difference
        if (curve_turn >= target) == rises_first:
            return _crossing(target, slope, gain, lag_us, s, turn, rises_first), rises_first
    if s >= turn or turn < s_end:
        target = (on if rises_last else -off) - difference
        if (curve_end >= target) == rises_last:
            return _crossing(target, slope, gain, lag_us, max(s, turn), s_end, rises_last), rises_last
    return np.inf, False


@numba.njit(cache=True, nogil=True)
def _turn(slope, gain, lag_us, arrived, s_end, curve_end):
    """Where line and exponential pull apart, the difference may turn round once; s_end = it does not.

    Returns when, how far the curve has come by then, and whether it rises before and after.
    """
    rises_first, rises_last = slope * lag_us + gain > 0.0, slope * lag_us + gain * (1.0 - arrived) > 0.0
    if rises_first == rises_last:
        return s_end, curve_end, rises_first, rises_last
    turn = min(max(-lag_us * math.log(-slope * lag_us / gain), 0.0), s_end)
    return turn, slope * turn - gain * math.expm1(-turn / lag_us), rises_first, rises_last


@numba.njit(cache=True, nogil=True)
def _crossing(target, slope, gain, lag_us, low, high, rises):
    """Where slope s + gain (1 - exp(-s / lag_us)), monotonic from low to high, reaches `target`.

    Halley's method in a bracket, from the root of the parabola that osculates at `low`.
    """
    if gain == 0.0:
        return min(max(target / slope, low), high)
    # In units of the time constant after `low`: a x + b (1 - exp(-x)) = c.
    less_one = math.expm1(-low / lag_us)
    a, b, c = slope * lag_us, gain * (1.0 + less_one), target - slope * low + gain * less_one
    x_low, x_high = 0.0, (high - low) / lag_us
    root = (a + b) * (a + b) - 2.0 * b * c
    x = 2.0 * c / (a + b + math.copysign(math.sqrt(root), a + b)) if root >= 0.0 and a + b != 0.0 else -1.0
    if not 0.0 <= x <= x_high:
        x = 0.5 * x_high
    for _ in range(100):
        less_one = math.expm1(-x)
        excess = a * x - b * less_one - c
        if (excess >= 0.0) == rises:
            x_high = x
        else:
            x_low = x
        pull = b * (1.0 + less_one)
        velocity = a + pull
        divisor = velocity * velocity + 0.5 * excess * pull
        x_new = x - excess * velocity / divisor if divisor != 0.0 else x_low
        if not x_low <= x_new <= x_high:
            x_new = 0.5 * (x_low + x_high)
        moved, x = abs(x_new - x), x_new
        # Each step cubes the relative error.
        if moved <= 1e-7 * x:
            break
    return low + x * lag_us


@numba.njit(cache=True, nogil=True)
def _arrived(s, lag_us, gain):
    """1 - exp(-s / lag_us), where there is anything to multiply it by."""
    return -math.expm1(-s / lag_us) if gain != 0.0 else 0.0


@numba.njit(cache=True, nogil=True)
def _due_us(knot_us, difference, lag, leak, on, off, allowance, rate):
    """Before this time nothing happens to a pixel whose light stays as it is; -inf = nobody knows."""
    highest, lowest = difference + max(-lag, 0.0), difference + min(-lag, 0.0)
    if highest >= on or lowest <= -off:
        return -np.inf
    leaks_at = (on - highest) / leak if leak > 0.0 else np.inf
    noise_at = allowance / rate if rate > 0.0 else np.inf
    return knot_us + min(leaks_at, noise_at)


@numba.njit(cache=True, nogil=True)
def _noise(light, i, maps, physics):
    """Noise events a us of pixel i under this light, and the share of ON events among them."""
    shot_hz = maps.shot_rate_hz[i] * (1.0 - (1.0 - physics.shot_rate_bright) * min(light, 1.0))
    rate_hz = shot_hz + maps.hot_rate_hz[i]
    return 1e-6 * rate_hz, (0.5 * shot_hz + maps.hot_rate_hz[i]) / rate_hz if rate_hz > 0.0 else 0.0


@numba.njit(cache=True, nogil=True)
def _lag_us(light, physics):
    """Time constant of the photoreceptor under this light; 0 = there is no low-pass."""
    if physics.cutoff_dark_hz <= 0.0:
        return 0.0
    cutoff_hz = physics.cutoff_dark_hz + (physics.cutoff_bright_hz - physics.cutoff_dark_hz) * min(light, 1.0)
    return 1e6 / (2.0 * math.pi * cutoff_hz)


@numba.njit(cache=True, nogil=True)
def _log_response(light, log_floor):
    """Log above the floor, its tangent below: finite at zero, without a kink."""
    if light > log_floor:
        return math.log(light)
    return math.log(log_floor) + (light - log_floor) / log_floor


@numba.njit(cache=True, nogil=True)
def stamp_positions(exact_us, begin_us, counters):
    """Row of each event of an interval in the order of its time in whole us, events of one us in the order given.

    Args:
        exact_us: [N], from begin_us to at most begin_us + C - 2.
        begin_us: where the interval begins; a whole number of us.
        counters: [C] int64, overwritten.
    """
    counters[:] = 0
    position = np.empty(len(exact_us), np.int64)
    for i in range(len(exact_us)):
        position[i] = np.int64(exact_us[i] - begin_us + 0.5)
        counters[position[i] + 1] += 1
    for value in range(1, len(counters)):
        counters[value] += counters[value - 1]
    for i in range(len(exact_us)):
        value = position[i]
        position[i] = counters[value]
        counters[value] += 1
    return position


@numba.njit(cache=True, nogil=True)
def write_columns(exact_us, pixels, polarity, position, begin_us, begin_t_us, width, t, x, y, p, exact_sorted_us):
    """The columns of `Events` from what `advance` found; `begin_t_us` is `begin_us` on the clock of the frames."""
    for i in range(len(exact_us)):
        row = position[i]
        t[row] = begin_t_us + np.int64(exact_us[i] - begin_us + 0.5)
        y[row] = pixels[i] // width
        x[row] = pixels[i] - (pixels[i] // width) * width
        p[row] = polarity[i]
        exact_sorted_us[row] = exact_us[i]


@numba.njit(cache=True, nogil=True)
def _mix(value):
    """The finaliser of splitmix64: every bit of the result depends on every bit of the value."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@numba.njit(cache=True, nogil=True)
def _uniform(random):
    """The next state of a generator, and a number in [0, 1)."""
    random = random + np.uint64(0x9E3779B97F4A7C15)
    return random, (_mix(random) >> np.uint64(11)) * (1.0 / (1 << 53))


@numba.njit(cache=True, nogil=True)
def _exponential(random):
    random, uniform = _uniform(random)
    return random, -math.log1p(-uniform)
