"""Arrays compressed in chunks of rows, written as rows come and read at random.

A file `<name>.npy.zst` is Zstandard's seekable format: one Zstandard frame for the header of a .npy file, one for each
chunk of so many rows, and a table of their sizes at the end. Any Zstandard program makes a .npy file of it that NumPy
reads, `zstd -d frames.npy.zst`; this module decompresses only the chunks whose rows are asked for. Colour images
[N, H, W, 3] of 8 bits lie as planes [N, 3, H, W], which compress better: so does the .npy file made from them.

What a file holds depends on the rows alone, not on how many came at a time; another version of pyarrow may compress
to other bytes. Between chunks and table lies a frame that programs skip: which layout, and a checksum of every frame.

    table at the end: Zstandard, contrib/seekable_format/zstd_seekable_compression_format.md, version 0.1.0
    frames: RFC 8878
"""

from __future__ import annotations

import io
import itertools
import math
import os
import struct
import threading
import weakref
import zlib
from array import array
from collections import OrderedDict
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np
import pyarrow as pa
from numpy.lib import format as npy

from data_contracts.array_rows import ArrayRows
from data_contracts.errors import DataError

SUFFIX = ".npy.zst"
LEVEL = 3
CHUNK_BYTES = 1 << 15
"""Rows of a chunk before compression, one row at least: what reading a single row decompresses."""
MAX_CHUNK_BYTES = 1 << 28
"""What a file may make a reader allocate for a chunk: more than a row of any array here."""
CACHE_BYTES = 64 << 20
"""Decompressed chunks that a process keeps, of all its arrays together."""

_FRAME = struct.Struct("<IBI")
"""Of a frame that is not compressed: magic number, descriptor (one segment, size in 4 bytes), size."""
_FRAME_MAGIC, _FRAME_DESCRIPTOR = 0xFD2FB528, 0xA0
_SKIPPED = struct.Struct("<II")
"""Start of a frame that programs skip: magic number, bytes that follow."""
_TABLE_MAGIC, _CHECKS_MAGIC = 0x184D2A5E, 0x184D2A50
_TABLE_END = struct.Struct("<IBI")
"""End of the table: frames, descriptor, magic number."""
_SEEKABLE_MAGIC = 0x8F92EAB1
_CHECKS_NAME = b"ctlev\x01"
_CHECKS = struct.Struct("<6sH")
"""Name with version, and whether colours lie as planes; the checksums follow, and the checksum of all this."""
_MAX_HEADER_BYTES = 1 << 16
_KINDS = "biufc"
_CODEC = pa.Codec("zstd", LEVEL)
_serials = itertools.count()


class CompressedArrayWriter:
    """Append rows to a compressed array; the file is complete when the `with` block ends."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[bytes] | None = None
        self._row: tuple[np.dtype, tuple[int, ...]] = (np.dtype(np.uint8), ())
        self._step = 1
        self._waiting: list[np.ndarray] = []
        """Rows of the chunk that is not full yet."""
        # Of 32 bits: an array of millions of rows has as many chunks.
        self._sizes, self._checks = array("I"), array("I")
        self.rows = 0

    def append(self, rows: np.ndarray) -> None:
        """Write the rows of [N, ...]; dtype and row shape must be those of the first call.

        Raises:
            DataError: dtype or row shape differ, values are Python objects, or a row is larger than a chunk may be.
        """
        row = (rows.dtype, rows.shape[1:])
        if self._file is None:
            self._open(row)
        assert self._file is not None
        if row != self._row:
            raise DataError(f"{self._path.name}: rows must be alike; expected {self._row}, got {row}")
        waiting = self.rows % self._step
        self.rows += len(rows)
        first = 0
        while waiting + len(rows) - first >= self._step:
            last = first + self._step - waiting
            self._waiting.append(rows[first:last])
            self._write_chunk()
            first, waiting = last, 0
        if first < len(rows):
            # A copy: the caller may use its array again.
            self._waiting.append(rows[first:].copy())

    def _open(self, row: tuple[np.dtype, tuple[int, ...]]) -> None:
        dtype, shape = row
        row_bytes = dtype.itemsize * math.prod(shape)
        if dtype.kind not in _KINDS or row_bytes > MAX_CHUNK_BYTES:
            raise DataError(
                f"{self._path.name}: expected rows of numbers, of at most {MAX_CHUNK_BYTES} bytes each; "
                f"got {list(shape)} {dtype}"
            )
        self._row, self._step = row, max(CHUNK_BYTES // max(row_bytes, 1), 1)
        self._file = self._path.open("wb")
        self._write(self._header(), 0)

    def _header(self) -> bytes:
        """The first frame. NumPy pads its header so that the first axis can grow in place."""
        dtype, shape = self._row
        stored = (shape[-1], *shape[:-1]) if _has_planes(dtype, shape) else shape
        content = io.BytesIO()
        header = {"descr": npy.dtype_to_descr(dtype), "fortran_order": False, "shape": (self.rows, *stored)}
        npy.write_array_header_1_0(content, header)
        raw = content.getvalue()
        block = (len(raw) << 3 | 1).to_bytes(3, "little")  # the last one, as it is
        return _FRAME.pack(_FRAME_MAGIC, _FRAME_DESCRIPTOR, len(raw)) + block + raw

    def _write_chunk(self) -> None:
        # Without the type NumPy would give numbers of another byte order in its own.
        rows = self._waiting[0] if len(self._waiting) == 1 else np.concatenate(self._waiting, dtype=self._row[0])
        self._waiting = []
        stored = np.ascontiguousarray(rows)
        if _has_planes(*self._row):
            stored = np.empty((len(rows), rows.shape[-1], *rows.shape[1:-1]), rows.dtype)
            for colour in range(rows.shape[-1]):
                stored[:, colour] = rows[..., colour]
        self._write(_CODEC.compress(stored, asbytes=True), stored.nbytes)

    def _write(self, frame: bytes, size: int) -> None:
        assert self._file is not None
        self._file.write(frame)
        self._sizes.extend((len(frame), size))
        self._checks.append(zlib.crc32(frame))

    def _finish(self) -> None:
        assert self._file is not None
        if self._waiting:
            self._write_chunk()
        header = self._header()
        self._sizes[0], self._sizes[1] = len(header), len(header) - _FRAME.size - 3
        self._checks[0] = zlib.crc32(header)
        checks = _CHECKS.pack(_CHECKS_NAME, _has_planes(*self._row)) + np.array(self._checks, "<u4").tobytes()
        checks += zlib.crc32(checks).to_bytes(4, "little")
        self._write(_SKIPPED.pack(_CHECKS_MAGIC, len(checks)) + checks, 0)
        table = np.array(self._sizes, "<u4").tobytes()
        table += _TABLE_END.pack(len(self._checks), 0, _SEEKABLE_MAGIC)
        self._file.write(_SKIPPED.pack(_TABLE_MAGIC, len(table)) + table)
        self._file.seek(0)
        self._file.write(header)

    def __enter__(self) -> CompressedArrayWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._file is None:
            return
        try:
            if error is None:
                self._finish()
        finally:
            self._file.close()


def _has_planes(dtype: np.dtype, row_shape: tuple[int, ...]) -> bool:
    return dtype == np.uint8 and len(row_shape) == 3 and row_shape[-1] == 3


class CompressedArray(ArrayRows):
    """A compressed array [N, ...] on disk, of which rows are read when it is indexed.

    Reading is the same from several threads, and after the process was forked; sent to another process it is opened
    there anew.

    Args:
        path: of a file that `CompressedArrayWriter` wrote.

    Raises:
        DataError: the file is something else, cut short or damaged; reading rows says so of their chunks.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        descriptor = os.open(path, os.O_RDONLY)
        self._close = weakref.finalize(self, os.close, descriptor)
        self._descriptor = descriptor
        sizes, end = self._read_table(os.fstat(descriptor).st_size)
        self._starts = np.concatenate([[0], np.cumsum(sizes[:, 0], dtype=np.int64)])
        if self._starts[-1] != end:
            raise self._damaged(end, f"a table of {self._starts[-1]} bytes in {end}")
        self._checks, has_planes = self._read_checks(sizes)
        self.dtype, stored = self._read_header(int(sizes[0, 1]))
        self._is_planar = has_planes and len(stored) == 4 and _has_planes(self.dtype, (*stored[2:], stored[1]))
        self.shape = (stored[0], *stored[2:], stored[1]) if self._is_planar else stored
        if has_planes != self._is_planar:
            raise self._damaged(0, f"planes of an array {list(stored)} {self.dtype}")
        self._stored_row = stored[1:]
        self._serial = next(_serials)
        self._step = self._check_chunks(sizes[1:-1, 1])

    def _read_table(self, size: int) -> tuple[np.ndarray, int]:
        """Bytes [K, 2] of every frame, compressed and not, and where they end."""
        start = size - _TABLE_END.size
        count, descriptor, magic = _TABLE_END.unpack(self._pread(start, _TABLE_END.size, "the end of a table"))
        if magic != _SEEKABLE_MAGIC or descriptor != 0:
            raise self._damaged(start, "something else than the end of a table")
        length = 8 * count + _TABLE_END.size
        start = size - length - _SKIPPED.size
        if count < 2 or start < 0:
            raise self._damaged(size - _TABLE_END.size, f"a table of {count} frames in {size} bytes")
        table = self._pread(start, _SKIPPED.size + length, "a table")
        if _SKIPPED.unpack_from(table) != (_TABLE_MAGIC, length):
            raise self._damaged(start, "something else than a table")
        return np.frombuffer(table, "<u4", 2 * count, _SKIPPED.size).reshape(count, 2), start

    def _read_checks(self, sizes: np.ndarray) -> tuple[np.ndarray, bool]:
        """The checksum of every frame but the last, which holds them."""
        start, length = int(self._starts[-2]), _SKIPPED.size + _CHECKS.size + 4 * len(sizes)
        if sizes[-1].tolist() != [length, 0]:
            raise self._damaged(start, f"checksums of {sizes[-1, 0]} bytes, expected {length}")
        frame = self._pread(start, length, "checksums")
        skipped, content = frame[: _SKIPPED.size], frame[_SKIPPED.size : -4]
        name, has_planes = _CHECKS.unpack_from(content)
        own = int.from_bytes(frame[-4:], "little")
        if (skipped, name, own) != (_SKIPPED.pack(_CHECKS_MAGIC, len(content) + 4), _CHECKS_NAME, zlib.crc32(content)):
            raise self._damaged(start, "something else than checksums")
        return np.frombuffer(content, "<u4", len(sizes) - 1, _CHECKS.size), bool(has_planes)

    def _read_header(self, size: int) -> tuple[np.dtype, tuple[int, ...]]:
        if size > _MAX_HEADER_BYTES:
            raise self._damaged(0, f"a header of {size} bytes")
        content = io.BytesIO(self._decompressed(0, size))
        try:
            if npy.read_magic(content) != (1, 0):
                raise ValueError("version")
            shape, fortran_order, dtype = npy.read_array_header_1_0(content)
            np.empty((0, *shape[1:]), dtype)  # larger than NumPy can say?
            if fortran_order or dtype.kind not in _KINDS or not shape or content.read(1):
                raise ValueError(f"{list(shape)} {dtype}")
        except ValueError as error:
            raise self._damaged(0, f"something else than a .npy header ({error})") from error
        return dtype, shape

    def _check_chunks(self, sizes: np.ndarray) -> int:
        """Rows of a chunk: all but the last are of one size, and together as large as the header says."""
        count, row_bytes = self.shape[0], self.dtype.itemsize * math.prod(self._stored_row)
        largest = int(sizes[0]) if len(sizes) else 0
        step = largest // row_bytes if row_bytes else count
        last = int(sizes[-1]) if len(sizes) else 0
        if (
            not 0 <= count < 1 << 40
            or (step < 1 and count)
            or not last <= largest == step * row_bytes <= MAX_CHUNK_BYTES
            or (sizes[:-1] != largest).any()
            or last != (count - step * max(len(sizes) - 1, 0)) * row_bytes
        ):
            raise self._damaged(0, f"{len(sizes)} chunks that are not those of {list(self.shape)} {self.dtype}")
        return max(step, 1)

    def _read(self, rows: np.ndarray) -> np.ndarray:
        found = np.empty((len(rows), *self.shape[1:]), self.dtype)
        if not found.size:
            return found
        chunks, places = np.divmod(rows, self._step)
        order = np.argsort(chunks, kind="stable")
        starts = np.flatnonzero(np.diff(chunks[order], prepend=-1))
        for first, last in zip(starts.tolist(), [*starts[1:].tolist(), len(rows)], strict=True):
            members = order[first:last]
            chunk = self._chunk(int(chunks[members[0]]))
            if last - first == 1:
                found[members[0]] = chunk[places[members[0]]]
            else:
                found[members] = chunk[places[members]]
        return found

    def _chunk(self, number: int) -> np.ndarray:
        """The rows of a chunk, perhaps from memory."""
        key = (self._serial, number)
        chunk = _cache.get(key)
        if chunk is None:
            chunk = self._decompressed_chunk(number)
            _cache.put(key, chunk)
        return chunk

    def _decompressed_chunk(self, number: int) -> np.ndarray:
        count = min(self._step, self.shape[0] - number * self._step)
        size = count * math.prod(self._stored_row) * self.dtype.itemsize
        rows = np.frombuffer(self._decompressed(number + 1, size), self.dtype).reshape(count, *self._stored_row)
        if not self._is_planar:
            return rows
        images = np.empty((count, *self.shape[1:]), self.dtype)
        for colour in range(self.shape[-1]):
            images[..., colour] = rows[:, colour]
        return images

    def _decompressed(self, frame: int, size: int) -> pa.Buffer:
        """The content of a frame, of which the table says how large it is."""
        start = int(self._starts[frame])
        compressed = self._pread(start, int(self._starts[frame + 1]) - start, "a chunk")
        if zlib.crc32(compressed) != self._checks[frame]:
            raise self._damaged(start, "other content than was written")
        try:
            return _CODEC.decompress(compressed, size)
        except (OSError, pa.ArrowException) as error:
            raise self._damaged(start, f"a chunk that cannot be decompressed ({error})") from error

    def _pread(self, start: int, count: int, what: str) -> bytes:
        # Without a position of the file that processes would share.
        found = os.pread(self._descriptor, count, start) if start >= 0 else b""
        if len(found) != count:
            raise self._damaged(max(start, 0), f"{len(found)} bytes of {what}, expected {count}")
        return found

    def _damaged(self, place: int, found: str) -> DataError:
        return DataError(f"{self.path}: is no whole compressed array; at byte {place} it has {found}")

    def __reduce__(self) -> tuple[Any, ...]:
        return CompressedArray, (self.path,)


class _ChunkCache:
    """Decompressed chunks, those used last, of all arrays of a process."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Empty: after a fork, where another thread may have been at it."""
        self._lock = threading.Lock()
        self._chunks: OrderedDict[tuple[int, int], np.ndarray] = OrderedDict()
        self._bytes = 0

    def get(self, key: tuple[int, int]) -> np.ndarray | None:
        with self._lock:
            chunk = self._chunks.get(key)
            if chunk is not None:
                self._chunks.move_to_end(key)
            return chunk

    def put(self, key: tuple[int, int], chunk: np.ndarray) -> None:
        with self._lock:
            if key in self._chunks:
                return
            self._chunks[key] = chunk
            self._bytes += chunk.nbytes
            while self._bytes > CACHE_BYTES:
                self._bytes -= self._chunks.popitem(last=False)[1].nbytes


_cache = _ChunkCache()
os.register_at_fork(after_in_child=_cache.reset)
