"""A plain folder of generated event images with their labels, for users of files: its layout and its table.

FOLDER/README.md                             what it is and how to read it
FOLDER/labels.parquet                        one row an image (`IMAGES`); label columns that no row has are left out
FOLDER/metadata.parquet                      the same for `imagefolder` of `datasets`; `label` is the class's number
FOLDER/provenance.json                       the record of every stage behind it (ctlev_core.provenance.records)
FOLDER/images/000/synthetic_000000.png       RGB, 8 bit; 1,000 rows a sub-folder
FOLDER/conditions/000/synthetic_000000.png   the condition image, for generators that are asked by one
FOLDER/events/000/synthetic_000000.parquet   the image as an event stream, where that was asked for; a stretch of
                                             images has the name of its first

A folder that is being written has another name, and no labels.
"""

# pyarrow.compute makes its functions when it is imported, where a type checker cannot see them.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from data_contracts import tables
from data_contracts.errors import DataError, TableVersionError
from data_contracts.manifest import LABEL_COLUMNS
from data_contracts.tables import Column, TableSchema, check_table

README_FILE, LABELS_FILE, METADATA_FILE, PROVENANCE_FILE = (
    "README.md", "labels.parquet", "metadata.parquet", "provenance.json",
)  # fmt: skip
IMAGES_FOLDER, CONDITIONS_FOLDER, EVENTS_FOLDER = "images", "conditions", "events"
SHARD_ROWS = 1_000
"""Rows whose files share a sub-folder: more would make it slow to list."""
_SCHEMA_KEY = b"ctlev.schema"

_SYNTHETIC = {column.name: column for column in tables.SYNTHETIC.columns}
_STREAMS = {column.name: column for column in tables.EVENT_STREAMS.columns}
EVENT_COLUMNS = {
    "file": "events_file",
    "event_start": "event_start",
    "num_events": "num_events",
    "t_start_us": "t_start_us",
    "t_end_us": "t_end_us",
    "has_polarity": "has_polarity",
    "is_exact": "is_exact",
    "error_levels": "error_levels",
}
"""Columns of `event_streams`, and what they are called here."""
_OPTIONAL = ("condition_file_name", *EVENT_COLUMNS.values(), "joint_set", *LABEL_COLUMNS.values())
IMAGES = TableSchema(
    "image_folder",
    1,
    "sample_id",
    (
        Column("file_name", pa.string(), "the image, relative to this table"),
        Column("condition_file_name", pa.string(), "its condition image, relative to this table", nullable=True),
        replace(_SYNTHETIC["sample_id"], doc="names the image"),
        *(_SYNTHETIC[name] for name in ("class_name", "split", "subject", "prompt")),
        *(_SYNTHETIC[name] for name in ("joint_set", *LABEL_COLUMNS.values())),
        *(replace(_STREAMS[name], name=own, nullable=True) for name, own in EVENT_COLUMNS.items()),
        *(_SYNTHETIC[name] for name in ("seed", "num_attempts", "source_id", "condition_id", "generator", "scheduler")),
        *(_SYNTHETIC[name] for name in ("num_inference_steps", "guidance_scale", "checkpoint_digest")),
        Column("frames_digest", pa.string(), "digest of the manifest of all frames that were sampled"),
    ),
)


def file_names(kind: str, sample_ids: Sequence[str], rows: Sequence[int], suffix: str) -> list[str]:
    """Where the files of some rows lie: `images/002/synthetic_002500.png`.

    Args:
        kind: folder of such files.
        sample_ids: of the rows.
        rows: their numbers in the table they come from, which choose the sub-folder.
        suffix: of the files.
    Raises:
        DataError: two samples would have one name.
    """
    plain = [re.sub(r"[^A-Za-z0-9._-]", "_", sample_id) for sample_id in sample_ids]
    if len(set(plain)) < len(plain):
        raise DataError(f"samples need names that differ in letters, digits, '.', '_' or '-', got {sample_ids[:3]} ...")
    return [f"{kind}/{row // SHARD_ROWS:03d}/{name}{suffix}" for row, name in zip(rows, plain, strict=True)]


def write_image_table(folder: Path, table: pa.Table) -> None:
    """Check and write `labels.parquet`, and as `metadata.parquet` the same with class numbers (`ClassLabel`).

    Columns that hold nothing stay out.

    Args:
        folder: holds the files that the table names.
        table: columns of `IMAGES`; optional ones may be missing.
    Raises:
        DataError: the table breaks its schema.
    """
    table = _completed(table, str(folder))
    empty = [name for name in _OPTIONAL if is_empty(table[name])]
    table = table.drop_columns(empty)
    schema = table.schema.with_metadata({_SCHEMA_KEY: json.dumps({"name": IMAGES.name, "version": IMAGES.version})})
    table = table.cast(schema)
    pq.write_table(table, folder / LABELS_FILE, compression="zstd")
    pq.write_table(_with_class_numbers(table), folder / METADATA_FILE, compression="zstd")


def _with_class_numbers(table: pa.Table) -> pa.Table:
    """The table with a column `label` that `datasets` reads as a `ClassLabel`, where there are classes.

    Source: `datasets.Features` in the metadata of a Parquet schema.
    """
    names = sorted(set(table["class_name"].to_pylist()) - {""})
    if not names or is_empty(table["class_name"]):
        return table
    numbers = {name: number for number, name in enumerate(names)} | {"": -1}  # -1: no class, as `datasets` has it
    told = {"info": {"features": {"label": {"names": names, "_type": "ClassLabel"}}}}
    column = pa.array([numbers[name] for name in table["class_name"].to_pylist()], pa.int64())
    metadata = {**(table.schema.metadata or {}), b"huggingface": json.dumps(told).encode()}
    return table.append_column("label", column).replace_schema_metadata(metadata)


def read_image_table(folder: Path) -> pa.Table:
    """The table of an exported folder, with all columns of `IMAGES`: what it leaves out is null, or empty.

    Columns a user has added are dropped, and types that another program has widened are narrowed again.

    Raises:
        DataError: no exported folder, one whose export did not end, or a table that breaks its schema.
        TableVersionError: it was exported by another version of the code.
    """
    path = folder / LABELS_FILE
    if not path.is_file():
        partial = "an export that did not end" if folder.name.endswith(".partial") else "another folder"
        got = partial if folder.is_dir() else "a file" if folder.exists() else "nothing there"
        raise DataError(f"{folder}: expected an exported folder, which holds {LABELS_FILE}; got {got}")
    try:
        with pq.ParquetFile(path) as file:
            table = file.read()
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:  # the last of names that are no text
        raise DataError(f"{path}: cannot be read as Parquet: {error}") from error
    try:
        version = json.loads((table.schema.metadata or {}).get(_SCHEMA_KEY, b"{}")).get("version", IMAGES.version)
        if version != IMAGES.version:
            raise TableVersionError(f"{path}: table version {version}; this code reads version {IMAGES.version}")
        return _completed(table.replace_schema_metadata(None), str(path))
    except (AttributeError, UnicodeDecodeError, json.JSONDecodeError) as error:  # metadata or text that nobody wrote
        raise DataError(f"{path}: damaged: {error}") from error


def _completed(table: pa.Table, where: str) -> pa.Table:
    """All columns of `IMAGES`, in order and checked."""
    columns = []
    for column in IMAGES.columns:
        if column.name in table.column_names:
            try:
                columns.append(table[column.name].cast(column.type))
            except pa.ArrowException as error:
                raise DataError(f"{where}: column {column.name!r} is not {column.type}: {error}") from error
        elif column.name == "joint_set":
            columns.append(pa.array([""] * table.num_rows, column.type))
        elif column.name in _OPTIONAL:
            columns.append(pa.nulls(table.num_rows, column.type))
        else:
            raise DataError(f"{where}: column {column.name!r} is missing; the table has {table.column_names}")
    completed = check_table(pa.table(columns, names=[c.name for c in IMAGES.columns]), IMAGES, where)
    for name in ("file_name", "condition_file_name", "events_file"):
        outside = pc.match_substring_regex(completed[name].combine_chunks(), r"^/|(^|/)\.\.(/|$)")
        row = pc.index(outside, True).as_py()
        if row >= 0:
            raise DataError(f"{where}: {name} of row {row} leads out of the folder: {completed[name][row].as_py()!r}")
    return completed


def is_empty(column: pa.ChunkedArray) -> bool:
    """Does a column hold nothing but nulls or empty texts?"""
    return column.null_count == len(column) or (
        pa.types.is_string(column.type) and pc.unique(column).to_pylist() == [""]
    )
