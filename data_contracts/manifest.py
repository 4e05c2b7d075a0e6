"""Manifests on disk: one Parquet table per artefact, with the digests of all files beside it.

An artefact is a folder. `manifest.parquet` holds its rows and, in the Parquet metadata, size and SHA-256 of every other
file of the folder, so the digest of the manifest vouches for the whole artefact. More than some thousands of files are
listed in a table of their own, `file_list.parquet`, whose digest is in the metadata. Arrays lie beside it,
compressed (`data_contracts.compressed_arrays`) or as .npy files; row i of an array belongs to row i of the table.
"""

# pyarrow.compute makes its functions when it is imported, where a type checker cannot see them.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import hashlib
import itertools
import json
import stat
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from data_contracts.array_rows import Images
from data_contracts.arrays import load_array
from data_contracts.compressed_arrays import SUFFIX
from data_contracts.config import ConditionChoice, Frozen
from data_contracts.errors import DataError, TableVersionError
from data_contracts.file_lists import (
    FILE_LIST,
    MAX_LISTED_FILES,
    file_digest,
    read_file_list,
    read_table,
    write_file_list,
)
from data_contracts.image_rows import ImageRows
from data_contracts.labels import LABEL_ARRAYS, BodyMotions, Conditions, HeldOut, History, Labels, held_out_split
from data_contracts.run_record import RUN_FILE, read_run_record
from data_contracts.tables import TABLES, TableSchema, check_table

MANIFEST_FILE = "manifest.parquet"
_FILES_KEY = b"ctlev.files"
_SCHEMA_KEY = b"ctlev.schema"
_MOTION_PREFIX = "motion_"
_MOTION_ARRAYS = tuple(field.name for field in fields(BodyMotions))


class ManifestRef(Frozen):
    """What stages hand to one another: where an artefact is and what its manifest's digest must be.

    Attributes:
        key: the cache key of the stage that made it; names the artefact in the store.
        path: the artefact's folder.
        digest: SHA-256 of manifest.parquet; empty while only planned.
        rows: rows of the table; -1 while only planned.
    """

    key: str
    path: Path
    digest: str = ""
    rows: int = -1


def artefact_files(folder: Path) -> list[Path]:
    """Every file of an artefact except the manifest and the provenance record, sorted."""
    special = {folder / MANIFEST_FILE, folder / RUN_FILE}
    return sorted(path for path in folder.rglob("*") if path.is_file() and path not in special)


def write_manifest(folder: Path, table: pa.Table, schema: TableSchema) -> ManifestRef:
    """Check `table` and write it as the manifest of `folder`, which already holds every other file.

    Returns:
        The reference, with `key` = the folder's name.

    Raises:
        DataError: the table breaks its schema.
    """
    table = check_table(table, schema, str(folder))
    listed = artefact_files(folder)
    if folder / FILE_LIST in listed:
        raise DataError(f"{folder}: no stage may write a file {FILE_LIST}, which lists the others")
    if len(listed) > MAX_LISTED_FILES:
        # Parquet's readers refuse metadata above 100 MB, which 700,000 files are.
        write_file_list(folder, listed)
        listed = [folder / FILE_LIST]
    files = {
        path.relative_to(folder).as_posix(): {"bytes": path.stat().st_size, "sha256": file_digest(path)}
        for path in listed
    }
    metadata = {
        _SCHEMA_KEY: json.dumps({"name": schema.name, "version": schema.version}).encode(),
        _FILES_KEY: json.dumps(files, sort_keys=True).encode(),
    }
    path = folder / MANIFEST_FILE
    pq.write_table(table.replace_schema_metadata(metadata), path, compression="zstd")
    return ManifestRef(key=folder.name, path=folder, digest=file_digest(path), rows=table.num_rows)


@dataclass(frozen=True, eq=False)
class Manifest:
    """An opened artefact: its table, and its files by name."""

    ref: ManifestRef
    schema: TableSchema
    table: pa.Table
    files: Mapping[str, Mapping[str, Any]]

    def __len__(self) -> int:
        return self.table.num_rows

    def path(self, name: str) -> Path:
        """A file of the artefact that the manifest lists."""
        if name not in self.files:
            known = ", ".join(sorted(itertools.islice(self.files, 20))) or "none"
            raise DataError(f"{self.ref.path}: holds no file {name!r}; it has {known[:200]}")
        return self.ref.path / name

    def array(self, name: str) -> Images:
        """An array of the artefact, whose rows stay on disk until they are indexed."""
        return load_array(self.array_path(name))

    def array_path(self, name: str) -> Path:
        """Its file."""
        return self.path(self._array_file(name))

    def has_array(self, name: str) -> bool:
        """Does the artefact hold an array of this name?"""
        return self._array_file(name) in self.files

    def _array_file(self, name: str) -> str:
        """`<name>.npy.zst`, or `<name>.npy`, which earlier versions wrote and which holds what does not compress."""
        return f"{name}.npy" if f"{name}.npy" in self.files else f"{name}{SUFFIX}"

    def images(self, rows: np.ndarray, name: str = "frames") -> ImageRows:
        """The given rows of an array, which stay on disk until they are indexed."""
        return image_rows([(self, rows)], name)

    def attached(self, schema: TableSchema) -> pa.Table:
        """The table `<schema.name>.parquet` that lies beside the manifest, checked."""
        path = self.path(f"{schema.name}.parquet")
        return check_table(read_table(path, path).replace_schema_metadata(None), schema, str(path))

    def column(self, name: str) -> list:
        """A column as Python values."""
        return self.table[name].to_pylist()

    def rows_where(self, **values: str) -> np.ndarray:
        """Indices of the rows whose columns equal the given values."""
        keep = np.ones(len(self), dtype=bool)
        for name, value in values.items():
            keep &= np.array([item == value for item in self.column(name)], dtype=bool)
        return np.flatnonzero(keep)

    @cached_property
    def held_out(self) -> HeldOut:
        """The split of frames that models are scored on: `test`, or `validation` of frames for choosing options."""
        return held_out_split(self.column("split"))

    @cached_property
    def labels(self) -> Labels:
        """The label columns of the table."""
        return labels_of(self.table)


def image_rows(parts: Sequence[tuple[Manifest, np.ndarray]], name: str = "frames") -> ImageRows:
    """The given rows of an array of several artefacts, one after another, left on disk."""
    arrays = [(manifest.array(name), rows) for manifest, rows in parts]
    return ImageRows.of(arrays, " ".join([name, *(manifest.ref.digest for manifest, _ in parts)]))


def read_manifest(ref: ManifestRef, *, full: bool = False) -> Manifest:
    """Open an artefact and verify it.

    Args:
        ref: from the stage that made it.
        full: hash every file again; otherwise the manifest is hashed and the other files are checked by size.

    Raises:
        DataError: a file is missing or has changed.
        TableVersionError: the table has another version than the one this code reads.
        OSError: a file cannot be read now, which says nothing about its content.
    """
    path = ref.path / MANIFEST_FILE
    try:
        content = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        raise DataError(f"{ref.path}: manifest is missing; run the flow again to make it anew") from None
    digest = hashlib.sha256(content).hexdigest()
    if ref.digest and digest != ref.digest:
        raise DataError(f"{path}: content has changed; expected digest {ref.digest[:12]}, got {digest[:12]}")
    try:
        table = read_table(pa.BufferReader(content), path)
        schema, files = _declared(table.schema.metadata or {}, path)
        checked = check_table(table.replace_schema_metadata(None), schema, str(path))
    except (UnicodeDecodeError, pa.ArrowException) as error:  # text that is not UTF-8, types that nobody wrote
        raise DataError(f"{path}: damaged: {error}") from error
    for name, expected in files.items():
        _check_file(ref.path / name, expected, full or name == FILE_LIST)
    if FILE_LIST in files:
        files = read_file_list(ref.path / FILE_LIST)
        for name, expected in files.items():
            _check_file(ref.path / name, expected, full)
    return Manifest(ManifestRef(key=ref.key, path=ref.path, digest=digest, rows=len(checked)), schema, checked, files)


def _declared(metadata: Mapping[bytes, bytes], path: Path) -> tuple[TableSchema, dict[str, Any]]:
    """The schema that a manifest names, and size and digest of the files beside it."""
    if _SCHEMA_KEY not in metadata or _FILES_KEY not in metadata:
        raise DataError(f"{path}: is not a ctlev manifest; its metadata names no schema")
    try:
        declared, files = json.loads(metadata[_SCHEMA_KEY]), json.loads(metadata[_FILES_KEY])
        name, version = declared["name"], declared["version"]
        if any(not isinstance(stated["bytes"], int) or not stated["sha256"] for stated in files.values()):
            raise TypeError("sizes and digests of files")
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: is not a ctlev manifest; its metadata cannot be read: {error!r}") from error
    schema = TABLES.get(name)
    if schema is None:
        raise DataError(f"{path}: table {name!r}; this code reads {sorted(TABLES)}")
    if schema.version != version:
        raise TableVersionError(f"{path}: table {name!r} version {version}; this code reads version {schema.version}")
    return schema, files


def _check_file(path: Path, expected: Mapping[str, Any], full: bool) -> None:
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise DataError(f"{path}: file is missing") from None
    if not stat.S_ISREG(status.st_mode):
        raise DataError(f"{path}: is not a file")
    size = status.st_size
    if size != expected["bytes"]:
        raise DataError(f"{path}: expected {expected['bytes']} bytes, got {size}")
    if full and file_digest(path) != expected["sha256"]:
        raise DataError(f"{path}: content has changed since it was written")


LABEL_COLUMNS = {
    "joints2d": "joints2d_px",
    "visible": "visible",
    "joints3d": "joints3d_mm",
    "smpl_pose": "smpl_pose_rad",
    "smpl_betas": "smpl_betas",
    "smpl_transl": "smpl_transl_m",
    "intrinsics": "intrinsics_px",
}
"""Column of a table for each array of `Labels`."""


def label_columns(labels: Labels) -> dict[str, pa.Array]:
    """The label columns of a table, `joint_set` and one for each array of `Labels`; null where there is none."""
    count = len(labels)
    columns = {"joint_set": pa.array([labels.joint_set] * count, pa.string())}
    for name, column in LABEL_COLUMNS.items():
        element = pa.from_numpy_dtype(LABEL_ARRAYS[name][0])
        values = getattr(labels, name)
        if values is None:
            columns[column] = pa.nulls(count, pa.list_(element))
            continue
        offsets = pa.array(np.arange(count + 1, dtype=np.int32) * int(np.prod(values.shape[1:])))
        columns[column] = pa.ListArray.from_arrays(offsets, pa.array(values.reshape(-1), element))
    return columns


def labels_of(table: pa.Table) -> Labels:
    """Inverse of `label_columns`, for any table with label columns."""
    count = table.num_rows
    class_names = tuple(table["class_name"].to_pylist())
    times = "t_us" if "t_us" in table.column_names else "t_end_us"
    t_us = table[times].to_numpy() if times in table.column_names else np.zeros(count, np.int64)
    joint_sets = set(table["joint_set"].to_pylist())
    if len(joint_sets) > 1:
        raise DataError(f"rows must share one joint set, got {sorted(joint_sets)}")
    arrays: dict[str, np.ndarray] = {}
    for name, column in LABEL_COLUMNS.items():
        lists = table[column].combine_chunks()
        if lists.null_count == count:
            continue
        if lists.null_count:
            raise DataError(f"rows must all have {column} or none, got {count - lists.null_count} of {count}")
        dtype, last = LABEL_ARRAYS[name]
        values = lists.flatten().to_numpy(zero_copy_only=False).astype(dtype, copy=False)
        of_joints = name in ("joints2d", "joints3d")
        arrays[name] = values.reshape((count, -1, last) if of_joints else (count, -1))
    return Labels(class_names, t_us.astype(np.int64), joint_set="".join(joint_sets), **arrays)


def by_recording(table: pa.Table) -> dict[str, pa.Table]:
    """The rows of each recording, which lie together."""
    names, starts, stops = _runs(table)
    return {
        name: table.slice(start, stop - start)
        for name, start, stop in zip(names.to_pylist(), starts.tolist(), stops.tolist(), strict=True)
    }


def rows_by_recording(table: pa.Table, recording_ids: pa.ChunkedArray) -> np.ndarray:
    """Which rows of a table are of each of N recordings, where they lie together: [N, 2] int64, ranges.

    As `by_recording`, in a few bytes a recording.
    """
    names, starts, stops = _runs(table)
    found = pc.index_in(names, value_set=recording_ids.combine_chunks())
    known = np.asarray(found.is_valid())
    ranges = np.zeros((len(recording_ids), 2), np.int64)
    ranges[found.drop_null().to_numpy()] = np.stack([starts, stops], axis=1)[known]
    return ranges


def _runs(table: pa.Table) -> tuple[pa.Array, np.ndarray, np.ndarray]:
    """Names of the recordings of a table, and the first row of each and one past its last."""
    names = table["recording_id"].combine_chunks()
    changed = np.flatnonzero(pc.not_equal(names[1:], names[:-1])) + 1 if len(names) else np.zeros(0, np.int64)
    starts = np.concatenate([np.zeros(min(len(names), 1), np.int64), changed])
    return names.take(pa.array(starts)), starts, np.append(starts[1:], len(names))[: len(starts)]


class LabelKinds:
    """Tables with label columns that come one by one: all must carry the same kinds of labels."""

    def __init__(self) -> None:
        self._kinds: set[tuple[str, ...]] = set()

    def check(self, table: pa.Table) -> pa.Table:
        """The table; raises `DataError` where its labels are of another kind than those before."""
        if not table.num_rows:
            return table
        arrays = [name for name, column in LABEL_COLUMNS.items() if table[column].null_count < table.num_rows]
        self._kinds.add((table["joint_set"][0].as_py(), *arrays))
        if len(self._kinds) != 1:
            raise DataError(f"cannot mix labels of different kinds: {sorted(self._kinds)}")
        return table


def concat_labels(parts: Iterable[Labels], *, common: bool = False) -> Labels:
    """Stack label rows; all parts must carry the same kinds of labels, or (`common`) only what all have is kept."""
    parts = [part for part in parts if len(part)]
    if not parts:
        return Labels((), np.zeros(0, np.int64))
    if common:
        shared = set.intersection(*(set(part.arrays) for part in parts))
        parts = [replace(part, **{name: None for name in part.arrays if name not in shared}) for part in parts]
    kinds = {(part.joint_set, *part.arrays) for part in parts}
    if len(kinds) != 1:
        raise DataError(f"cannot mix labels of different kinds: {sorted(kinds)}")
    return Labels(
        class_names=tuple(name for part in parts for name in part.class_names),
        t_us=np.concatenate([part.t_us for part in parts]),
        joint_set=parts[0].joint_set,
        **{name: np.concatenate([part.arrays[name] for part in parts]) for name in parts[0].arrays},
    )


def matching_rows(frames: Manifest, conditions: Manifest) -> np.ndarray:
    """Row of the frame [N] int64 that each of N condition rows describes, joined on `sample_id`.

    Raises:
        DataError: a condition has no frame.
    """
    position = {name: row for row, name in enumerate(frames.column("sample_id"))}
    wanted = conditions.column("sample_id")
    missing = [name for name in wanted if name not in position]
    if missing:
        raise DataError(f"{conditions.ref.path}: condition {missing[0]!r} has no frame in {frames.ref.path}")
    return np.array([position[name] for name in wanted], dtype=np.int64)


def conditions_of(manifest: Manifest) -> Conditions:
    """The conditions of a manifest of conditions; row i is row i of its table."""
    images = manifest.array("images") if manifest.has_array("images") else None
    arrays = {name: f"{_MOTION_PREFIX}{name}" for name in _MOTION_ARRAYS}
    motions = None
    if all(map(manifest.has_array, arrays.values())):
        motions = BodyMotions(**{name: np.asarray(manifest.array(array)) for name, array in arrays.items()})
    names = tuple(manifest.column("class_name"))
    return Conditions(tuple(manifest.column("prompt")), images, motions, names, _condition_choice(manifest))


def _condition_choice(manifest: Manifest) -> ConditionChoice | None:
    """The plug-in that made a manifest of conditions, if a stage did."""
    folder = manifest.ref.path
    chosen = read_run_record(folder).arguments.get("condition") if (folder / RUN_FILE).exists() else None
    if chosen is None:
        return None
    return ConditionChoice(name=chosen["plugin"].rpartition("/")[2], options=chosen["options"])


def condition_arrays(conditions: Conditions) -> dict[str, np.ndarray]:
    """The arrays to attach to a manifest of conditions, by name, from which `conditions_of` makes them again."""
    arrays = {} if conditions.images is None else {"images": np.asarray(conditions.images)}
    if conditions.motions is not None:
        arrays |= {f"{_MOTION_PREFIX}{name}": getattr(conditions.motions, name) for name in _MOTION_ARRAYS}
    return arrays


def history_table(history: History) -> pa.Table:
    """The loss curves of a training run as rows of the table `training`."""
    curves = (
        ("training", history.step, history.loss),
        ("validation", history.validation_step, history.validation_loss),
        ("shuffled", history.validation_step, history.shuffled_loss),
    )
    rows = [(name, step, loss) for name, steps, losses in curves for step, loss in zip(steps, losses, strict=False)]
    return pa.table(
        {
            "curve": pa.array([row[0] for row in rows], pa.string()),
            "step": pa.array([row[1] for row in rows], pa.int64()),
            "loss": pa.array([row[2] for row in rows], pa.float64()),
        }
    )
