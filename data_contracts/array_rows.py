"""Arrays that lie on disk and are read by rows: what `data_contracts.image_rows` and `compressed_arrays` share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np

CHUNK_BYTES = 64 << 20


class ArrayRows(ABC):
    """Has `shape`, `dtype` and `len`, and gives rows as arrays when it is indexed; only `numpy.asarray` reads all.

    Attributes:
        dtype: of the values.
        shape: [N, ...].
    """

    dtype: np.dtype
    shape: tuple[int, ...]

    @abstractmethod
    def _read(self, rows: np.ndarray) -> np.ndarray:
        """New array [K, ...] of K int64 rows, each from 0 to N - 1."""

    @property
    def ndim(self) -> int:
        """Axes, as of an array."""
        return len(self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: Any) -> np.ndarray:
        """Rows as an array: of an integer, a slice, a mask or an array of integers; further axes may be indexed too."""
        chosen, *further = index if isinstance(index, tuple) else (index,)
        if chosen is Ellipsis:
            chosen, further = slice(None), [Ellipsis, *further]
        rows = _row_numbers(chosen, len(self))
        found = self._read(np.atleast_1d(rows))
        return found[(slice(None) if rows.ndim else 0, *further)]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        found = self[:]
        return found if dtype is None else found.astype(dtype, copy=False)

    def __iter__(self) -> Iterator[np.ndarray]:
        for rows in image_chunks(self):
            yield from rows


Images: TypeAlias = np.ndarray | ArrayRows
"""What has `shape`, `dtype` and `len`, and gives arrays of rows when indexed."""


def image_chunks(images: Images, chunk_bytes: int = CHUNK_BYTES) -> Iterator[np.ndarray]:
    """All rows in order, as arrays of at most `chunk_bytes`, one row at least."""
    row_bytes = images.dtype.itemsize * int(np.prod(images.shape[1:]))
    step = max(chunk_bytes // max(row_bytes, 1), 1)
    for start in range(0, len(images), step):
        yield images[start : start + step]


def _row_numbers(chosen: Any, count: int) -> np.ndarray:
    """Rows from 0 to `count` - 1, int64: none of many rows is looked at that is not asked for."""
    if isinstance(chosen, slice):
        return np.arange(*chosen.indices(count))
    rows = np.asarray(chosen)
    if rows.dtype == np.bool_ and rows.shape == (count,):
        return np.flatnonzero(rows)
    if not rows.size:
        rows = rows.astype(np.int64)
    if rows.ndim > 1 or rows.dtype.kind not in "iu":
        raise IndexError(
            f"rows must be chosen by integers, a slice or a mask of {count}, got {rows.shape} {rows.dtype}"
        )
    rows = rows.astype(np.int64)
    outside = (rows < -count) | (rows >= count)
    if outside.any():
        raise IndexError(f"row {rows[outside][0]} is out of bounds for {count} rows")
    return np.where(rows < 0, rows + count, rows)
