"""Structs of numbers from MATLAB files of version 5 to 7.

scipy.io.loadmat reads far more, and trusts what it reads: of damaged files some end the process and some are read for
ever. Here every length is compared with the bytes there are before anything is made of it.

Source: MathWorks, "MAT-File Format", version 5: elements of a tag (type, bytes) and data, padded to 8 bytes; a matrix
is an element of elements (flags, dimensions, name, values); a compressed element holds one other.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_contracts.errors import DataError

MAX_BYTES = 512 * 2**20
"""Of the file, and of an element unpacked: DHP19's largest has 3 MB."""
HEADER_BYTES = 128
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_STRUCT_CLASS, _NUMBER_CLASSES = 2, range(6, 16)
_COMPLEX = 1 << 11


def read_struct(path: Path, variable: str) -> dict[str, np.ndarray]:
    """The fields of a 1 x 1 struct that are real arrays of numbers, in the shape that MATLAB shows.

    Raises:
        DataError: no such file, one that is damaged or of another version, or there is no such struct in it.
        OSError: the file cannot be read now.
    """
    try:
        content = _read(path)
        order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
        if len(content) < HEADER_BYTES or order is None or content[:8] == b"\x89HDF\r\n\x1a\n":
            raise DataError("expected a .mat file of version 5 to 7 (save -v7)")
        names = []
        for kind, data in _elements(memoryview(content)[HEADER_BYTES:], order):
            if kind == _COMPRESSED:
                ((kind, data),) = list(_elements(memoryview(_unpacked(data)), order))
            if kind == _MATRIX:
                matrix = _parse_matrix(data, order)
                if matrix.name == variable:
                    return _fields(matrix, order)
                names.append(matrix.name)
        raise DataError(f"expected a variable {variable}, got {', '.join(names)[:200] or 'none'}")
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    except (ValueError, zlib.error) as error:
        raise DataError(f"{path}: damaged: {error}") from error


@dataclass(frozen=True)
class _Matrix:
    name: str
    kind: int
    is_complex: bool
    shape: tuple[int, ...]
    values: list[tuple[int, memoryview]]


def _read(path: Path) -> bytes:
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise DataError(f"has {size} bytes, more than the limit of {MAX_BYTES}")
    return path.read_bytes()


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Types and contents of consecutive elements."""
    at = 0
    while at < len(data):
        if len(data) - at < 8:
            raise ValueError("it ends within the tag of an element")
        kind, num_bytes = (int(number) for number in np.frombuffer(data[at : at + 8], f"{order}u4"))
        start, stop = at + 8, at + 8 + num_bytes
        if kind >> 16:  # at most four bytes, beside type and length
            kind, num_bytes = kind & 0xFFFF, kind >> 16
            start, stop, limit = at + 4, at + 4 + num_bytes, at + 8
            at += 8
        else:
            at, limit = stop if kind == _COMPRESSED else stop + -num_bytes % 8, len(data)
        if stop > limit:
            raise ValueError(f"an element of {num_bytes} bytes, where {limit - start} are left")
        yield kind, data[start:stop]


def _unpacked(data: memoryview) -> bytes:
    stream = zlib.decompressobj()
    content = stream.decompress(data, MAX_BYTES)
    if stream.unconsumed_tail or not stream.eof:
        raise ValueError("a compressed element that is cut, or larger than the limit")
    return content


def _parse_matrix(data: memoryview, order: str) -> _Matrix:
    """Flags, dimensions and name; what follows stays as it is."""
    elements = list(_elements(data, order))
    if len(elements) < 3:
        raise ValueError("a matrix without flags, dimensions or name")
    flags = int(_numbers(elements[0], order)[0])
    shape = tuple(int(length) for length in _numbers(elements[1], order))
    if len(shape) < 2 or min(shape) < 0:
        raise ValueError(f"a matrix of dimensions {list(shape)[:8]}")
    name = bytes(elements[2][1]).decode("ascii", errors="replace")
    return _Matrix(name, flags & 0xFF, bool(flags & _COMPLEX), shape, elements[3:])


def _numbers(element: tuple[int, memoryview], order: str) -> np.ndarray:
    kind, data = element
    if kind not in _NUMBERS or not len(data):
        raise ValueError(f"expected numbers, got an element of type {kind} and {len(data)} bytes")
    return np.frombuffer(data, order + _NUMBERS[kind])


def _fields(struct: _Matrix, order: str) -> dict[str, np.ndarray]:
    if struct.kind != _STRUCT_CLASS or math.prod(struct.shape) != 1 or len(struct.values) < 2:
        raise DataError(f"expected {struct.name} to be one struct, got class {struct.kind}, shape {list(struct.shape)}")
    length, text = int(_numbers(struct.values[0], order)[0]), bytes(struct.values[1][1])
    if length < 1 or len(text) % length:
        raise ValueError(f"names of fields of {length} bytes each, in {len(text)}")
    names = [text[at : at + length].split(b"\0")[0].decode("ascii", "replace") for at in range(0, len(text), length)]
    if len(names) != len(struct.values) - 2:
        raise ValueError(f"{len(names)} names for {len(struct.values) - 2} fields")
    found = {}
    for name, (kind, data) in zip(names, struct.values[2:], strict=True):
        # An empty field is a matrix without anything in it.
        matrix = _parse_matrix(data, order) if kind == _MATRIX and len(data) else None
        if matrix is not None and matrix.kind in _NUMBER_CLASSES and not matrix.is_complex and matrix.values:
            values = _numbers(matrix.values[0], order) if math.prod(matrix.shape) else np.zeros(0)
            if len(values) != math.prod(matrix.shape):
                raise ValueError(f"{name}: {len(values)} values for dimensions {list(matrix.shape)[:8]}")
            found[name] = values.reshape(matrix.shape, order="F")
    return found
