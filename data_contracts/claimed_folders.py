"""A folder that one process at a time writes into."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def folder_claimed(folder: Path, refusal: str) -> Iterator[None]:
    """In this block `folder`, which is made where it is not there, is this process's alone.

    Raises:
        BlockingIOError: another process has it; says `refusal`, and nothing waits.
    """
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BlockingIOError(refusal) from None
        yield
    finally:
        os.close(descriptor)
