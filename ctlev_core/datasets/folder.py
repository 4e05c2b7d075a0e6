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
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from ctlev_core.dataset_files.trees import recording_ids
from ctlev_core.events import files as event_files
from data_contracts.config import ADDED_LATER, RUN_SETTING, Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events, check_events
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
    validation_fraction: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        json_schema_extra=ADDED_LATER,
        description="the same, before what is tested: to choose options by (`evaluate_on: validation`)",
    )
    sensor_size: tuple[int, int] | None = Field(
        default=None,
        json_schema_extra=ADDED_LATER,
        description="(width, height) px of the camera of all recordings; null = as each file says, or the smallest "
        "common size that holds its events, which may differ from file to file",
    )

    @model_validator(mode="after")
    def _something_is_learnt_from(self) -> Options:
        if self.test_fraction + self.validation_fraction >= 1:
            raise ValueError("test_fraction and validation_fraction leave nothing to learn from")
        return self


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
            parts = [_split_in_time(options)] * len(files)
        else:
            parts = _split_by_recording(files, options)
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
    return _on_sensor(events, file, options)


def read_event_chunks(recording: Recording, options: Options) -> Iterator[Events]:
    """The events of `read_events` chunk by chunk, so that a recording may be larger than memory.

    Raises:
        DataError: the file cannot be read.
    """
    file = recording.files[0]
    for chunk in event_files.read_event_chunks(file):
        yield _on_sensor(chunk, file, options)


def _on_sensor(events: Events, file: Path, options: Options) -> Events:
    """The events on the sensor that was named."""
    if options.sensor_size is None:
        return events
    return check_events(replace(events, sensor_size=options.sensor_size), f"{file}, on the sensor_size that was set")


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


def _split_in_time(options: Options) -> tuple[Part, ...]:
    tested = 1 - options.test_fraction
    learnt = tested - options.validation_fraction
    validated = (Part("validation", learnt, tested),) if learnt < tested else ()
    return (Part("train", 0.0, learnt), *validated, Part("test", tested, 1.0))


def _split_by_recording(files: list[Path], options: Options) -> list[tuple[Part, ...]]:
    """The last files by name are for testing, those before for validation: at least one each, and never all."""
    least = 3 if options.validation_fraction else 2
    if len(files) < least:
        word = "three" if least == 3 else "two"
        got = f"one ({files[0].name})" if len(files) == 1 else str(len(files))
        raise DataError(
            f"{files[0].parent}: split 'recording' needs {word} recordings a class, got {got}; "
            "add another, or use split 'time'"
        )
    num_test = min(max(round(len(files) * options.test_fraction), 1), len(files) - least + 1)
    num_validation = 0
    if options.validation_fraction:
        num_validation = min(max(round(len(files) * options.validation_fraction), 1), len(files) - num_test - 1)
    num_train = len(files) - num_test - num_validation
    return [(Part("train"),)] * num_train + [(Part("validation"),)] * num_validation + [(Part("test"),)] * num_test
