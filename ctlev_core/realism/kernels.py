"""The loops behind the realism summary, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def count_and_time(
    t: np.ndarray, x: np.ndarray, y: np.ndarray, edges_us: np.ndarray, counts: np.ndarray, intervals: np.ndarray
) -> None:
    """Events of each pixel, and the times between one event of a pixel and its next.

    Args:
        t: [N] int64, us, non-decreasing.
        x: [N] uint16, px, inside the sensor.
        y: [N] uint16, px, inside the sensor.
        edges_us: [B - 1] float64, ascending: where one bin ends and the next begins.
        counts: [H, W] int64, zeros on entry; filled.
        intervals: [B] int64, zeros on entry; filled. Both polarities count.
    """
    last = np.zeros(counts.shape, np.int64)
    for event in range(len(t)):
        row, column = y[event], x[event]
        if counts[row, column] > 0:
            intervals[np.searchsorted(edges_us, t[event] - last[row, column], side="right")] += 1
        counts[row, column] += 1
        last[row, column] = t[event]


@njit(cache=True, nogil=True)
def find_hot_pixels(counts: np.ndarray, factor: float, min_count: int, is_hot: np.ndarray) -> None:
    """Pixels that fire far more often than those around them.

    Args:
        counts: [H, W] int64.
        factor: a hot pixel has more than this many times the second largest count of its up to 8 neighbours, or of 1
            if that is less. Not the largest: two hot pixels may touch. Not the median: an edge has few active pixels.
        min_count: and at least so many events.
        is_hot: [H, W] bool, filled.
    """
    height, width = counts.shape
    for row in range(height):
        for column in range(width):
            largest = second = 1
            for other_row in range(max(row - 1, 0), min(row + 2, height)):
                for other_column in range(max(column - 1, 0), min(column + 2, width)):
                    if other_row != row or other_column != column:
                        count = counts[other_row, other_column]
                        second = max(second, min(largest, count))
                        largest = max(largest, count)
            is_hot[row, column] = counts[row, column] >= min_count and counts[row, column] > factor * second


@njit(cache=True, nogil=True)
def find_isolated(
    t: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    radius_us: int,
    covered_until: np.ndarray,
    last_event: np.ndarray,
    is_isolated: np.ndarray,
) -> float:
    """Events that none of the 8 pixels around them joins within `radius_us`, before or after.

    Args:
        t: [N] int64, us, non-decreasing, N > 0.
        x: [N] uint16, px, inside the sensor.
        y: [N] uint16, px, inside the sensor.
        radius_us: how far before and after to look; an event exactly that far away joins.
        covered_until: [H, W] int64, overwritten.
        last_event: [H, W] int64, overwritten.
        is_isolated: [N] bool, filled.
    Returns:
        Pixel-microseconds, between the first and the last event, in which one more event would not be isolated: each
        event covers its 8 neighbours from `radius_us` before to `radius_us` after it.
    """
    height, width = last_event.shape
    is_isolated[:] = True
    last_event[:] = -1
    covered_until[:] = t[0]
    covered = 0.0
    for event in range(len(t)):
        end = min(t[event] + radius_us, t[-1])
        for row in range(max(np.int64(y[event]) - 1, 0), min(np.int64(y[event]) + 2, height)):
            for column in range(max(np.int64(x[event]) - 1, 0), min(np.int64(x[event]) + 2, width)):
                if row == y[event] and column == x[event]:
                    continue
                covered += max(0, end - max(covered_until[row, column], t[event] - radius_us))
                covered_until[row, column] = end
                before = last_event[row, column]
                if before >= 0 and t[event] - t[before] <= radius_us:
                    is_isolated[event] = False
        last_event[y[event], x[event]] = event
    # Backwards, for those that only a later event joins.
    last_event[:] = -1
    for event in range(len(t) - 1, -1, -1):
        for row in range(max(np.int64(y[event]) - 1, 0), min(np.int64(y[event]) + 2, height)):
            for column in range(max(np.int64(x[event]) - 1, 0), min(np.int64(x[event]) + 2, width)):
                after = last_event[row, column]
                if (row != y[event] or column != x[event]) and after >= 0 and t[after] - t[event] <= radius_us:
                    is_isolated[event] = False
        last_event[y[event], x[event]] = event
    return covered
