"""Generated frames as a plain folder of images with their labels; its layout: `data_contracts.image_folder`."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa

from ctlev_core.export.dataset_card import Card, render_card
from ctlev_core.progress import ProgressBar
from ctlev_core.provenance.records import Record, read_provenance, read_records, write_provenance
from data_contracts.claimed_folders import folder_claimed
from data_contracts.errors import DataError
from data_contracts.image_folder import (
    CONDITIONS_FOLDER,
    EVENT_COLUMNS,
    EVENTS_FOLDER,
    IMAGES,
    IMAGES_FOLDER,
    PROVENANCE_FILE,
    README_FILE,
    file_names,
    read_image_table,
    write_image_table,
)
from data_contracts.manifest import Manifest, ManifestRef, read_manifest

Artefacts = Mapping[str, ManifestRef]
"""What is exported, by role: `synthetic` frames, their `conditions`, and `event streams` where they are wanted."""
WriteFile = Callable[[int, Path], object]
"""Writes the file of a number of the export, counted from 0."""


def export_images(artefacts: Artefacts, folder: Path, *, name: str, notice: str) -> Path:
    """Write frames that passed the quality filter, with their labels, into a new folder, as a task of the run that
    calls it.

    The folder appears when it is complete. Until then the files lie beside it, under another name; a run that is killed
    goes on with them. A folder that holds this very export stays as it is.

    Args:
        artefacts: `synthetic`, `conditions`, and `event streams` where they are wanted.
        folder: new, or empty.
        name: of the experiment, for the description.
        notice: what data it was learnt from, likewise.
    Returns:
        The folder.
    Raises:
        DataError: the folder holds something else, or no frame passed the quality filter.
        BlockingIOError: another run is writing it.
    """
    from prefect import task
    from prefect.cache_policies import NO_CACHE

    @task(name="export_images", task_run_name=f"export_images: {folder}", cache_policy=NO_CACHE, persist_result=False)
    def run() -> Path:
        return write_image_folder(artefacts, folder, name=name, notice=notice)

    return run()


def check_export_folder(artefacts: Artefacts, folder: Path) -> bool:
    """Is this very export in the folder? Needs keys alone, so that a wrong folder is found while planning.

    Raises:
        DataError: the folder holds something else.
    """
    if folder.is_symlink() or os.path.ismount(folder):
        # The finished folder is renamed into place, which only works where nothing else holds the name.
        raise DataError(f"{folder}: is a link or a mount point; export to a new folder inside of it")
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        above = next(path for path in folder.absolute().parents if path.exists())
        if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
            raise DataError(f"{folder}: cannot be made, for {above} is no folder that can be written to")
        return False
    if not (folder / PROVENANCE_FILE).is_file():
        raise DataError(f"{folder}: expected a new or an empty folder to export to, got one that holds something else")
    if not _holds(artefacts, folder):
        raise DataError(f"{folder}: holds the export of other data; choose a new folder, or remove this one")
    missing = _missing_files(folder)
    if missing:
        raise DataError(f"{folder}: {len(missing)} files are missing, such as {missing[0]}; remove it to export anew")
    return True


def _missing_files(folder: Path) -> list[str]:
    """Files that the table of an exported folder names and that are not there."""
    table = read_image_table(folder)
    columns = {"file_name", "condition_file_name", EVENT_COLUMNS["file"]} & set(table.column_names)
    named = dict.fromkeys(name for column in columns for name in table[column].to_pylist() if name)
    return [name for name in named if not (folder / name).is_file()]


def _holds(artefacts: Artefacts, folder: Path) -> bool:
    """Does the record in a folder, whole or half-written, name the same artefacts?"""
    found = {record.role: record for record in read_provenance(folder / PROVENANCE_FILE)}
    return ("event streams" in found) == ("event streams" in artefacts) and all(
        role in found and found[role].key == ref.key and ref.digest in ("", found[role].digest)
        for role, ref in artefacts.items()
    )


def write_image_folder(artefacts: Artefacts, folder: Path, *, name: str, notice: str) -> Path:
    """What `export_images` does, without Prefect."""
    folder = folder.absolute()
    if check_export_folder(artefacts, folder):
        return folder
    opened = {role: read_manifest(ref) for role, ref in artefacts.items()}
    frames = opened["synthetic"]
    rows = frames.rows_where(rejected="")
    if not len(rows):
        raise DataError(
            f"{frames.ref.path}: the quality filter rejected all {len(frames)} frames, there is nothing to export"
        )
    records = read_records([(role, ref.path) for role, ref in artefacts.items()])
    with _claimed(artefacts, folder, records) as partial:
        table, event_suffix = _write_files(opened, rows, partial)
        write_image_table(partial, table)
        card = Card(
            name=name,
            notice=notice,
            table=table,
            image_size=(frames.array("frames").shape[2], frames.array("frames").shape[1]),
            num_rejected=len(frames) - len(rows),
            event_suffix=event_suffix,
            records=records,
        )
        (partial / README_FILE).write_text(render_card(card), encoding="utf-8")
        os.sync()
        partial.rename(folder)  # onto nothing, or an empty folder; anything else is an error
    return folder


@contextlib.contextmanager
def _claimed(artefacts: Artefacts, folder: Path, records: Sequence[Record]) -> Iterator[Path]:
    """The folder beside `folder` to write into: this run's alone, with what an earlier run wrote of the same data."""
    partial = folder.with_name(f".{folder.name}.partial")
    with folder_claimed(partial, f"{folder}: another run is writing this folder"):
        record = partial / PROVENANCE_FILE
        if not record.is_file() or not _holds(artefacts, partial):
            _clear(partial)
            temporary = record.with_name(f".{record.name}")
            write_provenance(temporary, records)
            temporary.rename(record)
        yield partial


def _clear(partial: Path) -> None:
    """Remove what an earlier run wrote of other data, its record last."""
    record, rest = partial / PROVENANCE_FILE, [path for path in partial.iterdir() if path.name != PROVENANCE_FILE]
    if not record.is_file() and any(path.name != f".{PROVENANCE_FILE}" for path in rest):
        raise DataError(f"{partial}: is not an export that did not end, but its name is needed for one; move it away")
    for path in rest:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    record.unlink(missing_ok=True)


def _write_files(opened: Mapping[str, Manifest], rows: np.ndarray, partial: Path) -> tuple[pa.Table, str]:
    """Images, condition images and event streams of some rows; the table that names them, and the streams' suffix."""
    frames, conditions, streams = opened["synthetic"], opened["conditions"], opened.get("event streams")
    table = frames.table.take(pa.array(rows))
    sample_ids = table["sample_id"].to_pylist()

    def names_in(kind: str, suffix: str = ".png") -> list[str]:
        return file_names(kind, sample_ids, rows.tolist(), suffix)

    columns = {name: table[name] for name in table.column_names if name in {c.name for c in IMAGES.columns}}
    columns["file_name"] = pa.array(names_in(IMAGES_FOLDER))
    images = frames.array("frames")
    _write_shards(partial, names_in(IMAGES_FOLDER), lambda n, path: _write_png(path, images[rows[n]]))
    if conditions.has_array("images"):
        pictures, asked = conditions.array("images"), _rows_of(conditions, table["condition_id"])
        columns["condition_file_name"] = pa.array(names_in(CONDITIONS_FOLDER))
        _write_shards(partial, names_in(CONDITIONS_FOLDER), lambda n, path: _write_png(path, pictures[asked[n]]))
    suffix = ""
    if streams is not None:
        of_rows = streams.table.take(pa.array(_rows_of(streams, table["sample_id"])))
        sources = of_rows["file"].to_pylist()
        suffix = Path(sources[0]).suffix
        files = _write_streams(streams, sources, names_in(EVENTS_FOLDER, suffix), partial)
        columns |= {own: of_rows[name] for name, own in EVENT_COLUMNS.items()} | {"events_file": pa.array(files)}
    columns["frames_digest"] = pa.array([frames.ref.digest] * len(rows))
    return pa.table({c.name: columns[c.name] for c in IMAGES.columns if c.name in columns}), suffix


def _rows_of(manifest: Manifest, sample_ids: pa.ChunkedArray) -> np.ndarray:
    """The row of each sample."""
    numbers = {sample_id: number for number, sample_id in enumerate(manifest.column("sample_id"))}
    try:
        return np.array([numbers[sample_id] for sample_id in sample_ids.to_pylist()], np.int64)
    except KeyError as error:
        raise DataError(f"{manifest.ref.path}: has no row for sample {error}; it belongs to other frames") from error


def _write_streams(streams: Manifest, sources: Sequence[str], names: list[str], partial: Path) -> list[str]:
    """Copy event files, those of several rows under the name of the first; where all streams lie in one file, that.
    Returns where each row's is.
    """
    distinct = list(dict.fromkeys(sources))
    if len(distinct) == 1 and len(sources) > 1:
        (partial / EVENTS_FOLDER).mkdir(exist_ok=True)
        shutil.copyfile(streams.path(distinct[0]), partial / EVENTS_FOLDER / Path(distinct[0]).name)
        return [f"{EVENTS_FOLDER}/{Path(distinct[0]).name}"] * len(sources)
    name_of: dict[str, str] = {}
    for source, name in zip(sources, names, strict=True):
        name_of.setdefault(source, name)
    _write_shards(partial, list(name_of.values()), lambda n, path: shutil.copyfile(streams.path(distinct[n]), path))
    return [name_of[source] for source in sources]


def _write_shards(partial: Path, names: Sequence[str], write: WriteFile) -> None:
    """Write a file for each name, sub-folder by sub-folder; those that an earlier run finished stay."""
    shards: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        shards.setdefault(name.rpartition("/")[0], []).append(number)
    kind = names[0].partition("/")[0]
    with ProgressBar(total=len(names), desc=f"export {kind}", unit="file") as progress:
        for shard, numbers in shards.items():
            place = partial / shard
            if not place.exists():
                temporary = place.with_name(f".{place.name}")
                shutil.rmtree(temporary, ignore_errors=True)
                temporary.mkdir(parents=True)
                for number in numbers:
                    write(number, temporary / Path(names[number]).name)
                os.sync()  # once for a thousand small files; after a power cut a finished sub-folder holds all of them
                temporary.rename(place)
            progress.update(len(numbers))


def _write_png(path: Path, image: np.ndarray) -> None:
    """[H, W, 3] uint8, RGB. Python writes the file, because its errors say when a disk is full."""
    _, encoded = cv2.imencode(".png", cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR))
    path.write_bytes(encoded.tobytes())
