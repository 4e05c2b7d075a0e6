"""The loops over EVT 2.0, EVT 3.0 and DAT words, compiled. `ctlev_core.events.decoding.prophesee` is the way in.

Words before the first TIME_HIGH carry no time, EVT3 events before the first row or vector base no position: they are
skipped, as Prophesee's own decoders do. So are triggers and reserved types (some cameras pad with 0x9999).

The camera's clock overflows: at 2^34 us in EVT2, 2^24 us (16.8 s) in EVT3, 2^32 us in DAT. An overflow shows as a step
of more than half its range back. A smaller step back is time running backwards, which `check_events` reports.

Words are visited in blocks that stay in the cache: a first loop decodes, then loops over the block's columns, which the
compiler turns into vector instructions, gather the largest coordinates and whether time went back.
"""

from __future__ import annotations

import numpy as np
from numba import njit

ADDR_Y, ADDR_X, VECT_BASE_X, VECT_12, VECT_8, TIME_LOW, TIME_HIGH = 0, 2, 3, 4, 5, 6, 8
EVT2_TIME_HIGH_BITS = 28
EVT2_TIME_LOW_BITS = 6
EVT3_TIME_BITS = 12

UNKNOWN = -(1 << 62)  # so far below 0 that no number of vectors makes a base of it
EVT2_STATE = (0, UNKNOWN)
EVT3_STATE = (0, UNKNOWN, 0, UNKNOWN, UNKNOWN, 0)
DAT_STATE = (0, 0)
"""What the decoders' own parts of the state start as, see `record_files`."""

_BLOCK = 8192
_LOWEST_BIT = np.array([(value & -value).bit_length() - 1 if value else 0 for value in range(1 << 12)], np.uint8)
_MAX_COORDINATE = np.iinfo(np.uint16).max


@njit(cache=True, nogil=True)
def _inspect(state: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Add newly decoded events to the shared part of the state."""
    if len(t) == 0:
        return
    largest_x, largest_y, went_back = np.uint16(0), np.uint16(0), np.uint8(0)
    for value in x:
        largest_x = max(largest_x, value)
    for value in y:
        largest_y = max(largest_y, value)
    for event in range(1, len(t)):
        went_back |= np.uint8(t[event] < t[event - 1])
    state[1] |= went_back != 0 or t[0] < state[0]
    state[0] = t[len(t) - 1]
    state[2], state[3] = max(state[2], np.int64(largest_x)), max(state[3], np.int64(largest_y))


@njit(cache=True, nogil=True)
def decode_evt2(
    words: np.ndarray, state: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray
) -> int:
    """Decode 32-bit words: type 31:28, time low 27:22, x 21:11, y 10:0; types 0 OFF, 1 ON, 8 TIME_HIGH (28 bits).

    Args:
        words: [W] uint32.
        state: [6] int64, see `record_files`; own part: overflows, last TIME_HIGH.
        t: [W] int64, filled, as the other columns.
        x: [W] uint16, filled.
        y: [W] uint16, filled.
        p: [W] uint8, filled.
    Returns:
        How many events were written.
    """
    count = np.uint64(0)
    loops, high = state[4], state[5]
    base = ((loops << EVT2_TIME_HIGH_BITS) + high) << EVT2_TIME_LOW_BITS
    for start in range(0, len(words), _BLOCK):
        first = count
        for word in words[start : start + _BLOCK]:
            kind = word >> np.uint32(28)
            if kind >= 2 or high < 0:
                if kind == TIME_HIGH:
                    new_high = np.int64(word & np.uint32(0xFFFFFFF))
                    loops += high - new_high > 1 << (EVT2_TIME_HIGH_BITS - 1)
                    high = new_high
                    base = ((loops << EVT2_TIME_HIGH_BITS) + high) << EVT2_TIME_LOW_BITS
                continue
            t[count] = base + np.int64(word >> np.uint32(22) & np.uint32(0x3F))
            x[count] = word >> np.uint32(11) & np.uint32(0x7FF)
            y[count] = word & np.uint32(0x7FF)
            p[count] = kind
            count += np.uint64(1)
        _inspect(state, t[first:count], x[first:count], y[first:count])
    state[4], state[5] = loops, high
    return int(count)


@njit(cache=True, nogil=True)
def count_evt3(words: np.ndarray) -> int:
    """Upper bound of the number of events.

    Loops without branches, all in 16 bits, so that the compiler counts many words at once.
    """
    total = 0
    length = 4096  # times 12 events a word fits 16 bits
    bits = np.empty(length, np.uint16)
    for start in range(0, len(words), length):
        block = words[start : start + length]
        for index in range(len(block)):
            word = block[index]
            kind = word >> np.uint16(12)
            mask = (np.uint16(0) - np.uint16(kind == VECT_12)) & np.uint16(0xFFF)
            mask |= (np.uint16(0) - np.uint16(kind == VECT_8)) & np.uint16(0xFF)
            bits[index] = (word & mask) | np.uint16(kind == ADDR_X)
        for index in range(len(block)):  # the number of set bits
            value = bits[index]
            value = np.uint16(value - (value >> np.uint16(1) & np.uint16(0x5555)))
            value = np.uint16((value & np.uint16(0x3333)) + (value >> np.uint16(2) & np.uint16(0x3333)))
            value = np.uint16((value & np.uint16(0x0F0F)) + (value >> np.uint16(4) & np.uint16(0x0F0F)))
            bits[index] = np.uint16((value + (value >> np.uint16(8))) & np.uint16(0x1F))
        count = np.uint16(0)
        for index in range(len(block)):
            count = np.uint16(count + bits[index])
        total += np.int64(count)
    return int(total)


@njit(cache=True, nogil=True)
def decode_evt3(  # noqa: C901 one branch a word type
    words: np.ndarray, state: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray
) -> int:
    """Decode 16-bit words: type 15:12, payload 11:0; each word changes the state or adds events to it.

    TIME_LOW is taken as it comes, never as an overflow: in real files it jumps ahead and back between two events.
    A new TIME_HIGH starts at low time 0; a repeated one (cameras send it every few microseconds) keeps the low time.

    Args:
        words: [W] uint16.
        state: [10] int64, see `record_files`; own part: overflows, TIME_HIGH, TIME_LOW, row, vector base,
            its polarity.
        t: [M] int64, filled; M is at least `count_evt3(words)`, as for the other columns.
        x: [M] uint16, filled; a vector that runs past 16 bits is clipped, so that the check of the sensor size sees it.
        y: [M] uint16, filled.
        p: [M] uint8, filled.
    Returns:
        How many events were written.
    """
    count = np.uint64(0)
    loops, high, low, row, base, polarity = state[4], state[5], state[6], state[7], state[8], state[9]
    now = (((loops << EVT3_TIME_BITS) + high) << EVT3_TIME_BITS) + low
    for start in range(0, len(words), _BLOCK):
        first = count
        for word in words[start : start + _BLOCK]:
            kind = word >> np.uint16(12)
            payload = np.int64(word & np.uint16(0xFFF))
            if kind == ADDR_X:
                if high >= 0 and row >= 0:
                    t[count], x[count], y[count], p[count] = now, payload & 0x7FF, row, payload >> 11
                    count += np.uint64(1)
            elif kind == ADDR_Y:
                row = payload & 0x7FF
            elif kind == VECT_12 or kind == VECT_8:  # noqa: SIM109 a tuple is slower
                if kind == VECT_8:
                    payload &= 0xFF
                if high >= 0 and row >= 0 and base >= 0:
                    while payload:
                        column = base + np.int64(_LOWEST_BIT[np.uint64(payload)])
                        t[count], x[count], y[count], p[count] = now, min(column, _MAX_COORDINATE), row, polarity
                        count += np.uint64(1)
                        payload &= payload - 1
                base += 12 if kind == VECT_12 else 8
            elif kind == VECT_BASE_X:
                base, polarity = payload & 0x7FF, payload >> 11
            elif kind == TIME_LOW:
                low = payload
                now = (((loops << EVT3_TIME_BITS) + high) << EVT3_TIME_BITS) + low
            elif kind == TIME_HIGH:
                loops += high - payload > 1 << (EVT3_TIME_BITS - 1)
                if payload != high:
                    high, low = payload, np.int64(0)
                now = (((loops << EVT3_TIME_BITS) + high) << EVT3_TIME_BITS) + low
        _inspect(state, t[first:count], x[first:count], y[first:count])
    state[4], state[5], state[6], state[7], state[8], state[9] = loops, high, low, row, base, polarity
    return int(count)


@njit(cache=True, nogil=True)
def decode_dat(items: np.ndarray, state: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> int:
    """Decode pairs of 32-bit words: the time, then polarity 28, y 27:14, x 13:0.

    Args:
        items: [2 R] uint32.
        state: [6] int64, see `record_files`; own part: overflows, last clock.
        t: [R] int64, filled, as the other columns.
        x: [R] uint16, filled.
        y: [R] uint16, filled.
        p: [R] uint8, filled.
    Returns:
        How many events were written.
    """
    half_range = np.int64(1) << 31
    num_records = len(items) // 2
    for start in range(0, num_records, _BLOCK):
        stop = min(start + _BLOCK, num_records)
        block = items[2 * start : 2 * stop].reshape(stop - start, 2)
        block_t, block_x, block_y, block_p = t[start:stop], x[start:stop], y[start:stop], p[start:stop]
        offset = state[4] << 32
        for record in range(stop - start):
            block_t[record] = offset + np.int64(block[record, 0])
        for record in range(stop - start):
            address = block[record, 1]
            block_x[record] = address & np.uint32(0x3FFF)
            block_y[record] = address >> np.uint32(14) & np.uint32(0x3FFF)
            block_p[record] = address >> np.uint32(28) & np.uint32(1)
        went_back = np.uint8(block[0, 0] < state[5])
        for record in range(1, stop - start):
            went_back |= np.uint8(block[record, 0] < block[record - 1, 0])
        if went_back:  # seldom: an overflow or an error
            for record in range(stop - start):
                clock = np.int64(block[record, 0])
                state[4] += state[5] - clock > half_range
                state[5] = clock
                block_t[record] = (state[4] << 32) + clock
        state[5] = np.int64(block[stop - start - 1, 0])
        _inspect(state, block_t, block_x, block_y)
    return num_records
