"""The content-addressed store: where artefacts live, how they appear all at once, and who may write.

Below the home folder:
artefacts/<stage>/<key>/   finished artefacts: manifest.parquet, run.json, arrays, checkpoints
work/<key>/                resumable state of a stage that is running or was interrupted
tmp/<key>/                 an artefact being put together; renamed into place when complete
locks/<key>                held (flock) while a process makes the artefact; freed by the kernel on death
locks/store                shared by every process that uses the store, until it ends; exclusive while pruning
damaged/<stage>/           artefacts that were set aside; nothing here deletes them
pruned/                    on its way out
test_sets/<digest>.jsonl   which experiments were scored on these test frames (tasks.openings)
published/<experiment>/    which artefacts are the versions of its synthetic data (data_contracts.published)
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import itertools
import os
import re
import shutil
import stat
import threading
import time
import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from data_contracts.errors import DataError
from data_contracts.file_lists import file_digest
from data_contracts.manifest import MANIFEST_FILE, ManifestRef, read_manifest
from data_contracts.published import kept_versions
from data_contracts.run_record import RUN_FILE, RunRecord, mark_used, read_run_record, write_run_record
from tasks import file_locks

KEEP_VERSIONS = 5
MAX_SYNCS = 16
"""Files that are synced at once. Four hundred of 40 kB take 0.12 s on ext4, one after the other 1.8 s."""


def home_folder() -> Path:
    """Folder of all state: `CTLEV_HOME`, by default `.ctlev` in the working directory."""
    return Path(os.environ.get("CTLEV_HOME", ".ctlev")).absolute()


@dataclass(frozen=True)
class Stored:
    """One folder of the store that could be pruned.

    Attributes:
        kind: `artefact`, `work` or `tmp`.
        name: stage/key of an artefact, else the key.
        folder: where it is.
        size_bytes: of all its files.
        last_used_s: when a run last found it or wrote to it, in seconds since the epoch.
    """

    kind: str
    name: str
    folder: Path
    size_bytes: int
    last_used_s: float


_used: dict[Path, IO[bytes]] = {}
_used_guard = threading.Lock()


class Store:
    """Finished artefacts by stage and key under one home folder."""

    def __init__(self, home: Path | None = None) -> None:
        self.home = home or home_folder()

    def folder(self, stage: str, key: str) -> Path:
        """Where the artefact is, or will be."""
        return self.home / "artefacts" / stage / key

    def work_folder(self, key: str) -> Path:
        """Resumable state that outlives a killed run."""
        return self.home / "work" / key

    def temporary_folder(self, key: str) -> Path:
        """Where an artefact is put together, on the same disk as its final place."""
        return self.home / "tmp" / key

    def find(
        self, stage: str, key: str, upstream: dict[str, str] | None = None, *, make_room: bool = False
    ) -> ManifestRef | None:
        """The finished artefact, or None where there is none, it is damaged, or was made from other inputs.

        Args:
            stage: that makes it.
            key: its cache key.
            upstream: digests of the manifests it must have been made from, by their keys; None for whichever.
            make_room: move what cannot be used aside, so that it can be made anew. Only for who holds `lock(key)`:
                else it may be what another process has just made in its place.

        Raises:
            OSError: the artefact cannot be read now, for reasons that say nothing about its content.
        """
        self.use()
        folder = self.folder(stage, key)
        try:
            folder.lstat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        try:
            record = read_run_record(folder)
            ref = read_manifest(ManifestRef(key=key, path=folder, digest=record.digest)).ref
            if upstream is None or record.upstream == upstream:
                mark_used(folder)
                return ref
        except DataError:
            pass
        if make_room:
            self.set_aside(folder)
        return None

    def set_aside(self, folder: Path) -> Path:
        """Move a damaged or outdated artefact out of the way without deleting it; returns its new place."""
        target = self.home / "damaged" / folder.parent.name
        target.mkdir(parents=True, exist_ok=True)
        number = next(number for number in itertools.count() if not (target / f"{folder.name}.{number}").exists())
        with contextlib.suppress(FileNotFoundError):
            folder.rename(target / f"{folder.name}.{number}")
        return target / f"{folder.name}.{number}"

    @contextlib.contextmanager
    def lock(self, key: str, what: str = "") -> Iterator[None]:
        """Only one process makes an artefact; a second waits here, saying so, and then finds it finished."""
        path = self.home / "locks" / key
        path.parent.mkdir(parents=True, exist_ok=True)
        self.use()
        with file_locks.locked(path, what or f"artefact {key}"):
            yield

    def use(self) -> None:
        """Nothing is pruned from now until this process ends, for it holds references to what it finds.

        Waits while another process prunes, which takes as long as renaming does. A store that we may not write to is
        not held: its owner should not prune while others read.
        """
        with _used_guard:
            if self.home in _used or not self.home.is_dir():
                return
            path = self.home / "locks" / "store"
            try:
                path.parent.mkdir(exist_ok=True)
                file = path.open("ab")
            except OSError as error:
                if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
                    return
                raise  # one that passes: unheld, what we find could be pruned
            file_locks.lock(file, fcntl.LOCK_SH, f"a pruning of {self.home}")
            _used[self.home] = file

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Inside this block no other process uses the store; one that starts meanwhile waits.

        Raises:
            StoreInUseError: a process uses it.
            OSError: the home cannot be written.
        """
        path = self.home / "locks" / "store"
        path.parent.mkdir(exist_ok=True)
        with path.open("ab") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StoreInUseError(f"{self.home}: a run uses this store; prune when it has ended") from None
            yield

    def publish(self, stage: str, key: str, temporary: Path, record: dict[str, Any]) -> ManifestRef:
        """Write the provenance record, flush everything to disk and rename the folder into place.

        What is under its final name is whole, and still there after a power failure once this has returned.
        """
        digest = file_digest(temporary / MANIFEST_FILE)
        write_run_record(temporary, RunRecord(**record, digest=digest))
        _share_as_the_record(temporary)
        folder = self.folder(stage, key)
        folder.parent.mkdir(parents=True, exist_ok=True)
        # The name of a new folder lies in the one around it.
        above = [path for path in (folder.parent.parent, self.home, self.home.parent) if os.access(path, os.R_OK)]
        _sync_all([*temporary.rglob("*"), temporary, *above])
        temporary.rename(folder)
        _sync(folder.parent)
        shutil.rmtree(self.work_folder(key), ignore_errors=True)
        return read_manifest(ManifestRef(key=key, path=folder, digest=digest)).ref

    def artefacts(self) -> list[Stored]:
        """All finished artefacts, by stage and key. Links are not followed."""
        stages = _folders(self.home / "artefacts")
        return [
            _stored("artefact", f"{stage.name}/{folder.name}", folder) for stage in stages for folder in _folders(stage)
        ]

    def check(self, folder: Path) -> None:
        """Hash every file of an artefact again.

        Raises:
            DataError: it is damaged: a file is missing or has changed, or is a link to something outside the artefact.
            TableVersionError: it is of an older or newer version of the code; its files were not hashed.
            OSError: it cannot be read now, which says nothing about its content.
        """
        ref = ManifestRef(key=folder.name, path=folder, digest=read_run_record(folder).digest)
        for path in (path for path in folder.rglob("*") if path.is_symlink()):
            if not path.resolve().is_relative_to(folder.resolve()):
                raise DataError(f"{path}: is a link to something outside the artefact")
        read_manifest(ref, full=True)

    def unneeded(self, keep_days: float, keep_versions: int = KEEP_VERSIONS) -> tuple[list[Stored], list[Stored]]:
        """What can go, and what stays, if everything that was used within `keep_days` stays.

        An artefact stays if it was used, if one of the newest `keep_versions` published versions of an experiment, or
        the latest, refers to it, or if the provenance record of one that stays names its key: what a report was made
        from stays as long as the report. Half-made artefacts (`tmp`) can always go, for a rerun begins them anew;
        the resumable state of an interrupted stage (`work`) is kept as long as an artefact.

        Raises:
            DataError: a record cannot be read, so that what it refers to is not known.
        """
        oldest_s = time.time() - keep_days * 86_400
        stored = self.artefacts()
        referred = {item.folder: _keys_in(item.folder / RUN_FILE) for item in stored}
        published = {found.key for version in kept_versions(self.home, keep_versions) for found in version.artefacts}
        waiting = [item for item in stored if item.last_used_s >= oldest_s or item.folder.name in published]
        kept = {item.folder for item in waiting}
        while waiting:
            named = referred[waiting.pop().folder]
            new = [item for item in stored if item.folder.name in named and item.folder not in kept]
            kept.update(item.folder for item in new)
            waiting += new
        work = [_stored("work", folder.name, folder) for folder in _folders(self.home / "work")]
        kept.update(item.folder for item in work if item.last_used_s >= oldest_s)
        half_made = [_stored("tmp", folder.name, folder) for folder in _folders(self.home / "tmp")]
        found = [*stored, *work, *half_made]
        return [item for item in found if item.folder not in kept], [item for item in found if item.folder in kept]

    def prune(self, keep_days: float, keep_versions: int = KEEP_VERSIONS) -> list[Stored]:
        """Remove what `unneeded` says can go, and return it; what an interrupted pruning left goes too.

        Everything is renamed out of the store while no run can start, and deleted after. A link is deleted, never what
        it points to.

        Raises:
            StoreInUseError: a run uses the store; nothing was removed.
            DataError: as `unneeded`; nothing was removed.
            OSError: the home cannot be written.
        """
        pruned = self.home / "pruned"
        with self.alone():
            if pruned.is_symlink():
                raise DataError(f"{pruned}: is a link; nothing is moved out of the home")
            pruned.mkdir(exist_ok=True)
            leaving, _ = self.unneeded(keep_days, keep_versions)
            for item in leaving:
                item.folder.rename(pruned / uuid.uuid4().hex)
        for folder in _folders(pruned):
            shutil.rmtree(folder)
        return leaving


class StoreInUseError(RuntimeError):
    """The store cannot be pruned because a run uses it."""


def _share_as_the_record(folder: Path) -> None:
    """Who may read the provenance record may read every file beside it: safetensors makes its own private (0600)."""
    mode = stat.S_IMODE((folder / RUN_FILE).stat().st_mode)
    for path in folder.rglob("*"):
        if path.is_file() and not path.is_symlink() and stat.S_IMODE(path.stat().st_mode) != mode:
            path.chmod(mode)


def _folders(folder: Path) -> list[Path]:
    """The folders in a folder, sorted; links are not followed, and without the folder there are none."""
    if folder.is_symlink() or not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        return sorted(Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False))


def _stored(kind: str, name: str, folder: Path) -> Stored:
    """Measure a folder, without following links."""
    found: dict[Path, os.stat_result] = {}
    for path in [folder, *folder.rglob("*")]:  # which does not enter links to folders
        with contextlib.suppress(FileNotFoundError):  # a run moves on meanwhile
            found[path] = path.lstat()
    size_bytes = sum(status.st_size for status in found.values() if not stat.S_ISDIR(status.st_mode))
    record = found.get(folder / RUN_FILE)
    last_used_s = (
        record.st_mtime if record else max((status.st_mtime for status in found.values()), default=time.time())
    )
    return Stored(kind, name, folder, size_bytes, last_used_s)


def _keys_in(record: Path) -> set[str]:
    """Whatever looks like a key in a provenance record: its inputs, and artefacts whose path an option names."""
    try:
        read_run_record(record.parent)
        text = record.read_text()
    except (OSError, ValueError) as error:
        raise DataError(f"{record}: cannot be read, so its inputs are unknown; run flows/verify.py first") from error
    return set(re.findall(r"(?<![0-9a-f])[0-9a-f]{32}(?![0-9a-f])", text))


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_all(paths: Sequence[Path]) -> None:
    """Sync files and folders side by side: a journal writes what waits for it in one go, else once for each."""
    with ThreadPoolExecutor(min(len(paths), MAX_SYNCS)) as threads:
        for _ in threads.map(_sync, paths):  # which raises what went wrong
            pass
