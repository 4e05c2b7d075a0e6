"""A folder of your own recordings, one sub-folder a class.

    root/
      person/
        walk_01.aedat4
        walk_02.raw
      spot/
        laser.parquet

Any format of `ctlev_core/formats` will do; the content decides, not the suffix. Hidden files and folders are ignored,
and so are files beside the class folders that are no recordings (a README).
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from ctlev_core.dataset_files.trees import recording_ids
from ctlev_core.events import files as event_files
from data_contracts.config import RUN_SETTING, Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import Labels, Part, Recording

VERSION = 1

EXPECTED_TREE = """expected one folder a class with at least one recording each:
  ROOT/
    person/
      walk_01.aedat4
      walk_02.raw
    spot/
      laser.parquet"""


class Options(Frozen):
    """Options of the folder dataset."""

    root: Path = Field(json_schema_extra=RUN_SETTING, description="the folder that holds the class folders")
    split: Literal["time", "recording"] = Field(
        default="time",
        description="`time`: the last part of every recording is for testing; `recording`: whole recordings are, and "
        "every class needs two",
    )
    test_fraction: float = Field(
        default=0.3, gt=0, lt=1, description="of the events of a recording, or of the recordings"
    )


def list_recordings(options: Options) -> list[Recording]:
    """Every recording, sorted by class and name; its id and subject are `<class>/<file name without suffix>`.

    Names are free; in ids, blanks and letters of other alphabets are written as `recording_ids` does.

    Raises:
        DataError: the tree is not as expected; the message says where and shows it.
    """
    root = options.root
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; {EXPECTED_TREE}")
    found: list[tuple[str, Path, tuple[Part, ...]]] = []
    for class_folder in _class_folders(root):
        files = _recording_files(root, class_folder)
        if options.split == "time":
            boundary = 1 - options.test_fraction
            parts = [(Part("train", 0.0, boundary), Part("test", boundary, 1.0))] * len(files)
        else:
            parts = _split_by_recording(files, options.test_fraction)
        # What looks the same is the same class, however a file system composes its accents.
        class_name = unicodedata.normalize("NFC", class_folder.name)
        for file, parts_of_file in zip(files, parts, strict=True):
            found.append((class_name, file, parts_of_file))
    names = recording_ids([file for _, file, _ in found], root)
    return [
        Recording(name, name, parts, class_name, files=(file,))
        for name, (class_name, file, parts) in zip(names, found, strict=True)
    ]


def read_events(recording: Recording, options: Options) -> Events:
    """All events of the recording's file, of every part.

    Raises:
        DataError: the file cannot be read, or holds no events.
    """
    file = recording.files[0]
    events = event_files.read_events_file(file)
    if len(events) == 0:
        raise DataError(f"{file}: expected a recording, got a file without events")
    return events


def read_event_chunks(recording: Recording, options: Options) -> Iterator[Events]:
    """The events of `read_events` chunk by chunk, so that a recording may be larger than memory.

    Raises:
        DataError: the file cannot be read.
    """
    return event_files.read_event_chunks(recording.files[0])


def read_labels(recording: Recording, options: Options) -> Labels:
    """One row: the class, which holds for the whole recording, at time 0."""
    return Labels(class_names=(recording.class_name,), t_us=np.zeros(1, np.int64))


def _class_folders(root: Path) -> list[Path]:
    folders = []
    for entry in _visible_entries(root, root):
        if entry.is_dir():
            folders.append(entry)
        elif _is_recording(entry):
            raise DataError(f"{entry}: a recording outside a class folder; {EXPECTED_TREE}")
    if not folders:
        raise DataError(f"{root}: no class folders; {EXPECTED_TREE}")
    return folders


def _recording_files(root: Path, class_folder: Path) -> list[Path]:
    by_stem: dict[str, Path] = {}
    for file in _visible_entries(root, class_folder):
        if file.is_dir():
            raise DataError(f"{file}: a folder inside a class folder; {EXPECTED_TREE}")
        event_files.find_format(file)
        if file.stem in by_stem:
            raise DataError(
                f"{file}: has the name of {by_stem[file.stem].name}; recordings of a class need their own names"
            )
        by_stem[file.stem] = file
    if not by_stem:
        raise DataError(f"{class_folder}: a class folder without recordings; {EXPECTED_TREE}")
    return list(by_stem.values())


def _visible_entries(root: Path, folder: Path) -> Iterator[Path]:
    """Sorted entries that are not hidden. A link out of the root is refused: a dataset is what lies in its folder."""
    for entry in sorted(folder.iterdir()):
        if entry.name.startswith("."):
            continue
        if not entry.exists():
            raise DataError(f"{entry}: a link to nothing")
        if not entry.resolve().is_relative_to(root.resolve()):
            raise DataError(f"{entry}: links to {entry.resolve()}, outside the dataset folder {root}")
        if not entry.name.isprintable():
            raise DataError(f"{str(entry)!r}: expected a name of printable characters")
        yield entry


def _is_recording(file: Path) -> bool:
    try:
        event_files.find_format(file)
    except DataError:
        return False
    return True


def _split_by_recording(files: list[Path], test_fraction: float) -> list[tuple[Part, ...]]:
    """The last files by name are for testing: at least one, and never all."""
    if len(files) < 2:
        raise DataError(
            f"{files[0].parent}: split 'recording' needs two recordings a class, got one ({files[0].name}); "
            "add another, or use split 'time'"
        )
    num_test = min(max(round(len(files) * test_fraction), 1), len(files) - 1)
    return [(Part("train"),)] * (len(files) - num_test) + [(Part("test"),)] * num_test
