"""Prophesee's Event Compression Format (ECF), the HDF5 filter 36559: one chunk of rows, decoded by a compiled loop.

All numbers are little-endian. A chunk has 4 bytes of count << 2 | layout, 8 bytes of the first time in microseconds,
and then the columns one after the other:

- Times in runs of 8 bits, step << 4 | count: the step, below 15, is added to the time, which count events have. A count
  of 15 says that the true one follows in two bytes. Bytes of step 15 carry 4 bits each of a larger difference, the
  lowest first; it is added before the next step.
- Layout 0: y in runs of 16 bits, y << 5 | count, 31 for a count in the next 16 bits; then x in 16 bits, x << 5 | mask,
  where bit 4 - j of the mask stands for one more event at x + j + 1; then polarity in runs of 8 bits,
  p << 7 | count, 127 for a count in the next two bytes.
- Layout 1: y as before; then four events in three words of 16 bits, 12 bits of x << 1 | p each, the first event
  highest.
- Layout 2 or 3: four events in three words of 32 bits, 24 bits of y << 12 | x << 1 | p each, the first event highest.

Where an event is divided between two words, its lowest bits end the first word and the others start the second.

Source: prophesee-ai/hdf5_ecf @51fa1bc, ecf_codec.cpp (layout), ecf_h5filter.h (number).
"""

from __future__ import annotations

import numpy as np
from numba import njit

HEAD_BYTES = 12
MAX_EVENTS = 65_535
MAX_CHUNK_BYTES = HEAD_BYTES + MAX_EVENTS * 9
PROBLEMS = ("", "it ends too early", "a run passes its number of events", "a time difference has more than 64 bits")
"""What `decode_ecf` found, by the number it returns."""
_CUT, _LONG_RUN, _LONG_DIFFERENCE = 1, 2, 3


@njit(cache=True, nogil=True)
def decode_ecf(content: np.ndarray, t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> int:
    """Decode the first events of a chunk; bytes after them are not looked at.

    Args:
        content: [B] uint8, B at least `HEAD_BYTES`.
        t: [N] int64, filled, as the other columns; N is the count that the chunk states.
        x: [N] uint16, filled.
        y: [N] uint16, filled.
        p: [N] uint8, filled.
    Returns:
        0, or the number of one of `PROBLEMS`; the columns are not to be used then.
    """
    layout = content[0] & 3
    problem, place = _decode_times(content, t)
    if problem:
        return problem
    if layout >= 2:
        return _decode_packed(content, place, x, y, p)
    problem, place = _decode_runs(content, place, y, 2, 5)
    if problem:
        return problem
    if layout == 1:
        return _decode_packed_x(content, place, x, p)
    problem, place = _decode_masks(content, place, x)
    if problem:
        return problem
    return _decode_runs(content, place, p, 1, 7)[0]


@njit(cache=True, nogil=True)
def _word(content: np.ndarray, place: int, num_bytes: int) -> np.int64:
    word = np.int64(0)
    for byte in range(num_bytes):
        word |= np.int64(content[place + byte]) << 8 * byte
    return word


@njit(cache=True, nogil=True)
def _decode_times(content: np.ndarray, t: np.ndarray) -> tuple[int, int]:
    now, place, event = _word(content, 4, 8), HEAD_BYTES, 0
    difference, bits = np.int64(0), 0
    while event < len(t):
        if place >= len(content):
            return _CUT, place
        step, count = np.int64(content[place] >> 4), np.int64(content[place] & 15)
        place += 1
        if step == 15:
            if bits == 64:
                return _LONG_DIFFERENCE, place
            difference |= count << bits
            bits += 4
            continue
        now += difference + step
        difference, bits = np.int64(0), 0
        if count == 15:
            if place + 2 > len(content):
                return _CUT, place
            count = _word(content, place, 2)
            place += 2
        if event + count > len(t):
            return _LONG_RUN, place
        t[event : event + count] = now
        event += count
    return 0, place


@njit(cache=True, nogil=True)
def _decode_runs(
    content: np.ndarray, place: int, column: np.ndarray, num_bytes: int, count_bits: int
) -> tuple[int, int]:
    """Runs of equal values: words of `num_bytes` with the count in the lowest bits, all set where two bytes follow."""
    event, largest = 0, (1 << count_bits) - 1
    while event < len(column):
        if place + num_bytes > len(content):
            return _CUT, place
        word = _word(content, place, num_bytes)
        place += num_bytes
        count = word & largest
        if count == largest:
            if place + 2 > len(content):
                return _CUT, place
            count = _word(content, place, 2)
            place += 2
        if event + count > len(column):
            return _LONG_RUN, place
        column[event : event + count] = word >> count_bits
        event += count
    return 0, place


@njit(cache=True, nogil=True)
def _decode_masks(content: np.ndarray, place: int, x: np.ndarray) -> tuple[int, int]:
    event = 0
    while event < len(x):
        if place + 2 > len(content):
            return _CUT, place
        word = _word(content, place, 2)
        place += 2
        x[event] = word >> 5
        event += 1
        for bit in range(5):
            # The encoder may set bits of the last mask for what is no event any more.
            if word >> 4 - bit & 1 and event < len(x):
                x[event] = (word >> 5) + bit + 1
                event += 1
    return 0, place


@njit(cache=True, nogil=True)
def _decode_packed_x(content: np.ndarray, place: int, x: np.ndarray, p: np.ndarray) -> int:
    for start in range(0, len(x), 4):
        if place + 6 > len(content):
            return _CUT
        a, b, c = _word(content, place, 2), _word(content, place + 2, 2), _word(content, place + 4, 2)
        place += 6
        values = (a >> 4, a & 0xF | (b >> 8) << 4, b & 0xFF | (c >> 12) << 8, c & 0xFFF)
        for event in range(start, min(start + 4, len(x))):
            value = values[event - start]
            x[event], p[event] = value >> 1, value & 1
    return 0


@njit(cache=True, nogil=True)
def _decode_packed(content: np.ndarray, place: int, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> int:
    for start in range(0, len(x), 4):
        if place + 12 > len(content):
            return _CUT
        a, b, c = _word(content, place, 4), _word(content, place + 4, 4), _word(content, place + 8, 4)
        place += 12
        values = (a >> 8, a & 0xFF | (b >> 16) << 8, b & 0xFFFF | (c >> 24) << 16, c & 0xFFFFFF)
        for event in range(start, min(start + 4, len(x))):
            value = values[event - start]
            y[event], x[event], p[event] = value >> 12 & 0x7FF, value >> 1 & 0x7FF, value & 1
    return 0
