"""The loops behind averages over areas, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def average_areas(
    images: np.ndarray,
    first_column: np.ndarray,
    column_shares: np.ndarray,
    first_row: np.ndarray,
    row_shares: np.ndarray,
    out: np.ndarray,
) -> None:
    """Rows are averaged first, for one new row at a time, then its columns: one row of sums stays in the cache.

    Args:
        images: [N, H, W] uint8.
        first_column: [w] int64, the first of K old columns of each new one.
        column_shares: [w, K] float64.
        first_row: [h] int64, the first of L old rows of each new one.
        row_shares: [h, L] float64.
        out: [N, h, w] float32, filled.
    """
    sums = np.empty(images.shape[2])
    for number in range(len(images)):
        for row in range(len(first_row)):
            sums[:] = 0.0
            is_black = True
            for neighbour in range(row_shares.shape[1]):
                share = row_shares[row, neighbour]
                if share == 0.0:
                    continue
                is_black = False
                values = images[number, first_row[row] + neighbour]
                for column in range(len(sums)):
                    sums[column] += share * values[column]
            if is_black:
                out[number, row] = np.float32(0.0)
                continue
            for column in range(len(first_column)):
                first, total = first_column[column], 0.0
                for neighbour in range(column_shares.shape[1]):
                    total += column_shares[column, neighbour] * sums[first + neighbour]
                out[number, row, column] = np.float32(min(total, 255.0))
