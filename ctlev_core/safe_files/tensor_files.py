"""Weights files, safetensors and torch's own: what tensors they hold and where, read without torch or unpickling.

Source of the safetensors layout: its format description: eight bytes with the length of a JSON header, the header, then
the bytes of all tensors.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from data_contracts.errors import DataError

ITEM_BYTES = {
    "F64": 8, "F32": 4, "F16": 2, "BF16": 2, "I64": 8, "I32": 4, "I16": 2, "I8": 1, "U8": 1, "BOOL": 1,
}  # fmt: skip
MAX_HEADER = 100 * 2**20
_EXPONENTS = {"F64": ("<u8", 0x7FF0 << 48), "F32": ("<u4", 0x7F800000), "F16": ("<u2", 0x7C00), "BF16": ("<u2", 0x7F80)}
FLOATS = tuple(_EXPONENTS)
_PIECE = 2**22


@dataclass(frozen=True)
class StoredTensor:
    """Where a tensor lies.

    Attributes:
        path: the file.
        dtype: a key of `ITEM_BYTES`.
        shape: of the tensor.
        strides: in items.
        start: of the first item in the file, in bytes.
    """

    path: Path
    dtype: str
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    start: int

    @property
    def stored_items(self) -> int:
        """From the first item to the last, those of others between them included."""
        if 0 in self.shape:
            return 0
        return 1 + sum((size - 1) * stride for size, stride in zip(self.shape, self.strides, strict=True))


def contiguous_strides(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Strides in items of a C-ordered array."""
    return tuple(math.prod(shape[axis + 1 :]) for axis in range(len(shape)))


def read_tensor_table(path: Path) -> dict[str, StoredTensor]:
    """The tensors of a weights file by name; the ending of the file's name is not trusted.

    Args:
        path: a safetensors file, or the archive that `torch.save` writes since torch 1.6.
    Raises:
        DataError: no such file, cut, damaged, a bare pickle, or an archive whose pickle names anything but tensors.
    """
    if not path.is_file():
        raise DataError(f"{path}: expected a weights file, got {'a folder' if path.is_dir() else 'nothing there'}")
    with path.open("rb") as file:
        head = file.read(9)
    if head.startswith(b"version "):
        raise DataError(f"{path}: a pointer of Git LFS, not the weights themselves; fetch them with `git lfs pull`")
    if head[:4] == b"PK\x03\x04":
        from ctlev_core.safe_files.torch_files import read_torch_table

        return read_torch_table(path)
    if head[:1] == b"\x80" and head[8:] != b"{":
        raise DataError(
            f"{path}: refused: it is a bare pickle, which could run code while it is loaded; "
            "expected safetensors, or the archive that torch.save writes since torch 1.6"
        )
    return _read_safetensors_table(path)


def _read_safetensors_table(path: Path) -> dict[str, StoredTensor]:
    size = path.stat().st_size
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        if size < 8 or length > MAX_HEADER:
            raise DataError(f"{path}: no safetensors file: {size} bytes that begin with a header length of {length}")
        if size < 8 + length:
            raise DataError(f"{path}: truncated: its header alone takes {8 + length} bytes, the file has {size}")
        try:
            header = json.loads(file.read(length))
            header.pop("__metadata__", None)
            claims = {name: _claim(entry) for name, entry in header.items()}
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise DataError(f"{path}: no safetensors file: its header cannot be read: {error}") from error
    expected = 8 + length + max((stop for *_, stop in claims.values()), default=0)
    if size != expected:
        problem = "truncated" if size < expected else "longer than its header says"
        raise DataError(f"{path}: {problem}: expected {expected} bytes, got {size}")
    tensors = {}
    for name, (dtype, shape, begin, stop) in claims.items():
        if dtype not in ITEM_BYTES:
            raise DataError(f"{path}: tensor {name!r} is of type {dtype}; read are {', '.join(ITEM_BYTES)}")
        if not 0 <= begin <= stop or stop - begin != math.prod(shape) * ITEM_BYTES[dtype]:
            raise DataError(
                f"{path}: tensor {name!r} of shape {list(shape)} {dtype} cannot lie in bytes {begin} to {stop}"
            )
        tensors[name] = StoredTensor(path, dtype, shape, contiguous_strides(shape), 8 + length + begin)
    return tensors


def _claim(entry: Any) -> tuple[str, tuple[int, ...], int, int]:
    shape, (begin, stop) = tuple(entry["shape"]), entry["data_offsets"]
    if not all(type(number) is int and number >= 0 for number in (*shape, begin, stop)):
        raise ValueError(f"shape {entry['shape']}, offsets {entry['data_offsets']}")
    return str(entry["dtype"]), shape, begin, stop


def read_items(tensor: StoredTensor) -> np.ndarray:
    """The stored items [`stored_items`] of a tensor, mapped from its file; 16-bit floats as their bits, uint16."""
    numbers = {"F64": "<f8", "F32": "<f4", "F16": "<u2", "BF16": "<u2", "BOOL": "?"}
    dtype = np.dtype(numbers.get(tensor.dtype, f"<{tensor.dtype[0].lower()}{ITEM_BYTES[tensor.dtype]}"))
    if tensor.stored_items == 0:
        return np.zeros(0, dtype)
    return np.memmap(tensor.path, dtype, "r", tensor.start, (tensor.stored_items,))


def check_finite(tensors: Iterable[tuple[str, StoredTensor]]) -> None:
    """Raise `DataError` where a weight is NaN or infinite; files that have not changed are looked at once a process."""
    for name, tensor in tensors:
        stat = tensor.path.stat()
        if not _is_finite(tensor, stat.st_size, stat.st_mtime_ns):
            raise DataError(f"{tensor.path}: tensor {name!r} holds values that are not finite (NaN or infinite)")


@lru_cache(maxsize=2**16)
def _is_finite(tensor: StoredTensor, size: int, mtime_ns: int) -> bool:
    if tensor.dtype not in _EXPONENTS:
        return True
    kind, mask = _EXPONENTS[tensor.dtype]
    bits = read_items(tensor).view(kind)
    # The exponent of NaN and infinity is all ones; on the bits this is faster than on halves, and bfloat16 has no type.
    exponent = np.array(mask, kind)
    return not any(
        bool(((bits[start : start + _PIECE] & exponent) == exponent).any()) for start in range(0, len(bits), _PIECE)
    )
