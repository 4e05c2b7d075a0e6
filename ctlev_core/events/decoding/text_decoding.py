"""The loop over rows of numbers as text, compiled; `ctlev_core.formats.csv` is the way in.

Decimal text is turned into whole microseconds directly, not through a binary float: the result is the nearest one to
what is written, ties to even.
"""

from __future__ import annotations

import numpy as np
from numba import njit

OK, NOT_A_NUMBER, NOT_WHOLE, TOO_LARGE, FEWER_COLUMNS, MORE_COLUMNS = 0, 1, 2, 3, 4, 5
UNKNOWN, SECONDS, MICROSECONDS = 0, 1, 2

_LARGEST_MANTISSA = ((1 << 63) - 10) // 10
_HALF = 5 * 10**18
_MICRO_DIGITS = 6


@njit(cache=True, nogil=True)
def _is_separator(byte: int) -> bool:
    return byte == 32 or byte == 9 or byte == 44 or byte == 59 or byte == 13


@njit(cache=True, nogil=True)
def _parse(  # noqa: C901 a number's grammar, in one pass
    content: np.ndarray, start: int, stop: int, shift: int
) -> tuple[int, int, bool, bool]:
    """The field [start, stop) times 10^shift: (value, error, is it exact, was it written with a point or exponent)."""
    mantissa, exponent, sticky, dropped = np.int64(0), np.int64(shift), False, np.int64(0)
    position, negative, has_point, digits = start, False, False, 0
    if position < stop and (content[position] == 43 or content[position] == 45):
        negative = content[position] == 45
        position += 1
    while position < stop:
        byte = content[position]
        if 48 <= byte <= 57:
            digits += 1
            if mantissa <= _LARGEST_MANTISSA:
                mantissa = mantissa * 10 + (np.int64(byte) - 48)
                exponent -= has_point
            else:
                sticky |= byte != 48
                dropped += not has_point
        elif byte == 46 and not has_point:
            has_point = True
        else:
            break
        position += 1
    exponent += dropped
    if digits == 0:
        return 0, NOT_A_NUMBER, False, False
    if position < stop and (content[position] == 69 or content[position] == 101):
        has_point = True
        position += 1
        sign = 1
        if position < stop and (content[position] == 43 or content[position] == 45):
            sign = -1 if content[position] == 45 else 1
            position += 1
        power, digits = np.int64(0), 0
        while position < stop and 48 <= content[position] <= 57:
            power = min(power * 10 + (np.int64(content[position]) - 48), 100_000)
            digits += 1
            position += 1
        if digits == 0:
            return 0, NOT_A_NUMBER, False, False
        exponent += sign * power
    if position != stop:
        return 0, NOT_A_NUMBER, False, False
    while exponent > 0 and mantissa > 0:
        if mantissa > _LARGEST_MANTISSA:
            return 0, TOO_LARGE, False, has_point
        mantissa *= 10
        exponent -= 1
    if sticky and exponent >= 0:  # digits are lost that the result would need
        return 0, TOO_LARGE, False, has_point
    exact = not sticky
    if exponent < 0 and mantissa > 0:
        if exponent < -18:  # below one: a mantissa has 19 digits at most
            up = exponent == -19 and (mantissa > _HALF or (mantissa == _HALF and sticky))
            return int(-np.int64(up) if negative else np.int64(up)), OK, False, has_point
        divisor = np.int64(1)
        for _ in range(-exponent):
            divisor *= 10
        quotient, rest = mantissa // divisor, mantissa % divisor
        exact = exact and rest == 0
        half = divisor // 2  # exact: a power of ten
        up = rest > half or (rest == half and (sticky or quotient & 1 == 1))
        mantissa = quotient + up
    return int(-mantissa if negative else mantissa), OK, exact, has_point


@njit(cache=True, nogil=True)
def parse_rows(  # noqa: C901 a row's grammar, in one pass
    content: np.ndarray, places: np.ndarray, num_columns: int, unit: int, rows: np.ndarray
) -> tuple[int, int, int, int, bool]:
    """Parse whole lines of numbers separated by blanks, tabs, commas or semicolons; lines with `#` first are skipped.

    Args:
        content: [B] uint8, ends with a line end.
        places: [num_columns] int64, which of the columns t, x, y, p (0 to 3) each field is, or -1 for none.
        num_columns: fields every row must have.
        unit: of t; `UNKNOWN` accepts any number but does not give t.
        rows: [M, 4] int64, filled with t (us), x, y, p; M is at least the number of lines.
    Returns:
        Rows written, error code, where its line starts, its column, and whether any t has a point or an exponent.
    """
    count, position, any_point = 0, 0, False
    size = len(content)
    while position < size:
        line_start = position
        field = 0
        while position < size and content[position] != 10:
            if _is_separator(content[position]):
                position += 1
                continue
            if field == 0 and content[position] == 35:
                while position < size and content[position] != 10:
                    position += 1
                break
            start = position
            while position < size and content[position] != 10 and not _is_separator(content[position]):
                position += 1
            if field >= num_columns:
                return count, MORE_COLUMNS, line_start, field, any_point
            place = places[field]
            if place >= 0:
                is_time = place == 0
                shift = _MICRO_DIGITS if is_time and unit == SECONDS else 0
                value, error, exact, has_point = _parse(content, start, position, shift)
                if error == NOT_A_NUMBER and place == 3:  # True and False, as tables of booleans are written
                    first, length = content[start] | 32, position - start
                    if (first == 116 and length == 4) or (first == 102 and length == 5):
                        value, error, exact = np.int64(first == 116), OK, True
                if error != OK:
                    return count, error, line_start, field, any_point
                if not exact and not (is_time and unit != MICROSECONDS):
                    return count, NOT_WHOLE, line_start, field, any_point
                any_point |= is_time and has_point
                rows[count, place] = value
            field += 1
        position += 1
        if field > 0:
            if field < num_columns:
                return count, FEWER_COLUMNS, line_start, field, any_point
            count += 1
    return count, OK, 0, 0, any_point
