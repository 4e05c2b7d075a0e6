"""The event filters of DHP19: hot pixels, background activity, and the two places where an infra-red light blinks.

All four cameras are filtered as one picture, side by side: column = 346 * channel + x. The order matters and is the
authors': hot pixels first, then background activity, then the masks.

Source: SensorsINI/DHP19, generate_DHP19/Generate_DHP19.m (constants), extract_from_aedat.m (order), HotPixelFilter.m,
BackgroundFilter.m and maskRegionFilter.m. Coordinates here start at 0, theirs at 1.
"""

from __future__ import annotations

import numpy as np
from numba import njit

NUM_CAMERAS = 4
WIDTH, HEIGHT = 346, 260
HOT_PIXEL_EVENTS = 10_000
"""A pixel with this many events in a recording is hot."""
BACKGROUND_DT_US = 70_000
"""An event is noise unless an event of its pixel or of the eight around it came at most so long before."""
MASKS = ((779, 809, 114, 144), (1251, 1258, 135, 143))
"""(column, column, row, row) of each mask; events strictly between the bounds are dropped: in channel 2
x 88 .. 116, y 115 .. 143, in channel 3 x 214 .. 219, y 136 .. 142."""


def keep_events(column: np.ndarray, y: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Which events pass all filters.

    Args:
        column: [N] int64, 346 * channel + x, 0 <= column < 1384.
        y: [N] int64, rows, 0 <= y < 260.
        t: [N] int64, us, time stamps as they stand in the file: in its first 70 ms every event counts as supported.
    Returns:
        [N] bool.
    """
    keep = keep_cool_pixels(column, y)
    index = np.flatnonzero(keep)
    keep[index] = keep_supported(column[index], y[index], t[index])
    return keep & keep_unmasked(column, y)


def keep_cool_pixels(column: np.ndarray, y: np.ndarray, num_events: int = HOT_PIXEL_EVENTS) -> np.ndarray:
    """Which events [N] bool are of pixels with fewer than `num_events` events."""
    pixel = column * HEIGHT + y
    return np.bincount(pixel, minlength=1)[pixel] < num_events


def keep_supported(column: np.ndarray, y: np.ndarray, t: np.ndarray, dt_us: int = BACKGROUND_DT_US) -> np.ndarray:
    """Which events [N] bool have an event at most `dt_us` before them in their own or a neighbouring pixel.

    As in the authors' code, events on the border of the picture of all four cameras support nothing, a dropped event
    supports others all the same, and pixels at the seam of two cameras are neighbours.
    """
    keep = np.empty(len(t), np.bool_)
    last = np.zeros((NUM_CAMERAS * WIDTH, HEIGHT), np.int64)
    _mark_supported(column, y, t, dt_us, last, keep)
    return keep


def keep_unmasked(column: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Which events [N] bool lie outside both masks."""
    keep = np.ones(len(y), np.bool_)
    for left, right, top, bottom in MASKS:
        keep &= ~((column > left) & (column < right) & (y > top) & (y < bottom))
    return keep


@njit(cache=True, nogil=True)
def _mark_supported(column, y, t, dt_us, last, keep):  # pragma: no cover - compiled
    """`last` [columns, rows] holds the latest time of an event in each pixel or around it."""
    num_columns, num_rows = last.shape
    for i in range(len(t)):
        x_i, y_i, t_i = column[i], y[i], t[i]
        keep[i] = t_i - last[x_i, y_i] <= dt_us
        if 0 < x_i < num_columns - 1 and 0 < y_i < num_rows - 1:
            for neighbour_x in range(x_i - 1, x_i + 2):
                for neighbour_y in range(y_i - 1, y_i + 2):
                    last[neighbour_x, neighbour_y] = t_i
