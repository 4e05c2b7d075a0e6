"""SHA-256 of the raw files an experiment reads, remembered in its home: a second plan reads none of them again."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field, TypeAdapter, ValidationError

from data_contracts.errors import DataError
from data_contracts.file_lists import file_digest
from data_contracts.run_record import Digest, mark_used

FILE = "raw_file_digests.json"
_START = b'{"digest": "'
_MIDDLE = b'", "files": '
_BODY = len(_START) + 64 + len(_MIDDLE)
Count = Annotated[int, Field(ge=0, strict=True)]
Entry = tuple[Count, int, int, Count, Digest]
"""Size, times of modification and of change in ns, inode, SHA-256. Who sets a modification time back cannot set that of
the change."""
_ENTRIES = TypeAdapter(dict[str, Entry])


def digest_raw_files(files: Sequence[tuple[str, Path]], home: Path) -> list[list[str]]:
    """[name, SHA-256 of the content] of each named file."""
    if not files:
        return []
    digests = RawFileDigests(home)
    found = [[name, digests.digest(path)] for name, path in files]
    digests.save()
    return found


def read_remembered(path: Path) -> dict[str, Entry]:
    """What the file of a home says, by path; nothing where there is no file.

    Raises:
        DataError: it is damaged, or of an older version of the code.
        OSError: it cannot be read now.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return {}
    except (IsADirectoryError, NotADirectoryError) as error:
        raise DataError(f"{path}: is not a file of remembered digests: {error.strerror}") from error
    body = content[_BODY:-1]
    if content != _with_digest(body):
        raise DataError(f"{path}: is not a file of remembered digests: its content is not that of its digest")
    try:
        return _ENTRIES.validate_json(body)
    except ValidationError as error:
        raise DataError(f"{path}: is not a file of remembered digests: {error.errors()[0]['msg'][:100]}") from error


def _with_digest(body: bytes) -> bytes:
    return _START + hashlib.sha256(body).hexdigest().encode() + _MIDDLE + body + b"}"


class RawFileDigests:
    """SHA-256 of raw input files, remembered by path, size, times and inode."""

    _read: ClassVar[dict[Path, tuple[tuple[int, int], dict[str, Entry]]]] = {}
    """What a process has read of a home, until somebody writes it anew: of a million files it takes seconds."""

    def __init__(self, home: Path) -> None:
        """Read what the home remembers; of a damaged file nothing, so that all is hashed again and it is replaced."""
        self.path = home / FILE
        self.artefacts = home.resolve() / "artefacts"
        self.known: dict[str, Entry] = {}
        self.changed = False
        with contextlib.suppress(FileNotFoundError, PermissionError, DataError):
            written = _identity(self.path)
            before, known = self._read.get(self.path, (None, {}))
            self.known = known if before == written else read_remembered(self.path)
            self._read[self.path] = (written, self.known)

    def digest(self, path: Path) -> str:
        """SHA-256 of the file's content."""
        status = path.stat()
        identity = (status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino)
        resolved = path.resolve()
        name = str(resolved)
        if resolved.is_relative_to(self.artefacts):  # a base model that was trained here, say
            mark_used(self.artefacts.joinpath(*resolved.relative_to(self.artefacts).parts[:2]))
        entry = self.known.get(name)
        if entry is None or entry[:-1] != identity:
            entry = (*identity, file_digest(path))
            self.known[name] = entry
            self.changed = True
        return entry[-1]

    def save(self) -> None:
        """Write what was learnt, atomically."""
        if not self.changed:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        temporary = self.path.with_suffix(f".{uuid.uuid4().hex}.tmp")  # threads, and containers that count alike
        try:
            temporary.write_bytes(_with_digest(json.dumps(dict(self.known)).encode()))
            written = _identity(temporary)
            temporary.replace(self.path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        self._read[self.path] = (written, self.known)
        self.changed = False


def _identity(path: Path) -> tuple[int, int]:
    status = os.stat(path)
    return status.st_ino, status.st_mtime_ns
