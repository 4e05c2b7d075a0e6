"""The local cache of a bucket: what of it the bucket has, what running processes hold, and what goes when it is full.

In the home folder that is the cache:
uploaded/<stage>/<key>     digest and bytes of an artefact that the bucket has, too
in_use/<number>            names of the artefacts that a process found or made; locked (flock) until it ends
locks/eviction             shared while a process notes an artefact and looks for it; exclusive while some leave
"""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import shutil
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from data_contracts.errors import DataError
from data_contracts.published import kept_versions
from data_contracts.run_record import RUN_FILE

LIMIT = "CTLEV_CACHE_GB"
"""Environment: gigabytes (1e9 bytes) of artefacts that the cache of a bucket keeps; none = any number."""
NOTE_USE_S = 86_400.0

_notes: dict[tuple[Path, int], tuple[IO[str], set[str]]] = {}
_notes_guard = threading.Lock()


def cache_limit_bytes() -> float:
    """The variable CTLEV_CACHE_GB in bytes; infinite where it is not set.

    Raises:
        DataError: it is not a number above 0.
    """
    asked = os.environ.get(LIMIT)
    if not asked:
        return math.inf
    try:
        limit = float(asked)
    except ValueError:
        limit = math.nan
    if not limit > 0:
        raise DataError(f"{LIMIT} must be a number of gigabytes above 0, got {asked!r}")
    return limit * 1e9


class BucketCache:
    """The cache below one home folder. Artefacts are named `stage/key`."""

    def __init__(self, home: Path) -> None:
        self.home = home

    @contextlib.contextmanager
    def holding(self, name: str) -> Iterator[None]:
        """Note that this process uses an artefact until it ends; inside this block none leaves the cache."""
        with self._locked(fcntl.LOCK_SH):
            self._note(name)
            yield

    def mark_uploaded(self, name: str, digest: str) -> None:
        """Note that the bucket has an artefact of the cache."""
        marker = self.home / "uploaded" / name
        marker.parent.mkdir(parents=True, exist_ok=True)
        folder = self.home / "artefacts" / name
        num_bytes = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        temporary = marker.with_name(f".{marker.name}.{uuid.uuid4().hex}")
        temporary.write_text(f"{digest} {num_bytes}\n", encoding="utf-8")
        temporary.replace(marker)

    def is_uploaded(self, name: str, digest: str) -> bool:
        """Does the bucket have it with this digest, as far as is known here?"""
        return self._uploaded(name)[0] == digest

    def is_use_to_be_noted(self, name: str) -> bool:
        """Has the bucket an artefact of which this machine has not noted for a day that it uses it? Asked, it has."""
        marker = self.home / "uploaded" / name
        try:
            if time.time() - marker.stat().st_mtime < NOTE_USE_S:
                return False
            os.utime(marker)
        except OSError:
            return False
        return True

    def unmark(self, name: str) -> None:
        """Forget that the bucket has an artefact."""
        (self.home / "uploaded" / name).unlink(missing_ok=True)

    def evict(self, is_in_bucket: Callable[[str], bool]) -> list[str]:
        """Remove artefacts that the bucket has until the rest is below CTLEV_CACHE_GB, those first that were used last.

        What a running process holds stays, and what the latest published versions refer to; where that is more than the
        limit, a line says so.

        Args:
            is_in_bucket: asks the bucket once more before an artefact goes.

        Returns:
            Their names.
        """
        limit_bytes = cache_limit_bytes()
        sizes = {} if math.isinf(limit_bytes) else self._sizes()
        excess = sum(num_bytes for _, num_bytes in sizes.values()) - limit_bytes
        if excess <= 0:
            return []
        latest = (one for version in kept_versions(self.home, 0) for one in version.artefacts)
        kept = self._held() | {f"{one.stage}/{one.key}" for one in latest}
        leaving: list[str] = []
        for name in sorted(sizes.keys() - kept, key=lambda name: sizes[name][0]):
            if excess <= 0:
                break
            if is_in_bucket(name):
                leaving.append(name)
                excess -= sizes[name][1]
            else:
                self.unmark(name)  # it was removed there; the next run sends it again
        if excess > 0:
            held_gb = (excess + limit_bytes) / 1e9
            print(f"{self.home}: {held_gb:.3g} GB are in use, above {LIMIT}={limit_bytes / 1e9:g}", file=sys.stderr)
        return self._remove(leaving)

    def _remove(self, names: list[str]) -> list[str]:
        pruned = self.home / "pruned"
        pruned.mkdir(exist_ok=True)
        moved = {}
        with self._locked(fcntl.LOCK_EX):
            held = self._held()  # some may have been found since
            for name in names:
                target = pruned / uuid.uuid4().hex
                if name not in held:
                    with contextlib.suppress(FileNotFoundError):
                        (self.home / "artefacts" / name).rename(target)
                        moved[name] = target
                    self.unmark(name)
        for target in moved.values():
            shutil.rmtree(target, ignore_errors=True)
        return list(moved)

    def _sizes(self) -> dict[str, tuple[float, int]]:
        """When each artefact that the bucket has was last used, and its bytes."""
        found = {}
        for marker in (self.home / "uploaded").glob("*/[0-9a-f]*"):
            name = f"{marker.parent.name}/{marker.name}"
            try:
                used_s = (self.home / "artefacts" / name / RUN_FILE).stat().st_mtime
            except (FileNotFoundError, NotADirectoryError):
                continue
            found[name] = used_s, self._uploaded(name)[1]
        return found

    def _uploaded(self, name: str) -> tuple[str, int]:
        try:
            digest, num_bytes = (self.home / "uploaded" / name).read_text(encoding="utf-8").split()
            return digest, int(num_bytes)
        except (FileNotFoundError, NotADirectoryError, ValueError):
            return "", 0

    def _note(self, name: str) -> None:
        with _notes_guard:
            key = self.home, os.getpid()
            if key not in _notes:
                path = self.home / "in_use" / uuid.uuid4().hex
                path.parent.mkdir(parents=True, exist_ok=True)
                file = path.open("a", encoding="utf-8")
                fcntl.flock(file, fcntl.LOCK_EX)
                while not os.fstat(
                    file.fileno()
                ).st_nlink:  # removed before it was locked, as that of a process that ended
                    file.close()
                    file = path.open("a", encoding="utf-8")
                    fcntl.flock(file, fcntl.LOCK_EX)
                _notes[key] = file, set()
            file, known = _notes[key]
            if name not in known:
                file.write(f"{name}\n")
                file.flush()
                known.add(name)

    def _held(self) -> set[str]:
        """What running processes hold; the notes of those that have ended are removed."""
        held: set[str] = set()
        for path in (self.home / "in_use").glob("*"):
            with contextlib.suppress(FileNotFoundError), path.open("r+", encoding="utf-8") as file:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    held.update(file.read().split("\n"))
                else:
                    path.unlink(missing_ok=True)
        return held

    @contextlib.contextmanager
    def _locked(self, mode: int) -> Iterator[None]:
        path = self.home / "locks" / "eviction"
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab") as file:
            fcntl.flock(file, mode)
            yield
