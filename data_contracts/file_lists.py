"""Files of an artefact or of folders, with sizes and digests; lists of them too long for a manifest's metadata."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from data_contracts.errors import DataError

FILE_LIST = "file_list.parquet"
MAX_LISTED_FILES = 10_000
"""Files that the manifest's own metadata lists at most."""
_COLUMNS = pa.schema([("name", pa.string()), ("bytes", pa.int64()), ("sha256", pa.binary(32))])


class FileList(Mapping[str, Mapping[str, Any]]):
    """Size and digest of each file by its name, as `{"bytes": ..., "sha256": ...}`; a million takes some 200 MB."""

    def __init__(self, table: pa.Table) -> None:
        self._row = {name: row for row, name in enumerate(table["name"].to_pylist())}
        self._bytes = table["bytes"].to_numpy()
        # One buffer: a million short texts would take a hundred bytes each.
        self._digests = np.frombuffer(b"".join(table["sha256"].to_pylist()), np.uint8).reshape(-1, 32)

    def __getitem__(self, name: str) -> Mapping[str, Any]:
        row = self._row[name]
        return {"bytes": int(self._bytes[row]), "sha256": self._digests[row].tobytes().hex()}

    def __contains__(self, name: object) -> bool:
        return name in self._row

    def __iter__(self) -> Iterator[str]:
        return iter(self._row)

    def __len__(self) -> int:
        return len(self._row)


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_of(places: Sequence[Path]) -> list[tuple[str, Path]]:
    """Files, and every file of folders, named by the place's number and the path inside it, folders sorted.

    Links to folders are followed: parts of a model that several models share are often linked.
    """
    return [
        (str(number) if path == place else f"{number}/{path.relative_to(place).as_posix()}", path)
        for number, place in enumerate(places)
        for path in ([place] if place.is_file() else sorted(_files_within(place)))
        if path.is_file()
    ]


def _files_within(folder: Path, around: frozenset[str] = frozenset()) -> Iterator[Path]:
    """Files below a folder; where links lead to one folder from several places it counts at each, but not in itself."""
    place = os.path.realpath(folder)
    try:
        names = [] if place in around else os.listdir(folder)
    except OSError:  # one that is not there has none
        names = []
    for path in (folder / name for name in names):
        if path.is_dir():
            yield from _files_within(path, around | {place})
        else:
            yield path


def write_file_list(folder: Path, files: Sequence[Path]) -> None:
    """Write `file_list.parquet` of files below `folder`."""
    columns = {
        "name": [path.relative_to(folder).as_posix() for path in files],
        "bytes": [path.stat().st_size for path in files],
        "sha256": [bytes.fromhex(file_digest(path)) for path in files],
    }
    pq.write_table(pa.table(columns, schema=_COLUMNS), folder / FILE_LIST, compression="zstd")


def read_file_list(path: Path) -> FileList:
    """The list in `file_list.parquet`, whose own digest was checked.

    Raises:
        DataError: it is no such table.
    """
    table = read_table(path, path).replace_schema_metadata(None)
    if table.schema != _COLUMNS or any(column.null_count for column in table.columns):
        raise DataError(f"{path}: expected columns {', '.join(_COLUMNS.names)}, got {', '.join(table.column_names)}")
    return FileList(table)


def read_table(source: Path | pa.BufferReader, path: Path) -> pa.Table:
    """One Parquet file. `pq.read_table` would load pyarrow's datasets for it, and those pandas, a third of a second."""
    try:
        with pq.ParquetFile(source) as file:
            # pyarrow's threads may let go of Python's memory after the interpreter has ended, which aborts the process:
            # github.com/apache/arrow/issues/34314
            return file.read(use_threads=not isinstance(source, pa.BufferReader))
    except OSError as error:
        if error.errno is not None:
            raise
        raise DataError(f"{path}: is not a Parquet file: {str(error)[:200]}") from error
    except (pa.ArrowInvalid, UnicodeDecodeError) as error:  # the last of names that are no text
        raise DataError(f"{path}: is not a Parquet file: {str(error)[:200]}") from error
