"""N-ImageNet: the ImageNet pictures on a monitor, before a moving 640 x 480 px camera; 1,000 classes.

Layout as published; the lists, with one path a line, say which files belong to the splits, and without a list the
folder does. Their paths are those of the authors' machine: the last three parts count, so the lists need no editing.

    N_Imagenet/
      train_list.txt
      val_list.txt
      LOC_synset_mapping.txt      (not of N-ImageNet: see below)
      extracted_train/
        n01440764/
          n01440764_10026.npz
      extracted_val/
        n01440764/
          ILSVRC2012_val_00000293.npz

Classes are WordNet ids; their English names come from a file that every ImageNet user has, `LOC_synset_mapping.txt`
(of ImageNet's object localization challenge on Kaggle), `synset_words.txt` or WordNet's `words.txt`: an id, then names
with commas between. The class name is the first of them, with the id behind where two classes share it (`crane` is a
bird and a machine); `read_synonyms` has them all.

Splits: training files are `train`, validation files are `test`, as the authors evaluate. A picture has no subject, so
each recording is its own.

Source: Kim et al., N-ImageNet, ICCV 2021 (github.com/82magnolia/n_imagenet: README and
`real_cnn_model/data/imagenet.py`); ControlEvents, section 4.1: 100 pictures a class to learn from.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field, model_validator

from ctlev_core.dataset_files.trees import (
    check_inside,
    check_root,
    first_of,
    list_files,
    list_folder,
    read_lines,
    shuffled,
)
from ctlev_core.events import files as event_files
from data_contracts.config import ADDED_LATER, RUN_SETTING, Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize, check_events
from data_contracts.labels import Labels, Part, Recording

VERSION = 1

SENSOR_SIZE: SensorSize = (640, 480)
FOLDERS = {"train": "extracted_train", "test": "extracted_val"}
LISTS = {"train": "train_list.txt", "test": "val_list.txt"}
NAME_FILES = ("LOC_synset_mapping.txt", "synset_words.txt", "words.txt")
_WORDNET_ID = re.compile(r"n\d{8}")
_FILE_NAME = re.compile(r"[A-Za-z0-9._-]+\.npz")

EXPECTED_TREE = """expected the unpacked N_ImageNet.7z:
  ROOT/
    train_list.txt
    val_list.txt
    LOC_synset_mapping.txt    (class names, from ImageNet)
    extracted_train/
      n01440764/
        n01440764_10026.npz
    extracted_val/
      n01440764/
        ILSVRC2012_val_00000293.npz"""


class Options(Frozen):
    """Options of N-ImageNet. The defaults are what ControlEvents learns from."""

    root: Path = Field(json_schema_extra=RUN_SETTING, description="the folder that holds extracted_train")
    names_file: Path | None = Field(
        default=None, json_schema_extra=RUN_SETTING, description="WordNet ids and names, where it is not in the root"
    )
    classes: tuple[str, ...] = Field(default=(), description="only these; WordNet ids or class names; empty = all")
    images_per_class: int | None = Field(default=100, ge=1, description="to learn from; None = all (about 1,280)")
    test_images_per_class: int | None = Field(default=None, ge=1, description="to test; None = all 50")
    validation_images_per_class: int = Field(
        default=0,
        ge=0,
        json_schema_extra=ADDED_LATER,
        description="further training files, to choose options by (`evaluate_on: validation`)",
    )
    seed: int = Field(default=0, ge=0, description="decides which pictures are taken")

    @model_validator(mode="after")
    def _files_are_left(self) -> Options:
        if self.validation_images_per_class and self.images_per_class is None:
            raise ValueError("validation_images_per_class takes training files, of which images_per_class takes all")
        return self


def list_recordings(options: Options) -> list[Recording]:
    """The chosen recordings, sorted by folder, class, split and file; id and subject are `<split>/<WordNet id>/<file>`.

    Raises:
        DataError: the tree is not as expected (the message says where and shows it), no names, an unknown class, a
            class that is only in one split, or a chosen file that is listed but not there.
    """
    root = check_root(options.root, EXPECTED_TREE, _is_root)
    names_file, names = _read_names(options)
    names_of_files = {split: _files_by_class(root, split) for split in FOLDERS}
    class_names = _class_names(names_of_files, names, names_file)
    wanted = _wanted_classes(class_names, options)
    recordings = []
    for split, limit in (("train", options.images_per_class), ("test", options.test_images_per_class)):
        missing = [wordnet_id for wordnet_id in wanted if wordnet_id not in names_of_files[split]]
        if missing:
            raise DataError(f"{root / FOLDERS[split]}: lacks class {missing[0]}, which the other split has")
        for wordnet_id in wanted:
            candidates = shuffled(names_of_files[split][wordnet_id], options.seed, "n_imagenet", split, wordnet_id)
            chosen = [(split, name) for name in sorted(first_of(candidates, limit))]
            if split == "train":
                others = candidates[len(chosen) : len(chosen) + options.validation_images_per_class]
                chosen += [("validation", name) for name in sorted(others)]
            for own, name in chosen:
                file = _check_there(root / FOLDERS[split] / wordnet_id / name, root, split)
                recording_id = f"{own}/{wordnet_id}/{file.stem}"
                parts, class_name = (Part(own),), class_names[wordnet_id]
                # The names are part of what the recordings are made of, so their file is as well.
                sources = (file, names_file)
                recordings.append(Recording(recording_id, recording_id, parts, class_name, SENSOR_SIZE, files=sources))
    return recordings


def read_events(recording: Recording, options: Options) -> Events:
    """All events of one picture, 640 x 480 px.

    Raises:
        DataError: the file cannot be read, holds no events, or one outside the sensor.
    """
    file = recording.files[0]
    events = event_files.read_events_file(file)
    if len(events) == 0:
        raise DataError(f"{file}: expected a recording, got a file without events")
    return check_events(replace(events, sensor_size=SENSOR_SIZE), str(file))


def read_labels(recording: Recording, options: Options) -> Labels:
    """One row: the class, at time 0."""
    return Labels(class_names=(recording.class_name,), t_us=np.zeros(1, np.int64))


def read_synonyms(options: Options) -> dict[str, list[str]]:
    """Names to draw from, by class name, of the chosen classes: WordNet's lemmas, typically two to five.

    Raises:
        DataError: as `list_recordings`.
    """
    root = check_root(options.root, EXPECTED_TREE, _is_root)
    names_file, names = _read_names(options)
    class_names = _class_names({split: _files_by_class(root, split) for split in FOLDERS}, names, names_file)
    return {class_names[wordnet_id]: names[wordnet_id] for wordnet_id in _wanted_classes(class_names, options)}


def _is_root(folder: Path) -> bool:
    return any((folder / name).is_dir() for name in FOLDERS.values())


def _files_by_class(root: Path, split: str) -> dict[str, list[str]]:
    """WordNet id -> names of the files of a split, sorted; from its list where there is one."""
    folder, list_file = root / FOLDERS[split], root / LISTS[split]
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; {EXPECTED_TREE}")
    if list_file.is_file():
        return _listed_files(list_file, FOLDERS[split])
    by_class = {}
    for entry in list_folder(folder):
        if entry.is_dir() and _WORDNET_ID.fullmatch(entry.name):
            by_class[entry.name] = [file.name for file in list_files(check_inside(entry, root), root, ".npz")]
        elif entry.is_dir() or entry.suffix == ".npz":
            raise DataError(f"{entry}: expected folders named by WordNet ids, n and eight digits; {EXPECTED_TREE}")
    if not by_class:
        raise DataError(f"{folder}: no class folders; {EXPECTED_TREE}")
    return by_class


def _listed_files(list_file: Path, folder: str) -> dict[str, list[str]]:
    # Names, not paths: there are 1.3 million of them.
    by_class: dict[str, set[str]] = {}
    for number, line in read_lines(list_file):
        parts = line.replace("\\", "/").rsplit("/", 3)
        as_expected = len(parts) >= 3 and parts[-3] == folder and _WORDNET_ID.fullmatch(parts[-2])
        if not as_expected or not _FILE_NAME.fullmatch(parts[-1]):
            raise DataError(
                f"{list_file}: line {number}: expected a path that ends in {folder}/nXXXXXXXX/*.npz, got {line!r}"
            )
        names = by_class.setdefault(parts[-2], set())
        if parts[-1] in names:
            raise DataError(f"{list_file}: line {number}: {parts[-2]}/{parts[-1]} is listed twice")
        names.add(parts[-1])
    if not by_class:
        raise DataError(f"{list_file}: the list is empty")
    return {wordnet_id: sorted(names) for wordnet_id, names in sorted(by_class.items())}


def _check_there(file: Path, root: Path, split: str) -> Path:
    if not file.is_file():
        raise DataError(
            f"{file}: not there, though {LISTS[split]} has it; name the classes you have in dataset.options.classes, "
            f"or move {LISTS[split]} away to use what the folders hold"
        )
    return check_inside(file, root)


def _read_names(options: Options) -> tuple[Path, dict[str, list[str]]]:
    """The file of names, and the names by WordNet id."""
    candidates = [options.names_file] if options.names_file else [options.root / name for name in NAME_FILES]
    file = next((candidate for candidate in candidates if candidate.is_file()), None)
    if file is None:
        raise DataError(
            f"{candidates[0]}: no names of the classes; put LOC_synset_mapping.txt there, a file of ImageNet's object "
            "localization challenge (www.kaggle.com/c/imagenet-object-localization-challenge/data, accept its terms), "
            "or name a file of that form (`n01440764 tench, Tinca tinca` a line) in dataset.options.names_file"
        )
    names: dict[str, list[str]] = {}
    for number, line in read_lines(file):
        wordnet_id, _, rest = line.replace("\t", " ", 1).partition(" ")
        lemmas = [name.strip() for name in rest.split(",") if name.strip()]
        if not _WORDNET_ID.fullmatch(wordnet_id) or not lemmas:
            raise DataError(f"{file}: line {number}: expected `n01440764 tench, Tinca tinca`, got {line!r}")
        if wordnet_id in names:
            raise DataError(f"{file}: line {number}: {wordnet_id} is named twice")
        names[wordnet_id] = list(dict.fromkeys(lemmas))
    return file, names


def _class_names(
    files: dict[str, dict[str, list[str]]], names: dict[str, list[str]], names_file: Path
) -> dict[str, str]:
    """WordNet id -> class name, of every class on disk: unique, also where lower and upper case are not told apart."""
    present = sorted({wordnet_id for by_class in files.values() for wordnet_id in by_class})
    nameless = [wordnet_id for wordnet_id in present if wordnet_id not in names]
    if nameless:
        raise DataError(f"{names_file}: no name for class {nameless[0]} (and {len(nameless) - 1} more)")
    first = [names[wordnet_id][0].lower() for wordnet_id in present]
    shared = {name for name in first if first.count(name) > 1}
    return {
        wordnet_id: f"{names[wordnet_id][0]} ({wordnet_id})" if lower in shared else names[wordnet_id][0]
        for wordnet_id, lower in zip(present, first, strict=True)
    }


def _wanted_classes(class_names: dict[str, str], options: Options) -> list[str]:
    ids = {name: wordnet_id for wordnet_id, name in class_names.items()} | {key: key for key in class_names}
    unknown = [name for name in options.classes if name not in ids]
    if unknown:
        raise DataError(
            f"{options.root}: no class {unknown[0]!r} among {len(class_names)} such as "
            f"{' or '.join(next(iter(class_names.items())))}; give WordNet ids or first names"
        )
    return sorted({ids[name] for name in options.classes} or class_names)
