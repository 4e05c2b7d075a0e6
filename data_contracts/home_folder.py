"""The home folder of all state: a folder, or the URL of a bucket, whose local cache is then the home folder."""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

from data_contracts.errors import DataError

SCHEMES = {"s3": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "abfs": "adlfs", "abfss": "adlfs", "az": "adlfs"}
"""Kinds of buckets, and the package that each needs."""
CACHE = "CTLEV_CACHE"
"""Environment: folder of the caches of buckets, one folder each; by default `ctlev` in the user's cache folder."""
URL_FILE = "bucket_url"
"""In the cache of a bucket: the URL. Whoever is given the folder thus knows of the bucket."""


def home_folder(home: str | os.PathLike[str] | None = None) -> Path:
    """The home folder, absolute; that of a bucket is made.

    Args:
        home: folder or URL; None = CTLEV_HOME, else `.ctlev` in the working directory.

    Raises:
        DataError: the URL is of another kind than buckets that can be used, or names no bucket; or nobody is called as
            a `~NAME` says.
        OSError: the cache of a bucket cannot be made.
    """
    given = os.fspath(home) if home else os.environ.get("CTLEV_HOME") or ".ctlev"
    if "://" not in given:
        return _absolute(given)
    url = _checked(given)
    name = re.sub(r"[^A-Za-z0-9.-]+", "_", url)[:80]
    folder = _caches() / f"{name}_{hashlib.sha256(url.encode()).hexdigest()[:8]}"
    if bucket_url(folder) != url:
        folder.mkdir(parents=True, exist_ok=True)
        temporary = folder / f".{URL_FILE}.{os.getpid()}"
        temporary.write_text(f"{url}\n", encoding="utf-8")
        temporary.replace(folder / URL_FILE)
    return folder


def bucket_url(home: Path) -> str | None:
    """The bucket that a home folder is the cache of, if it is one."""
    try:
        return (home / URL_FILE).read_text(encoding="utf-8").strip()
    except (FileNotFoundError, NotADirectoryError):
        return None


def _checked(given: str) -> str:
    """The URL without slashes at its end or in a row."""
    scheme, _, path = given.partition("://")
    parts = [part for part in path.split("/") if part]
    if scheme not in SCHEMES:
        expected = ", ".join(f"{known}://" for known in SCHEMES)
        raise DataError(f"home {given!r}: expected a folder, or a bucket at {expected}; got {scheme}://")
    if not parts or not set(parts).isdisjoint({".", ".."}):
        raise DataError(f"home {given!r}: expected {scheme}://BUCKET or {scheme}://BUCKET/PREFIX")
    return f"{scheme}://{'/'.join(parts)}"


def _caches() -> Path:
    asked = os.environ.get(CACHE)
    if asked:
        return _absolute(asked)
    return _absolute(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "ctlev"


def _absolute(given: str) -> Path:
    try:
        return Path(given).expanduser().absolute()
    except RuntimeError as error:
        raise DataError(f"folder {given!r}: the home folder of that user is not known") from error
