"""The loops that write EVT 2.0 and EVT 3.0 words, compiled. `ctlev_core.events.decoding.prophesee` is the way in.

Every overflow of the camera's clock is spelled out, from time 0 on.
"""

from __future__ import annotations

import numpy as np
from numba import njit

ADDR_Y, ADDR_X, VECT_BASE_X, VECT_12, VECT_8, TIME_LOW, TIME_HIGH = 0, 2, 3, 4, 5, 6, 8
EVT2_TIME_HIGH_BITS = 28
EVT2_TIME_LOW_BITS = 6
EVT3_TIME_BITS = 12


@njit(cache=True, nogil=True)
def encode_evt2(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray, words: np.ndarray) -> int:
    """Fill `words` [M] uint32 with the events; returns how many words were written."""
    last = (np.int64(1) << EVT2_TIME_HIGH_BITS) - 1
    count, loops, high = 1, np.int64(0), np.int64(0)
    words[0] = TIME_HIGH << 28
    for event in range(len(t)):
        while t[event] >> (EVT2_TIME_HIGH_BITS + EVT2_TIME_LOW_BITS) > loops:
            words[count], words[count + 1] = TIME_HIGH << 28 | last, TIME_HIGH << 28
            count, loops, high = count + 2, loops + 1, np.int64(0)
        new_high = t[event] >> EVT2_TIME_LOW_BITS & last
        if new_high != high:
            words[count] = TIME_HIGH << 28 | new_high
            count, high = count + 1, new_high
        words[count] = (
            np.int64(p[event]) << 28 | (t[event] & 0x3F) << 22 | np.int64(x[event]) << 11 | np.int64(y[event])
        )
        count += 1
    return count


@njit(cache=True, nogil=True)
def _vector_mask(
    t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray, event: int, first_column: int
) -> tuple[int, int]:
    """Bit mask and number of the events from `event` on that one vector starting at `first_column` can hold.

    They share time, row and polarity, and their columns ascend, so that a decoder gives them in the same order.
    """
    mask = number = 0
    last = first_column - 1
    for other in range(event, min(event + 12, len(t))):
        column = np.int64(x[other])
        same = t[other] == t[event] and y[other] == y[event] and p[other] == p[event]
        if not same or column <= last or column >= first_column + 12:
            break
        mask |= 1 << (column - first_column)
        number += 1
        last = column
    return int(mask), number


@njit(cache=True, nogil=True)
def encode_evt3(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray, words: np.ndarray) -> int:
    """Fill `words` [M] uint16 with the events; returns how many words were written.

    Events of one time, row and polarity become vectors wherever that takes fewer words: three and more with a new base
    (a base word and a vector), two and more directly after another vector, whose end is base enough. After any other
    word a base is given anew, as cameras do: decoders differ in what they keep.
    """
    last = (np.int64(1) << EVT3_TIME_BITS) - 1
    count, loops, high = 1, np.int64(0), np.int64(0)
    low, row = np.int64(0), np.int64(-1)
    base, base_polarity, after_vector = np.int64(0), np.int64(0), -1
    words[0] = TIME_HIGH << 12
    event = 0
    while event < len(t):
        while t[event] >> (2 * EVT3_TIME_BITS) > loops:
            words[count], words[count + 1] = TIME_HIGH << 12 | last, TIME_HIGH << 12
            count, loops, high, low = count + 2, loops + 1, np.int64(0), np.int64(0)
        new_high = t[event] >> EVT3_TIME_BITS & last
        if new_high != high:
            words[count] = TIME_HIGH << 12 | new_high
            count, high, low = count + 1, new_high, np.int64(0)
        if t[event] & last != low:
            low = t[event] & last
            words[count] = TIME_LOW << 12 | low
            count += 1
        if np.int64(y[event]) != row:
            row = np.int64(y[event])
            words[count] = ADDR_Y << 12 | row
            count += 1
        column, polarity = np.int64(x[event]), np.int64(p[event])
        has_base = after_vector == count and polarity == base_polarity and base <= column < base + 12
        mask, number = _vector_mask(t, x, y, p, event, base if has_base else column)
        if number < (2 if has_base else 3):
            words[count] = ADDR_X << 12 | polarity << 11 | column
            count, event = count + 1, event + 1
            continue
        if not has_base:
            base, base_polarity = column, polarity
            words[count] = VECT_BASE_X << 12 | polarity << 11 | column
            count += 1
        short = mask < 256 and base + 12 > 2048
        words[count] = (VECT_8 if short else VECT_12) << 12 | mask
        base += 8 if short else 12
        count, event = count + 1, event + number
        after_vector = count
    return count
