"""Labels, recordings and conditions: the small records that travel between plug-ins and stages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np

from data_contracts.config import ConditionChoice
from data_contracts.errors import DataError
from data_contracts.events import SensorSize
from data_contracts.image_rows import Images

SPLITS = ("train", "validation", "test", "condition")
"""`condition`: labels without events, used only as conditions to sample from. Fixed at ingest."""

HELD_OUT_SPLITS = ("test", "validation")
HeldOut = Literal["test", "validation"]
"""Splits that nothing is learnt from and models are scored on: options are chosen on one, the other says what came of
it."""


def held_out_split(splits: Iterable[str]) -> HeldOut:
    """The split that models are scored on, of frames of these splits: `validation` where that is all there is."""
    found = set(splits)
    return "validation" if "validation" in found and "test" not in found else "test"


@dataclass(frozen=True)
class Part:
    """A stretch of a recording and the split it belongs to; `start` and `stop` are fractions of its events."""

    split: str
    start: float = 0.0
    stop: float = 1.0


@dataclass(frozen=True)
class Recording:
    """One recording of a dataset, before anything but its existence is known.

    Attributes:
        recording_id: unique within the dataset; letters, digits, `.`, `_`, `-` and `/`.
        subject: who or what was recorded; splits are by subject wherever a dataset names subjects.
        parts: which split the recording belongs to; more than one part where a recording is split in time.
        class_name: class or motion, empty where the dataset has none.
        sensor_size: (width, height) px; None when only the file itself tells.
        has_events: False for recordings that carry labels only, or event images in the place of events.
        has_event_images: the dataset's authors released finished event images of it; the dataset's
            `read_event_images` reads them.
        has_intensity: grey pictures were taken beside the events; the dataset's `read_intensity_frames` reads them.
        files: raw files the recording is read from; their content enters the cache key.
    """

    recording_id: str
    subject: str
    parts: tuple[Part, ...]
    class_name: str = ""
    sensor_size: SensorSize | None = None
    has_events: bool = True
    has_event_images: bool = False
    has_intensity: bool = False
    files: tuple[Path, ...] = ()


@dataclass(frozen=True, eq=False)
class ImageTrack:
    """Pictures of one recording in the order of their times: intensity frames, or event images as released.

    Attributes:
        images: [N, H, W] uint8, grey.
        t_us: [N] int64, microseconds on the clock of events and labels; of an exposure the middle, of an event image
            the end of its window.
        window_us: how long the window of an event image is; 0 = not known.
    """

    images: np.ndarray
    t_us: np.ndarray
    window_us: int = 0

    def __len__(self) -> int:
        return len(self.t_us)


def check_image_track(track: ImageTrack, where: str) -> ImageTrack:
    """Raise `DataError` unless there are pictures, grey and 8-bit, with one time each in ascending order."""
    images, t_us = track.images, track.t_us
    if images.ndim != 3 or images.dtype != np.uint8 or len(images) == 0:
        raise DataError(f"{where}: images must be [N, H, W] uint8 with N > 0, got {images.shape} {images.dtype}")
    if t_us.shape != (len(images),) or t_us.dtype != np.int64:
        raise DataError(f"{where}: t_us must be [{len(images)}] int64, got {t_us.shape} {t_us.dtype}")
    if t_us[0] < 0 or (t_us[1:] < t_us[:-1]).any():
        raise DataError(f"{where}: t_us must be non-negative and must not decrease")
    return track


LABEL_ARRAYS: dict[str, tuple[type, int | None]] = {
    "joints2d": (np.float32, 2),
    "visible": (np.bool_, None),
    "joints3d": (np.float32, 3),
    "smpl_pose": (np.float32, 72),
    "smpl_betas": (np.float32, 10),
    "smpl_transl": (np.float32, 3),
    "intrinsics": (np.float32, 4),
}
"""The optional arrays of `Labels`: dtype, and length of the last axis (None: one value a joint)."""
_OF_JOINTS = ("joints2d", "visible", "joints3d")
_OF_SMPL = ("smpl_pose", "smpl_betas", "smpl_transl")


@dataclass(frozen=True, eq=False)
class Labels:
    """N labelled moments: the label track of one recording, or one row per sample of a table.

    Attributes:
        class_names: N class names; empty strings where there is no class.
        t_us: [N] int64, time of each moment, microseconds on the clock of the events.
        joints2d: [N, J, 2] float32, px, (x right, y down), pixel centres at integer + 0.5; NaN = unknown.
        visible: [N, J] bool; False = outside the image, occluded or unknown.
        joint_set: name of the joint order, a key of `ctlev_core.geometry.joint_sets.JOINT_SETS`; empty without joints.
        joints3d: [N, J, 3] float32, mm, camera frame (x right, y down, z forward), same order; NaN = unknown.
        smpl_pose: [N, 72] float32, rad, axis-angle of the 24 SMPL joints, the root's (global orientation) first.
        smpl_betas: [N, 10] float32, shape coefficients.
        smpl_transl: [N, 3] float32, m, camera frame.
        intrinsics: [N, 4] float32, px: fx, fy, cx, cy of the camera that sees the row, in the image of `joints2d`;
            without them a body has a place in space but none in the image.
    """

    class_names: tuple[str, ...]
    t_us: np.ndarray
    joints2d: np.ndarray | None = None
    visible: np.ndarray | None = None
    joint_set: str = ""
    joints3d: np.ndarray | None = None
    smpl_pose: np.ndarray | None = None
    smpl_betas: np.ndarray | None = None
    smpl_transl: np.ndarray | None = None
    intrinsics: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.class_names)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The optional arrays that are there, by name."""
        return {name: getattr(self, name) for name in LABEL_ARRAYS if getattr(self, name) is not None}

    def take(self, rows: Sequence[int] | np.ndarray) -> Labels:
        """The given rows, in the given order."""
        rows = np.asarray(rows, dtype=np.int64)
        names = tuple(self.class_names[row] for row in rows)
        taken = {name: array[rows] for name, array in self.arrays.items()}
        return replace(self, class_names=names, t_us=self.t_us[rows], **taken)


def check_labels(labels: Labels, where: str) -> Labels:
    """Raise `DataError` unless shapes agree and every joint marked visible is a finite number."""
    count = len(labels)
    if labels.t_us.shape != (count,) or labels.t_us.dtype != np.int64:
        raise DataError(f"{where}: t_us must be [{count}] int64, got {labels.t_us.shape} {labels.t_us.dtype}")
    if (labels.joints2d is None) != (labels.visible is None):
        raise DataError(f"{where}: joints2d and visible must be given together")
    arrays = labels.arrays
    given = [name for name in _OF_SMPL if name in arrays]
    if given and len(given) != len(_OF_SMPL):
        raise DataError(f"{where}: {', '.join(_OF_SMPL)} must be given together, got {', '.join(given)}")
    num_joints = next((arrays[name].shape[1:2] for name in _OF_JOINTS if name in arrays), ())
    for name, array in arrays.items():
        dtype, last = LABEL_ARRAYS[name]
        expected = (count, *(num_joints if name in _OF_JOINTS else ()), *(() if last is None else (last,)))
        if array.shape != expected or array.dtype != dtype:
            kind = np.dtype(dtype).name
            raise DataError(f"{where}: {name} must be {list(expected)} {kind}, got {list(array.shape)} {array.dtype}")
        if name in (*_OF_SMPL, "intrinsics") and not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array))[0, 0])
            raise DataError(f"{where}: {name} of row {row} is not finite")
    if labels.intrinsics is not None and (labels.intrinsics[:, :2] <= 0).any():
        row = int(np.argmax((labels.intrinsics[:, :2] <= 0).any(axis=1)))
        raise DataError(f"{where}: focal lengths must be positive, row {row} has {labels.intrinsics[row, :2].tolist()}")
    if labels.joints2d is None or labels.visible is None:
        return labels
    wrong = labels.visible & ~np.isfinite(labels.joints2d).all(axis=-1)
    if wrong.any():
        row, joint = np.argwhere(wrong)[0]
        value = labels.joints2d[row, joint].tolist()
        raise DataError(f"{where}: joint {joint} of row {row} is marked visible but its position is {value}")
    return labels


@dataclass(frozen=True, eq=False)
class BodyMotions:
    """What the bodies of N rows do around the moment they are labelled at, seen by one still camera each.

    Attributes:
        t_us: [N, K] int64, times of K key poses, strictly ascending, on the clock of the row's label.
        moment_us: [N] int64, the labelled moment; not before the first key pose nor after the last.
        smpl_pose: [N, K, 72] float32, rad, as in `Labels`.
        smpl_transl: [N, K, 3] float32, m, camera frame.
        smpl_betas: [N, 10] float32.
        intrinsics: [N, 4] float32, px: fx, fy, cx, cy on the sensor that is to see them.
    """

    t_us: np.ndarray
    moment_us: np.ndarray
    smpl_pose: np.ndarray
    smpl_transl: np.ndarray
    smpl_betas: np.ndarray
    intrinsics: np.ndarray

    def __len__(self) -> int:
        return len(self.moment_us)

    def take(self, rows: slice | np.ndarray) -> BodyMotions:
        """Some of the rows."""
        return BodyMotions(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})


def check_body_motions(motions: BodyMotions, where: str) -> BodyMotions:
    """Raise `DataError` unless shapes agree, numbers are finite, and times ascend around the labelled moment."""
    if motions.t_us.ndim != 2 or motions.t_us.shape[1] < 2 or motions.t_us.dtype != np.int64:
        raise DataError(f"{where}: t_us must be [N, 2 or more] int64, got {motions.t_us.shape} {motions.t_us.dtype}")
    count, keys = motions.t_us.shape
    expected = {
        "moment_us": ((count,), np.int64),
        "smpl_pose": ((count, keys, 72), np.float32),
        "smpl_transl": ((count, keys, 3), np.float32),
        "smpl_betas": ((count, 10), np.float32),
        "intrinsics": ((count, 4), np.float32),
    }
    for name, (shape, dtype) in expected.items():
        array = getattr(motions, name)
        if array.shape != shape or array.dtype != dtype:
            got = f"{list(array.shape)} {array.dtype}"
            raise DataError(f"{where}: {name} must be {list(shape)} {np.dtype(dtype).name}, got {got}")
        if not np.isfinite(array).all():
            raise DataError(f"{where}: {name} of row {int(np.argwhere(~np.isfinite(array))[0, 0])} is not finite")
    wrong = (np.diff(motions.t_us) <= 0).any(axis=1)
    wrong |= (motions.moment_us < motions.t_us[:, 0]) | (motions.moment_us > motions.t_us[:, -1])
    wrong |= (motions.t_us[:, 0] < 0) | (motions.intrinsics[:, :2] <= 0).any(axis=1)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise DataError(
            f"{where}: row {row} needs ascending times, none negative, with its moment among them, and positive focal "
            f"lengths; got {motions.t_us[row].tolist()} us, {motions.moment_us[row]} us and "
            f"{motions.intrinsics[row, :2].tolist()} px"
        )
    return motions


@dataclass(frozen=True, eq=False)
class Conditions:
    """What a generator is asked for, one row per image.

    Attributes:
        prompts: N text prompts.
        images: [N, H, W, 3] uint8 condition images, or None for the text route.
        motions: what N bodies do, for a generator that records them; else None.
        class_names: N classes, whose names may take turns while a generator learns; else None.
        made_by: the plug-in that made them, where it is known: the colours of its images may be directions.
        stretches: N names of stretches: consecutive rows of one name follow one another in time, and are made from one
            another by a generator that can do so; None = each row is by itself.
    """

    prompts: tuple[str, ...]
    images: Images | None = None
    motions: BodyMotions | None = None
    class_names: tuple[str, ...] | None = None
    made_by: ConditionChoice | None = None
    stretches: tuple[str, ...] | None = None

    def __len__(self) -> int:
        return len(self.prompts)

    def take(self, rows: slice | np.ndarray) -> Conditions:
        """Some of the rows."""
        images = None if self.images is None else self.images[rows]
        motions = None if self.motions is None else self.motions.take(rows)
        names = None if self.class_names is None else tuple(np.array(self.class_names, object)[rows])
        stretches = None if self.stretches is None else tuple(np.array(self.stretches, object)[rows])
        return Conditions(tuple(np.array(self.prompts, object)[rows]), images, motions, names, self.made_by, stretches)


@dataclass
class History:
    """Scalars of a training run, one row per logged step, for the loss curves of the report."""

    step: list[int] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    validation_step: list[int] = field(default_factory=list)
    validation_loss: list[float] = field(default_factory=list)
    shuffled_loss: list[float] = field(default_factory=list)
