"""Published versions of an experiment's synthetic data: small JSON files beside one another.

<home>/published/<experiment>/v0001.json   what became of a version, whether it passed its gates or not; never changed
<home>/published/<experiment>/latest.json  the record of the newest version that passed; replaced as a whole

A record names artefacts of the store by key and digest, so that what it says can be checked.
"""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import Field, ValidationError

from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.manifest import ManifestRef
from data_contracts.regeneration import Gates

LATEST_FILE = "latest.json"


class StoredArtefact(Frozen):
    """An artefact of the store: `<home>/artefacts/<stage>/<key>`, whose manifest has this digest."""

    stage: str
    key: str
    digest: str
    rows: int


class GateCheck(Frozen):
    """One gate: `value` of `score` may be `limit` at most."""

    gate: str
    score: str
    value: float
    limit: float

    @property
    def passed(self) -> bool:
        """Is the value within the limit?"""
        return self.value <= self.limit

    def __str__(self) -> str:
        return f"{self.gate}: {self.score} is {self.value:.4g}, {self.limit:.4g} at most was asked for"


class Version(Frozen):
    """What became of one version.

    Attributes:
        experiment: its name.
        number: of the version, from 1.
        seed: of its poses and noise.
        made: when its record was written, UTC.
        synthetic: the frames.
        made_from: the checkpoint and the conditions.
        scored_in: artefacts that hold its scores.
        scores: every score, by setting, group and metric.
        gates: thresholds that were asked for.
        checks: how each was kept.
    """

    experiment: str
    number: int = Field(ge=1)
    seed: int
    made: str
    synthetic: StoredArtefact
    made_from: tuple[StoredArtefact, ...]
    scored_in: tuple[StoredArtefact, ...]
    scores: dict[str, float]
    gates: Gates
    checks: tuple[GateCheck, ...]

    @property
    def passed(self) -> bool:
        """Were all gates kept?"""
        return all(check.passed for check in self.checks)

    @property
    def artefacts(self) -> tuple[StoredArtefact, ...]:
        """Every artefact the record refers to."""
        return (self.synthetic, *self.made_from, *self.scored_in)

    def __str__(self) -> str:
        failed = "; ".join(str(check) for check in self.checks if not check.passed)
        return f"version {self.number} of {self.experiment} " + (
            f"was rejected: {failed}" if failed else "is published"
        )


def published_folder(home: Path, experiment: str) -> Path:
    """Where the versions of an experiment are listed.

    Raises:
        DataError: the name leads out of the folder.
    """
    if not experiment.strip(".") or Path(experiment).name != experiment:
        raise DataError(f"an experiment's name must be that of a folder, got {experiment!r}")
    return home / "published" / experiment


def version_file(folder: Path, number: int) -> Path:
    """The record of a version."""
    return folder / f"v{number:04d}.json"


def read_versions(folder: Path) -> list[Version]:
    """All records of an experiment, oldest first.

    Raises:
        DataError: one of them is damaged.
    """
    return sorted((_read(path) for path in folder.glob("v[0-9]*.json")), key=lambda version: version.number)


def read_latest(folder: Path) -> Version | None:
    """The newest version that passed, if any has.

    Raises:
        DataError: it is damaged.
    """
    path = folder / LATEST_FILE
    return _read(path) if path.exists() else None


def latest_frames(home: Path, experiment: str) -> ManifestRef:
    """The frames of the newest version that passed; `read_manifest` opens and checks them.

    Raises:
        DataError: there is none, or its record is damaged.
    """
    latest = read_latest(published_folder(home, experiment))
    if latest is None:
        raise DataError(f"{published_folder(home, experiment)}: no version has been published yet")
    found = latest.synthetic
    folder = home / "artefacts" / found.stage / found.key
    return ManifestRef(key=found.key, path=folder, digest=found.digest, rows=found.rows)


def kept_versions(home: Path, count: int) -> list[Version]:
    """Of each experiment the newest `count` versions that passed, and the latest.

    Raises:
        DataError: a record is damaged.
    """
    kept: list[Version] = []
    for folder in sorted(path for path in (home / "published").glob("*") if path.is_dir()):
        passed = [version for version in read_versions(folder) if version.passed]
        latest = read_latest(folder)
        kept += [*passed[max(len(passed) - count, 0) :], *([latest] if latest else [])]
    return kept


def write_version(folder: Path, version: Version) -> None:
    """Write the record of a version.

    Raises:
        FileExistsError: the version has a record, which is never changed.
    """
    path = version_file(folder, version.number)
    if path.exists():
        raise FileExistsError(f"{path}: this version has a record")
    write_durably(path, version.model_dump_json(indent=2) + "\n")


def write_latest(folder: Path, version: Version) -> None:
    """Make a version the latest, all at once: whoever reads finds the one before or this one."""
    write_durably(folder / LATEST_FILE, version.model_dump_json(indent=2) + "\n")


def write_durably(path: Path, text: str) -> None:
    """A whole file or none, also after a power cut."""
    temporary = path.with_name(f".{path.name}.tmp")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
    descriptor = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _read(path: Path) -> Version:
    try:
        return Version.model_validate_json(path.read_bytes())
    except (ValidationError, OSError) as error:
        raise DataError(f"{path}: is not the record of a version: {error}") from error
