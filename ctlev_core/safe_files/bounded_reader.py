"""Reading from files that may claim more than they hold."""

from __future__ import annotations

from typing import Protocol

from data_contracts.errors import DataError

_PIECE = 2**20


class _Readable(Protocol):
    def read(self, size: int, /) -> bytes: ...


class BoundedReader:
    """Reads exactly what is asked for, in chunks, so that memory grows only with bytes that are there.

    Args:
        stream: a file, or what decompresses one.
        limit: bytes; asking for more in all is refused.
    """

    def __init__(self, stream: _Readable, limit: int) -> None:
        self._stream = stream
        self._left = self._limit = limit

    def read(self, size: int) -> bytes:
        """The next `size` bytes.

        Raises:
            DataError: the stream ends before, or the limit is passed.
        """
        if not 0 <= size <= self._left:
            raise DataError(f"it claims {size} more bytes where at most {self._left} of {self._limit} are left")
        chunks, missing = [], size
        while missing:
            chunk = self._stream.read(min(missing, _PIECE))
            if not chunk:
                raise DataError(f"it ends {missing} bytes early")
            chunks.append(chunk)
            missing -= len(chunk)
        self._left -= size
        return chunks[0] if len(chunks) == 1 else b"".join(chunks)

    def readline(self) -> bytes:
        """The bytes up to and with the next line feed."""
        line = bytearray()
        while not line.endswith(b"\n"):
            line += self.read(1)
        return bytes(line)

    def read_to_end(self) -> None:
        """Read and forget the rest: a decompressor compares the checksum only there."""
        while chunk := self._stream.read(_PIECE):
            self._left -= len(chunk)
            if self._left < 0:
                raise DataError(f"it holds more than {self._limit} bytes")
