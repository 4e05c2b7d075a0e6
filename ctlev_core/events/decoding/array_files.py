"""NumPy's array files in chunks, without ever unpickling: the header is checked before any data is touched.

Source: NumPy, "A simple file format for NumPy arrays" (NEP 1); numpy.lib.format parses headers, which is safe.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import IO

import numpy as np

from ctlev_core.events.decoding.event_tables import require_columns, times_as_named
from data_contracts.errors import DataError

MAGIC = b"\x93NUMPY"


@dataclass(frozen=True)
class ArrayHeader:
    """What a .npy header says.

    Attributes:
        shape: of the array.
        dtype: of its items; no objects.
        fortran_order: columns lie together, not rows.
        offset: bytes before the first item.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    fortran_order: bool
    offset: int

    @property
    def num_bytes(self) -> int:
        """Bytes of all items."""
        return math.prod(self.shape) * self.dtype.itemsize


def read_array_header(file: IO[bytes], where: str, size: int) -> ArrayHeader:
    """Parse the header at the start of `file`, and leave the file after it.

    Args:
        file: a .npy file, at its start.
        where: names it in messages.
        size: of the file in bytes.
    Raises:
        DataError: no NumPy file, an unknown version, objects (which only a pickle can hold), or a cut file.
    """
    try:
        version = np.lib.format.read_magic(file)
        if version == (1, 0):
            shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(file)
        elif version == (2, 0):
            shape, fortran_order, dtype = np.lib.format.read_array_header_2_0(file)
        else:
            raise DataError(f"{where}: NumPy file of version {version}, expected (1, 0) or (2, 0)")
    except DataError:
        raise
    except Exception as error:  # the header is a Python literal, and wrong ones fail in many ways
        raise DataError(f"{where}: not a complete NumPy file: {error}") from error
    if dtype.hasobject:
        raise DataError(
            f"{where}: an array of Python objects, which only a pickle can hold; expected numbers. Unpickling may run "
            f"any code and is not done"
        )
    header = ArrayHeader(tuple(int(n) for n in shape), dtype, fortran_order, file.tell())
    if any(n < 0 for n in header.shape) or header.num_bytes != size - header.offset:
        raise DataError(
            f"{where}: not a complete NumPy file: shape {header.shape} of {dtype} takes {header.num_bytes} bytes, got "
            f"{size - header.offset}"
        )
    return header


def split_structured(records: np.ndarray, where: str) -> dict[str, np.ndarray]:
    """Columns t, x, y, p of a structured array with fields of any known name, in any order.

    Raises:
        DataError: a field is missing.
    """
    found = require_columns(records.dtype.names or (), where)
    columns = {column: records[name] for column, name in found.items()}
    return {**columns, "t": times_as_named(found["t"], columns["t"], where)}


def read_items(file: IO[bytes], dtype: np.dtype, count: int, where: str) -> np.ndarray:
    """The next `count` items [count].

    Raises:
        DataError: the file ends before.
    """
    content = file.read(count * dtype.itemsize)
    if len(content) != count * dtype.itemsize:
        raise DataError(f"{where}: not a complete NumPy file: cut inside its data")
    return np.frombuffer(content, dtype, count)
