"""CDEHP: 25 outdoor and 13 indoor actions before a CeleX-V event camera and an RGB-D camera (Shao et al., Pattern
Recognition 147, 2024).

The download has finished event images, 120 a second, and their labels; raw events are had by e-mail. Where a recording
has no images, its raw events are read from `event_point_cloud/`, a folder of one .csv or of one .npy for each window.
They have no polarity: p is 1 for every event, unless a fourth column gives it.

The folders `train` and `valid` are the authors' split; `valid` is tested on. Whether a person's number means the same
person indoors and outdoors is not said, so subjects are named with the place.

The colour pictures, 60 a second and 848 x 480, come from another camera beside the event camera; their times are
aligned with the events, their pixels are not.

Source: CDEHP-Dataset/cdehp-dataset.github.io (annotation.md, index.md); CDEHP-Dataset/Tools (bin_to_image.py,
csv_spliter.py, structure_renamer.py); CDEHP-Dataset/PyCeleX5, src/binfileobserver.cpp (columns of the .csv);
CDEHP-Dataset/Annotation-Tool, src/check.py (second line of a label file).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from ctlev_core.dataset_files import cdehp_files as files
from ctlev_core.dataset_files.picture_files import read_grey_pictures
from ctlev_core.dataset_files.subject_splits import SubjectSplit
from data_contracts.config import RUN_SETTING
from data_contracts.errors import DataError
from data_contracts.events import Events, check_events
from data_contracts.labels import ImageTrack, Labels, Part, Recording, check_labels

VERSION = 3
JOINT_SET = "cdehp"
Place = Literal["indoor", "outdoor"]

# index.md, in the order of the action numbers.
ACTIONS: dict[str, tuple[str, ...]] = {
    "indoor": (
        "walking", "squat jump", "boxing", "picking up", "jumping jack", "crotch high five", "sweeping",
        "alternate jumping lunge", "big jump", "sit-up jump", "shuttlecock kicking", "throwing", "spinning",
    ),
    "outdoor": (
        "walking", "running", "squat jump", "frog jump", "jump fwd/bwd/left/right", "boxing", "picking up", "cartwheel",
        "jumping jack", "crotch high five", "crawling", "rope skipping", "sweeping", "mopping", "cycling",
        "alternate jumping lunge", "big jump", "sit-up jump", "kicking", "jump shot", "shuttlecock kicking", "spinning",
        "throwing", "long jump", "burpee",
    ),
}  # fmt: skip

EXPECTED_TREE = """expected the unpacked download of CDEHP, at least one of indoor and outdoor:
  ROOT/
    outdoor/
      train/
        A0001P0001S00/
          event_image/000000.png ..   (or event_point_cloud/*.csv or *.npy: raw events)
          event_label/000000.txt ..
          color_image/000000.png ..   (optional)
          color_label/000000.txt ..   (optional)
      valid/
        ..
    indoor/
      .."""


class Options(SubjectSplit):
    """Options of CDEHP."""

    root: Path = Field(json_schema_extra=RUN_SETTING, description="the folder that holds indoor and outdoor")
    places: tuple[Place, ...] = Field(default=("indoor", "outdoor"), min_length=1, description="parts of the dataset")
    source: Literal["auto", "images", "raw"] = Field(
        default="auto", description="released event images, raw events, or images where there are any"
    )
    split: Literal["official", "subject"] = Field(
        default="official",
        description="by the folders train and valid, or by test_subjects; the numbers of people that "
        "the options name hold in both places",
    )
    labelled_only: bool = Field(default=True, description="leave out event images and windows without a label file")
    intensity: bool = Field(default=True, description="offer the colour pictures, in grey, as intensity frames")
    coordinates: Literal["auto", "row_first", "x_first"] = Field(
        default="auto",
        description="order of the first two columns of raw events; auto = told by a value of 800 or more",
    )

    @model_validator(mode="after")
    def _subjects_match_split(self) -> Options:
        if (self.split == "subject") != bool(self.test_subjects):
            raise ValueError("split 'subject' needs test_subjects, and no other split has any")
        return self


def list_recordings(options: Options) -> list[Recording]:
    """One recording a shot, by place, action, person and shot; the id is `outdoor/A0001P0002S00`.

    Shots of `condition_subjects` in the folder train carry labels only.

    Raises:
        DataError: the tree is not as expected, or frames and labels do not belong together.
    """
    root = options.root
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; {EXPECTED_TREE}")
    recordings: dict[str, Recording] = {}
    for place, folder in _shots(root, options):
        recording = _recording(place, folder, options)
        if recording.recording_id in recordings:
            raise DataError(f"{folder}: the shot is in train and in valid")
        recordings[recording.recording_id] = recording
    if not recordings:
        raise DataError(f"{root}: no shots of {' and '.join(options.places)}; {EXPECTED_TREE}")
    return [recordings[name] for name in sorted(recordings)]


def read_events(recording: Recording, options: Options) -> Events:
    """Raw events. Times are those of the file, in us; windows count from its 0.

    Raises:
        DataError: a file is damaged, times go back, coordinates lie outside, or which of the first two columns is x
            cannot be told.
    """
    points = [path for path in recording.files if path.parent.name == files.RAW_FOLDER]
    events = files.read_points(points, options.coordinates)
    return check_events(events, f"CDEHP {recording.recording_id}")


def read_windows(recording: Recording, options: Options) -> np.ndarray:
    """The authors' windows of 8,333 us, counted from time 0 of the file, as ranges [W, 2] int64; empty ones left out.

    With `labelled_only`, those whose number is that of a label file.

    Raises:
        DataError: as `read_events`.
    Source: csv_spliter.py.
    """
    number = files.window_numbers(read_events(recording, options).t)
    numbers, starts = np.unique(number, return_index=True)
    ranges = np.stack([starts, np.append(starts[1:], len(number))], axis=1).astype(np.int64)
    if not options.labelled_only:
        return ranges
    return ranges[np.isin(numbers, [int(path.stem) for path in _labels_of(recording)])]


def read_labels(recording: Recording, options: Options) -> Labels:
    """One row a label file. Of event images at the end of the frame, of raw events in the middle of the window.

    A label is a fraction of 1280 x 800; a few older files have pixels in brackets. A joint outside the image is not
    visible.

    Raises:
        DataError: a label file is not as the authors write it.
    """
    from ctlev_core.geometry.camera import is_inside

    paths = _labels_of(recording)
    joints2d = np.stack([files.read_label(path).joints2d for path in paths])
    numbers = np.array([int(path.stem) for path in paths], np.int64)
    half = files.WINDOW_US // 2
    labels = Labels(
        class_names=(recording.class_name,) * len(paths),
        t_us=(numbers * files.WINDOW_US + half) if recording.has_events else files.frame_end_us(numbers),
        joints2d=joints2d.astype(np.float32),
        visible=is_inside(joints2d, files.SENSOR_SIZE),
        joint_set=JOINT_SET,
    )
    return check_labels(labels, f"CDEHP {recording.recording_id}")


def read_event_images(recording: Recording, options: Options) -> ImageTrack:
    """The released event images [N, 800, 1280] uint8: where an event fell in 8.333 ms; with `labelled_only` those with
    a label.

    Frame n is dated (n + 1) * 8,333 us, the end of its window; the files have no times.

    Raises:
        DataError: a picture is damaged or of another size.
    """
    labelled = {path.stem for path in _labels_of(recording)}
    of_events = [path for path in recording.files if path.parent.name == "event_image"]
    paths = [path for path in of_events if not options.labelled_only or path.stem in labelled]
    numbers = np.array([int(path.stem) for path in paths], np.int64)
    return ImageTrack(read_grey_pictures(paths, files.SENSOR_SIZE), files.frame_end_us(numbers))


def read_intensity_frames(recording: Recording, options: Options) -> ImageTrack:
    """The colour pictures in grey [N, 480, 848] uint8, at the middle of the event frame they were labelled with.

    Labels name pairs of a colour and an event picture; colour pictures between and beyond them follow at 60 a second.
    Those before the first event frame are left out. The picture is not registered to the event image.

    Raises:
        DataError: a picture is damaged or of another size, no label names a pair, or pairs run backwards.
    """
    paths = [path for path in recording.files if path.parent.name == "color_image"]
    pairs = files.read_pairs([path for path in recording.files if path.suffix == ".txt"])
    t_us = files.colour_times_us(
        np.array([int(path.stem) for path in paths], np.int64), pairs, f"CDEHP {recording.recording_id}"
    )
    kept = np.flatnonzero(t_us >= 0)
    return ImageTrack(read_grey_pictures([paths[i] for i in kept], files.COLOUR_SIZE), t_us[kept])


def _shots(root: Path, options: Options) -> Iterator[tuple[str, Path]]:
    for place in options.places:
        for folder in sorted((root / place).glob("*/*")):
            if folder.is_dir() and not folder.name.startswith("."):
                if folder.parent.name not in ("train", "valid"):
                    raise DataError(f"{folder.parent}: expected the folders train and valid; {EXPECTED_TREE}")
                yield place, folder


def _recording(place: str, folder: Path, options: Options) -> Recording:
    match = re.fullmatch(r"A(\d{4})P(\d{4})S\d{2}", folder.name)
    if not match:
        raise DataError(f"{folder}: expected a shot such as A0001P0001S00; {EXPECTED_TREE}")
    action, person = int(match[1]), int(match[2])
    images = files.numbered(folder / "event_image", ".png")
    points = files.raw_files(folder / files.RAW_FOLDER)
    use_images = options.source == "images" or (options.source == "auto" and bool(images))
    data = images if use_images else points
    if not data:
        missing = {"images": "event_image", "raw": files.RAW_FOLDER}.get(options.source, "event_image")
        raise DataError(f"{folder / missing}: no files; {EXPECTED_TREE}")
    labels = files.numbered(folder / "event_label", ".txt")
    if not labels:
        raise DataError(f"{folder / 'event_label'}: no label files; {EXPECTED_TREE}")
    orphans = {path.stem for path in labels} - {path.stem for path in images} if use_images else set()
    if orphans:
        raise DataError(
            f"{folder}: {len(labels)} label files for {len(images)} event images; no image {min(orphans)}.png"
        )
    colour = files.numbered(folder / "color_image", ".png") if options.intensity else []
    colour_labels = files.numbered(folder / "color_label", ".txt") if colour else []
    split = options.split_of(person)
    if options.split == "official" and folder.parent.name == "valid":
        split = "test"
    has_data = split != "condition"
    names = ACTIONS[place]
    return Recording(
        recording_id=f"{place}/{folder.name}",
        subject=f"{place}_P{person:04d}",
        parts=(Part(split),),
        class_name=names[action - 1] if 1 <= action <= len(names) else f"A{action:04d}",
        sensor_size=files.SENSOR_SIZE,
        has_events=has_data and not use_images,
        has_event_images=has_data and use_images,
        has_intensity=bool(colour),
        files=(*(data if has_data else ()), *labels, *colour, *colour_labels),
    )


def _labels_of(recording: Recording) -> list[Path]:
    return [path for path in recording.files if path.parent.name == "event_label"]
