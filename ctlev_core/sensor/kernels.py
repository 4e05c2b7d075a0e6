"""The loops of the DVS pixel, compiled.

Between two frames the light of a pixel has a log response that is linear in time, so its low-passed signal, and with it
the difference to the level of the last event, is a line and a decaying exponential:

    difference(s) = difference + slope s + gain (1 - exp(-s / lag_us)),        s in us since the pixel's `knot`.

That is followed exactly, also between frames: crossings are roots of this expression. The state of a pixel is its knot,
the last moment at which its light began or ceased to change. While light stands still, the knot stays where it is, and
a pixel is not looked at before something can happen (`due_us`): a still pixel costs two comparisons a frame.

The two large functions are inlined because a call that hands on an array costs as much as a pixel takes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np


class PixelState(NamedTuple):
    """What a pixel remembers, [P] each."""

    knot_us: np.ndarray
    """float64, since the first frame."""
    signal: np.ndarray
    """float64, log response to the light at the knot."""
    lag: np.ndarray
    """float64, low-passed signal less signal, at the knot."""
    difference: np.ndarray
    """float64, low-passed signal less reference level, at the knot; thresholds that are crossed are taken off it."""
    allowance: np.ndarray
    """float64: noise strikes when the rate summed since the knot has used up this."""
    sent_us: np.ndarray
    """float64, time of the last event that was not suppressed."""
    random: np.ndarray
    """uint64, a generator a pixel: no result depends on what other pixels did."""
    due_us: np.ndarray
    """float64: nothing happens earlier to a pixel whose light stays as it is; -inf = nobody knows."""
    reference_us: np.ndarray
    """float64: since then the leak has been at work on the way to the next threshold; [0] = events are not marked."""


class PixelTraits(NamedTuple):
    """`PixelMaps` in raster order, [P] float64 each."""

    threshold_on: np.ndarray
    threshold_off: np.ndarray
    leak: np.ndarray
    """Log intensity per us."""
    shot_noise_rate: np.ndarray
    """Per us, in the dark."""
    hot_rate: np.ndarray
    """Per us."""


NOISE = 2
"""Added to the polarity of an event that is noise."""

BLOCK = 16
"""Pixels that are looked at together, whether any of them has something to do."""

HALF_ROOT_BITS = 0x3FE6A09E667F3BCD
"""sqrt(1 / 2) in IEEE 754 double precision."""


class Physics(NamedTuple):
    """What all pixels of a sensor share; `cutoff_dark_hz` 0 = no low-pass."""

    log_floor: float
    cutoff_dark_hz: float
    cutoff_bright_hz: float
    shot_noise_rate_bright: float
    refractory_us: float


@numba.njit(cache=True, nogil=True, error_model="numpy")
def start(intensity, traits, physics, starts_settled, seed, state):
    """The state of all pixels at the first frame, [P] intensity."""
    for i in range(len(intensity)):
        on, off = traits.threshold_on[i], traits.threshold_off[i]
        random, share = _uniform(_mix(seed ^ _mix(np.uint64(i))))
        state.random[i], state.allowance[i] = _exponential(random)
        # A pixel that has been running for long may be anywhere between its two thresholds.
        state.difference[i] = share * (on + off) - off if starts_settled else 0.0
        state.signal[i] = _log_response(np.float64(intensity[i]), physics.log_floor)
        state.knot_us[i] = state.lag[i] = 0.0
        state.sent_us[i] = state.due_us[i] = -np.inf
        # Where a pixel starts part of the way to a threshold, nobody knows what took it there: half of it counts as the
        # leak's, so that it decides nothing.
        if len(state.reference_us) > 0:
            state.reference_us[i] = -0.5 * state.difference[i] / traits.leak[i] if traits.leak[i] > 0.0 else 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def advance(  # noqa: C901 calls that hand on arrays are slow here
    before, after, begin_us, end_us, traits, physics, state, pixel, exact_us, pixels, polarity, count
):
    """All pixels, from `pixel` on, from one frame to the next.

    Args:
        before: [P] intensity at `begin_us`, float32 or float64.
        after: [P] intensity at `end_us`, of the same dtype.
        begin_us: since the first frame.
        end_us: since the first frame.
        traits: of the pixels.
        physics: of the kind of sensor.
        state: of the pixels, updated.
        pixel: where to begin.
        exact_us: [R] the times of the events found, since the first frame.
        pixels: [R] their pixels.
        polarity: [R] 1 = ON; and `NOISE`.
        count: rows that are filled already.
    Returns:
        The pixel to go on with, the rows filled, and the rows needed. When the first is P, all is done. Otherwise there
        was no room: that pixel was left as it is, and wants so many rows at least.
    """
    due_us = state.due_us
    marks = len(state.reference_us) > 0
    responses = np.empty(BLOCK)
    for first in range(pixel - pixel % BLOCK, len(after), BLOCK):
        last = min(first + BLOCK, len(after))
        # Sums and minima, because the processor takes those of several pixels at once.
        change, soonest_us = 0.0, np.inf
        for i in range(first, last):
            change += abs(np.float64(after[i]) - np.float64(before[i]))
        for i in range(first, last):
            soonest_us = min(soonest_us, due_us[i])
        if change == 0.0 and end_us < soonest_us:
            continue
        for i in range(first, last):
            responses[i - first] = _log_response(np.float64(after[i]), physics.log_floor)
        for i in range(max(first, pixel), last):
            light_before, light = np.float64(before[i]), np.float64(after[i])
            if light_before == light and end_us < due_us[i]:
                continue
            since_us = state.reference_us[i] if marks else 0.0
            (knot_us, signal, lag, difference, allowance, sent_us, random, due, since_us), end = _advance_pixel(
                light_before, light, responses[i - first], begin_us, end_us,
                traits.threshold_on[i], traits.threshold_off[i], traits.leak[i], traits.shot_noise_rate[i],
                traits.hot_rate[i], physics, state.knot_us[i], state.signal[i], state.lag[i], state.difference[i],
                state.allowance[i], state.sent_us[i], state.random[i], since_us, exact_us, polarity, count,
            )  # fmt: skip
            if end > len(exact_us):
                return i, count, end
            state.knot_us[i], state.signal[i], state.lag[i], state.difference[i] = knot_us, signal, lag, difference
            state.allowance[i], state.sent_us[i], state.random[i], due_us[i] = allowance, sent_us, random, due
            if marks:
                state.reference_us[i] = since_us
            for row in range(count, end):
                pixels[row] = i
            count = end
    return len(after), count, count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def advance_chosen(
    before, after, chosen, begin_us, end_us, traits, physics, state, number, exact_us, pixels, polarity, count
):
    """As `advance`, of the pixels `chosen` [K] alone.

    `before` and `after` [K] are their intensities, and `number` is which of them to begin with. Returns as `advance`;
    the first is K when all is done. Its step stands here once more: shared through an inlined function, `advance` took
    2.5 times as long.
    """
    marks = len(state.reference_us) > 0
    for k in range(number, len(chosen)):
        i = chosen[k]
        light_before, light = np.float64(before[k]), np.float64(after[k])
        if light_before == light and end_us < state.due_us[i]:
            continue
        since_us = state.reference_us[i] if marks else 0.0
        (knot_us, signal, lag, difference, allowance, sent_us, random, due, since_us), end = _advance_pixel(
            light_before, light, _log_response(light, physics.log_floor), begin_us, end_us,
            traits.threshold_on[i], traits.threshold_off[i], traits.leak[i], traits.shot_noise_rate[i],
            traits.hot_rate[i], physics, state.knot_us[i], state.signal[i], state.lag[i], state.difference[i],
            state.allowance[i], state.sent_us[i], state.random[i], since_us, exact_us, polarity, count,
        )  # fmt: skip
        if end > len(exact_us):
            return k, count, end
        state.knot_us[i], state.signal[i], state.lag[i], state.difference[i] = knot_us, signal, lag, difference
        state.allowance[i], state.sent_us[i], state.random[i], state.due_us[i] = allowance, sent_us, random, due
        if marks:
            state.reference_us[i] = since_us
        for row in range(count, end):
            pixels[row] = i
        count = end
    return len(chosen), count, count


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _advance_pixel(
    light_before, light, response, begin_us, end_us, on, off, leak, shot, hot, physics, knot_us, signal, lag,
    difference, allowance, sent_us, random, since_us, exact_us, polarity, count,
):  # fmt: skip
    """One pixel from one frame to the next: its new `PixelState`, and the rows filled."""
    still_us = begin_us - knot_us
    is_still = light == light_before
    if is_still:
        rate = hot + _shot_noise_rate(light, shot, physics)
        s, s_end, slope, gain, lag_us = still_us, end_us - knot_us, leak, -lag, _lag_us(light, physics)
    else:
        if still_us > 0.0:
            settled = lag * _arrived(still_us, _lag_us(light_before, physics), lag)
            difference += leak * still_us - settled
            lag -= settled
            allowance -= (hot + _shot_noise_rate(light_before, shot, physics)) * still_us
        middle = 0.5 * (light_before + light)
        rate = hot + _shot_noise_rate(middle, shot, physics)
        signal_before, signal = signal, response
        s_end, lag_us = end_us - begin_us, _lag_us(middle, physics)
        ramp = (signal - signal_before) / s_end
        knot_us, s, slope, gain = begin_us, 0.0, ramp + leak, -(lag + ramp * lag_us)
    arrived = _arrived(s_end, lag_us, gain)
    end = count
    highest = difference + max(slope * s_end, 0.0) + max(gain, 0.0)
    lowest = difference + min(slope * s_end, 0.0) + min(gain, 0.0)
    may_cross = highest >= on or lowest <= -off
    if may_cross or rate * s_end >= allowance:
        difference, allowance, sent_us, random, since_us, end = _follow(
            knot_us, s, s_end, slope, gain, lag_us, arrived, on, off, difference, allowance, rate, hot, may_cross,
            physics.refractory_us, sent_us, random, leak, since_us, exact_us, polarity, count,
        )  # fmt: skip
    # When it is due is worked out once it stands still.
    due_us = -np.inf
    if is_still:
        due_us = _due_us(knot_us, difference, lag, leak, on, off, allowance, rate)
    else:
        knot_us = end_us
        lag += gain * arrived
        difference += slope * s_end + gain * arrived
        allowance -= rate * s_end
    return (knot_us, signal, lag, difference, allowance, sent_us, random, due_us, since_us), end


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _follow(
    knot_us, s, s_end, slope, gain, lag_us, arrived, on, off, difference, allowance, rate, hot, seeks, refractory_us,
    sent_us, random, leak, since_us, exact_us, polarity, count,
):  # fmt: skip
    """Events of one pixel from s to s_end after its knot; writes as far as there is room, then counts on.

    `arrived` is 1 - exp(-s_end / lag_us); `seeks` says whether a threshold is within reach. Thresholds that are crossed
    are taken off the `difference` at the knot.
    """
    curve_end = slope * s_end + gain * arrived
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
        noise_at = max(allowance / rate, s) if rate * s_end >= allowance else np.inf
        at = min(crossing_at, noise_at)
        # Far too little room: what is missing is not counted to its end.
        if at > s_end or count > 2 * len(exact_us):
            return difference, allowance, sent_us, random, since_us, count
        is_on, is_noise = rises, True
        if noise_at < crossing_at:
            random, choice = _uniform(random)
            random, more = _exponential(random)
            is_on = choice * rate < 0.5 * (rate + hot)
            allowance += more
        else:
            difference -= on if rises else -off
            seeks = True
            # The rest of the way was light's.
            is_noise = rises and leak * (knot_us + at - since_us) > 0.5 * on
            since_us = knot_us + at
        s = at
        if knot_us + at - sent_us >= refractory_us:
            sent_us = knot_us + at
            if count < len(exact_us):
                exact_us[count] = sent_us
                polarity[count] = is_on + NOISE * is_noise
            count += 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turn(slope, gain, lag_us, arrived, s_end, curve_end):
    """Where line and exponential pull apart, the difference may turn round once; s_end = it does not.

    Returns when, how far the curve has come by then, and whether it rises before and after.
    """
    rises_first, rises_last = slope * lag_us + gain > 0.0, slope * lag_us + gain * (1.0 - arrived) > 0.0
    if rises_first == rises_last:
        return s_end, curve_end, rises_first, rises_last
    turn = min(max(-lag_us * math.log(-slope * lag_us / gain), 0.0), s_end)
    return turn, slope * turn - gain * math.expm1(-turn / lag_us), rises_first, rises_last


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _arrived(s, lag_us, gain):
    """1 - exp(-s / lag_us), where there is anything to multiply it by."""
    return -math.expm1(-s / lag_us) if gain != 0.0 else 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _due_us(knot_us, difference, lag, leak, on, off, allowance, rate):
    """Before this time nothing happens to a pixel whose light stays as it is; -inf = nobody knows."""
    highest, lowest = difference + max(-lag, 0.0), difference + min(-lag, 0.0)
    if highest >= on or lowest <= -off:
        return -np.inf
    leaks_at = (on - highest) / leak if leak > 0.0 else np.inf
    noise_at = allowance / rate if rate > 0.0 else np.inf
    return knot_us + min(leaks_at, noise_at)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shot_noise_rate(light, shot, physics):
    """Shot noise events a us under this light."""
    return shot * (1.0 - (1.0 - physics.shot_noise_rate_bright) * min(light, 1.0))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lag_us(light, physics):
    """Time constant of the photoreceptor under this light; 0 = there is no low-pass."""
    if physics.cutoff_dark_hz <= 0.0:
        return 0.0
    cutoff_hz = physics.cutoff_dark_hz + (physics.cutoff_bright_hz - physics.cutoff_dark_hz) * min(light, 1.0)
    return 1e6 / (2.0 * math.pi * cutoff_hz)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _log_response(light, log_floor):
    """Log above the floor, its tangent below: finite at zero, without a kink.

    The logarithm is worked out here, to an ulp or two, because the library's does one number at a time, and a loop
    over this one takes several: log(2^k m) = k log(2) + 2 artanh((m - 1) / (m + 1)) with m in [0.71, 1.41].
    """
    above = np.float64(max(light, log_floor))
    bits = np.int64(above.view(np.int64))
    exponent = (bits - HALF_ROOT_BITS) >> 52
    mantissa = np.int64(bits - (exponent << 52)).view(np.float64)
    z = (mantissa - 1.0) / (mantissa + 1.0)
    w = z * z
    series = 1 / 19 + w * (1 / 21 + w * (1 / 23))
    series = 1 / 13 + w * (1 / 15 + w * (1 / 17 + w * series))
    series = 1 / 7 + w * (1 / 9 + w * (1 / 11 + w * series))
    series = w * (1 / 3 + w * (1 / 5 + w * series))
    return exponent * math.log(2.0) + (2.0 * z + 2.0 * z * series) + min(light - log_floor, 0.0) / log_floor


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mix(value):
    """The finaliser of splitmix64: every bit of the result depends on every bit of the value."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _uniform(random):
    """The next state of a generator, and a number in [0, 1)."""
    random = random + np.uint64(0x9E3779B97F4A7C15)
    return random, (_mix(random) >> np.uint64(11)) * (1.0 / (1 << 53))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _exponential(random):
    random, uniform = _uniform(random)
    return random, -math.log1p(-uniform)
