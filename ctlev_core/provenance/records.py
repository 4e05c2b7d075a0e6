"""Where an artefact comes from: the records of all stages behind it, read from the store or from a report.

Every artefact's `run.json` holds its options, versions, time, and the digests of what it was made from; its neighbours
in the store are found by their keys. A report keeps all of them in one file, so that it can be traced, and compared
with another, wherever it is copied to.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from data_contracts.errors import DataError
from data_contracts.manifest import MANIFEST_FILE
from data_contracts.run_record import read_run_record

Value = str | int | float | bool | None


@dataclass(frozen=True)
class Record:
    """One stage as it was run.

    Attributes:
        role: what it is in the experiment: `recordings`, `checkpoint of synthetic`, `frames / recordings` ...
        stage: its name.
        stage_version: its version.
        key: its cache key.
        digest: of its manifest.
        rows: of its manifest.
        arguments: its options; `{"manifest": KEY}` stands for an input.
        upstream: digests of its inputs by their keys.
        versions: of the software and the machine it ran on.
        started: when, UTC.
        wall_seconds: how long.
        cpu_seconds: of its process, meanwhile.
        process_peak_memory_mib: highest of its process while it ran.
    """

    role: str
    stage: str
    stage_version: int
    key: str
    digest: str
    rows: int
    arguments: dict[str, Any]
    upstream: dict[str, str]
    versions: dict[str, str]
    started: str
    wall_seconds: float
    cpu_seconds: float
    process_peak_memory_mib: float


def read_records(artefacts: Iterable[tuple[str, Path]]) -> list[Record]:
    """Records of artefacts of the store and of everything they were made from, each once.

    Args:
        artefacts: (role, folder) of each; a role that occurs twice is numbered. What lies behind is named after the
            artefact and argument that lead to it, over the shortest way.
    Raises:
        DataError: a record is missing or cannot be read.
    """
    waiting = list(artefacts)
    found: dict[str, Record] = {}
    roles: set[str] = set()
    for role, folder in waiting:  # grows while it is read: breadth first
        if folder.name in found:
            continue
        role = next(name for name in _numbered(role) if name not in roles)
        roles.add(role)
        record = _read(role, folder)
        found[record.key] = record
        for name, key in _inputs(record.arguments):
            waiting.append((f"{role} / {name}", _folder_of(key, folder)))
    return list(found.values())


def _numbered(role: str) -> Iterator[str]:
    yield role
    number = 1
    while True:
        number += 1
        yield f"{role} ({number})"


def _read(role: str, folder: Path) -> Record:
    try:
        noted = read_run_record(folder).model_dump()
        noted["rows"] = pq.read_metadata(folder / MANIFEST_FILE).num_rows  # older records do not have it
        return Record(role=role, **noted)
    except (OSError, ValueError) as error:
        raise DataError(f"{folder}: has no provenance record that can be read: {str(error)[:300]}") from error


def _folder_of(key: str, neighbour: Path) -> Path:
    """The artefact of a key in the store of another artefact: `artefacts/STAGE/KEY`."""
    found = next(neighbour.parent.parent.glob(f"*/{key}"), None)
    if found is None:
        raise DataError(f"{neighbour}: was made from artefact {key}, which is not in the store any more")
    return found


def _inputs(arguments: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """(argument, key) of every input."""
    for name, value in arguments.items():
        for item in value if isinstance(value, list) else [value]:
            if isinstance(item, dict) and set(item) == {"manifest"}:
                yield name, item["manifest"]
            elif isinstance(item, dict):
                yield from _inputs(item)


def behind(records: Sequence[Record], key: str) -> list[Record]:
    """The record of a key and of everything it was made from."""
    by_key = {record.key: record for record in records}
    waiting, found = [key], {}
    for name in waiting:
        if name in by_key and name not in found:
            found[name] = by_key[name]
            waiting += by_key[name].upstream
    return list(found.values())


def options_of(record: Record) -> dict[str, Value]:
    """The options of a stage by dotted name, `generator.options.num_steps`, without inputs and versions of plug-ins."""
    return dict(_leaves(record.arguments, ""))


def _leaves(value: Any, name: str) -> Iterator[tuple[str, Value]]:
    if isinstance(value, dict):
        if set(value) == {"manifest"}:
            return
        is_plugin = {"plugin", "version", "options"} == set(value)
        for key, item in value.items():
            if not (is_plugin and key == "version"):
                yield from _leaves(item, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        for number, item in enumerate(value):
            yield from _leaves(item, f"{name}.{number}")
    else:
        yield name, json.dumps(value) if isinstance(value, list) else value


def versions_of(records: Iterable[Record]) -> dict[str, str]:
    """Versions of all stages, plug-ins and software behind an experiment; several are joined by commas."""
    found: dict[str, set[str]] = {}
    for record in records:
        found.setdefault(f"stage {record.stage}", set()).add(str(record.stage_version))
        for plugin, version in _plugins(record.arguments):
            found.setdefault(f"plug-in {plugin}", set()).add(str(version))
        for name, version in record.versions.items():
            found.setdefault(name, set()).add(str(version))
    return {name: ", ".join(sorted(versions)) for name, versions in sorted(found.items())}


def _plugins(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        if {"plugin", "version", "options"} == set(value):
            yield value["plugin"], value["version"]
        for item in value.values():
            yield from _plugins(item)
    elif isinstance(value, list):
        for item in value:
            yield from _plugins(item)


def write_provenance(path: Path, records: Sequence[Record]) -> None:
    """All records as JSON, in the given order."""
    path.write_text(json.dumps({"stages": [asdict(record) for record in records]}, indent=1) + "\n", encoding="utf-8")


def read_provenance(path: Path) -> list[Record]:
    """Inverse of `write_provenance`.

    Raises:
        DataError: the file is missing, or is something else.
    """
    try:
        return [Record(**record) for record in json.loads(path.read_text(encoding="utf-8"))["stages"]]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: is not the provenance file of a report: {error!r}") from error
