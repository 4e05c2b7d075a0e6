"""Digests of files that are asked for many times in one process."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from data_contracts.file_lists import file_digest


def remembered_digest(path: Path) -> str:
    """SHA-256 of a file's content; it is read again only where size or time of change are other than before.

    Every score of an experiment asks for the same files when it is planned, and again when it runs.
    """
    status = path.stat()
    return _digest(path, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=16)
def _digest(path: Path, size: int, modified_ns: int) -> str:
    return file_digest(path)
