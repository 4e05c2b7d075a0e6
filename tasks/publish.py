"""Versions of synthetic data: one process makes one at a time, and a version that was begun is finished."""

from __future__ import annotations

import contextlib
import fcntl
import json
import time
from collections.abc import Iterator
from pathlib import Path

from data_contracts.errors import DataError
from data_contracts.published import (
    Version,
    read_latest,
    read_versions,
    version_file,
    write_durably,
    write_latest,
    write_version,
)
from tasks.bucket import bucket_of
from tasks.bucket_files import fetch_files, send_files

CLAIM_FILE = "claimed.json"


class Claim:
    """A version this process alone makes.

    Attributes:
        number: of the version.
        version: its record, where a run was killed between writing it and moving `latest`.
    """

    def __init__(self, folder: Path, number: int, version: Version | None) -> None:
        self.folder = folder
        self.number = number
        self.version = version

    def finish(self, version: Version) -> Version:
        """Record the version, make it the latest if it passed, and give the claim back; returns it."""
        if version.number != self.number:
            raise ValueError(f"{self.folder}: version {self.number} is claimed, not {version.number}")
        if self.version is None:
            write_version(self.folder, version)
        latest = read_latest(self.folder)
        # A run that was killed may find that other machines have published newer versions since.
        if version.passed and (latest is None or latest.number <= version.number):
            write_latest(self.folder, version)
        bucket = bucket_of(_home(self.folder))
        if bucket is not None:
            # Other machines number their versions by these records, so that they are there before the claim ends.
            send_files(_home(self.folder), bucket, ("published",))
        (self.folder / CLAIM_FILE).unlink(missing_ok=True)
        return version


def next_number(folder: Path) -> int:
    """The number of the version that the next run makes: one that was begun, else the next integer.

    Raises:
        DataError: the claim or a record is damaged.
    """
    path = folder / CLAIM_FILE
    if path.exists():
        try:
            number = json.loads(path.read_text(encoding="utf-8"))["number"]
            if type(number) is not int or number < 1:  # else the record of the version fails, after all is made
                raise TypeError(f"number {number!r}")
            return number
        except (ValueError, KeyError, TypeError) as error:
            raise DataError(f"{path}: is not a claim; remove it to begin the next version") from error
    numbers = [version.number for version in read_versions(folder)]
    latest = read_latest(folder)
    return max([*numbers, latest.number if latest else 0], default=0) + 1


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[Claim]:
    """Inside this block the next version is this process's; without `finish` the next run goes on with it.

    Raises:
        BlockingIOError: another process makes a version of the same experiment.
        DataError: the claim or a record is damaged.
        BucketError: the bucket of the home cannot be used now.
    """
    folder.mkdir(parents=True, exist_ok=True)
    bucket = bucket_of(_home(folder))
    with (folder / "lock").open("ab") as lock, contextlib.ExitStack() as stack:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BlockingIOError(f"{folder}: another run is making a version; ask again when it has ended") from None
        if bucket is not None:
            what = f"a version of {folder.name}"
            stack.enter_context(bucket.lease(f"published-{folder.name}", what, wait=False))
            fetch_files(_home(folder), bucket, ("published",))
        number = next_number(folder)
        began = version_file(folder, number)
        version = next((v for v in read_versions(folder) if v.number == number), None) if began.exists() else None
        if not (folder / CLAIM_FILE).exists():
            started = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
            write_durably(folder / CLAIM_FILE, json.dumps({"number": number, "started": started}) + "\n")
        yield Claim(folder, number, version)


def _home(folder: Path) -> Path:
    """The home that lists the versions of an experiment in a folder."""
    return folder.parents[1]
