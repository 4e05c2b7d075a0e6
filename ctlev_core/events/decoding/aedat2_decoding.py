"""The loop over AEDAT 2.0 records, compiled; `ctlev_core.formats.aedat2` is the way in."""

from __future__ import annotations

import numpy as np
from numba import njit

DAVIS, DVS128 = 0, 1
CLOCK, OVERFLOWS, CAMERAS, LARGEST_ADDRESS, LAYOUT = 4, 5, 6, 7, 8
"""Where the decoder's own state lies; `CAMERAS` is a bit mask of the cameras seen, `LAYOUT` is set by the caller."""


@njit(cache=True, nogil=True)
def decode_aedat2(
    items: np.ndarray, state: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray
) -> int:
    """Decode pairs of a 32-bit address and a 32-bit time, both big-endian; the camera's own columns and rows.

    DAVIS: bit 31 a frame or inertial sample, y 30:22, x 21:12, polarity 11, bit 10 a special event, camera 3:0.
    DVS128: bit 15 a special event, y 14:8, x 7:1, bit 0 set for OFF. What is no polarity event is skipped. The clock is
    unwrapped as in `ctlev_core.events.decoding.aedat2`.

    Args:
        items: [2 R] uint32 as they lie in the file, bytes not yet swapped.
        state: [9] int64, see `record_files` and the names above.
        t: [R] int64, filled, as the other columns.
        x: [R] uint16, filled.
        y: [R] uint16, filled.
        p: [R] uint8, filled.
    Returns:
        How many events were written.
    """
    last_t, went_back, largest_x, largest_y = state[0], state[1], state[2], state[3]
    clock, overflows, cameras, largest_address = state[4], state[5], state[6], state[7]
    is_dvs128 = state[8] == DVS128
    count = 0
    for start in range(0, len(items) - 1, 2):
        raw = np.int64(items[start])
        address = (raw & 0xFF) << 24 | (raw & 0xFF00) << 8 | raw >> 8 & 0xFF00 | raw >> 24
        raw = np.int64(items[start + 1])
        new_clock = (raw & 0xFF) << 24 | (raw & 0xFF00) << 8 | raw >> 8 & 0xFF00 | raw >> 24
        if clock - new_clock > 1 << 31:
            overflows += 1
        elif new_clock - clock > 1 << 31 and overflows > 0:
            overflows -= 1
        clock = new_clock
        largest_address = max(largest_address, address)
        if is_dvs128:
            if address & 0x8000:
                continue
            column, row, polarity = address >> 1 & 0x7F, address >> 8 & 0x7F, 1 - (address & 1)
        else:
            if address & 0x80000400:
                continue
            column, row, polarity = address >> 12 & 0x3FF, address >> 22 & 0x1FF, address >> 11 & 1
            cameras |= np.int64(1) << (address & 0xF)
        now = (overflows << 32) + clock
        went_back |= now < last_t
        last_t = now
        largest_x, largest_y = max(largest_x, column), max(largest_y, row)
        t[count], x[count], y[count], p[count] = now, column, row, polarity
        count += 1
    state[0], state[1], state[2], state[3] = last_t, went_back, largest_x, largest_y
    state[4], state[5], state[6], state[7] = clock, overflows, cameras, largest_address
    return count
