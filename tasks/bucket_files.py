"""Files that people look at, between a home folder and its bucket: reports, published versions, exported events.

Artefacts never change; these do, and a file that two machines write is that of the last one, as in one home folder.
`shared_files.json` of the home folder says how each file was when it was last the same on both sides, so that only what
has changed since is sent or fetched. What is deleted on one side stays on the other.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from data_contracts.errors import DataError
from data_contracts.file_lists import file_digest
from tasks import file_locks
from tasks.bucket import Bucket, modified

FETCHED = ("reports", "published")
EVENTS = "events"
SENT = (*FETCHED, EVENTS)
"""Exported events may be many gigabytes: other machines fetch them where somebody asks for them."""
OWN_FILES = ("lock", "claimed.json")
"""What a process keeps for itself beside published versions (tasks.publish)."""
STATE_FILE = "shared_files.json"
State = dict[str, list[Any]]
"""By name: size, time of modification in ns and SHA-256 of the file; and size and version of the object, None while it
is being sent, empty where another machine has removed it since."""


def fetch_files(home: Path, bucket: Bucket, folders: tuple[str, ...] = FETCHED) -> int:
    """Fetch what other machines wrote since the last time; returns how many files.

    Raises:
        BucketError: the bucket cannot be read now.
        DataError: a name of an object leads out of the folder.
    """
    fetched = 0
    with _state(home) as state:
        for folder in folders:
            found = {f"{folder}/{name}": _object_state(info) for name, info in bucket.list(folder).items()}
            for name, there in found.items():
                if ".." in PurePosixPath(name).parts:
                    raise DataError(f"{bucket.url}/{name}: leads out of the home")
                path = home / name
                if path.exists() and name in state and state[name][-1] in (there, None):  # None: ours is to be sent
                    continue
                temporary = path.with_name(f".{path.name}.fetched")
                try:
                    bucket.fetch(name, temporary)
                except FileNotFoundError:  # removed since it was listed
                    continue
                temporary.replace(path)
                state[name] = [*_file_state(path), there]
                fetched += 1
    return fetched


def send_files(home: Path, bucket: Bucket, folders: tuple[str, ...] = SENT) -> int:
    """Send what was written here since the last time; returns how many files.

    Raises:
        BucketError: the bucket cannot be written now; the next run sends what was not sent.
    """
    sent = 0
    with _state(home) as state:
        for folder in folders:
            files = {path.relative_to(home): path for path in (home / folder).rglob("*") if path.is_file()}
            own = {name.as_posix(): path for name, path in files.items() if _is_shared(name)}
            changed = {name: path for name, path in own.items() if _has_changed(path, state.get(name))}
            for name, path in changed.items():
                # Before it is sent: what a process writes meanwhile is another state, and is sent the next time.
                state[name] = [*_file_state(path), None]
                bucket.send(path, name)
            objects = bucket.list(folder) if changed else {}
            for name in changed:
                sent_as = objects.get(name.partition("/")[2])
                state[name][-1] = [] if sent_as is None else _object_state(sent_as)
            if folder == EVENTS:
                # Streams of the export before would lie among those of this one.
                exports = {PurePosixPath(name).parts[1] for name in changed}
                names = (f"{folder}/{name}" for name in objects if PurePosixPath(name).parts[0] in exports)
                for name in (name for name in names if name not in own):
                    bucket.delete(name)
            sent += len(changed)
    return sent


@contextlib.contextmanager
def _state(home: Path) -> Iterator[State]:
    """What was the same on both sides; written when the block ends, whatever ends it."""
    path = home / STATE_FILE
    (home / "locks").mkdir(parents=True, exist_ok=True)
    with file_locks.locked(home / "locks" / STATE_FILE, f"the shared files of {home}"):
        state: State = {}
        with contextlib.suppress(FileNotFoundError, ValueError):  # all is compared anew
            state = json.loads(path.read_bytes())
        before = json.dumps(state)
        try:
            yield state
        finally:
            if json.dumps(state) != before:
                temporary = path.with_suffix(".tmp")
                temporary.write_text(json.dumps(state), encoding="utf-8")
                temporary.replace(path)


def _is_shared(name: Path) -> bool:
    """Finished files; those that begin with a point, or lie in such a folder, are being written."""
    return not any(part.startswith(".") for part in name.parts) and name.name not in OWN_FILES


def _has_changed(path: Path, state: list[Any] | None) -> bool:
    """Is a file another than the one of the bucket? A cached run writes its report anew, with the same content."""
    if state is None or state[-1] is None:
        return True
    status = path.stat()
    if [status.st_size, status.st_mtime_ns] == state[:2]:
        return False
    return file_digest(path) != state[2]


def _file_state(path: Path) -> list[Any]:
    status = path.stat()
    return [status.st_size, status.st_mtime_ns, file_digest(path)]


def _object_state(info: Mapping[str, Any]) -> list[Any]:
    return [info["size"], info.get("ETag") or info.get("etag") or modified(info).timestamp()]
