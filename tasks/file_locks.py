"""Locks on files (flock) that say what they wait for."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO

SAY_AFTER_S = 5.0
SAY_AGAIN_S = 300.0


def lock(file: IO[bytes], mode: int, what: str) -> None:
    """Lock an open file; where that takes longer than seconds, say on standard error what is waited for.

    Args:
        file: opened for appending and reading.
        mode: LOCK_EX or LOCK_SH.
        what: is waited for, such as `artefact encode/0a1b`.
    """
    with contextlib.suppress(BlockingIOError):
        fcntl.flock(file, mode | fcntl.LOCK_NB)
        return
    got = threading.Event()
    threading.Thread(target=_say, args=(Path(file.name), what, got), daemon=True).start()
    try:
        fcntl.flock(file, mode)
    finally:
        got.set()


@contextlib.contextmanager
def locked(path: Path, what: str) -> Iterator[None]:
    """Only one process is in this block for a file; the file says which, for those who wait."""
    with path.open("a+b") as file:
        lock(file, fcntl.LOCK_EX, what)
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        file.flush()
        yield


def _say(path: Path, what: str, got: threading.Event) -> None:
    wait_s = SAY_AFTER_S
    while not got.wait(wait_s):
        print(f"waiting for {what}: {_holder(path)} holds {path}", file=sys.stderr, flush=True)
        wait_s = SAY_AGAIN_S


def _holder(path: Path) -> str:
    """Who holds a lock, as far as its file says, and whether that process is stopped."""
    text = path.read_text(errors="replace")[:200] if path.exists() else ""
    found = re.fullmatch(r"process (\d+) on (\S+)\n", text)
    if found is None:
        return "another process"
    number, host = int(found[1]), found[2]
    named = f"process {number} on {host}"
    if host != socket.gethostname():
        return named
    with contextlib.suppress(OSError):
        state = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0]
        if state in "Tt":
            return f"{named}, which is stopped (kill -CONT {number} lets it go on),"
    return named
