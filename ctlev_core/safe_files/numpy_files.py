"""NumPy's .npy and .npz files of datasets and tools, without running the code that pickled ones may carry.

`numpy.save` turns a dictionary into an array of one Python object, which is a pickle; text-to-motion tools write their
results so. It is read as any pickle here is (`safe_pickle`): plain data and arrays alone. Tensors of torch that lie
beside them become None, for nothing of what they hold is needed, and their bytes are a pickle again.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np

from ctlev_core.events.decoding import array_files
from ctlev_core.safe_files.bounded_reader import BoundedReader
from ctlev_core.safe_files.plain_unpickler import Marker, PlainUnpickler
from data_contracts.errors import DataError

MAX_BYTES = 2 * 2**30
"""Of one array, as stored and as float64."""
MAX_NPZ_BYTES = 512 * 2**20
"""Of all arrays read from an .npz file, as float64: a small file can unpack to a thousand times its size, and single
bytes to eight times that. The largest body models have 300 MB."""
_OBJECT = Marker()


def read_shape(path: Path) -> tuple[int, ...] | None:
    """The shape of a .npy file of numbers; None of any other file.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        try:
            header = array_files.read_array_header(file, str(path), path.stat().st_size)
        except DataError:
            return None
    return header.shape if header.dtype.kind in "fiu" else None


def read_numbers(file: IO[bytes], size: int, where: str, max_bytes: int = MAX_BYTES) -> np.ndarray:
    """The array of a .npy stream as float64.

    Args:
        file: at its start.
        size: of the whole stream in bytes.
        where: names it in messages.
        max_bytes: limit of the file, and of the array as float64.
    Raises:
        DataError: it is no .npy file, cut, larger than the limit, or holds something else than numbers.
    """
    if size > max_bytes:
        raise DataError(f"{where} has {size} bytes, more than the limit of {max_bytes}")
    header = array_files.read_array_header(file, where, size)
    if header.dtype.kind not in "fiu":
        raise DataError(f"{where} must be numbers, got {header.dtype}")
    needed = 8 * math.prod(header.shape)
    if needed > max_bytes:
        raise DataError(
            f"{where}: {list(header.shape)} numbers take {needed} bytes, more than the limit of {max_bytes}"
        )
    items = array_files.read_items(file, header.dtype, math.prod(header.shape), where)
    with np.errstate(invalid="ignore"):  # a signalling NaN; what it means is the caller's business
        return items.reshape(header.shape, order="F" if header.fortran_order else "C").astype(np.float64)


def list_npz(path: Path) -> list[str]:
    """Names of the arrays of an .npz file; none where it is no such file.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        if file.read(4) != b"PK\x03\x04":
            return []
    try:
        with zipfile.ZipFile(path) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist()]
    except (zipfile.BadZipFile, NotImplementedError, ValueError):
        return []


def read_npz(path: Path, names: Sequence[str], what: str) -> dict[str, np.ndarray]:
    """The named arrays as float64; the others, some of them perhaps pickled, stay unread.

    Args:
        path: the file.
        names: all of them must be there.
        what: the file should be, for messages.
    Raises:
        DataError: it is damaged, lacks an array, or one is not of numbers.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = {name.removesuffix(".npy"): name for name in archive.namelist()}
            missing = [name for name in names if name not in members]
            if missing:
                raise DataError(f"{path}: lacks {', '.join(missing)}; found {', '.join(members)[:200]}")
            arrays, left = {}, MAX_NPZ_BYTES
            for name in names:
                with archive.open(members[name]) as file:
                    size = archive.getinfo(members[name]).file_size
                    arrays[name] = read_numbers(file, size, f"{path}: {name}", left)
                    left -= arrays[name].nbytes
            return arrays
    except DataError:
        raise
    except Exception as error:  # a damaged archive can raise nearly any error
        raise DataError(f"{path}: cannot be read as {what} (.npz): {type(error).__name__}: {error}") from error


def read_dictionary(path: Path, max_bytes: int = MAX_BYTES) -> dict[Any, Any]:
    """The dictionary that `numpy.save` wrote to a .npy file.

    Args:
        path: the file.
        max_bytes: limit of the file and of all arrays in it together.
    Raises:
        DataError: no such file, damaged, too large, something else than one dictionary, or it holds anything but plain
            data, arrays and tensors; a function or class it names is told by name, and was not called.
    """
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise DataError(f"{path}: {size} bytes, more than the limit of {max_bytes}")
        with path.open("rb") as file:
            version = np.lib.format.read_magic(file)
            if version != (1, 0):
                raise DataError(f"{path}: NumPy file of version {version}, expected (1, 0) for a dictionary")
            shape, _, dtype = np.lib.format.read_array_header_1_0(file)
            if shape != () or not dtype.hasobject:
                raise DataError(f"{path}: expected a dictionary, got an array {list(shape)} of {dtype}")
            loaded = _DictionaryUnpickler(BoundedReader(file, size), max_bytes).load()
    except DataError as error:
        raise DataError(str(error) if str(error).startswith(str(path)) else f"{path}: {error}") from None
    except Exception as error:  # a damaged pickle can raise nearly any error
        raise DataError(f"{path}: damaged, or no dictionary: {type(error).__name__}: {error}") from error
    if not isinstance(loaded, dict):
        raise DataError(f"{path}: expected a dictionary, got {type(loaded).__name__}")
    return loaded


def _dtype(spec: object, *rest: object) -> Any:
    """The type of an array; that of Python objects is known, but only for an array of one."""
    return _OBJECT if spec in ("O8", "O4", "|O", "O") else PlainUnpickler.GLOBALS["numpy.dtype"](spec, *rest)


def _forget(*_: object) -> None:
    """In the place of all that makes tensors."""


class _DictionaryUnpickler(PlainUnpickler):
    """Knows the array of one Python object as well, and gives the object in its place."""

    GLOBALS: ClassVar[dict[str, Any]] = {
        **PlainUnpickler.GLOBALS,
        "numpy.dtype": _dtype,
        "torch._utils._rebuild_tensor_v2": _forget,
        "torch.storage._load_from_bytes": _forget,
        "collections.OrderedDict": _forget,
    }
    dispatch: ClassVar[dict[int, Callable]] = dict(PlainUnpickler.dispatch)

    def load_build(self) -> None:
        """Give an object its state."""
        state, target = self.stack[-1], self.stack[-2]
        if target is _OBJECT:
            self.stack.pop()
        elif id(target) in self._unfilled and isinstance(state, tuple) and len(state) == 5 and state[2] is _OBJECT:
            if state[1] != () or not isinstance(state[4], list) or len(state[4]) != 1:
                raise DataError("it holds an array of several Python objects; expected one dictionary")
            self._unfilled.pop(id(target))
            self.stack.pop()
            self.stack[-1] = state[4][0]
        else:
            super().load_build()

    dispatch[ord("b")] = load_build
