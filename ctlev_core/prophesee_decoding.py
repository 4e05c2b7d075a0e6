"""The loops over EVT 2.0 and EVT 3.0 words, compiled. `ctlev_core.prophesee` is the way in.

Words before the first TIME_HIGH carry no time, EVT3 events before the first row or vector base no position: they are
skipped, as Prophesee's own decoders do. So are triggers and reserved types (some cameras pad with 0x9999).

The camera's clock overflows: at 2^34 us in EVT2, 2^24 us (16.8 s) in EVT3. An overflow shows as a TIME_HIGH more than
half its range below the last one. A smaller step back is time running backwards, which `check_events` reports.
"""

from __future__ import annotations

import numpy as np
from numba import njit

ADDR_Y, ADDR_X, VECT_BASE_X, VECT_12, VECT_8, TIME_LOW, TIME_HIGH = 0, 2, 3, 4, 5, 6, 8
EVT2_TIME_HIGH_BITS = 28
EVT2_TIME_LOW_BITS = 6
EVT3_TIME_BITS = 12

_NUM_SET_BITS = np.array([value.bit_count() for value in range(1 << 12)], np.int64)
_UNKNOWN = -(1 << 62)  # so far below 0 that no number of vectors makes a base of it
_MAX_COORDINATE = np.iinfo(np.uint16).max


@njit(cache=True, nogil=True)
def count_evt2(words: np.ndarray) -> int:
    """Upper bound of the number of events."""
    count = 0
    for word in words:
        count += (word >> 28) < 2
    return count


@njit(cache=True, nogil=True)
def decode_evt2(words: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> int:
    """Decode 32-bit words: type 31:28, time low 27:22, x 21:11, y 10:0; types 0 OFF, 1 ON, 8 TIME_HIGH (28 bits).

    Args:
        words: [W] uint32.
        t: [M] int64, filled; M is at least `count_evt2(words)`, as for the other columns.
        x: [M] uint16, filled.
        y: [M] uint16, filled.
        p: [M] uint8, filled.
    Returns:
        How many events were written.
    """
    count = 0
    high = np.int64(_UNKNOWN)
    loops = np.int64(0)
    for raw in words:
        word = np.int64(raw)
        kind = word >> 28
        if kind == TIME_HIGH:
            new_high = word & 0xFFFFFFF
            loops += high - new_high > 1 << (EVT2_TIME_HIGH_BITS - 1)
            high = new_high
        elif kind < 2 and high >= 0:
            t[count] = (((loops << EVT2_TIME_HIGH_BITS) + high) << EVT2_TIME_LOW_BITS) + ((word >> 22) & 0x3F)
            x[count] = (word >> 11) & 0x7FF
            y[count] = word & 0x7FF
            p[count] = kind
            count += 1
    return count


@njit(cache=True, nogil=True)
def count_evt3(words: np.ndarray) -> int:
    """Upper bound of the number of events."""
    count = 0
    for word in words:
        kind = word >> 12
        if kind == ADDR_X:
            count += 1
        elif kind == VECT_12:
            count += int(_NUM_SET_BITS[word & 0xFFF])
        elif kind == VECT_8:
            count += int(_NUM_SET_BITS[word & 0xFF])
    return count


@njit(cache=True, nogil=True)
def _fired_columns(
    kind: int, payload: np.int64, base: np.int64, base_polarity: np.int64
) -> tuple[np.int64, np.int64, np.int64]:
    """First column, polarity and bit mask of the columns that fired: one form for single and vector events."""
    if kind == ADDR_X:
        return payload & 0x7FF, payload >> 11, np.int64(1)
    if kind == VECT_12:
        return base, base_polarity, payload
    if kind == VECT_8:
        return base, base_polarity, payload & 0xFF
    return base, base_polarity, np.int64(0)


@njit(cache=True, nogil=True)
def decode_evt3(words: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> int:
    """Decode 16-bit words: type 15:12, payload 11:0; each word changes the state or adds events to it.

    TIME_LOW is taken as it comes, never as an overflow: in real files it jumps ahead and back between two events.
    A new TIME_HIGH starts at low time 0; a repeated one (cameras send it every few microseconds) keeps the low time.

    Args:
        words: [W] uint16.
        t: [M] int64, filled; M is at least `count_evt3(words)`, as for the other columns.
        x: [M] uint16, filled; a vector that runs past 16 bits is clipped, so that the check of the sensor size sees it.
        y: [M] uint16, filled.
        p: [M] uint8, filled.
    Returns:
        How many events were written.
    """
    count = 0
    loops, high, low = np.int64(0), np.int64(_UNKNOWN), np.int64(0)
    row, base, base_polarity = np.int64(_UNKNOWN), np.int64(_UNKNOWN), np.int64(0)
    for raw in words:
        payload = np.int64(raw) & 0xFFF
        kind = raw >> 12
        if kind == TIME_HIGH:
            loops += high - payload > 1 << (EVT3_TIME_BITS - 1)
            if payload != high:
                high, low = payload, np.int64(0)
        elif kind == TIME_LOW:
            low = payload
        elif kind == ADDR_Y:
            row = payload & 0x7FF
        elif kind == VECT_BASE_X:
            base, base_polarity = payload & 0x7FF, payload >> 11
        else:
            column, polarity, mask = _fired_columns(kind, payload, base, base_polarity)
            base += 12 * (kind == VECT_12) + 8 * (kind == VECT_8)
            if min(high, row, column) < 0:
                continue
            now = (((loops << EVT3_TIME_BITS) + high) << EVT3_TIME_BITS) + low
            while mask:
                if mask & 1:
                    t[count], x[count], y[count], p[count] = now, min(column, _MAX_COORDINATE), row, polarity
                    count += 1
                mask >>= 1
                column += 1
    return count


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
def encode_evt3(t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray, words: np.ndarray) -> int:
    """Fill `words` [M] uint16 with the events; returns how many words were written."""
    last = (np.int64(1) << EVT3_TIME_BITS) - 1
    count, loops, high = 1, np.int64(0), np.int64(0)
    low, row = np.int64(0), np.int64(-1)
    words[0] = TIME_HIGH << 12
    for event in range(len(t)):
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
        words[count] = ADDR_X << 12 | np.int64(p[event]) << 11 | np.int64(x[event])
        count += 1
    return count
