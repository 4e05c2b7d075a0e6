"""The provenance record of an artefact, `run.json`: what made it, from what, when, and the digest of its manifest.

The record carries a digest of itself, so that a flipped bit in it is damage like any other.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from data_contracts.errors import DataError

RUN_FILE = "run.json"
_OWN_DIGEST = "record_digest"

Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
"""SHA-256 in hexadecimal."""


class RunRecord(BaseModel):
    """One stage as it was run.

    Attributes:
        stage: its name.
        stage_version: its version.
        key: its cache key.
        digest: of its manifest.
        arguments: its options; `{"manifest": KEY}` stands for an input.
        upstream: digests of the manifests of its inputs, by their keys.
        versions: of the software and the machine it ran on.
        started: when, UTC.
        wall_seconds: how long.
        cpu_seconds: of its process, meanwhile.
        process_peak_memory_mib: highest of its process while it ran.
        rows: of its table; None in records of before this was noted.
    """

    # What a newer version of the code notes beside these is no damage.
    model_config = ConfigDict(frozen=True, extra="ignore")

    stage: str
    stage_version: int
    key: str
    digest: Digest
    arguments: dict[str, Any]
    upstream: dict[str, Digest]
    versions: dict[str, str]
    started: str
    wall_seconds: float
    cpu_seconds: float
    process_peak_memory_mib: float
    rows: int | None = None


def read_run_record(folder: Path) -> RunRecord:
    """The record of an artefact.

    Raises:
        DataError: there is none, it is damaged, or it is that of another artefact than the folder is named after.
        OSError: it cannot be read now, which says nothing about its content.
    """
    path = folder / RUN_FILE
    try:
        content = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError) as error:
        raise DataError(f"{path}: is not a provenance record: {error.strerror}") from error
    return parse_run_record(content, folder.name, str(path))


def parse_run_record(content: bytes, key: str, where: str) -> RunRecord:
    """The record in what a file or an object holds.

    Args:
        content: of `run.json`.
        key: of the artefact it must be of.
        where: named in messages.

    Raises:
        DataError: it is damaged, or is that of another artefact.
    """
    try:
        values = json.loads(content)
        if not isinstance(values, dict):
            raise TypeError(f"expected an object, got {type(values).__name__}")
        # Records of before there was a digest have none.
        own = values.pop(_OWN_DIGEST, None)
        if own is not None and own != digest_of(values):
            raise ValueError("its content is not that of its digest")
        record = RunRecord.model_validate(values)
        if record.key != key:
            raise ValueError(f"it is of key {record.key[:64]!r}")
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise DataError(f"{where}: is not a provenance record: {place[:100]}: {first['msg'][:100]}") from error
    except (TypeError, ValueError, RecursionError) as error:
        raise DataError(f"{where}: is not a provenance record: {str(error)[:200]}") from error
    return record


def write_run_record(folder: Path, record: RunRecord) -> None:
    """Write `run.json` of an artefact, with its digest."""
    values = record.model_dump()
    values[_OWN_DIGEST] = digest_of(values)
    (folder / RUN_FILE).write_text(json.dumps(values, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def digest_of(value: Any) -> str:
    """SHA-256 of anything JSON can hold, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def mark_used(folder: Path) -> None:
    """Note that an artefact is used, as the modification time of its provenance record.

    A time stamp needs no file or lock of its own, moves with the artefact, and no digest covers it.
    """
    with contextlib.suppress(OSError):  # not ours to write; reading goes on
        os.utime(folder / RUN_FILE)
