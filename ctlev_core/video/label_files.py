"""Labels of the frames of a video: boxes, keypoints and masks of instances, from COCO's JSON or a CSV.

    COCO    an image of the file is a frame: by its file name in a folder of pictures, else by `frame_id` (CocoVID) or
            `frame_index` (TAO), from 0 on. The instance of an annotation is its `instance_id` or `track_id`; without
            one it is in that frame alone. `bbox`, `keypoints` and `segmentation` are read
    CSV     with a header: `frame` (from 0 on), `instance`, and any of `category`; `x`, `y`, `width`, `height` of a box;
            `NAME_x`, `NAME_y` of keypoints, empty where one is not seen. Without: MOTChallenge's columns, frames from 1
            on; rows whose flag is 0 are left out

Coordinates are pixels of the stored frame, 0 at the left and upper edge of the first pixel.

Source: Lin et al., Microsoft COCO, ECCV 2014 (format of annotations); MMTracking (CocoVID); Dave et al., TAO, ECCV
2020; Dendorfer et al., MOT20, 2020, table 4.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.video import coco_masks
from ctlev_core.video.frames import Frames
from data_contracts.errors import DataError, shortened
from data_contracts.events import SensorSize

INSTANCE_KEYS = ("instance_id", "track_id")
FRAME_KEYS = ("frame_id", "frame_index")
LARGEST = 1e7
"""Px; a coordinate beyond it is none."""


@dataclass(frozen=True, eq=False)
class Label:
    """One instance in one frame.

    Attributes:
        box: [4] left, top, width, height, px; None = none.
        keypoints: [K, 3] x, y px and COCO's flag (0 not labelled, 1 hidden, 2 seen); None = none.
        mask: polygons, each [M, 2] px, or COCO's run lengths, which `coco_masks.read_runs` reads; None = none.
        is_crowd: COCO's `iscrowd`.
    """

    box: np.ndarray | None = None
    keypoints: np.ndarray | None = None
    mask: list[np.ndarray] | dict[str, Any] | None = None
    is_crowd: bool = False


@dataclass
class Track:
    """One instance: its labels by number of the frame, its category, and its id in the file (None = it has none)."""

    category_id: int
    instance: int | str | None
    labels: dict[int, Label] = field(default_factory=dict)


@dataclass
class VideoLabels:
    """All labels of a video: numbers of the frames that were labelled, ascending, and what is in them."""

    path: Path
    frames: list[int]
    tracks: list[Track]
    categories: list[dict[str, Any]]


def read_video_labels(path: Path, frames: Frames) -> VideoLabels:
    """The labels of a file, by its suffix `.json` or `.csv` (`.txt`), checked against the frames they belong to.

    Raises:
        DataError: no such file; no labels; a frame that does not exist, or two for one; an image whose size is not
            that of the stored frames; two labels of an instance in one frame, or frames of one that descend; a number
            that is none or not finite. The message names file and place.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not a file of labels: {error}") from None
    if path.suffix.lower() in (".csv", ".txt"):
        from ctlev_core.video.label_tables import read_table

        labels = read_table(path, text)
    elif path.suffix.lower() == ".json":
        labels = _read_coco(path, text, frames)
    else:
        raise DataError(f"{path}: expected labels as .json (COCO), .csv or .txt, got the suffix {path.suffix!r}")
    if not any(track.labels for track in labels.tracks):
        raise DataError(f"{path}: expected labels, got none")
    last = max(max(track.labels, default=0) for track in labels.tracks)
    check_frames(labels, frames.num_stored, last)
    return labels


def check_frames(labels: VideoLabels, count: int, last: int) -> None:
    """Raise `DataError` if the last labelled frame is not one of `count`; 0 = nobody knows how many there are."""
    if count and last >= count:
        raise DataError(
            f"{labels.path}: labels of frame {last}, expected frames 0 to {count - 1}: the source has no more"
        )


def _read_coco(path: Path, text: str, frames: Frames) -> VideoLabels:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: not JSON: {shortened(str(error), 200)}") from None
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected COCO's table of images and annotations, got a {type(content).__name__}")
    images, annotations, categories = (_rows(path, content, key) for key in ("images", "annotations", "categories"))
    number_of = _image_frames(path, images, frames)
    known = {one.get("id") for one in categories}
    tracks: dict[Any, Track] = {}
    size = frames.stored_size()
    for row, one in enumerate(annotations):
        where = f"{path}: annotation {row}"
        image_id, category = one.get("image_id"), one.get("category_id")
        if not isinstance(image_id, int | str) or image_id not in number_of:
            raise DataError(f"{where}: image_id {str(image_id)[:40]} is not one of the images")
        if not isinstance(category, int) or category not in known:
            raise DataError(f"{where}: category_id {str(category)[:40]} is not one of the categories")
        instance = next((one[key] for key in INSTANCE_KEYS if one.get(key) is not None), None)
        if instance is not None and not isinstance(instance, int | str):
            raise DataError(f"{where}: instance_id must be a number or a text, got {str(instance)[:40]}")
        track = tracks.setdefault(("", row) if instance is None else instance, Track(category, instance))
        add_label(track, number_of[image_id], category, _coco_label(where, one, size), where)
    return VideoLabels(path, sorted(number_of.values()), list(tracks.values()), categories)


def add_label(track: Track, frame: int, category_id: int, label: Label, where: str) -> None:
    """One more label of an instance."""
    if frame in track.labels:
        raise DataError(f"{where}: instance {track.instance} is in frame {frame} twice")
    if category_id != track.category_id:
        raise DataError(
            f"{where}: instance {track.instance} is of category {category_id}, before of {track.category_id}"
        )
    track.labels[frame] = label


def _rows(path: Path, content: dict[str, Any], key: str) -> list[dict[str, Any]]:
    rows = content.get(key)
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise DataError(f"{path}: expected a list of tables under {key!r}, as COCO has it")
    for row, one in enumerate(rows):
        if key != "annotations" and not isinstance(one.get("id"), int | str):
            raise DataError(f"{path}: {key}, entry {row}: expected an id, got {str(one.get('id'))[:40]}")
    return rows


def _image_frames(path: Path, images: list[dict[str, Any]], frames: Frames) -> dict[Any, int]:
    """The number of the frame of each image, by the image's id."""
    size = frames.stored_size()
    by_name = {name: number for number, name in enumerate(frames.names)}
    number_of: dict[Any, int] = {}
    taken: dict[int, int] = {}
    for row, image in enumerate(images):
        where = f"{path}: image {row}"
        stated = image.get("width"), image.get("height")
        if stated != (None, None) and stated != size:
            raise DataError(f"{where} is of {stated[0]} x {stated[1]} px, expected the frames' {size[0]} x {size[1]}")
        number = by_name.get(Path(str(image.get("file_name", ""))).name)
        if number is None:
            number = next((image[key] for key in FRAME_KEYS if image.get(key) is not None), None)
        if not isinstance(number, int) or number < 0:
            raise DataError(
                f"{where} names no frame: expected a frame_id or frame_index from 0 on"
                + (", or the file name of a picture" if by_name else "")
            )
        if number in taken or image["id"] in number_of:
            raise DataError(f"{where}: frame {number} or id {image['id']} is that of image {taken.get(number)} too")
        number_of[image["id"]], taken[number] = number, row
    return number_of


def _coco_label(where: str, one: Mapping[str, Any], size: SensorSize) -> Label:
    box = points = mask = None
    if one.get("bbox") is not None:
        box = check_box(numbers(one["bbox"], 4, f"{where}: bbox"), where)
    if one.get("keypoints"):
        points = numbers(one["keypoints"], None, f"{where}: keypoints")
        if len(points) % 3:
            raise DataError(f"{where}: keypoints must be x, y and a flag in turn, got {len(points)} numbers")
        points = points.reshape(-1, 3)
    given = one.get("segmentation")
    if coco_masks.is_polygons(given):
        assert isinstance(given, list)
        mask = [numbers(polygon, None, f"{where}: segmentation").reshape(-1, 2) for polygon in given]
    elif isinstance(given, dict):
        try:
            coco_masks.read_runs(given, size)  # checked here, and kept as it is: in frames of 1080p each takes 2 MB
            mask = given
        except ValueError as error:
            raise DataError(f"{where}: segmentation: {error}") from None
    elif given:
        raise DataError(f"{where}: segmentation must be polygons or run lengths, got {str(given)[:40]}")
    if box is None and points is None and mask is None:
        raise DataError(f"{where}: expected a bbox, keypoints or a segmentation, got none")
    return Label(box, points, mask, bool(one.get("iscrowd")))


def numbers(values: Any, count: int | None, where: str) -> np.ndarray:
    """[count] float64; raises `DataError` unless they are so many finite numbers."""
    if not isinstance(values, list) or (count is not None and len(values) != count):
        raise DataError(f"{where} must be {'' if count is None else f'{count} '}numbers, got {str(values)[:60]}")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
            what = "finite numbers" if isinstance(value, float) and not math.isfinite(value) else "numbers of px"
            raise DataError(f"{where} must be {what}, got {str(value)[:40]}")
    return np.array(values, np.float64)


def check_box(box: np.ndarray, where: str) -> np.ndarray:
    """The box; raises `DataError` unless it has an extent."""
    if not (box[2:] > 0).all():
        raise DataError(f"{where}: a box must have a width and a height above 0, got {box[2]:g} x {box[3]:g}")
    return box
