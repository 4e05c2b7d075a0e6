"""The loops behind event streams, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def place_events(
    counts: np.ndarray,
    places: np.ndarray,
    uniforms: np.ndarray,
    gaps: np.ndarray,
    patterns: np.ndarray,
    ranges: np.ndarray,
    keep_polarity: float,
    duration_us: int,
    t: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    p: np.ndarray,
) -> None:
    """Give the events of each pixel their times: one after another, with the gaps of a real pixel.

    Of a real pixel with another number of events, gaps are drawn, and stretched until they take as long in all.

    Args:
        counts: [C, H, W] uint16; channels (positive, negative), or one whose events are positive.
        places: [A] float64, 0 .. 1, of the A pixels that have events, row by row: where between the earliest and the
            latest possible start its events start.
        uniforms: [2, E] float64, 0 .. 1 without 1, for the gap before each event and for its polarity.
        gaps: [G] float64, times between two events of a real pixel, in windows, pixel after pixel.
        patterns: [P + 1] int64, where the gaps of each recorded pixel start.
        ranges: [M, 2] int64, the patterns to draw from for 2, 3, ... M + 1 or more events; none is empty.
        keep_polarity: probability that an event has the polarity of the one before, where both are left.
        duration_us: of the window.
        t: [E] int64, us, 0 .. duration_us, filled pixel by pixel.
        x: [E] uint16, filled.
        y: [E] uint16, filled.
        p: [E] uint8, filled.
    """
    num_channels, height, width = counts.shape
    moments = np.empty(len(t))
    event, pixel = 0, 0
    for row in range(height):
        for column in range(width):
            positive = int(counts[0, row, column])
            number = positive + (int(counts[1, row, column]) if num_channels == 2 else 0)
            if number == 0:
                continue
            stop = event + number
            span = _real_moments(uniforms[0, event:stop], gaps, patterns, ranges, moments[event:stop])
            _draw_polarities(positive, uniforms[1, event:stop], keep_polarity, p[event:stop])
            for placed in range(event, stop):
                moment = places[pixel] * (1.0 - span) + moments[placed]
                t[placed] = min(max(np.int64(moment * (duration_us + 1)), 0), duration_us)
                x[placed], y[placed] = column, row
            event, pixel = stop, pixel + 1


@njit(cache=True, nogil=True)
def _real_moments(
    uniforms: np.ndarray, gaps: np.ndarray, patterns: np.ndarray, ranges: np.ndarray, moments: np.ndarray
) -> float:
    """Times since a pixel's first event, in windows; returns that of its last."""
    moments[0] = 0.0
    number = len(moments)
    if number == 1:
        return 0.0
    low, high = ranges[min(number - 2, len(ranges) - 1)]
    drawn = low + int(uniforms[0] * (high - low))
    real = gaps[patterns[drawn] : patterns[drawn + 1]]
    for i in range(1, number):
        gap = i - 1 if len(real) == number - 1 else int(uniforms[i] * len(real))
        moments[i] = moments[i - 1] + real[gap]
    if len(real) != number - 1 and moments[-1] > 0:
        moments *= real.sum() / moments[-1]
    return moments[-1]


@njit(cache=True, nogil=True)
def _draw_polarities(positive: int, uniforms: np.ndarray, keep_polarity: float, p: np.ndarray) -> None:
    """The order of a pixel's positive and negative events."""
    is_positive = False
    for i in range(len(p)):
        left, chance = len(p) - i, uniforms[i]
        if positive == 0 or positive == left:
            is_positive = positive > 0
        elif i == 0:
            is_positive = chance * left < positive
        elif chance >= keep_polarity:
            # What is left of the random number is uniform again.
            is_positive = (chance - keep_polarity) / (1.0 - keep_polarity) * left < positive
        if is_positive:
            positive -= 1
        p[i] = 1 if is_positive else 0


@njit(cache=True, nogil=True)
def put_off(t: np.ndarray, pixels: np.ndarray, windows: np.ndarray, interval_us: int, least_gap_us: int) -> None:
    """Keep the events of a pixel apart where one window follows another.

    Args:
        t: [E] int64, us, ascending within a pixel; changed in place.
        pixels: [E] int64, ascending.
        windows: [E] int64, which window an event belongs to.
        interval_us: window k lasts from k times the interval on, until the next begins.
        least_gap_us: an event that follows one of the window before sooner is put off until so much time has passed,
            and those behind it that it comes too near to; none beyond the end of its window.
    """
    put_off_one = False
    for event in range(1, len(t)):
        if pixels[event] != pixels[event - 1]:
            put_off_one = False
            continue
        is_first = windows[event] != windows[event - 1]
        earliest = t[event - 1] + least_gap_us
        put_off_one = (is_first or put_off_one) and t[event] < earliest
        if put_off_one:
            t[event] = max(t[event], min(earliest, (windows[event] + 1) * interval_us - 1))
