"""The loops behind counts from event images, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit

KICKS = 64
_ROUNDING, _NARROW = 1e-12, 1e-9
"""Relative; ends of ranges are moved out by so much, so that rounding loses no scale that fits, and those that are
narrower than the second are rounding alone."""


@njit(cache=True, nogil=True)
def read_values(frame: np.ndarray, values: np.ndarray, frequencies: np.ndarray) -> None:
    """The channels of an event image, and how often they have each value.

    Args:
        frame: [H, W, 3] uint8.
        values: [C, H, W] uint8, filled: red and blue for C = 2; for C = 1 the mean of the three channels, rounded.
        frequencies: [256] int64, zeros on entry; filled.
    """
    num_channels, height, width = values.shape
    for row in range(height):
        for column in range(width):
            red, green, blue = frame[row, column]
            if num_channels == 2:
                values[0, row, column], values[1, row, column] = red, blue
                frequencies[red] += 1
                frequencies[blue] += 1
            else:
                mean = np.uint8((2 * (np.int64(red) + np.int64(green) + np.int64(blue)) + 3) // 6)
                values[0, row, column] = mean
                frequencies[mean] += 1


@njit(cache=True, nogil=True)
def look_up(values: np.ndarray, table: np.ndarray, counts: np.ndarray, saturated: np.ndarray) -> int:
    """Counts of an image by a table of values; cells whose table entry is negative are listed.

    Args:
        values: [cells] uint8.
        table: [256] int64; negative = saturated.
        counts: [cells] int64, filled.
        saturated: [cells] int64; its start is filled with the saturated cells.
    Returns:
        How many saturated cells there are.
    """
    used = 0
    for cell in range(len(values)):
        count = table[values[cell]]
        counts[cell] = count
        if count < 0:
            saturated[used] = cell
            used += 1
    return used


@njit(cache=True, nogil=True)
def find_scale_ranges(values: np.ndarray, low: float, high: float, ranges: np.ndarray) -> int:
    """All full scales at which every value is a grey level: v = floor(255 k / scale) for some count k.

    A value v and a count k allow the scales above 255 k / (v + 1), up to 255 k / v. Below 255, where neighbouring
    levels differ, the ranges of one value do not overlap; the ranges of several values are cut with one another.

    Args:
        values: [V] int64, 1 .. 254, each once.
        low: scales above this are looked at.
        high: scales up to this, at most 255.
        ranges: [B, 2] float64, filled with (low end, excluded; high end, included), ascending.
    Returns:
        How many ranges there are; -1 if they are more than B.
    """
    other = np.empty_like(ranges)
    current, following = ranges, other
    current[0, 0], current[0, 1] = low, high
    used = 1 if low < high else 0
    for value in values:
        found = 0
        for number in range(used):
            start, stop = current[number]
            for count in range(max(1, int(start * value / 255.0)), int(stop * (value + 1) / 255.0) + 2):
                first = max(start, 255.0 * count / (value + 1) * (1.0 - _ROUNDING))
                last = min(stop, 255.0 * count / value * (1.0 + _ROUNDING))
                if first * (1.0 + _NARROW) < last:
                    if found == len(ranges):
                        return -1
                    following[found, 0], following[found, 1] = first, last
                    found += 1
        current, following = following, current
        used = found
    ranges[:used] = current[:used]
    return used


@njit(cache=True, nogil=True)
def settle_saturated(
    totals: np.ndarray, pixels: np.ndarray, counts: np.ndarray, least: int, low: float, high: float, draws: np.ndarray
) -> bool:
    """Change the counts of saturated cells until three standard deviations of the totals lie in a range.

    Random steps, kept where they bring the standard deviation closer to the middle of the range: one event more or less
    in a cell, which moves the sum of squares far, or one event from a cell to another, which moves it little. Where no
    step helps any more, some events are added or taken away at random, up to `KICKS` times.

    Args:
        totals: [P] int64, events of each pixel that has any, those of `counts` included; changed.
        pixels: [S] int64, the row of `totals` that each saturated cell belongs to.
        counts: [S] int64, events of the saturated cells, none below `least`; changed.
        least: fewest events of a saturated cell.
        low: three standard deviations (divisor P - 1) shall be above this
        high: and at most this.
        draws: [D, 2] int64, random cells, 0 .. S - 1; used again from the start when all are used.
    Returns:
        Do they lie in the range now?
    """
    num_pixels = max(len(totals), 1)
    mean = totals.sum() / num_pixels
    # Moments about a fixed place near the mean: sums of squares of the counts themselves would cancel.
    moments = np.zeros(2)
    for value in totals:
        moments[0] += value - mean
        moments[1] += (value - mean) ** 2
    lowest, highest = (low / 3.0) ** 2 if low > 0 else -1.0, (high / 3.0) ** 2
    aim = ((low + high) / 6.0) ** 2
    unchanged, draw, kicks = 0, 0, 0
    variance = _variance(moments[0], moments[1], num_pixels)
    while not lowest < variance <= highest and len(draws) > 0 and kicks < KICKS:
        if unchanged == len(draws):
            kicks, unchanged = kicks + 1, 0
            for cell in draws[kicks % len(draws) :: max(len(draws) // 4, 1), 0]:
                sign = -1 if (cell + kicks) % 2 and counts[cell] > least else 1
                _add(sign, cell, counts, totals, pixels, mean, moments)
        elif _improve(draws[draw], counts, totals, pixels, least, mean, aim, moments):
            unchanged = 0
        else:
            unchanged += 1
        draw = (draw + 1) % len(draws)
        variance = _variance(moments[0], moments[1], num_pixels)
    return bool(lowest < variance <= highest)


@njit(cache=True, nogil=True)
def _variance(total: float, squares: float, num_pixels: int) -> float:
    return (squares - total * total / num_pixels) / max(num_pixels - 1, 1)


@njit(cache=True, nogil=True)
def _add(
    sign: int,
    cell: int,
    counts: np.ndarray,
    totals: np.ndarray,
    pixels: np.ndarray,
    mean: float,
    moments: np.ndarray,
) -> None:
    """One event more (sign 1) or less (-1) in a saturated cell, also in the moments (sum, sum of squares)."""
    moments[0] += sign
    moments[1] += 2 * sign * (totals[pixels[cell]] - mean) + 1
    counts[cell] += sign
    totals[pixels[cell]] += sign


@njit(cache=True, nogil=True)
def _improve(
    cells: np.ndarray,
    counts: np.ndarray,
    totals: np.ndarray,
    pixels: np.ndarray,
    least: int,
    mean: float,
    aim: float,
    moments: np.ndarray,
) -> bool:
    """Take the first of four steps with two cells that brings the variance closer to its aim; is there one?"""
    first, second = cells
    num_pixels = len(totals)
    error = abs(_variance(moments[0], moments[1], num_pixels) - aim)
    for sign, other in ((1, 0), (-1, 0), (1, -1), (-1, 1)):
        if counts[first] + sign < least or counts[second] + other < least:
            continue
        if other != 0 and pixels[first] == pixels[second]:
            continue
        squares = moments[1] + 2 * sign * (totals[pixels[first]] - mean) + 1
        if other != 0:
            squares += 2 * other * (totals[pixels[second]] - mean) + 1
        if abs(_variance(moments[0] + sign + other, squares, num_pixels) - aim) < error:
            _add(sign, first, counts, totals, pixels, mean, moments)
            if other != 0:
                _add(other, second, counts, totals, pixels, mean, moments)
            return True
    return False


@njit(cache=True, nogil=True)
def compare(first: np.ndarray, second: np.ndarray) -> tuple[int, int]:
    """Sum of the absolute differences of two images [H, W, 3] uint8, and values that are not 0 in both."""
    difference, seen = 0, 0
    for row in range(first.shape[0]):
        for column in range(first.shape[1]):
            for channel in range(3):
                a, b = np.int64(first[row, column, channel]), np.int64(second[row, column, channel])
                difference += abs(a - b)
                seen += 1 if a | b else 0
    return int(difference), int(seen)
