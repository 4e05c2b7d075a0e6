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

A home in a bucket (tasks.bucket) has such a folder as its cache on each machine (tasks.bucket_cache): what is not in it
is fetched, and what is made is sent.
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
import sys
import threading
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

from data_contracts.errors import DataError, TableVersionError
from data_contracts.file_lists import file_digest
from data_contracts.home_folder import home_folder as folder_of_home
from data_contracts.manifest import MANIFEST_FILE, ManifestRef, read_manifest
from data_contracts.published import kept_versions
from data_contracts.run_record import (
    RUN_FILE,
    RunRecord,
    mark_used,
    parse_run_record,
    read_run_record,
    write_run_record,
)
from tasks import file_locks
from tasks.bucket import Bucket, BucketError, bucket_of
from tasks.bucket_cache import BucketCache, cache_limit_bytes
from tasks.bucket_files import fetch_files, send_files

KEEP_VERSIONS = 5
BEGUN_S = 86_400.0
"""What was begun in a bucket so long ago, and has no provenance record, is not being sent any more."""
MAX_FETCHES = 8
"""Artefacts that are fetched at once."""
MAX_SYNCS = 16
"""Files that are synced at once. Four hundred of 40 kB take 0.12 s on ext4, one after the other 1.8 s."""
_OURS = re.compile(r"[0-9a-f]{32}(\.fetched)?")
"""Names of the folders that are made here, of which alone any is removed: a home named by mistake has a `tmp`, too."""


def home_folder() -> Path:
    """Folder of all state: `CTLEV_HOME`, by default `.ctlev` in the working directory; of a bucket its cache."""
    return folder_of_home()


@dataclass(frozen=True)
class Stored:
    """One folder of the store that could be pruned.

    Attributes:
        kind: `artefact`, `work` or `tmp`.
        name: stage/key of an artefact, else the key.
        folder: where it is.
        size_bytes: of all its files.
        last_used_s: when a run last found it or wrote to it, in seconds since the epoch; of one that is in a bucket
            alone, when it was sent there.
    """

    kind: str
    name: str
    folder: Path
    size_bytes: int
    last_used_s: float


_used: dict[Path, IO[bytes]] = {}
_used_guard = threading.Lock()


class Store:
    """Finished artefacts by stage and key under one home folder.

    Attributes:
        home: the folder.
        bucket: whose cache it is, if it is one.
    """

    def __init__(self, home: Path | None = None) -> None:
        self.home = home or home_folder()
        self.bucket: Bucket | None = bucket_of(self.home)
        self._cache = BucketCache(self.home)

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
            BucketError: it is not in the cache, and the bucket cannot be read now.
        """
        self.use()
        found = self._find_here(stage, key, upstream, make_room=make_room)
        if self.bucket is None:
            return found
        if found is None and self._fetch(self.bucket, stage, key, upstream, make_room=make_room):
            found = self._find_here(stage, key, upstream, make_room=make_room)
            self._evict(self.bucket)
        elif found is not None and self._cache.is_use_to_be_noted(f"{stage}/{key}"):
            with contextlib.suppress(BucketError):  # what is here can be used without a network
                self.bucket.overwrite(f"used/{stage}/{key}", b"")
        return found

    def held_digest(self, stage: str, key: str, upstream: dict[str, str] | None = None) -> str | None:
        """Digest of the artefact that `find` would find, None where there is none. Of a bucket nothing is fetched."""
        self.use()
        here = self._find_here(stage, key, upstream, make_room=False)
        if here is not None:
            return here.digest
        if self.bucket is None:
            return None
        try:
            record = self.bucket.record(stage, key)
        except BucketError:
            raise
        except DataError:  # damaged
            return None
        return record.digest if record is not None and upstream in (None, record.upstream) else None

    def here(self, ref: ManifestRef) -> ManifestRef:
        """The same artefact on this machine: as it is, or of a bucket that of our cache, fetched where it is not there.

        Raises:
            DataError: the bucket does not have it.
        """
        stage = ref.path.parent.name
        if self.bucket is None or not ref.digest:
            return ref
        with self._cache.holding(f"{stage}/{ref.key}"):
            is_here = self.folder(stage, ref.key).is_dir()
        if not is_here and self.find(stage, ref.key) is None:
            raise DataError(f"{self.bucket.url}: has no artefact {stage}/{ref.key} any more; run again to make it anew")
        return ref.model_copy(update={"path": self.folder(stage, ref.key)})

    def _find_here(
        self, stage: str, key: str, upstream: dict[str, str] | None, *, make_room: bool
    ) -> ManifestRef | None:
        """As `find`, in the folder."""
        holding = contextlib.nullcontext() if self.bucket is None else self._cache.holding(f"{stage}/{key}")
        with holding:
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

    def set_aside_damaged(self, folder: Path) -> Path | None:
        """Set an artefact aside that was found damaged, unless a run has done so since, and made it anew: then None.

        Raises:
            OSError: it cannot be read or moved now.
        """
        if not folder.exists():
            return None
        with self.lock(folder.name, f"artefact {folder.parent.name}/{folder.name}"):
            try:
                self.check(folder)
            except TableVersionError:
                return None
            except DataError:
                return self.set_aside(folder) if folder.exists() else None
        return None

    def set_aside_in_bucket(self, bucket: Bucket, stage: str, key: str) -> str:
        """The same of an artefact in the bucket, which is sent again if the cache has it; returns its new URL."""
        self._cache.unmark(f"{stage}/{key}")
        return bucket.set_aside(stage, key)

    @contextlib.contextmanager
    def lock(self, key: str, what: str = "") -> Iterator[None]:
        """Only one process makes an artefact; a second waits here, saying so, and then finds it finished.

        Raises:
            BucketError: other machines cannot be told, for the bucket cannot be written now.
        """
        path = self.home / "locks" / key
        path.parent.mkdir(parents=True, exist_ok=True)
        self.use()
        what = what or f"artefact {key}"
        with file_locks.locked(path, what), contextlib.ExitStack() as stack:
            if self.bucket is not None:
                stack.enter_context(self.bucket.lease(key, what))
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

        What is under its final name is whole, and still there after a power failure once this has returned. Of a bucket
        it is then in the bucket too; where another machine was first, which this one could not know, with the content
        that the other gave it.

        Raises:
            BucketError: it cannot be sent. It is in the cache, and the next run sends it.
        """
        digest = file_digest(temporary / MANIFEST_FILE)
        write_run_record(temporary, RunRecord(**record, digest=digest))
        holding = contextlib.nullcontext() if self.bucket is None else self._cache.holding(f"{stage}/{key}")
        with holding:
            self._move_in(stage, key, temporary)
        shutil.rmtree(self.work_folder(key), ignore_errors=True)
        if self.bucket is not None:
            self._send(self.bucket, stage, key)
            self._evict(self.bucket)
            digest = read_run_record(self.folder(stage, key)).digest
        return read_manifest(ManifestRef(key=key, path=self.folder(stage, key), digest=digest)).ref

    def _move_in(self, stage: str, key: str, temporary: Path) -> None:
        """Flush a finished artefact to disk and rename its folder into place."""
        _share_as_the_record(temporary)
        folder = self.folder(stage, key)
        folder.parent.mkdir(parents=True, exist_ok=True)
        # The name of a new folder lies in the one around it.
        above = [path for path in (folder.parent.parent, self.home, self.home.parent) if os.access(path, os.R_OK)]
        _sync_all([*temporary.rglob("*"), temporary, *above])
        temporary.rename(folder)
        _sync(folder.parent)

    def _fetch(self, bucket: Bucket, stage: str, key: str, upstream: dict[str, str] | None, *, make_room: bool) -> bool:
        """Fetch an artefact into the folder; whether one is there now.

        It gets its name when every digest was found right. What is damaged, or was made from other inputs, is moved
        aside in the bucket by who makes room.
        """
        (self.home / "locks").mkdir(parents=True, exist_ok=True)
        with file_locks.locked(self.home / "locks" / f"{key}.fetched", f"artefact {stage}/{key} to be fetched"):
            if self.folder(stage, key).exists():
                return True
            # Named after the key, as records are of the folder they lie in.
            temporary, damage = self.home / "tmp" / f"{key}.fetched" / key, ""
            shutil.rmtree(temporary.parent, ignore_errors=True)  # left by a process that died
            try:
                record = bucket.record(stage, key)
                if record is None:
                    return False
                if upstream is None or record.upstream == upstream:
                    if not bucket.download(stage, key, record.digest, temporary):
                        return False
                    self.check(temporary)
                    with self._cache.holding(f"{stage}/{key}"):
                        self._move_in(stage, key, temporary)
                    self._cache.mark_uploaded(f"{stage}/{key}", record.digest)
                    return True
            except BucketError:
                raise
            except TableVersionError:
                pass
            except DataError as error:
                damage = str(error)
            finally:
                shutil.rmtree(temporary.parent, ignore_errors=True)
            if make_room:
                moved = bucket.set_aside(stage, key)
                if damage:
                    print(f"damaged in {bucket.url}: {stage}/{key}: {damage}\n  now in {moved}", file=sys.stderr)
            return False

    def _send(self, bucket: Bucket, stage: str, key: str) -> None:
        """Send an artefact of the folder, or take the one that the bucket has under its key in its place."""
        name, folder = f"{stage}/{key}", self.folder(stage, key)
        digest = read_run_record(folder).digest
        try:
            if bucket.upload(stage, key, digest, folder):
                self._cache.mark_uploaded(name, digest)
                return
        except DataError as error:
            raise BucketError(f"{error}; {name} is kept in {self.home}, and the next run sends it") from error
        self.set_aside(folder)
        if not self._fetch(bucket, stage, key, None, make_room=False):
            raise BucketError(f"{bucket.url}: {name} is damaged there; `ctlev verify` sets it aside, then run again")

    def connect(self, *, send: bool) -> None:
        """Before a run: see whether the bucket can be used, and fetch what people look at. Nothing without a bucket.

        Args:
            send: what earlier runs could not send.

        Raises:
            BucketError: it cannot be used.
            DataError: CTLEV_CACHE_GB is not a number above 0.
        """
        if self.bucket is not None:
            cache_limit_bytes()
            self.bucket.check()
            self.fetch_files()
            if send:
                self.send_unsent()

    def fetch_planned(self, wanted: Iterable[tuple[str, str]]) -> None:
        """Fetch side by side what a run would else wait for one after the other. Nothing without a bucket.

        Args:
            wanted: stage and key of artefacts that the home holds.

        Raises:
            BucketError: the bucket cannot be read now.
        """
        missing = [] if self.bucket is None else [one for one in wanted if not self.folder(*one).exists()]
        if not missing or self.bucket is None:
            return
        print(f"fetching {len(missing)} artefacts from {self.bucket.url}", file=sys.stderr, flush=True)
        with ThreadPoolExecutor(MAX_FETCHES) as threads:
            for _ in threads.map(lambda one: self.find(*one), missing):  # which raises what went wrong
                pass

    def fetch_files(self) -> None:
        """Fetch reports and published versions of other machines (tasks.bucket_files). Nothing without a bucket."""
        if self.bucket is not None:
            fetch_files(self.home, self.bucket)

    def send_files(self) -> None:
        """After a run: send what it left here, also reports and events. Nothing without a bucket."""
        if self.bucket is not None:
            self.send_unsent()
            send_files(self.home, self.bucket)

    def send_unsent(self) -> int:
        """Send what earlier runs made and could not send; returns how many artefacts. Nothing without a bucket.

        Raises:
            BucketError: the bucket cannot be written now.
        """
        sent = 0
        if self.bucket is None:
            return sent
        for folder in _named_folders(self.home / "artefacts"):
            if self._is_unsent(folder):
                # Who makes it, here or elsewhere, sends it too.
                with self.lock(folder.name, f"artefact {folder.parent.name}/{folder.name}"):
                    if self._is_unsent(folder) and _is_whole(self, folder):
                        self._send(self.bucket, folder.parent.name, folder.name)
                        sent += 1
        return sent

    def _is_unsent(self, folder: Path) -> bool:
        """Is it an artefact that the bucket does not have, as far as is known here?"""
        try:
            return not self._cache.is_uploaded(f"{folder.parent.name}/{folder.name}", read_run_record(folder).digest)
        except DataError:
            return False  # made anew where it is needed

    def _evict(self, bucket: Bucket) -> None:
        """Keep the cache below its limit."""
        self._cache.evict(lambda name: bucket.has(*name.split("/")))

    def artefacts(self) -> list[Stored]:
        """All finished artefacts, by stage and key. Links are not followed."""
        return [
            _stored("artefact", f"{folder.parent.name}/{folder.name}", folder)
            for folder in _named_folders(self.home / "artefacts")
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

    def check_in_bucket(self, bucket: Bucket, stage: str, key: str) -> None:
        """The same of an artefact in the bucket: it is fetched to be hashed, and not kept.

        Raises:
            BucketError: it cannot be fetched now.
            DataError: as `check`; so are the others.
        """
        folder = self.home / "tmp" / uuid.uuid4().hex / key
        try:
            record = bucket.record(stage, key)
            if record is not None and bucket.download(stage, key, record.digest, folder):
                self.check(folder)
        finally:
            shutil.rmtree(folder.parent, ignore_errors=True)

    def unneeded(self, keep_days: float, keep_versions: int = KEEP_VERSIONS) -> tuple[list[Stored], list[Stored]]:
        """What can go, and what stays, if everything that was used within `keep_days` stays.

        An artefact stays if it was used, if one of the newest `keep_versions` published versions of an experiment, or
        the latest, refers to it, or if the provenance record of one that stays names its key: what a report was made
        from stays as long as the report. Half-made artefacts (`tmp`) can always go, for a rerun begins them anew;
        the resumable state of an interrupted stage (`work`) is kept as long as an artefact.

        Raises:
            DataError: a record cannot be read, so that what it refers to is not known.
        """
        oldest_s = (time.time() if self.bucket is None else self.bucket.clock()) - keep_days * 86_400
        stored = self.artefacts()
        referred = {item.folder: _keys_in(item.folder / RUN_FILE) for item in stored}
        half_made = [_stored("tmp", folder.name, folder) for folder in _own_folders(self.home / "tmp")]
        if self.bucket is not None:
            stored, begun = self._with_those_of(self.bucket, stored, referred)
            half_made += begun
        published = {found.key for version in kept_versions(self.home, keep_versions) for found in version.artefacts}
        waiting = [item for item in stored if item.last_used_s >= oldest_s or item.folder.name in published]
        kept = {item.folder for item in waiting}
        while waiting:
            named = referred[waiting.pop().folder]
            new = [item for item in stored if item.folder.name in named and item.folder not in kept]
            kept.update(item.folder for item in new)
            waiting += new
        work = [_stored("work", folder.name, folder) for folder in _own_folders(self.home / "work")]
        kept.update(item.folder for item in work if item.last_used_s >= oldest_s)
        found = [*stored, *work, *half_made]
        return [item for item in found if item.folder not in kept], [item for item in found if item.folder in kept]

    def _with_those_of(
        self, bucket: Bucket, stored: list[Stored], referred: dict[Path, set[str]]
    ) -> tuple[list[Stored], list[Stored]]:
        """The artefacts of the cache and the bucket, and those of the bucket that were begun a day ago or more.

        Args:
            bucket: of this home.
            stored: artefacts of the cache.
            referred: keys that their records name; those of the bucket are added.
        """
        found = {item.folder: item for item in stored}
        begun = []
        for item in bucket.artefacts():
            folder = self.folder(item.stage, item.key)
            entry = Stored("artefact", f"{item.stage}/{item.key}", folder, item.size_bytes, item.last_used_s)
            if not item.is_finished:
                if bucket.clock() - item.last_used_s > BEGUN_S and folder not in found:
                    begun.append(replace(entry, kind="tmp"))
            elif folder in found:
                found[folder] = replace(entry, last_used_s=max(entry.last_used_s, found[folder].last_used_s))
            else:
                found[folder] = entry
                where = f"artefacts/{entry.name}/{RUN_FILE}"
                referred[folder] = _named_keys(bucket.read(where) or b"", item.key, f"{bucket.url}/{where}")
        return sorted(found.values(), key=lambda item: item.name), begun

    def prune(self, keep_days: float, keep_versions: int = KEEP_VERSIONS) -> list[Stored]:
        """Remove what `unneeded` says can go, and return it; what an interrupted pruning left goes too.

        Everything is renamed out of the store while no run can start, and deleted after. A link is deleted, never what
        it points to. Of a bucket it is deleted there and in the cache of this machine, while runs of other machines may
        go on with what is in theirs.

        Raises:
            BucketError: the bucket cannot be changed now; what was removed before stays removed.
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
                with contextlib.nullcontext() if self.bucket is None else contextlib.suppress(FileNotFoundError):
                    item.folder.rename(pruned / uuid.uuid4().hex)
                if self.bucket is not None and "/" in item.name:
                    self._cache.unmark(item.name)
                    self.bucket.remove(*item.name.split("/"))
        for folder in _own_folders(pruned):
            shutil.rmtree(folder)
        return leaving


class StoreInUseError(RuntimeError):
    """The store cannot be pruned because a run uses it."""


def _is_whole(store: Store, folder: Path) -> bool:
    """Is an artefact one that others can use? Of a damaged one a line says so."""
    try:
        store.check(folder)
    except TableVersionError:
        return False
    except DataError as error:
        print(f"damaged, and not sent: {error}; `ctlev verify` sets it aside", file=sys.stderr)
        return False
    return True


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


def _own_folders(folder: Path) -> list[Path]:
    """Those of them that are named as the store names folders."""
    return [found for found in _folders(folder) if _OURS.fullmatch(found.name)]


def _named_folders(folder: Path) -> list[Path]:
    """The folders in the folders in a folder: of artefacts, by stage and key."""
    return [found for stage in _folders(folder) for found in _own_folders(stage)]


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
        content = record.read_bytes()
    except OSError as error:
        raise DataError(f"{record}: cannot be read, so its inputs are unknown; run flows/verify.py first") from error
    return _named_keys(content, record.parent.name, str(record))


def _named_keys(content: bytes, key: str, where: str) -> set[str]:
    """The same of what a record of an artefact holds."""
    try:
        parse_run_record(content, key, where)
        text = content.decode()
    except ValueError as error:
        raise DataError(f"{where}: cannot be read, so its inputs are unknown; run flows/verify.py first") from error
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
