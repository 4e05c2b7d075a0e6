"""Arrays of files, plain (.npy) or compressed (.npy.zst), whose rows together may not fit into memory."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np
from numpy.lib import format as npy

from data_contracts.array_rows import Images
from data_contracts.compressed_arrays import SUFFIX, CompressedArray, CompressedArrayWriter
from data_contracts.errors import DataError


def load_array(path: Path) -> Images:
    """An array whose rows stay on disk until they are indexed: compressed, or of another name mapped into memory."""
    if path.name.endswith(SUFFIX):
        return CompressedArray(path)
    return np.load(path, mmap_mode="r", allow_pickle=False)


def save_compressed(path: Path, array: np.ndarray) -> None:
    """Write the rows of an array [N, ...], compressed."""
    with CompressedArrayWriter(path) as written:
        written.append(array)


def times_file(images_file: str) -> str:
    """The file with the times of a recording's pictures, plain: it lies beside theirs."""
    return f"{images_file.removesuffix('.zst').removesuffix('.npy')}.t_us.npy"


class ArrayWriter:
    """Append rows to a plain .npy file, which is complete when the `with` block ends."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[bytes] | None = None
        self._row: tuple[np.dtype, tuple[int, ...]] | None = None
        self.rows = 0

    def append(self, rows: np.ndarray) -> None:
        """Write the rows of [N, ...]; dtype and row shape must be those of the first call.

        Raises:
            DataError: dtype or row shape differ.
        """
        row = (rows.dtype, rows.shape[1:])
        if self._file is None:
            self._row, self._file = row, self._path.open("wb")
            self._write_header()
        if row != self._row:
            raise DataError(f"{self._path.name}: rows must be alike; expected {self._row}, got {row}")
        self._file.write(np.ascontiguousarray(rows).data)
        self.rows += len(rows)

    def _write_header(self) -> None:
        # NumPy pads the header so that the first axis can grow in place.
        assert self._file is not None and self._row is not None
        dtype, shape = self._row
        header = {"descr": npy.dtype_to_descr(dtype), "fortran_order": False, "shape": (self.rows, *shape)}
        npy.write_array_header_1_0(self._file, header)

    def __enter__(self) -> ArrayWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._file is None:
            return
        if error is None:
            self._file.seek(0)
            self._write_header()
        self._file.close()
