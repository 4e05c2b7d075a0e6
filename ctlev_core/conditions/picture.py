"""A picture of the labelled class, out of the user's own labelled pictures: the condition of generators that record
one.

Source: Orchard et al., Converting Static Image Datasets to Spiking Neuromorphic Datasets Using Saccades, Frontiers in
Neuroscience 2015: each recording is of one labelled picture.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from pydantic import Field

from ctlev_core.pictures.labelled_pictures import LabelledPictures, PictureSource, open_pictures, picture_files
from data_contracts.errors import DataError
from data_contracts.labels import Conditions, Labels

VERSION = 2
NEEDS = ""
WHERE = "condition 'picture'"
PLACEHOLDER = "{class_name}"


class Options(PictureSource):
    """Which pictures, and how large they are handed on."""

    prompt: str = Field(default="A photo of {class_name}", description="the prompt; {class_name} stands for the class")
    size: int | None = Field(
        default=None,
        ge=1,
        description="side of the square that a picture is fitted into, px; null = the longer side of pictures that "
        "come in one array, and of files that of an event image",
    )


def input_files(options: Options) -> list[Path]:
    """The folder or file of the pictures; its content enters the cache key.

    Raises:
        DataError: none is named, or it is none of the layouts of `ctlev_core.pictures.labelled_pictures`.
    """
    _open(options)
    return picture_files(options)


def check_classes(class_names: Iterable[str], options: Options) -> None:
    """Raise `DataError` where no picture shows one of the classes; asked before an experiment starts."""
    _check_classes(class_names, set(_open(options).names), options)


def render(labels: Labels, image_size: tuple[int, int], options: Options, seeds: Sequence[int]) -> Conditions:
    """One picture a row, chosen at random among those of its class.

    Args:
        labels: N rows with class names.
        image_size: (width, height) px of an event image; only its longer side, and only for pictures in files.
        options: see `Options`.
        seeds: N integers; class and seed i alone decide which picture row i gets.
    Returns:
        N conditions with images [N, S, S, 3] uint8, the pictures whole, the rest in the colour of their border.
    Raises:
        DataError: the number of seeds differs, a class has no pictures, or a file is no picture.
    """
    if len(seeds) != len(labels):
        raise DataError(f"{WHERE}: {len(labels)} labels but {len(seeds)} seeds")
    pictures = _open(options)
    wanted = [unicodedata.normalize("NFC", name) for name in labels.class_names]
    rows_of = {name: np.flatnonzero(np.array(pictures.names, object) == name) for name in set(wanted)}
    _check_classes(wanted, {name for name, rows in rows_of.items() if len(rows)}, options)
    size = options.size or _own_size(pictures) or max(image_size)
    images = np.empty((len(labels), size, size, 3), np.uint8)
    for image, name, seed in zip(images, wanted, seeds, strict=True):
        rows = rows_of[name]
        image[:] = pictures.read(int(rows[np.random.default_rng(seed).integers(len(rows))]), size)
    prompts = (options.prompt.replace(PLACEHOLDER, name.replace("_", " ").strip()) for name in labels.class_names)
    return Conditions(tuple(prompts), images)


def _open(options: Options) -> LabelledPictures:
    if options.root is None:
        raise DataError(f"{WHERE}: set its option root to a folder or file of labelled pictures")
    return open_pictures(options)


def _check_classes(class_names: Iterable[str], shown: set[str], options: Options) -> None:
    missing = sorted({unicodedata.normalize("NFC", name) for name in class_names} - shown)
    if missing:
        there = ", ".join(_open(options).classes)
        raise DataError(
            f"{WHERE}: {options.root} has no picture of class {missing[0]!r}; there are: {there} (name numbered labels "
            "with its option class_names)"
        )


def _own_size(pictures: LabelledPictures) -> int | None:
    return None if pictures.images is None else max(pictures.images.shape[1:3])
