"""Pickle and joblib files of datasets, read without running the code they may carry.

`pickle.load` and `joblib.load` call whatever function a file names. Here a file may hold plain data and NumPy arrays
alone (see `plain_unpickler`); anything else is a `DataError` that names it, and was not called. Python 2 files
are read with their byte strings as latin-1 text, as is usual for them. Arrays come in the machine's byte order.

Source of the joblib layout: `joblib.numpy_pickle`: a pickle in which each array is a small wrapper object, followed at
once by its raw bytes; since joblib 1.2 with padding before them.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import pickle
import zlib
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from ctlev_core.safe_files.bounded_reader import BoundedReader
from ctlev_core.safe_files.plain_unpickler import NDARRAY, Marker, PlainUnpickler, array_of, count_bytes, dtype_of
from data_contracts.errors import DataError

MAX_BYTES = 4 * 2**30
"""Default limit of a file's unpacked bytes, and of the bytes of the arrays read from it."""

_PIECE = 2**20
_OBJECT = Marker()


def load(path: Path, max_bytes: int = MAX_BYTES, stand_ins: Collection[str] = ()) -> Any:
    """The object of a pickle file, protocols 0 to 5.

    Args:
        path: the file; what follows the first pickle in it is not read.
        max_bytes: more than this, in the file or in the arrays made from it, is refused.
        stand_ins: classes, as `module.Class` or `package.*`, that the file may name besides: in the place of such an
            object comes a `plain_unpickler.StandIn` with its state, which is plain data again. No code of it runs.
    Raises:
        DataError: no such file, damaged, too large, or it holds anything but plain data; a function or class it names
            is told by name, and was not called.
    """
    with _open(path, max_bytes) as file:
        reader = BoundedReader(file, path.stat().st_size)
        return _load(path, lambda: PlainUnpickler(reader, max_bytes, stand_ins).load())


def load_joblib(path: Path, max_bytes: int = MAX_BYTES) -> Any:
    """The object of a file that `joblib.dump` of joblib 0.10 or newer wrote: plain, or as zlib, gzip, bz2, lzma or xz.

    Memory maps become arrays. An array that is there twice is read twice, as joblib does.

    Args:
        path: the file.
        max_bytes: as for `load`; of a compressed file also the unpacked bytes.
    Raises:
        DataError: as for `load`; written by an older joblib, with its arrays in files beside it; or packed by lz4.
    """
    with _open(path, max_bytes) as file:
        return _load(path, lambda: _load_joblib_stream(file, path.stat().st_size, max_bytes))


def _open(path: Path, max_bytes: int) -> BinaryIO:
    if not path.is_file():
        raise DataError(f"{path}: expected a pickle file, got {'a folder' if path.is_dir() else 'nothing there'}")
    if path.stat().st_size == 0:
        raise DataError(f"{path}: the file is empty")
    if path.stat().st_size > max_bytes:
        raise DataError(f"{path}: {path.stat().st_size} bytes, more than the limit of {max_bytes}")
    try:
        return path.open("rb")
    except OSError as error:
        raise DataError(f"{path}: cannot be opened: {error.strerror}") from error


def _load(path: Path, read: Callable[[], Any]) -> Any:
    try:
        return read()
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    except Exception as error:
        # A damaged pickle can raise nearly any error from the unpickler; it is the file's fault, whichever it is.
        raise DataError(f"{path}: damaged, or no pickle: {type(error).__name__}: {error}") from error


class _ZlibFile:
    """The unpacked bytes of a zlib stream."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._inflate = zlib.decompressobj()

    def read(self, size: int, /) -> bytes:
        while not self._inflate.eof:
            packed = self._inflate.unconsumed_tail or self._stream.read(_PIECE)
            chunk = self._inflate.decompress(packed, size)
            if chunk or self._inflate.eof:
                return chunk
            if not packed:
                raise DataError("the compressed stream ends early")
        return b""


# By the first bytes; no uncompressed joblib file begins with any of them.
_DECOMPRESSORS: dict[bytes, Callable[[BinaryIO], Any]] = {
    b"x": _ZlibFile,
    b"\x1f\x8b": lambda stream: gzip.GzipFile(fileobj=stream),
    b"BZ": bz2.BZ2File,
    b"\xfd7zXZ": lzma.LZMAFile,
    b"]\x00": lzma.LZMAFile,
}
_NOT_READ = {
    b"ZF": "written by a joblib before 0.10; load it with that and dump it with a newer one",
    b"\x04\x22\x4d\x18": "packed by lz4, which is not read; dump it with another compression",
}


def _load_joblib_stream(file: BinaryIO, size: int, max_bytes: int) -> Any:
    head = file.read(6)
    file.seek(0)
    for magic, problem in _NOT_READ.items():
        if head.startswith(magic):
            raise DataError(problem)
    for magic, decompress in _DECOMPRESSORS.items():
        if head.startswith(magic):
            reader = BoundedReader(decompress(file), max_bytes)
            loaded = _JoblibUnpickler(reader, max_bytes).load()
            reader.read_to_end()
            return loaded
    return _JoblibUnpickler(BoundedReader(file, size), max_bytes).load()


class _JoblibArray:
    """Stands in for joblib's wrapper of an array, until its state comes."""


def _reconstruct_object(kind: object, base: object, state: object) -> _JoblibArray:
    """How protocols 0 and 1 make an object."""
    if kind is not _JoblibArray or base is not _OBJECT or state is not None:
        raise DataError("refused: it makes an object that is not plain data")
    return _JoblibArray()


class _JoblibUnpickler(PlainUnpickler):
    """Knows joblib's wrapper of arrays as well."""

    GLOBALS: ClassVar[dict[str, Any]] = {
        **PlainUnpickler.GLOBALS,
        "joblib.numpy_pickle.NumpyArrayWrapper": _JoblibArray,
        "sklearn.externals.joblib.numpy_pickle.NumpyArrayWrapper": _JoblibArray,
        "numpy.memmap": NDARRAY,
        "numpy.core.memmap.memmap": NDARRAY,
        "copyreg._reconstructor": _reconstruct_object,
        "copy_reg._reconstructor": _reconstruct_object,
        "builtins.object": _OBJECT,
        "__builtin__.object": _OBJECT,
    }
    dispatch: ClassVar[dict[int, Callable]] = dict(PlainUnpickler.dispatch)

    def find_class(self, module: str, name: str) -> Any:
        """As for plain pickles; the wrappers of old files get an error that says what to do."""
        if name in ("NDArrayWrapper", "ZNDArrayWrapper") and "joblib" in module:
            raise DataError(
                "its arrays lie in files beside it, as a joblib before 0.10 wrote them; dump it with a newer"
            )
        return super().find_class(module, name)

    def load_newobj(self) -> None:
        """How protocols 2 and later make an object."""
        arguments = self.stack.pop()
        if self.stack[-1] is not _JoblibArray or arguments != ():
            raise DataError("refused: it makes an object that is not plain data")
        self.stack[-1] = _JoblibArray()

    def load_build(self) -> None:
        """The array itself takes the place of its wrapper."""
        if not isinstance(self.stack[-2], _JoblibArray):
            return super().load_build()
        state = self.stack.pop()
        self.stack[-1] = self._read_array(state)

    dispatch[pickle.NEWOBJ[0]] = load_newobj
    dispatch[pickle.BUILD[0]] = load_build

    def _read_array(self, state: Any) -> np.ndarray:
        """The array whose bytes follow in the file."""
        needed, optional = {"subclass", "shape", "order", "dtype"}, {"allow_mmap", "numpy_array_alignment_bytes"}
        if not isinstance(state, dict) or not needed <= state.keys() <= needed | optional:
            raise DataError("it holds a joblib array with an unknown state")
        if state["subclass"] is not NDARRAY or state["order"] not in ("C", "F"):
            raise DataError("refused: it holds an array that is no plain numpy.ndarray")
        dtype, shape = dtype_of(state["dtype"]), state["shape"]
        nbytes = count_bytes(shape, dtype)
        self.claim(nbytes)
        if state.get("numpy_array_alignment_bytes") is not None:
            self.reader.read(self.reader.read(1)[0])
        return array_of(dtype, self.reader.read(nbytes), shape, state["order"])
