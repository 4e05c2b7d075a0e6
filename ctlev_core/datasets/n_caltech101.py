"""N-Caltech101: the Caltech101 pictures on a monitor, before a moving ATIS camera.

Root and layout as published, one 40-bit ATIS file a picture; the folder `Annotations` (outlines) may lie beside:

    Caltech101/
      accordion/
        image_0001.bin
      ...

The authors left out Caltech101's class `Faces`, so there are 100 objects and `BACKGROUND_Google`, pictures of nothing
in particular, which is left out unless `background` asks for it: it has no name to make a prompt of.

Splits: there is no official one. As is usual, each class is shuffled and split by fractions, here with a seed and a
quarter for testing; numbers in papers stem from other random splits. The split that came with EST (folders
`training`, `validation`, `testing` of .npy files) is used as it is where the root has it. A picture has no subject, so
each recording is its own.

Sensor: of the ATIS's 304 x 240 px the pictures fill 240 x 180 px at most, each as much as its shape allows, and a file
does not say how much. `field` has all recordings on 240 x 180 px, as EST and EventCLIP do; `extent` cuts each recording
to the box of its events, as tonic does.

Source: Orchard et al., Converting Static Image Datasets to Spiking Neuromorphic Datasets Using Saccades, Frontiers in
Neuroscience 2015; Gehrig et al., End-to-End Learning of Representations for Asynchronous Event-Based Data, ICCV 2019
(github.com/uzh-rpg/rpg_event_representation_learning); github.com/Wuziyi616/EventCLIP `datasets/caltech.py` (size,
names); ControlEvents, supplementary material, table 5 (the ten classes of `ZERO_SHOT`).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from ctlev_core.dataset_files.trees import (
    check_inside,
    check_name,
    check_root,
    first_of,
    list_files,
    list_folder,
    shuffled,
)
from ctlev_core.events import files as event_files
from data_contracts.config import RUN_SETTING, Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize, check_events
from data_contracts.labels import Labels, Part, Recording

VERSION = 2

FIELD: SensorSize = (240, 180)
MAX_OUTSIDE = 0.01
"""Share of events outside `FIELD` above which a file is no recording of this dataset."""

BACKGROUND = "BACKGROUND_Google"
_CLASS_FOLDERS = """
    accordion airplanes anchor ant barrel bass beaver binocular bonsai brain brontosaurus buddha butterfly camera
    cannon car_side ceiling_fan cellphone chair chandelier cougar_body cougar_face crab crayfish crocodile
    crocodile_head cup dalmatian dollar_bill dolphin dragonfly electric_guitar elephant emu euphonium ewer Faces
    Faces_easy ferry flamingo flamingo_head garfield gerenuk gramophone grand_piano hawksbill headphone hedgehog
    helicopter ibis inline_skate joshua_tree kangaroo ketch lamp laptop Leopards llama lobster lotus mandolin mayfly
    menorah metronome minaret Motorbikes nautilus octopus okapi pagoda panda pigeon pizza platypus pyramid revolver
    rhino rooster saxophone schooner scissors scorpion sea_horse snoopy soccer_ball stapler starfish stegosaurus
    stop_sign strawberry sunflower tick trilobite umbrella watch water_lilly wheelchair wild_cat windsor_chair wrench
    yin_yang"""
CLASSES = tuple(_CLASS_FOLDERS.split())
"""Folder names of Caltech101; `Faces` is not in N-Caltech101."""

ZERO_SHOT = (
    "bonsai",
    "ceiling_fan",
    "ferry",
    "joshua_tree",
    "minaret",
    "pagoda",
    "sunflower",
    "water_lilly",
    "windsor_chair",
    "chandelier",
)
"""The classes of ControlEvents' table 5, in its order (and in its, and Caltech101's, spelling)."""

# Where the folder's name is no name for what a picture shows; as CoOp and EventCLIP rename them.
_NAMES = {
    "airplanes": "airplane",
    "Faces": "full face",
    "Faces_easy": "face",
    "Leopards": "leopard",
    "Motorbikes": "motorbike",
    "car_side": "side of a car",
    BACKGROUND: "background",
}
_SPLIT_FOLDERS = {"train": "training", "validation": "validation", "test": "testing"}

EXPECTED_TREE = """expected the unpacked Caltech101.zip of N-Caltech101:
  ROOT/
    accordion/
      image_0001.bin
      ...
    airplanes/
    ...
    yin_yang/
(or EST's N-Caltech101.zip: ROOT/training, ROOT/validation and ROOT/testing with such class folders of .npy files)"""


class Options(Frozen):
    """Options of N-Caltech101."""

    root: Path = Field(json_schema_extra=RUN_SETTING, description="the folder that holds the class folders")
    classes: tuple[str, ...] = Field(default=(), description="only these; folder names or class names; empty = all")
    background: bool = Field(default=False, description="with the class of pictures of nothing in particular")
    zero_shot: bool = Field(
        default=False,
        description="the ten classes of ControlEvents' table 5 are neither learnt from nor validated on, only they are "
        "tested, and they are what is sampled",
    )
    test_fraction: float = Field(default=0.25, ge=0, lt=1, description="of each class's recordings")
    validation_fraction: float = Field(default=0.0, ge=0, lt=1, description="of each class's recordings")
    images_per_class: int | None = Field(default=None, ge=1, description="at most so many to learn from; None = all")
    test_images_per_class: int | None = Field(default=None, ge=1, description="at most so many to test; None = all")
    seed: int = Field(default=0, ge=0, description="of the split")
    sensor: Literal["field", "extent"] = Field(
        default="field", description="240 x 180 px for all, or the box of the events of each recording"
    )

    @model_validator(mode="after")
    def _something_is_left_to_learn_from(self) -> Options:
        if self.test_fraction + self.validation_fraction >= 1:
            raise ValueError("test_fraction and validation_fraction leave nothing to learn from")
        return self


def class_name_of(folder: str) -> str:
    """The readable name of a class folder: `crocodile_head` is `crocodile head`."""
    return _NAMES.get(folder, folder.replace("_", " "))


def list_recordings(options: Options) -> list[Recording]:
    """Every chosen recording, sorted by class and name; its id and subject are the path in the root.

    Last come label-only recordings `condition/<class folder>`, which say what is sampled: one for each class, with
    `zero_shot` for each of the ten.

    Raises:
        DataError: the tree is not as expected; the message says where and shows it. An unknown class.
    """
    root = check_root(options.root, EXPECTED_TREE, _is_root)
    by_split = _files_of_est(root, options) if _is_est(root) else _files_of_published(root, options)
    wanted = _wanted_classes({folder for files in by_split.values() for folder in files}, options)
    limits = {"train": options.images_per_class, "test": options.test_images_per_class}
    recordings = []
    for folder in wanted:
        for split, files in by_split.items():
            if options.zero_shot and (split == "test") != (folder in ZERO_SHOT):
                continue
            for file in sorted(first_of(files.get(folder, []), limits.get(split))):
                recordings.append(_recording(folder, split, file, options))
    for folder in wanted:
        if folder in ZERO_SHOT or not options.zero_shot:
            name = f"condition/{folder}"
            recordings.append(Recording(name, name, (Part("condition"),), class_name_of(folder), has_events=False))
    return recordings


def _recording(folder: str, split: str, file: Path, options: Options) -> Recording:
    recording_id = "/".join([*file.parent.relative_to(options.root).parts, check_name(file)])
    size = FIELD if options.sensor == "field" else None
    return Recording(recording_id, recording_id, (Part(split),), class_name_of(folder), size, files=(file,))


def read_events(recording: Recording, options: Options) -> Events:
    """All events of the recording, on the sensor that `options.sensor` says.

    Raises:
        DataError: the file cannot be read, holds no events, or, with `field`, has more than one event in a hundred
            outside 240 x 180 px; fewer are dropped.
    """
    file = recording.files[0]
    events = event_files.read_events_file(file)
    if len(events) == 0:
        raise DataError(f"{file}: expected a recording, got a file without events")
    if options.sensor == "extent":
        x, y = events.x - events.x.min(), events.y - events.y.min()
        return check_events(replace(events, x=x, y=y, sensor_size=(int(x.max()) + 1, int(y.max()) + 1)), str(file))
    inside = (events.x < FIELD[0]) & (events.y < FIELD[1])
    outside = len(events) - int(inside.sum())
    if outside > MAX_OUTSIDE * len(events):
        raise DataError(
            f"{file}: expected events within {FIELD[0]} x {FIELD[1]} px, got {outside} of {len(events)} outside; "
            "is this a recording of N-Caltech101? (option sensor=extent takes any)"
        )
    if outside:
        events = Events(events.t[inside], events.x[inside], events.y[inside], events.p[inside], FIELD)
    return check_events(replace(events, sensor_size=FIELD), str(file))


def read_labels(recording: Recording, options: Options) -> Labels:
    """One row: the class, at time 0."""
    return Labels(class_names=(recording.class_name,), t_us=np.zeros(1, np.int64))


def _is_est(root: Path) -> bool:
    return (root / _SPLIT_FOLDERS["train"]).is_dir() and (root / _SPLIT_FOLDERS["test"]).is_dir()


def _is_root(folder: Path) -> bool:
    # Two classes, so that a folder which happens to be called like one is no root.
    known = sum((folder / name).is_dir() for name in (*CLASSES, BACKGROUND))
    return (known >= 2 and folder.name not in _SPLIT_FOLDERS.values()) or _is_est(folder)


def _class_folders(parent: Path, root: Path) -> dict[str, Path]:
    folders = {}
    for entry in list_folder(parent):
        if not entry.is_dir() or "annotations" in entry.name.lower():
            continue
        if entry.name not in (*CLASSES, BACKGROUND):
            raise DataError(f"{entry}: {entry.name!r} is no class of N-Caltech101; {EXPECTED_TREE}")
        folders[entry.name] = check_inside(entry, root)
    return folders


def _files_of_published(root: Path, options: Options) -> dict[str, dict[str, list[Path]]]:
    """Split -> class folder -> files, in the random order of the split."""
    by_split: dict[str, dict[str, list[Path]]] = {split: {} for split in _SPLIT_FOLDERS}
    for name, folder in _class_folders(root, root).items():
        files = _shuffled_files(folder, root, ".bin", options)
        num_test, num_validation = _split_sizes(folder, len(files), options)
        by_split["test"][name] = files[:num_test]
        by_split["validation"][name] = files[num_test : num_test + num_validation]
        by_split["train"][name] = files[num_test + num_validation :]
    return by_split


def _split_sizes(folder: Path, count: int, options: Options) -> tuple[int, int]:
    """How many of a class's recordings test and validate: at least one each where asked for, and never all."""
    sizes = [
        round(f * count) if f == 0 else max(round(f * count), 1)
        for f in (options.test_fraction, options.validation_fraction)
    ]
    if sum(sizes) >= count:
        raise DataError(f"{folder}: {count} recordings are too few to split; {sum(sizes) + 1} are needed")
    return sizes[0], sizes[1]


def _files_of_est(root: Path, options: Options) -> dict[str, dict[str, list[Path]]]:
    """Split -> class folder -> files, as EST split them, in random order."""
    return {
        split: {
            name: _shuffled_files(path, root, ".npy", options) for name, path in _class_folders(parent, root).items()
        }
        for split, parent in ((split, root / folder) for split, folder in _SPLIT_FOLDERS.items())
        if parent.is_dir()
    }


def _shuffled_files(folder: Path, root: Path, suffix: str, options: Options) -> list[Path]:
    names = [file.name for file in list_files(folder, root, suffix)]
    return [folder / name for name in shuffled(names, options.seed, "n_caltech101", folder.name)]


def _wanted_classes(present: set[str], options: Options) -> list[str]:
    by_name = {class_name_of(folder): folder for folder in present} | {folder: folder for folder in present}
    unknown = [name for name in options.classes if name not in by_name]
    if unknown:
        raise DataError(f"{options.root}: no class {unknown[0]!r}; there are: {', '.join(sorted(present))}")
    wanted = {by_name[name] for name in options.classes} or (present if options.background else present - {BACKGROUND})
    if options.zero_shot and (not wanted & set(ZERO_SHOT) or not wanted - set(ZERO_SHOT)):
        raise DataError(
            f"{options.root}: zero_shot needs classes to learn from and some of {', '.join(ZERO_SHOT)}; "
            f"there are: {', '.join(sorted(wanted))}"
        )
    return sorted(wanted)
