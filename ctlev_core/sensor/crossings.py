"""When the difference of a DVS pixel reaches its thresholds between two frames, compiled.

    difference(s) = difference + slope s + gain (1 - exp(-s / lag_us))

`solve_crossings` does this for many pixels at once, each of which only rises or only falls; `follow_pixel` for one,
which may turn round, stand still, or send noise.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from ctlev_core.sensor.pixel_math import draw_exponential, draw_uniform, one_minus_exp

NOISE = 2
"""Added to the polarity of an event that is noise."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def solve_crossings(slope, gain, target, latest, curve, at, number):
    """When slope x + gain (1 - exp(-x)), rising to `curve` from 0 to `latest`, reaches `target`."""
    for n in range(number):
        a, b, c, end = slope[n], gain[n], target[n], latest[n]
        # From v x / (1 + w x), which leaves 0 as steeply and arrives at the same place.
        velocity = a + b
        x = c / (velocity - (velocity / curve[n] - 1.0 / end) * c)
        x = x if 0.0 <= x <= end else 0.5 * end
        low, high, x, moved = _halley(a, b, c, 0.0, end, x)
        low, high, x, moved = _halley(a, b, c, low, high, x)
        low, high, x, moved = _halley(a, b, c, low, high, x)
        # Each step cubes the relative error.
        at[n] = x if moved <= 1e-7 * x else np.nan


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _halley(a, b, c, low, high, x):
    """A step of Halley's method in a bracket."""
    share = one_minus_exp(x)
    excess = a * x + b * share - c
    high = x if excess >= 0.0 else high
    low = low if excess >= 0.0 else x
    pull = b * (1.0 - share)
    velocity = a + pull
    x_new = x - excess * velocity / (velocity * velocity + 0.5 * excess * pull)
    x_new = x_new if low <= x_new <= high else 0.5 * (low + high)
    return low, high, x_new, abs(x_new - x)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def find_crossing(target, slope, gain, lag_us, low, high, rises):
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
def find_turn(slope, gain, lag_us, arrived, s_end, curve_end):
    """Where line and exponential pull apart, the difference may turn round once; s_end = it does not.

    Returns when, how far the curve has come by then, and whether it rises before and after.
    """
    rises_first, rises_last = slope * lag_us + gain > 0.0, slope * lag_us + gain * (1.0 - arrived) > 0.0
    if rises_first == rises_last:
        return s_end, curve_end, rises_first, rises_last
    turn = min(max(-lag_us * math.log(-slope * lag_us / gain), 0.0), s_end)
    return turn, slope * turn - gain * math.expm1(-turn / lag_us), rises_first, rises_last


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _next_crossing(
    difference, slope, gain, lag_us, on, off, s, turn, curve_turn, rises_first, s_end, curve_end, rises_last
):  # fmt: skip
    """When from s on the difference reaches a threshold, and whether it rises to it; inf = not before s_end."""
    if s < turn:
        target = (on if rises_first else -off) - difference
        if (curve_turn >= target) == rises_first:
            return find_crossing(target, slope, gain, lag_us, s, turn, rises_first), rises_first
    if s >= turn or turn < s_end:
        target = (on if rises_last else -off) - difference
        if (curve_end >= target) == rises_last:
            return find_crossing(target, slope, gain, lag_us, max(s, turn), s_end, rises_last), rises_last
    return np.inf, False


@numba.njit(cache=True, nogil=True, error_model="numpy")
def share_arrived(s, lag_us, gain):
    """1 - exp(-s / lag_us), where there is anything to multiply it by."""
    return -math.expm1(-s / lag_us) if gain != 0.0 else 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def follow_pixel(
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
        turn, curve_turn, rises_first, rises_last = find_turn(slope, gain, lag_us, arrived, s_end, curve_end)
    crossing_at, rises = np.inf, False
    while True:
        if seeks:
            crossing_at, rises = _next_crossing(
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
            random, choice = draw_uniform(random)
            random, more = draw_exponential(random)
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
