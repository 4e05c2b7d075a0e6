"""The loop over 40-bit ATIS records, compiled; `ctlev_core.formats.atis` is the way in."""

from __future__ import annotations

import numpy as np
from numba import njit

OVERFLOW_ROW = 240
OVERFLOW_US = 1 << 13


@njit(cache=True, nogil=True)
def decode_atis(
    content: np.ndarray, state: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray
) -> int:
    """Decode records of 5 bytes: x 39:32, y 31:24, polarity 23, time 22:0.

    A record of row 240, one below the sensor, is no event: it adds 2^13 us to its own and all later times.

    Args:
        content: [5 R] uint8.
        state: [5] int64, see `record_files`; own part: what markers have added so far, microseconds.
        t: [R] int64, filled, as the other columns.
        x: [R] uint16, filled.
        y: [R] uint16, filled.
        p: [R] uint8, filled.
    Returns:
        How many events were written.
    """
    last_t, went_back, largest_x, largest_y, added = state[0], state[1], state[2], state[3], state[4]
    count = 0
    for start in range(0, len(content) - 4, 5):
        row = np.int64(content[start + 1])
        if row == OVERFLOW_ROW:
            added += OVERFLOW_US
            continue
        column = np.int64(content[start])
        high = np.int64(content[start + 2])
        now = ((high & 0x7F) << 16 | np.int64(content[start + 3]) << 8 | np.int64(content[start + 4])) + added
        went_back |= now < last_t
        last_t = now
        largest_x, largest_y = max(largest_x, column), max(largest_y, row)
        t[count], x[count], y[count], p[count] = now, column, row, high >> 7
        count += 1
    state[0], state[1], state[2], state[3], state[4] = last_t, went_back, largest_x, largest_y, added
    return count
