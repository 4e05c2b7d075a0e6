"""A home in a bucket (S3, Google Cloud Storage, Azure Blob): machines share artefacts through it, by fsspec.

Every machine has a cache of it, a home folder like any other (`data_contracts.home_folder`). Below the URL of the home:
artefacts/<stage>/<key>/run.json          written last, and only where there is none: with it the artefact is there
artefacts/<stage>/<key>/<digest>/<file>   the other files; the digest is that of the manifest, so that two machines that
                                          make one artefact do not mix their files
used/<stage>/<key>                        written once a day by each machine that uses the artefact
leases/<key>/<number>                     who makes an artefact: the highest number, while it is renewed
damaged/<stage>/<key>.<time>/             artefacts that were set aside; nothing here deletes them
reports/, published/, events/             as in a home folder (tasks.bucket_files)
test_sets/<digest>/<options>.json         an object for each line of a home folder's ledger (tasks.openings)

The only conditional write that fsspec has for every kind of bucket is the one that fails where the object exists
(`If-None-Match: *`). Artefacts and leases need no other: a lease that has expired is not overwritten, but followed by
one of the next number, and so nobody but its holder ever writes an object of a lease.
"""

from __future__ import annotations

import contextlib
import datetime
import errno
import functools
import importlib
import math
import os
import socket
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from data_contracts.errors import DataError, shortened
from data_contracts.home_folder import SCHEMES, bucket_url
from data_contracts.run_record import RUN_FILE, RunRecord, parse_run_record

R = TypeVar("R")
RETRY_WAITS_S = (1.0, 4.0, 16.0)
"""Between the attempts of a request. Packages such as s3fs repeat single requests themselves, for some seconds."""
LEASE_S = 120.0
"""A lease that was not renewed for so long may be taken over."""
RENEW_S = 30.0
POLL_S = 2.0
"""Who waits for a lease looks so often."""
SAY_AFTER_S = 5.0
SAY_AGAIN_S = 300.0
MAX_TRANSFERS = 8
"""Files that are sent or fetched at once."""
_TIMES = ("LastModified", "last_modified", "mtime", "updated")
"""What packages call the time of the last write."""


class BucketError(DataError):
    """A bucket cannot be reached, or does not let us do what is needed; messages say which, where and what to do."""


@dataclass(frozen=True)
class ObjectsOfArtefact:
    """What lies below the name of an artefact in a bucket.

    Attributes:
        stage: that makes it.
        key: its cache key.
        is_finished: has it a provenance record?
        size_bytes: of all its objects.
        last_used_s: when one was written, or a machine last noted its use, by the server's clock, since the epoch.
    """

    stage: str
    key: str
    is_finished: bool
    size_bytes: int
    last_used_s: float


class Bucket:
    """The home in one bucket.

    Attributes:
        url: of the home, without a slash at its end.
    """

    def __init__(self, url: str) -> None:
        self.url = url

    @functools.cached_property
    def _files(self) -> tuple[Any, str]:
        """The file system of fsspec, and the home's path in it."""
        scheme = self.url.partition("://")[0]
        try:
            fsspec = importlib.import_module("fsspec")
            importlib.import_module(SCHEMES[scheme])
        except ImportError as error:
            extra = "-e '.[bucket]'" if SCHEMES[scheme] == "s3fs" else SCHEMES[scheme]
            raise BucketError(f"{self.url}: needs the package {SCHEMES[scheme]}: pip install {extra}") from error
        return fsspec.url_to_fs(self.url, use_listings_cache=False)

    def _path(self, *parts: str) -> str:
        return "/".join((self._files[1].rstrip("/"), *parts))

    def check(self) -> None:
        """Write, list and delete an object, before anything long starts.

        Raises:
            BucketError: there is no such bucket, no credentials, a right is missing, or the server overwrites what a
                conditional write must not.
        """
        probe = f"probes/{uuid.uuid4().hex}"
        name = self._path(probe)
        self.create(probe, b"probe\n")
        with contextlib.suppress(FileExistsError):
            self._try("written", self._create_once, name, b"another probe\n")
            self._try("deleted", self._files[0].rm_file, name)
            raise BucketError(
                f"{self.url}: the server ignores the condition of a write (If-None-Match: *), so that machines could "
                "overwrite one another's artefacts; use a server that keeps it, such as S3 or MinIO of 2024 or newer"
            )
        self._try("listed", self._list_once, "probes")
        self._try("read", self._files[0].cat_file, name)
        self._try("deleted", self._files[0].rm_file, name)

    # Artefacts.

    def record(self, stage: str, key: str) -> RunRecord | None:
        """The provenance record of an artefact; None where the bucket has none.

        Raises:
            BucketError: the bucket cannot be read now.
            DataError: the record is damaged.
        """
        content = self.read(f"artefacts/{stage}/{key}/{RUN_FILE}")
        where = f"{self.url}/artefacts/{stage}/{key}/{RUN_FILE}"
        return None if content is None else parse_run_record(content, key, where)

    def has(self, stage: str, key: str) -> bool:
        """Is there such an artefact, whether whole or damaged?"""
        return self._try("read", self._files[0].exists, self._path("artefacts", stage, key, RUN_FILE))

    def download(self, stage: str, key: str, digest: str, folder: Path) -> bool:
        """Fetch an artefact; what arrives is not checked here.

        Args:
            stage: that made it.
            key: its cache key.
            digest: of its manifest, as its provenance record says.
            folder: where to; is made.

        Returns:
            Whether it was there to the end; False where another machine removed it meanwhile.

        Raises:
            BucketError: the bucket cannot be read now.
            DataError: a name of a file leads out of the folder.
            OSError: the folder cannot be written.
        """
        place = f"artefacts/{stage}/{key}/{digest}"
        names = {f"{place}/{name}": name for name in self.list(place)}
        for name in names.values():
            if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
                raise DataError(f"{self.url}/{place}: a file is called {name!r}, which leads out of the artefact")
        folder.mkdir(parents=True)
        names[f"artefacts/{stage}/{key}/{RUN_FILE}"] = RUN_FILE
        try:
            self._side_by_side(lambda item: self.fetch(item[0], folder / item[1]), names.items())
        except FileNotFoundError:  # what was missing before is not in the list
            return False
        return True

    def upload(self, stage: str, key: str, digest: str, folder: Path) -> bool:
        """Send a finished artefact, its provenance record last.

        Returns:
            Whether the artefact of the bucket is now this one; False where there was one with another content.

        Raises:
            BucketError: it cannot be sent; what has arrived is used by the next attempt and is no artefact.
            DataError: the record of the one that is there is damaged.
        """
        there = self.record(stage, key)
        if there is not None:
            return there.digest == digest
        place = f"artefacts/{stage}/{key}/{digest}"
        arrived = {name: info["size"] for name, info in self.list(place).items()}
        files = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
        del files[RUN_FILE]
        # An object appears whole or not at all, and the digest in its name is that of the content.
        missing = [item for item in files.items() if arrived.get(item[0]) != item[1].stat().st_size]
        self._side_by_side(lambda item: self.send(item[1], f"{place}/{item[0]}"), missing)
        while not self.create(f"artefacts/{stage}/{key}/{RUN_FILE}", (folder / RUN_FILE).read_bytes()):
            there = self.record(stage, key)
            if there is not None and there.digest != digest:
                self._try("deleted", self._remove_once, self._path(place))
            if there is not None:
                return there.digest == digest
        return True

    def set_aside(self, stage: str, key: str) -> str:
        """Move a damaged or outdated artefact out of the way without deleting it; returns its new URL.

        Only for who holds its lease, or looks after the bucket.
        """
        old = f"artefacts/{stage}/{key}"
        new = f"damaged/{stage}/{key}.{time.strftime('%Y%m%dT%H%M%S', time.gmtime())}.{uuid.uuid4().hex[:6]}"
        # The record first: without it there is no artefact, whatever happens to the rest.
        for name in [RUN_FILE, *(name for name in self.list(old) if name != RUN_FILE)]:
            with contextlib.suppress(FileNotFoundError):
                self._try("moved", self._files[0].mv, self._path(old, name), self._path(new, name))
        return f"{self.url}/{new}"

    def remove(self, stage: str, key: str) -> None:
        """Delete an artefact, its provenance record first."""
        self.delete(f"artefacts/{stage}/{key}/{RUN_FILE}")
        self._try("deleted", self._remove_once, self._path("artefacts", stage, key))
        self.delete(f"used/{stage}/{key}")

    def artefacts(self) -> Iterator[ObjectsOfArtefact]:
        """What lies below the name of each artefact, by stage and key, whether it is finished or not."""
        found: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
        for name, info in self.list("artefacts").items():
            parts = name.split("/", 2)
            if len(parts) == 3:
                found.setdefault((parts[0], parts[1]), {})[parts[2]] = info
        used = self.list("used")
        for (stage, key), objects in found.items():
            times = [*objects.values(), *([used[f"{stage}/{key}"]] if f"{stage}/{key}" in used else [])]
            yield ObjectsOfArtefact(
                stage,
                key,
                is_finished=RUN_FILE in objects,
                size_bytes=sum(info["size"] for info in objects.values()),
                last_used_s=max(modified(info).timestamp() for info in times),
            )

    # Objects by their names below the home.

    def list(self, folder: str) -> dict[str, Mapping[str, Any]]:
        """What fsspec says of each object below a folder, by the name within it, sorted; empty without the folder."""
        return self._try("listed", self._list_once, folder)

    def read(self, name: str) -> bytes | None:
        """The content of an object; None where there is none."""
        try:
            return self._try("read", self._files[0].cat_file, self._path(name))
        except FileNotFoundError:
            return None

    def fetch(self, name: str, path: Path) -> None:
        """Copy an object into a file, whose folder is made."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self._try("read", self._files[0].get_file, self._path(name), str(path))

    def send(self, path: Path, name: str) -> None:
        """Copy a file into an object."""
        self._try("written", self._files[0].put_file, str(path), self._path(name))

    def create(self, name: str, content: bytes) -> bool:
        """Write an object where there is none; whether its content is now the given one."""
        try:
            self._try("written", self._create_once, self._path(name), content)
        except FileExistsError:
            return self.read(name) == content  # an answer that was lost, after which it was asked again
        return True

    def overwrite(self, name: str, content: bytes) -> None:
        """Write an object, whatever was there."""
        self._try("written", self._files[0].pipe_file, self._path(name), content)

    def delete(self, name: str) -> None:
        """Delete an object, if it is there."""
        with contextlib.suppress(FileNotFoundError):
            self._try("deleted", self._files[0].rm_file, self._path(name))

    # Leases.

    @contextlib.contextmanager
    def lease(self, key: str, what: str, *, wait: bool = True) -> Iterator[None]:
        """Only one machine is in this block for a key; others wait, saying so, until it has ended or seems dead.

        Who is taken for dead, because it slept or could not reach the bucket for `LEASE_S`, may go on all the same: a
        lease spares work, and what is right rests on conditional writes.

        Args:
            key: of an artefact, or another name.
            what: is waited for, such as `artefact encode/0a1b`.
            wait: raise at once where another machine holds it.

        Raises:
            BlockingIOError: another holds it and `wait` is False.
            BucketError: the bucket cannot be used now.
        """
        holder = f"process {os.getpid()} on {socket.gethostname()}, {uuid.uuid4().hex}\n".encode()
        name = self._take_lease(key, what, holder, wait=wait)
        ended = threading.Event()
        renewing = threading.Thread(target=self._renew, args=(name, holder, ended), daemon=True)
        renewing.start()
        try:
            yield
        finally:
            ended.set()
            renewing.join()  # else it could write the object again after it was deleted
            with contextlib.suppress(BucketError):  # it expires
                for number in self._leases(key):
                    if number <= int(name.rpartition("/")[2]):
                        self.delete(_lease_name(key, number))

    def _take_lease(self, key: str, what: str, holder: bytes, *, wait: bool) -> str:
        """The name of the object of a lease that is now held."""
        started = said = time.monotonic()
        while True:
            taken = self._leases(key)
            newest = max(taken, default=0)
            age_s = self.clock() - modified(taken[newest]).timestamp() if taken else math.inf
            if age_s > LEASE_S:
                name = _lease_name(key, newest + 1)
                if self.create(name, holder):
                    return name
                continue
            content = self.read(_lease_name(key, newest)) or b"another process"
            by = content.decode(errors="replace").partition(",")[0]
            if not wait:
                raise BlockingIOError(
                    f"{self.url}/leases/{key}: {by[:200]} is making {what}; ask again when it has ended"
                )
            now = time.monotonic()
            if now - started >= SAY_AFTER_S and (said == started or now - said >= SAY_AGAIN_S):
                said = now
                print(
                    f"waiting for {what}: {by[:200]} holds {self.url}/leases/{key}, renewed {max(age_s, 0):.0f} s ago "
                    f"(taken over after {LEASE_S:.0f} s)",
                    file=sys.stderr,
                    flush=True,
                )
            time.sleep(POLL_S)

    def _leases(self, key: str) -> dict[int, Mapping[str, Any]]:
        """What fsspec says of the objects of leases, by their numbers."""
        return {int(name): info for name, info in self.list(f"leases/{key}").items() if name.isdecimal()}

    def _renew(self, name: str, holder: bytes, ended: threading.Event) -> None:
        while not ended.wait(RENEW_S):
            with contextlib.suppress(BucketError):  # the next time may succeed
                self.overwrite(name, holder)

    def clock(self) -> float:
        """Seconds since the epoch by the server's clock, which is that of all machines."""
        return self._server_ahead_s + time.clock_gettime(time.CLOCK_BOOTTIME)  # which runs on while a machine sleeps

    @functools.cached_property
    def _server_ahead_s(self) -> float:
        """The server's time less that of this machine's clock, by an object that it writes; to a second."""
        name = f"probes/{uuid.uuid4().hex}"
        self.overwrite(name, b"clock\n")
        here = time.clock_gettime(time.CLOCK_BOOTTIME)
        written = modified(self._try("read", self._files[0].info, self._path(name)))
        self.delete(name)
        return written.timestamp() - here

    # Requests.

    def _create_once(self, path: str, content: bytes) -> None:
        files = self._files[0]
        try:
            files.pipe_file(path, content, mode="create")
        except (FileExistsError, FileNotFoundError, PermissionError):
            raise
        except OSError:
            # Not every server says which condition it was that did not hold.
            if files.exists(path):
                raise FileExistsError(path) from None
            raise

    def _list_once(self, folder: str) -> dict[str, Mapping[str, Any]]:
        place = f"{self._path(folder)}/"
        found = self._files[0].find(place, detail=True)
        # A folder whose first object comes just now may be listed as itself.
        return {path.removeprefix(place): info for path, info in sorted(found.items()) if path.startswith(place)}

    def _remove_once(self, path: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            self._files[0].rm(path, recursive=True)

    def _side_by_side(self, transfer: Callable[[Any], None], items: Iterable[Any]) -> None:
        with ThreadPoolExecutor(MAX_TRANSFERS) as threads:
            transfers = [threads.submit(transfer, item) for item in items]
            try:
                for one in transfers:
                    one.result()
            except BaseException:
                threads.shutdown(wait=False, cancel_futures=True)
                raise

    def _try(self, done: str, request: Callable[..., R], *arguments: Any) -> R:
        """A request, repeated with growing waits where it failed in a way that may pass.

        Raises:
            FileNotFoundError: there is no such object, or no such bucket.
            FileExistsError: a conditional write met an object.
            BucketError: every attempt failed, or it is one that would fail again.
        """
        for wait_s in (*RETRY_WAITS_S, None):
            try:
                return request(*arguments)
            except BucketError:
                raise
            except (FileNotFoundError, FileExistsError) as error:
                no_bucket = isinstance(error, FileNotFoundError) and done in ("written", "listed")
                if no_bucket and not _is_local(error, arguments):
                    raise self._error(done, error) from error
                raise
            except Exception as error:  # each package has errors of its own
                if _is_local(error, arguments):
                    raise
                if wait_s is None or _is_final(error):
                    raise self._error(done, error) from error
                time.sleep(wait_s)
        raise AssertionError

    def _error(self, done: str, error: Exception) -> BucketError:
        said = shortened(str(error).strip() or type(error).__name__, 200)
        if isinstance(error, FileNotFoundError):
            return BucketError(
                f"{self.url}: there is no such bucket; make it, or correct --home or CTLEV_HOME ({said})"
            )
        if "Credentials" in type(error).__name__:
            return BucketError(
                f"{self.url}: no credentials were found; for S3 set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or "
                f"AWS_PROFILE ({said})"
            )
        if isinstance(error, PermissionError):
            return BucketError(
                f"{self.url}: an object may not be {done}: {said}; the credentials need the rights to list, read, "
                "write and delete objects below it"
            )
        return BucketError(
            f"{self.url}: an object could not be {done}: {said}; see whether the bucket can be reached and has room, "
            "then run again"
        )


def _lease_name(key: str, number: int) -> str:
    return f"leases/{key}/{number:06d}"


def modified(info: Mapping[str, Any]) -> datetime.datetime:
    """When an object was last written, by the server's clock, from what fsspec says of it."""
    found = next((info[name] for name in _TIMES if isinstance(info.get(name), datetime.datetime)), None)
    if found is None:
        raise BucketError(f"{info.get('name')}: the package of this kind of bucket does not say when it was written")
    return found


def bucket_of(home: Path) -> Bucket | None:
    """The bucket that a home folder is the cache of, if it is one."""
    url = bucket_url(home)
    # Connections do not survive a fork.
    return None if url is None else _bucket(url, os.getpid())


@functools.cache
def _bucket(url: str, process: int) -> Bucket:
    return Bucket(url)


def _is_local(error: Exception, arguments: tuple[Any, ...]) -> bool:
    """Is it about the file that is sent or written, not about the bucket?"""
    if not isinstance(error, OSError):
        return False
    return error.errno in (errno.ENOSPC, errno.EDQUOT) or (bool(error.filename) and error.filename in arguments)


def _is_final(error: Exception) -> bool:
    return isinstance(error, PermissionError) or "Credentials" in type(error).__name__
