"""N-MNIST: MNIST's digits on a monitor, before an ATIS camera that makes three saccades of about 100 ms.

Root and layout as published, or a folder of class folders of such files, called by digits or by words:

    N-MNIST/                      or      ROOT/
      Train/                                zero/
        0/                                    00002.bin
          00002.bin                           ...
          ...                               one/
      Test/                                 ...
        0/
          ...

A file is called by the number of its picture in MNIST, from 1, and nothing tells who wrote it, so that each recording
is its own subject. All have 34 x 34 px: the authors cut them out and stabilised them on the digit.

Splits are by recording and never change. Of each class, in the order of the numbers, the last `test_fraction` are
tested (in the published layout those of `Test` instead), those before for validation, and the rest are the pool, of
which `recordings_per_class` are drawn to learn from. `test_root` names other recordings to test on in their place.

Windows of the method `dataset` are the three saccades: thirds of the time from the first event to the last.

Source: Orchard et al., Converting Static Image Datasets to Spiking Neuromorphic Datasets Using Saccades, Frontiers in
Neuroscience 2015; https://www.garrickorchard.com/datasets/n-mnist. The validation split and the draws are ours.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from ctlev_core.dataset_files.trees import check_inside, check_name, check_root, list_files, list_folder, shuffled
from ctlev_core.events import files as event_files
from ctlev_core.events.windows import time_bins
from data_contracts.config import RUN_SETTING, Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize
from data_contracts.labels import Labels, Part, Recording

VERSION = 1

SENSOR: SensorSize = (34, 34)
NUM_SACCADES = 3
CLASSES = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
_TRAIN, _TEST = "Train", "Test"

EXPECTED_TREE = """expected N-MNIST as published, or class folders of its files:
  ROOT/Train/0/00002.bin ... and ROOT/Test/0/00004.bin ...
or
  ROOT/zero/00002.bin ... (or ROOT/0/00002.bin ...)"""


class Options(Frozen):
    """Options of N-MNIST."""

    root: Path = Field(json_schema_extra=RUN_SETTING, description="the folder of `Train` and `Test`, or class folders")
    test_root: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="folder of other recordings, all of which are tested in place of the root's own; null = none",
    )
    classes: tuple[str, ...] = Field(default=(), description="only these; empty = all that the root has")
    unseen: tuple[str, ...] = Field(
        default=(), description="classes that are tested, but neither learnt from nor validated on"
    )
    recordings_per_class: int | None = Field(
        default=None, ge=1, description="drawn from the pool to learn from; null = the whole pool"
    )
    draw: int = Field(default=0, ge=0, description="which random draw; the draw of 5 is part of that of 10")
    learn_from: Literal["drawn", "rest"] = Field(
        default="drawn", description="the recordings that are drawn, or the others of the pool"
    )
    tested: Literal["test", "validation"] = Field(
        default="test", description="what scores are of; options are chosen with `validation`"
    )
    test_fraction: float = Field(default=0.43, gt=0, lt=1, description="of each class; not of the published layout")
    validation_fraction: float = Field(default=0.15, gt=0, lt=1, description="of each class")

    @field_validator("classes", "unseen")
    @classmethod
    def _classes_are_digits(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        unknown = [name for name in names if name not in CLASSES]
        if unknown or len(set(names)) < len(names):
            raise ValueError(f"expected different ones of {', '.join(CLASSES)}, got {list(names)}")
        return names

    @model_validator(mode="after")
    def _something_is_left_to_learn_from(self) -> Options:
        if self.test_fraction + self.validation_fraction >= 1:
            raise ValueError("test_fraction and validation_fraction leave nothing to learn from")
        if self.learn_from == "rest" and self.recordings_per_class is None:
            raise ValueError("learn_from=rest needs recordings_per_class: without it nothing is left over")
        return self


def list_recordings(options: Options) -> list[Recording]:
    """Every recording of the splits that are used, by split and class; its id and subject are the path in its root.

    Last come label-only recordings `condition/<class>`, which say what is sampled.

    Raises:
        DataError: the tree is not as expected, a class has too few recordings, or fewer than are to be drawn.
    """
    pools = _pools(check_root(options.root, EXPECTED_TREE, _is_root), options)
    classes = [name for name in pools if not options.classes or name in options.classes]
    missing = [name for name in (*options.classes, *options.unseen) if name not in pools]
    if missing:
        raise DataError(f"{options.root}: no recordings of class {missing[0]!r}; there are: {', '.join(pools)}")
    given = None if options.test_root is None else _given(options.test_root)
    recordings = []
    for name in classes:
        pool, validation, test = pools[name]
        if name not in options.unseen:
            recordings += [_recording(file, "train", name, options.root) for file in _learnt(pool, name, options)]
        if options.tested == "validation":
            recordings += [_recording(file, "test", name, options.root) for file in validation]
        elif given is None:
            recordings += [_recording(file, "test", name, options.root) for file in test]
        else:
            recordings += given.get(name, [])
    recordings += [
        Recording(f"condition/{name}", f"condition/{name}", (Part("condition"),), name, has_events=False)
        for name in classes
    ]
    if not any(recording.parts[0].split == "test" for recording in recordings):
        raise DataError(f"{options.test_root}: no recordings of the classes {', '.join(classes)}")
    return recordings


def read_events(recording: Recording, options: Options) -> Events:
    """All events of the recording.

    Raises:
        DataError: the file cannot be read, holds no events, or events outside 34 x 34 px.
    """
    file = recording.files[0]
    events = event_files.read_events_file(file)
    if len(events) == 0:
        raise DataError(f"{file}: expected a recording, got a file without events")
    if events.sensor_size != SENSOR:
        width, height = events.sensor_size
        raise DataError(f"{file}: expected a recording of 34 x 34 px, got one of {width} x {height}; is it N-MNIST's?")
    return events


def read_windows(recording: Recording, options: Options) -> np.ndarray:
    """The three saccades, [3, 2] int64; fewer where one of them has no events."""
    t = read_events(recording, options).t
    ranges = time_bins(t, np.array([[0, len(t)]]), NUM_SACCADES)[0]
    return ranges[ranges[:, 1] > ranges[:, 0]]


def read_labels(recording: Recording, options: Options) -> Labels:
    """One row: the class, at time 0."""
    return Labels(class_names=(recording.class_name,), t_us=np.zeros(1, np.int64))


def class_name_of(folder: str) -> str | None:
    """The class of a folder called `7` or `seven`; None where it is called otherwise."""
    if folder.lower() in CLASSES:
        return folder.lower()
    return CLASSES[int(folder)] if folder.isdecimal() and len(folder) == 1 else None


def _is_root(folder: Path) -> bool:
    parent = folder / _TRAIN if (folder / _TRAIN).is_dir() else folder
    # Two classes, so that a folder which happens to be called like one is no root.
    return parent.is_dir() and sum(class_name_of(e.name) is not None and e.is_dir() for e in list_folder(parent)) >= 2


def _given(root: Path) -> dict[str, list[Recording]]:
    """Recordings of `test_root` by class: of class folders, or of all parts of the published layout."""
    check_root(root, EXPECTED_TREE, _is_root)
    found: dict[str, list[Recording]] = {}
    for parent in [root / part for part in (_TRAIN, _TEST) if (root / part).is_dir()] or [root]:
        for name, files in _files_in(parent, root).items():
            for file in files:
                recording = _recording(file, "test", name, root)
                # Its root may use the same names for other recordings.
                identity = f"test_root/{recording.recording_id}"
                found.setdefault(name, []).append(replace(recording, recording_id=identity, subject=identity))
    return found


def _files_in(parent: Path, root: Path) -> dict[str, list[Path]]:
    found: dict[str, list[Path]] = {}
    for entry in list_folder(parent):
        name = class_name_of(entry.name)
        if not entry.is_dir() or name is None:
            continue
        if name in found:
            raise DataError(f"{entry}: a second folder of class {name!r}; {EXPECTED_TREE}")
        found[name] = sorted(list_files(check_inside(entry, root), root, ".bin"), key=_number)
    return {name: found[name] for name in CLASSES if name in found}


def _number(file: Path) -> tuple[int, str]:
    return (int(file.stem), file.stem) if file.stem.isdecimal() else (10**12, file.stem)


def _pools(root: Path, options: Options) -> dict[str, tuple[list[Path], list[Path], list[Path]]]:
    """Pool, validation and test files of each class."""
    is_published = (root / _TRAIN).is_dir()
    if is_published and not (root / _TEST).is_dir():
        raise DataError(f"{root}: {_TRAIN} without {_TEST}; {EXPECTED_TREE}")
    tested = _files_in(root / _TEST, root) if is_published else {}
    pools = {}
    for name, files in _files_in(root / _TRAIN if is_published else root, root).items():
        num_test = 0 if is_published else max(round(options.test_fraction * len(files)), 1)
        num_validation = max(round(options.validation_fraction * len(files)), 1)
        num_pool = len(files) - num_test - num_validation
        if num_pool < 1:
            raise DataError(
                f"{files[0].parent}: {len(files)} recordings of class {name!r} are too few for the splits "
                f"to learn from, validation and test; {num_test + num_validation + 1} are needed"
            )
        test = tested.get(name, []) if is_published else files[num_pool + num_validation :]
        pools[name] = files[:num_pool], files[num_pool : num_pool + num_validation], test
    return pools


def _learnt(pool: list[Path], name: str, options: Options) -> list[Path]:
    wanted = options.recordings_per_class
    if wanted is None:
        return pool
    if wanted > len(pool):
        raise DataError(
            f"{pool[0].parent}: recordings_per_class is {wanted}, and class {name!r} has {len(pool)} to learn from"
        )
    by_name = {check_name(file): file for file in pool}
    drawn = set(shuffled(by_name, options.draw, "nmnist", name)[:wanted])
    return [file for key, file in by_name.items() if (key in drawn) == (options.learn_from == "drawn")]


def _recording(file: Path, split: str, name: str, root: Path) -> Recording:
    identity = "/".join([*file.parent.relative_to(root).parts, check_name(file)])
    return Recording(identity, identity, (Part(split),), name, SENSOR, files=(file,))
