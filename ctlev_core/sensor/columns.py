"""What goes into the sensor and what comes out: frames are checked, events sorted by time; compiled."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def first_bad(intensity):
    """Index of the first value of [P] that is not finite or negative; P = there is none."""
    # Without a way out of the loop the processor takes several values at once.
    num_good = 0
    for i in range(len(intensity)):
        num_good += (intensity[i] >= 0.0) & (intensity[i] < np.inf)
    if num_good < len(intensity):
        for i in range(len(intensity)):
            if not (intensity[i] >= 0.0 and intensity[i] < np.inf):
                return i
    return len(intensity)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def order_of_stamps(exact_us, begin_us, counters):
    """Which event of an interval comes when: by its time in whole us, events of one us in the order given.

    Args:
        exact_us: [N], from begin_us to at most begin_us + C - 2.
        begin_us: where the interval begins; a whole number of us.
        counters: [C] int64, overwritten.
    """
    counters[:] = 0
    stamps, order = np.empty(len(exact_us), np.int32), np.empty(len(exact_us), np.int64)
    for i in range(len(exact_us)):
        stamps[i] = np.int64(exact_us[i] - begin_us + 0.5)
        counters[stamps[i] + 1] += 1
    for value in range(1, len(counters)):
        counters[value] += counters[value - 1]
    for i in range(len(exact_us)):
        value = stamps[i]
        order[counters[value]] = i
        counters[value] += 1
    return order


@numba.njit(cache=True, nogil=True, error_model="numpy")
def write_columns(exact_us, pixels, polarity, order, begin_us, begin_t_us, width, t, x, y, p, exact_sorted_us):
    """The columns of `Events` from what `advance` found; `begin_t_us` is `begin_us` on the clock of the frames."""
    # A division of whole numbers takes several times as long; half a pixel is far more than rounding.
    rows_per_pixel = 1.0 / width
    for row in range(len(order)):
        i = order[row]
        t[row] = begin_t_us + np.int64(exact_us[i] - begin_us + 0.5)
        line = np.int64((pixels[i] + 0.5) * rows_per_pixel)
        y[row] = line
        x[row] = pixels[i] - line * width
        p[row] = polarity[i] & 1
        exact_sorted_us[row] = exact_us[i]
