"""The loops behind encodings that keep time, compiled: voxel grid and time surface."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def add_to_bins(
    t: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    p: np.ndarray,
    windows: np.ndarray,
    column_of: np.ndarray,
    row_start_of: np.ndarray,
    num_bins: int,
    negative_start: int,
    negative_weight: float,
    scratch: np.ndarray,
    touched: np.ndarray,
    grids: np.ndarray,
) -> int:
    """Share each event between the two temporal bins around it.

    Args:
        t: [E] int64, us, non-decreasing within a window.
        x: [E] uint16, sensor px.
        y: [E] uint16, sensor px.
        p: [E] uint8; anything but 0 is positive.
        windows: [N, 2] int64, ranges within 0 .. E.
        column_of: [sensor width] int64, image column; negative = outside the image.
        row_start_of: [sensor height] int64, cell where the image row starts; negative = outside.
        num_bins: bins between the first and the last event of a window, both included.
        negative_start: cell where the bins of negative events start; 0 where both polarities share theirs.
        negative_weight: what a negative event adds; a positive one adds 1.
        scratch: [cells] float64, zeros: sums of many small numbers would lose digits in 32 bits.
        touched: [M] int64, overwritten. Of windows with at most M / 2 events only the cells they touch are copied and
            cleared.
        grids: [N, cells] float32, zeros on entry, filled; the cells are those of [C, H, W].
    Returns:
        Index of the first event outside the sensor, where the sum stopped; -1 if there is none.
    """
    bin_size = len(scratch) // num_bins if negative_start == 0 else negative_start // num_bins
    for window in range(len(windows)):
        start, stop = windows[window]
        is_sparse = 2 * (stop - start) <= len(touched)
        num_touched = 0
        span = t[stop - 1] - t[start] if stop > start else 0
        # Without a span all events are at the first bin's centre.
        per_us = (num_bins - 1) / span if span > 0 else 0.0
        for event in range(start, stop):
            if x[event] >= len(column_of) or y[event] >= len(row_start_of):
                return event
            column, row_start = column_of[x[event]], row_start_of[y[event]]
            if column < 0 or row_start < 0:
                continue
            position = (t[event] - t[start]) * per_us
            lower = min(int(position), num_bins - 1)
            share = position - lower
            cell = row_start + column + lower * bin_size
            weight = 1.0
            if p[event] == 0:
                cell += negative_start
                weight = negative_weight
            # In the last bin nothing is left to share: the second cell is the first once more.
            next_cell = cell + bin_size if lower + 1 < num_bins else cell
            scratch[cell] += weight * (1.0 - share)
            scratch[next_cell] += weight * share
            if is_sparse:
                touched[num_touched], touched[num_touched + 1] = cell, next_cell
                num_touched += 2
        if is_sparse:
            for cell in touched[:num_touched]:
                grids[window, cell] = scratch[cell]
            for cell in touched[:num_touched]:
                scratch[cell] = 0.0
        else:
            grids[window] = scratch
            scratch[:] = 0.0
    return -1


@njit(cache=True, nogil=True)
def decay_from_end(
    t: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    p: np.ndarray,
    windows: np.ndarray,
    column_of: np.ndarray,
    row_start_of: np.ndarray,
    negative_start: int,
    tau_us: float,
    smallest: float,
    surfaces: np.ndarray,
) -> int:
    """How recent the last event of each cell is at the last event of its window.

    Going backwards, the first event met in a cell is its last: one exponential for each cell that has events.

    Args:
        t: [E] int64, us, non-decreasing within a window.
        x: [E] uint16, sensor px.
        y: [E] uint16, sensor px.
        p: [E] uint8; anything but 0 is positive.
        windows: [N, 2] int64, ranges within 0 .. E.
        column_of: [sensor width] int64, image column; negative = outside the image.
        row_start_of: [sensor height] int64, cell where the image row starts; negative = outside.
        negative_start: cell where the channel of negative events starts; 0 where polarity is discarded.
        tau_us: time constant.
        smallest: positive; what an event too old for a float32 gives.
        surfaces: [N, cells] float32, zeros on entry.
    Returns:
        Index of the first event outside the sensor, -1 if there is none; then the surfaces are not complete.
    """
    outside = -1
    for window in range(len(windows)):
        start, stop = windows[window]
        surface = surfaces[window]
        for event in range(stop - 1, start - 1, -1):
            if x[event] >= len(column_of) or y[event] >= len(row_start_of):
                outside = event
                continue
            column, row_start = column_of[x[event]], row_start_of[y[event]]
            if column < 0 or row_start < 0:
                continue
            cell = row_start + column + negative_start * (p[event] == 0)
            if surface[cell] == 0:
                surface[cell] = max(np.exp((t[event] - t[stop - 1]) / tau_us), smallest)
        if outside >= 0:
            return outside
    return -1
