"""The loops of the DVS pixel, compiled.

Between two frames the light of a pixel has a log response that is linear in time, so its low-passed signal, and with it
the difference to the level of the last event, is a line and a decaying exponential:

    difference(s) = difference + slope s + gain (1 - exp(-s / lag_us)),        s in us since the pixel's `knot`.

That is followed exactly, also between frames: crossings are roots of this expression. The state of a pixel is its knot,
the last moment at which its light began or ceased to change. While light stands still, the knot stays where it is, and
a pixel is not looked at before something can happen (`due_us`): a still pixel costs two comparisons a frame.

Pixels that have something to do are advanced in groups, stage by stage: light, curves, thresholds within reach, times
of crossings, events, state. So loops are vectorised, and few branches are mispredicted. A call that hands on an array
costs as much as a pixel takes; it is made once a group. All is in one file because Numba's cache of a function does not
notice that a function of another file, which it calls, has changed.
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


BLOCK = 16
"""Pixels that are looked at together, whether any of them has something to do."""

NOISE = 2
"""Added to the polarity of an event that is noise."""

HALF_ROOT_BITS = 0x3FE6A09E667F3BCD
"""sqrt(1 / 2) in IEEE 754 double precision."""

GROUP = 512
"""Pixels that have something to do and are advanced together."""

MOST_CROSSINGS = 8
"""Of one pixel in one interval; one with more is followed by itself."""


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
        random, share = _draw_uniform(_mix(seed ^ _mix(np.uint64(i))))
        state.random[i], state.allowance[i] = _draw_exponential(random)
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
def advance(before, after, begin_us, end_us, traits, physics, state, pixel, exact_us, pixels, polarity, count):
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
    group, crossings = _new_group(), _new_crossings()
    number = 0
    for first in range(pixel - pixel % BLOCK, len(after), BLOCK):
        last = min(first + BLOCK, len(after))
        # Sums and minima, because the processor takes those of several pixels at once.
        change, soonest_us = 0.0, np.inf
        for i in range(first, last):
            change += abs(np.float64(after[i]) - np.float64(before[i]))
        for i in range(first, last):
            soonest_us = min(soonest_us, due_us[i])
        if change != 0.0 or end_us >= soonest_us:
            for i in range(max(first, pixel), last):
                group.pixel[number] = i
                group.light_before[number] = before[i]
                group.light[number] = after[i]
                number += after[i] != before[i] or end_us >= due_us[i]
        if number > 0 and (number > GROUP - BLOCK or last == len(after)):
            end = _advance_group(
                group, crossings, number, begin_us, end_us, traits, physics, state, exact_us, pixels, polarity, count
            )
            if end >= len(exact_us):
                return group.pixel[0], count, end
            count, number = end, 0
    return len(after), count, count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def advance_chosen(
    before, after, chosen, begin_us, end_us, traits, physics, state, number, exact_us, pixels, polarity, count
):
    """As `advance`, of the pixels `chosen` [K] alone.

    `before` and `after` [K] are their intensities, and `number` is which of them to begin with. Returns as `advance`;
    the first is K when all is done.
    """
    group, crossings = _new_group(), _new_crossings()
    filled, first = 0, number
    for k in range(number, len(chosen)):
        group.pixel[filled] = chosen[k]
        group.light_before[filled] = before[k]
        group.light[filled] = after[k]
        filled += after[k] != before[k] or end_us >= state.due_us[chosen[k]]
        if filled == GROUP or (filled > 0 and k == len(chosen) - 1):
            end = _advance_group(
                group, crossings, filled, begin_us, end_us, traits, physics, state, exact_us, pixels, polarity, count
            )
            if end >= len(exact_us):
                return first, count, end
            count, filled, first = end, 0, k + 1
    return len(chosen), count, count


# Groups of pixels -----------------------------------------------------------------------------------------------------


class Group(NamedTuple):
    """Pixels that are advanced together, [GROUP] each, float64 where nothing else is said."""

    pixel: np.ndarray
    """uint64."""
    light_before: np.ndarray
    light: np.ndarray
    response: np.ndarray
    """To the light at the end."""
    lag_us: np.ndarray
    """Time constant of the low-pass; 0 = none."""
    latest: np.ndarray
    """The interval in time constants."""
    arrived: np.ndarray
    """1 - exp(-s / lag_us) at the end."""
    end: np.ndarray
    """s at the end."""
    slope: np.ndarray
    gain: np.ndarray
    rate: np.ndarray
    """Noise events a us."""
    lag: np.ndarray
    difference: np.ndarray
    allowance: np.ndarray
    sent_us: np.ndarray
    random: np.ndarray
    reference_us: np.ndarray
    busy: np.ndarray
    """uint64: numbers of those of which something may happen."""


class Crossings(NamedTuple):
    """Thresholds that are crossed by the pixels of a group, [GROUP * MOST_CROSSINGS] each.

    What is crossed downwards is turned over, so that all rise.
    """

    owner: np.ndarray
    """uint64, number in the group."""
    step: np.ndarray
    """The threshold; negative = OFF; 0 = this pixel is to be followed by itself."""
    slope: np.ndarray
    """In units of the time constant."""
    gain: np.ndarray
    target: np.ndarray
    latest: np.ndarray
    """End of the interval, in time constants,"""
    curve: np.ndarray
    """and how far the difference comes by then."""
    at: np.ndarray
    """When, in time constants; NaN = not found."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _new_group():
    # Rows a power of two apart would compete for the same cache lines. Unsigned indices need no check for negatives.
    numbers = np.zeros((15, GROUP + 24))
    lists = np.empty((2, GROUP), np.uint64)
    return Group(
        lists[0], numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5], numbers[6], numbers[7],
        numbers[8], numbers[9], numbers[10], numbers[11], numbers[12], numbers[13], np.empty(GROUP, np.uint64),
        numbers[14], lists[1],
    )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _new_crossings():
    numbers = np.empty((7, GROUP * MOST_CROSSINGS + 40))
    return Crossings(
        np.empty(GROUP * MOST_CROSSINGS, np.uint64), numbers[0], numbers[1], numbers[2], numbers[3], numbers[4],
        numbers[5], numbers[6],
    )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _advance_group(
    group, crossings, number, begin_us, end_us, traits, physics, state, exact_us, pixels, polarity, count
):
    """The first `number` pixels of a group from one frame to the next; returns the rows needed.

    Where these are more than there are, no pixel has changed.
    """
    _lights(group, number, end_us - begin_us, physics)
    num_busy = _curves(group, number, begin_us, end_us, traits, physics, state)
    found = _list_crossings(group, crossings, num_busy, traits, physics, state)
    if physics.cutoff_dark_hz > 0.0:
        _solve_crossings(
            crossings.slope, crossings.gain, crossings.target, crossings.latest, crossings.curve, crossings.at, found
        )
    end = _events(group, crossings, found, begin_us, traits, physics, state, exact_us, pixels, polarity, count)
    if end < len(exact_us):
        _settle(group, number, num_busy, end_us, traits, state)
    return end


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lights(group, number, span_us, physics):
    """What depends on light alone."""
    light_before, light = group.light_before, group.light
    response, lag_us, latest, arrived = group.response, group.lag_us, group.latest, group.arrived
    for k in range(number):
        response[k] = _log_response(light[k], physics.log_floor)
    if physics.cutoff_dark_hz > 0.0:
        for k in range(number):
            lag_us[k] = _time_constant_us(0.5 * (light_before[k] + light[k]), physics)
        for k in range(number):
            latest[k] = span_us / lag_us[k]
        for k in range(number):
            arrived[k] = _one_minus_exp(latest[k])
    else:
        lag_us[:number] = 0.0
        arrived[:number] = 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _curves(group, number, begin_us, end_us, traits, physics, state):
    """The way of each difference, and how many pixels are busy: those of which something may happen."""
    num_busy = 0
    has_lag = physics.cutoff_dark_hz > 0.0
    for k in range(number):
        i = group.pixel[k]
        light_before, light, lag_us = group.light_before[k], group.light[k], group.lag_us[k]
        on, off, leak = traits.threshold_on[i], traits.threshold_off[i], traits.leak[i]
        hot, shot = traits.hot_rate[i], traits.shot_noise_rate[i]
        difference, lag, allowance = state.difference[i], state.lag[i], state.allowance[i]
        still_us = begin_us - state.knot_us[i]
        is_still = light == light_before
        if is_still:
            s_end, slope, gain = end_us - state.knot_us[i], leak, -lag
            group.arrived[k] = _share_arrived(s_end, lag_us, gain)
        else:
            if still_us > 0.0:
                settled = lag * _share_arrived(still_us, _time_constant_us(light_before, physics), lag)
                difference += leak * still_us - settled
                lag -= settled
                allowance -= (hot + _shot_noise_rate(light_before, shot, physics)) * still_us
            ramp = (group.response[k] - state.signal[i]) / (end_us - begin_us)
            s_end, slope, gain = end_us - begin_us, ramp + leak, -(lag + ramp * lag_us)
        rate = hot + _shot_noise_rate(0.5 * (light_before + light), shot, physics)
        arrived = group.arrived[k]
        group.end[k], group.slope[k], group.gain[k], group.rate[k] = s_end, slope, gain, rate
        group.lag[k], group.difference[k], group.allowance[k] = lag, difference, allowance
        highest = difference + max(slope * s_end, 0.0) + max(gain, 0.0)
        lowest = difference + min(slope * s_end, 0.0) + min(gain, 0.0)
        may_cross = (highest >= on) | (lowest <= -off)
        rises, turns = _direction(slope, gain, lag_us, arrived, has_lag)
        crosses = (slope * s_end + gain * arrived >= (on if rises else -off) - difference) == rises
        # Without a branch, which would be mispredicted half of the time.
        group.busy[num_busy] = k
        num_busy += (may_cross & (crosses | turns | is_still)) | (rate * s_end >= allowance)
    return num_busy


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _direction(slope, gain, lag_us, arrived, has_lag):
    """Whether the difference rises at first, and whether it turns round later."""
    if not has_lag:
        return slope > 0.0, False
    rises = slope * lag_us + gain > 0.0
    return rises, rises != (slope * lag_us + gain * (1.0 - arrived) > 0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _list_crossings(group, crossings, num_busy, traits, physics, state):
    """What each busy pixel crosses, where that is all that happens to it; the others are to be followed one by one.

    Returns how many entries of `crossings` there are.
    """
    found = 0
    has_lag = physics.cutoff_dark_hz > 0.0
    for number in range(num_busy):
        k = group.busy[number]
        i = group.pixel[k]
        slope, gain, lag_us, s_end = group.slope[k], group.gain[k], group.lag_us[k], group.end[k]
        arrived, rest = group.arrived[k], group.difference[k]
        group.sent_us[k], group.random[k] = state.sent_us[i], state.random[i]
        if len(state.reference_us) > 0:
            group.reference_us[k] = state.reference_us[i]
        rises, turns = _direction(slope, gain, lag_us, arrived, has_lag)
        step = traits.threshold_on[i] if rises else -traits.threshold_off[i]
        sign = 1.0 if rises else -1.0
        curve_end = slope * s_end + gain * arrived
        begin = found
        moves_without_noise = group.light[k] != group.light_before[k] and group.rate[k] * s_end < group.allowance[k]
        if turns and moves_without_noise:
            _, curve_turn, _, rises_last = _find_turn(slope, gain, lag_us, arrived, s_end, curve_end)
            last_step = traits.threshold_on[i] if rises_last else -traits.threshold_off[i]
            if ((curve_turn >= step - rest) != rises) and ((curve_end >= last_step - rest) != rises_last):
                continue  # it turns round before a threshold, and does not reach the other
        if not turns and moves_without_noise:
            while found < begin + MOST_CROSSINGS and (curve_end >= step - rest) == rises:
                crossings.owner[found], crossings.step[found] = k, step
                if has_lag:
                    crossings.slope[found], crossings.gain[found] = sign * (slope * lag_us), sign * gain
                    crossings.target[found], crossings.latest[found] = sign * (step - rest), group.latest[k]
                    crossings.curve[found] = sign * curve_end
                else:
                    crossings.at[found] = (step - rest) / slope
                rest -= step
                found += 1
        if found == begin or found == begin + MOST_CROSSINGS:
            crossings.owner[begin], crossings.step[begin] = k, 0.0
            crossings.slope[begin], crossings.gain[begin] = 1.0, 0.0
            crossings.target[begin], crossings.latest[begin], crossings.curve[begin] = 0.0, 1.0, 1.0
            found = begin + 1
    return found


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _events(group, crossings, found, begin_us, traits, physics, state, exact_us, pixels, polarity, count):
    """Write the events of a group in the order of its pixels; returns the rows needed.

    The last row is for what there is no room for.
    """
    room = len(exact_us) - 1
    has_lag = physics.cutoff_dark_hz > 0.0
    marks = len(state.reference_us) > 0
    before, at = np.uint64(GROUP), 0.0
    for n in range(found):
        k, step, next_at = crossings.owner[n], crossings.step[n], crossings.at[n]
        i = group.pixel[k]
        if step == 0.0:
            still_us = begin_us - state.knot_us[i] if group.light[k] == group.light_before[k] else 0.0
            (
                group.difference[k], group.allowance[k], group.sent_us[k], group.random[k], group.reference_us[k], end
            ) = _follow_pixel(
                begin_us - still_us, still_us, group.end[k], group.slope[k], group.gain[k], group.lag_us[k],
                group.arrived[k], traits.threshold_on[i], traits.threshold_off[i], group.difference[k],
                group.allowance[k], group.rate[k], traits.hot_rate[i], physics.refractory_us, group.sent_us[k],
                group.random[k], traits.leak[i], group.reference_us[k], exact_us, polarity, count,
            )  # fmt: skip
            for row in range(count, min(end, room)):
                pixels[row] = i
            count = end
            continue
        at = at if k == before else 0.0
        if has_lag:
            next_at *= group.lag_us[k]
            if not next_at >= 0.0:
                next_at = _find_crossing(
                    step - group.difference[k], group.slope[k], group.gain[k], group.lag_us[k], at, group.end[k],
                    step > 0.0,
                )  # fmt: skip
        at, before = min(max(next_at, at), group.end[k]), k
        group.difference[k] -= step
        moment_us = begin_us + at
        is_noise = False
        if marks:
            is_noise = step > 0.0 and traits.leak[i] * (moment_us - group.reference_us[k]) > 0.5 * step
            group.reference_us[k] = moment_us
        is_sent = moment_us - group.sent_us[k] >= physics.refractory_us
        group.sent_us[k] = moment_us if is_sent else group.sent_us[k]
        row = min(count, room)
        exact_us[row], pixels[row], polarity[row] = moment_us, i, (step > 0.0) + NOISE * is_noise
        count += is_sent
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _settle(group, number, num_busy, end_us, traits, state):
    """The state of the pixels of a group at the end of the interval."""
    for k in range(number):
        i = group.pixel[k]
        if group.light[k] == group.light_before[k]:
            state.difference[i], state.allowance[i] = group.difference[k], group.allowance[k]
            state.due_us[i] = _due_us(
                state.knot_us[i], group.difference[k], group.lag[k], traits.leak[i], traits.threshold_on[i],
                traits.threshold_off[i], group.allowance[k], group.rate[k],
            )  # fmt: skip
        else:
            # When it is due is worked out once it stands still.
            state.due_us[i] = -np.inf
            s_end, bend = group.end[k], group.gain[k] * group.arrived[k]
            state.knot_us[i], state.signal[i] = end_us, group.response[k]
            state.lag[i] = group.lag[k] + bend
            state.difference[i] = group.difference[k] + (group.slope[k] * s_end + bend)
            state.allowance[i] = group.allowance[k] - group.rate[k] * s_end
    for n in range(num_busy):
        k = group.busy[n]
        i = group.pixel[k]
        state.sent_us[i], state.random[i] = group.sent_us[k], group.random[k]
        if len(state.reference_us) > 0:
            state.reference_us[i] = group.reference_us[k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _due_us(knot_us, difference, lag, leak, on, off, allowance, rate):
    """Before this time nothing happens to a pixel whose light stays as it is; -inf = nobody knows."""
    highest, lowest = difference + max(-lag, 0.0), difference + min(-lag, 0.0)
    if highest >= on or lowest <= -off:
        return -np.inf
    leaks_at = (on - highest) / leak if leak > 0.0 else np.inf
    noise_at = allowance / rate if rate > 0.0 else np.inf
    return knot_us + min(leaks_at, noise_at)


# Crossings ------------------------------------------------------------------------------------------------------------


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _solve_crossings(slope, gain, target, latest, curve, at, number):
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
    share = _one_minus_exp(x)
    excess = a * x + b * share - c
    high = x if excess >= 0.0 else high
    low = low if excess >= 0.0 else x
    pull = b * (1.0 - share)
    velocity = a + pull
    x_new = x - excess * velocity / (velocity * velocity + 0.5 * excess * pull)
    x_new = x_new if low <= x_new <= high else 0.5 * (low + high)
    return low, high, x_new, abs(x_new - x)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _find_crossing(target, slope, gain, lag_us, low, high, rises):
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
def _find_turn(slope, gain, lag_us, arrived, s_end, curve_end):
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
            return _find_crossing(target, slope, gain, lag_us, s, turn, rises_first), rises_first
    if s >= turn or turn < s_end:
        target = (on if rises_last else -off) - difference
        if (curve_end >= target) == rises_last:
            return _find_crossing(target, slope, gain, lag_us, max(s, turn), s_end, rises_last), rises_last
    return np.inf, False


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _share_arrived(s, lag_us, gain):
    """1 - exp(-s / lag_us), where there is anything to multiply it by."""
    return -math.expm1(-s / lag_us) if gain != 0.0 else 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _follow_pixel(
    knot_us, s, s_end, slope, gain, lag_us, arrived, on, off, difference, allowance, rate, hot, refractory_us,
    sent_us, random, leak, since_us, exact_us, polarity, count,
):  # fmt: skip
    """Events of one pixel from s to s_end after its knot; writes as far as there is room, then counts on.

    `arrived` is 1 - exp(-s_end / lag_us). Thresholds that are crossed are taken off the `difference` at the knot.
    """
    curve_end = slope * s_end + gain * arrived
    turn, curve_turn, rises_first, rises_last = s_end, curve_end, slope > 0.0, slope > 0.0
    if gain != 0.0:
        turn, curve_turn, rises_first, rises_last = _find_turn(slope, gain, lag_us, arrived, s_end, curve_end)
    crossing_at, rises, seeks = np.inf, False, True
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
            random, choice = _draw_uniform(random)
            random, more = _draw_exponential(random)
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


# Light and random numbers ---------------------------------------------------------------------------------------------


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
def _time_constant_us(light, physics):
    """Time constant of the photoreceptor under this light; 0 = there is no low-pass."""
    if physics.cutoff_dark_hz <= 0.0:
        return 0.0
    cutoff_hz = physics.cutoff_dark_hz + (physics.cutoff_bright_hz - physics.cutoff_dark_hz) * min(light, 1.0)
    return 1e6 / (2.0 * math.pi * cutoff_hz)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shot_noise_rate(light, shot, physics):
    """Shot noise events a us under this light."""
    return shot * (1.0 - (1.0 - physics.shot_noise_rate_bright) * min(light, 1.0))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _one_minus_exp(x):
    """1 - exp(-x) of x >= 0, to an ulp or two; several at once, where the library's takes one number at a time.

    exp(-x) = 2^-k exp(r) with |r| <= log(2) / 2, and exp(r) - 1 by its series.
    """
    x = np.float64(min(x, 64.0))
    shifted = np.float64(x * 1.4426950408889634 + 6755399441055744.0)
    k = shifted - 6755399441055744.0
    r = (k * 0.6931471803691238 - x) + k * 1.9082149292705877e-10
    r2 = r * r
    r4 = r2 * r2
    low = 1.0 / 2 + r * (1.0 / 6) + r2 * (1.0 / 24 + r * (1.0 / 120))
    middle = 1.0 / 720 + r * (1.0 / 5040) + r2 * (1.0 / 40320 + r * (1.0 / 362880))
    high = 1.0 / 3628800 + r * (1.0 / 39916800) + r2 * (1.0 / 479001600 + r * (1.0 / 6227020800))
    series = r + r2 * (low + r4 * (middle + r4 * high))
    power = np.int64((np.int64(1023) << 52) - (shifted.view(np.int64) << 52)).view(np.float64)
    return (1.0 - power) - power * series


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mix(value):
    """The finaliser of splitmix64: every bit of the result depends on every bit of the value."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _draw_uniform(random):
    """The next state of a generator, and a number in [0, 1)."""
    random = random + np.uint64(0x9E3779B97F4A7C15)
    return random, (_mix(random) >> np.uint64(11)) * (1.0 / (1 << 53))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _draw_exponential(random):
    """The next state of a generator, and a number of the exponential distribution of mean 1."""
    random, uniform = _draw_uniform(random)
    return random, -math.log1p(-uniform)
