"""Event-HPE, also named MMHPSD: people before an upright CeleX-V event camera, with SMPL poses (Zou et al., ICCV 2021).

Two layouts, told apart by what lies in the folder. `preprocessed` is the public download: event images as four binary
time slices, joined here to one grey picture, 255 where any slice has an event. `raw` has the events as .csv, had by
e-mail, beside the `pose_events` of the public download. Events have polarities; the authors and ControlEvents discard
them.

Event frame n lies between the grey pictures, and poses, n and n + 1; as in the authors' loader its label is pose
n + 1. Subjects 01, 02 and 07 are for tests.

The public files have no times: picture and pose n are dated n * `frame_period_us`, event image n the end of its
window, (n + 1) * `frame_period_us`. The 15 ms are what ControlEvents says of a frame; nothing in the dataset's own
code confirms them.

Source: JimmyZou/EventHPE @2af451f, event_pose_estimation/dataloader.py, flow_net/prepare_data.py, README.md.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from ctlev_core.dataset_files import event_hpe_files as files
from ctlev_core.dataset_files.picture_files import read_grey_pictures
from ctlev_core.dataset_files.subject_splits import SubjectSplit
from data_contracts.config import RUN_SETTING
from data_contracts.errors import DataError
from data_contracts.events import Events, check_events
from data_contracts.labels import ImageTrack, Labels, Part, Recording, check_labels

if TYPE_CHECKING:
    from ctlev_core.geometry.camera import Camera

VERSION = 4
JOINT_SET = "smpl"

EXPECTED_TREE = """expected the preprocessed download of EventHPE (layout `preprocessed`):
  ROOT/
    events_256/subject01_group1_time1/event0000.png ..
    pose_events/subject01_group1_time1/pose0000.pkl ..
    full_pic_256/subject01_group1_time1/fullpic0000.jpg ..   (optional)
or raw recordings with the poses of that download (layout `raw`):
  ROOT/
    subject01_group1_time1/event_camera/events/event0000.csv ..
    subject01_group1_time1/event_camera/full_pic/fullpic0000.jpg ..   (optional)
    pose_events/subject01_group1_time1/pose0000.pkl .."""


class Options(SubjectSplit):
    """Options of Event-HPE."""

    root: Path = Field(json_schema_extra=RUN_SETTING, description="the folder of the download")
    layout: Literal["auto", "preprocessed", "raw"] = Field(
        default="auto", description="event images or raw events; needed only where a folder holds both"
    )
    image_size: int = Field(
        default=256, gt=0, description="px of the square event images, in the names of the folders (preprocessed)"
    )
    frame_period_us: int = Field(
        default=15_000, gt=0, description="nominal time from one event image to the next (preprocessed)"
    )
    test_subjects: tuple[int, ...] = Field(default=(1, 2, 7), description="subjects to test on")
    subjects: tuple[int, ...] | None = Field(default=None, description="only these subjects")
    intensity: bool = Field(default=True, description="offer the grey pictures as intensity frames")


def list_recordings(options: Options) -> list[Recording]:
    """One recording an action that has poses; the id is `subject01/group1_time1`, the class `group1`.

    Group 4 is left out, as the authors do; actions of `condition_subjects` carry labels only.

    Raises:
        DataError: the tree is not as expected, or an action has poses and no events.
    """
    root = options.root
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; {EXPECTED_TREE}")
    layout = _find_layout(root, options)
    poses = root / "pose_events"
    if not poses.is_dir():
        raise DataError(f"{poses}: no such folder, the poses are missing; {EXPECTED_TREE}")
    recordings = []
    for folder in sorted(poses.iterdir()):
        match = re.fullmatch(r"subject(\d+)_(group(\d+)_time\d+)", folder.name)
        if not match or int(match[3]) == 4 or (options.subjects is not None and int(match[1]) not in options.subjects):
            continue
        recordings.append(_recording(folder, layout, int(match[1]), f"subject{match[1]}/{match[2]}", options))
    if not recordings:
        raise DataError(f"{poses}: no actions of the subjects asked for; {EXPECTED_TREE}")
    return recordings


def read_events(recording: Recording, options: Options) -> Events:
    """Raw events of all but the last file, which the authors leave out too; x to the right, y down, 800 x 1280 px.

    Raises:
        DataError: a file is damaged, the clock starts anew, or there are no events.
    """
    return check_events(_read_raw(recording).events, f"Event-HPE {recording.recording_id}")


def read_windows(recording: Recording, options: Options) -> np.ndarray:
    """The authors' windows as ranges [W, 2] int64: the events of a file each, where the pose that ends it is known.

    A file without events has an empty range.

    Raises:
        DataError: as `read_events`.
    """
    raw = _read_raw(recording)
    labelled = np.isin(raw.numbers + 1, list(_poses(recording)))
    return np.stack([raw.bounds[:-1], raw.bounds[1:]], axis=1)[labelled]


def read_window_labels(recording: Recording, options: Options) -> Labels:
    """The pose that ends each window of `read_windows`, one row a window.

    `labels_at_windows` would also average the pose before into it where two windows touch in the same microsecond.

    Raises:
        DataError: as `read_labels`.
    Source: event_pose_estimation/dataloader.py.
    """
    poses = np.array(list(_poses(recording)), np.int64)
    dated = poses[_times_us(recording, poses, options)[1]]
    ends = np.array([number + 1 for number in _read_raw(recording).numbers if number + 1 in _poses(recording)])
    # The pose of a window without events may have no time; such a window is not used.
    rows = np.minimum(np.searchsorted(dated, ends), len(dated) - 1)
    return read_labels(recording, options).take(rows)


def read_labels(recording: Recording, options: Options) -> Labels:
    """One row a pose, in px of the recording's own pictures: joints in 2D and 3D, SMPL parameters, intrinsics.

    A joint is visible where it lies in the picture and in front of the camera. The authors' pixel coordinates are
    taken as they are, with the origin at the outer corner; their own scaling (nearest neighbour) is off by up to half
    a pixel of the small image.

    Raises:
        DataError: a pose file is damaged; of raw recordings also as `read_events`.
    """
    from ctlev_core.geometry.camera import is_inside

    numbers = np.array(list(_poses(recording)), np.int64)
    t_us, known = _times_us(recording, numbers, options)
    poses = [
        files.read_pose(path) for path, is_known in zip(_poses(recording).values(), known, strict=True) if is_known
    ]
    joints2d = np.stack([pose.joints2d for pose in poses])
    joints3d = np.stack([pose.joints3d for pose in poses])
    if recording.sensor_size == files.RAW_SIZE:
        joints2d = joints2d * (files.PADDED_SIZE / files.POSE_IMAGE_SIZE) - [files.PADDING, 0]
    else:
        joints2d = joints2d * (options.image_size / files.POSE_IMAGE_SIZE)
    with np.errstate(invalid="ignore"):
        visible = is_inside(joints2d, _picture_size(recording)) & (joints3d[..., 2] > 0)
    labels = Labels(
        class_names=(recording.class_name,) * len(poses),
        t_us=t_us[known],
        joints2d=joints2d.astype(np.float32),
        visible=visible,
        joint_set=JOINT_SET,
        joints3d=(1000.0 * joints3d).astype(np.float32),
        smpl_pose=np.stack([pose.theta for pose in poses]).astype(np.float32),
        smpl_betas=np.stack([pose.betas for pose in poses]).astype(np.float32),
        smpl_transl=np.stack([pose.transl for pose in poses]).astype(np.float32),
        intrinsics=np.tile(read_camera(recording, options).intrinsics.astype(np.float32), (len(poses), 1)),
    )
    return check_labels(labels, f"Event-HPE {recording.recording_id}")


def read_event_images(recording: Recording, options: Options) -> ImageTrack:
    """The event images [N, 256, 256] uint8 whose end has a pose: 255 where any of the four time slices has an event.

    Raises:
        DataError: a picture is damaged or of another size, or no event image ends at a pose.
    """
    poses = _poses(recording)
    images = {number: path for number, path in _of(recording, "event", ".png").items() if number + 1 in poses}
    if not images:
        raise DataError(f"Event-HPE {recording.recording_id}: no event image n with a pose n + 1")
    ends = (np.array(list(images), np.int64) + 1) * options.frame_period_us
    pictures = files.read_event_images(list(images.values()), options.image_size)
    return ImageTrack(pictures, ends, options.frame_period_us)


def read_intensity_frames(recording: Recording, options: Options) -> ImageTrack:
    """The grey pictures of the event camera itself, so that pixels are those of the events.

    Raises:
        DataError: a picture is damaged or of another size; of raw recordings also as `read_events`.
    """
    pictures = _of(recording, "fullpic", ".jpg")
    t_us, known = _times_us(recording, np.array(list(pictures), np.int64), options)
    paths = [path for path, is_known in zip(pictures.values(), known, strict=True) if is_known]
    return ImageTrack(read_grey_pictures(paths, _picture_size(recording)), t_us[known])


def read_camera(recording: Recording, options: Options) -> Camera:
    """The camera of the recording's pictures, which is also its world frame.

    Without distortion, as the authors' loader, losses and viewer project. Their `projection` also knows OpenCV's
    rational model (k1 .. k6, p1, p2); its coefficients are in none of the files of theirs that we know.
    """
    from ctlev_core.geometry.camera import Camera

    f, c = files.FOCAL_LENGTH, files.CENTRE
    K = np.array([[f, 0, c], [0, f, c], [0, 0, 1]])
    if recording.sensor_size == files.RAW_SIZE:
        K[0, 2] -= files.PADDING
    else:
        K[:2] *= options.image_size / files.PADDED_SIZE
    return Camera(K, np.eye(3), np.zeros(3), _picture_size(recording))


def _find_layout(root: Path, options: Options) -> str:
    if options.layout != "auto":
        return options.layout
    there = {
        "preprocessed": (root / f"events_{options.image_size}").is_dir(),
        "raw": any(root.glob("subject*/event_camera")),
    }
    found = [name for name, is_there in there.items() if is_there]
    if len(found) == 2:
        raise DataError(f"{root}: holds event images and raw events; choose with dataset.options.layout")
    if not found:
        raise DataError(f"{root}: neither events_{options.image_size} nor raw recordings; {EXPECTED_TREE}")
    return found[0]


def _recording(poses: Path, layout: str, subject: int, name: str, options: Options) -> Recording:
    root, action = options.root, poses.name
    if layout == "raw":
        folder, suffix = root / action / "event_camera" / "events", ".csv"
        pictures = root / action / "event_camera" / "full_pic"
    else:
        folder, suffix = root / f"events_{options.image_size}" / action, ".png"
        pictures = root / f"full_pic_{options.image_size}" / action
    data = files.numbered(folder, "event", suffix)
    if not data:
        raise DataError(f"{folder}: no files event0000{suffix}, but {action} has poses; {EXPECTED_TREE}")
    labels = files.numbered(poses, "pose", ".pkl")
    if not labels:
        raise DataError(f"{poses}: no files pose0000.pkl; {EXPECTED_TREE}")
    grey = files.numbered(pictures, "fullpic", ".jpg") if options.intensity else {}
    split = options.split_of(subject)
    has_data = split != "condition"
    size = files.RAW_SIZE if layout == "raw" else (options.image_size, options.image_size)
    return Recording(
        recording_id=name,
        subject=name.partition("/")[0],
        parts=(Part(split),),
        class_name=name.partition("/")[2].partition("_")[0],
        sensor_size=size,
        has_events=has_data and layout == "raw",
        has_event_images=has_data and layout != "raw",
        has_intensity=bool(grey),
        files=(*(data.values() if has_data else ()), *labels.values(), *grey.values()),
    )


def _of(recording: Recording, prefix: str, suffix: str) -> dict[int, Path]:
    """The recording's files of one kind by number."""
    chosen = (path for path in recording.files if path.suffix == suffix and path.name.startswith(prefix))
    return {int(path.stem.removeprefix(prefix)): path for path in chosen}


def _poses(recording: Recording) -> dict[int, Path]:
    return _of(recording, "pose", ".pkl")


def _read_raw(recording: Recording) -> files.RawEvents:
    tables = _of(recording, "event", ".csv")
    kept = dict(list(tables.items())[:-1])
    return files.read_raw(kept, f"Event-HPE {recording.recording_id}")


def _times_us(recording: Recording, numbers: np.ndarray, options: Options) -> tuple[np.ndarray, np.ndarray]:
    """Times [N] int64 us of poses or grey pictures, and which [N] bool are known, of which there is at least one."""
    if not recording.has_events:
        return numbers * options.frame_period_us, np.ones(len(numbers), np.bool_)
    t_us = files.raw_times_us(_read_raw(recording), numbers)
    known = t_us >= 0
    if not known.any():
        raise DataError(f"Event-HPE {recording.recording_id}: no pose or picture belongs to a file of events")
    return t_us, known


def _picture_size(recording: Recording) -> tuple[int, int]:
    return recording.sensor_size or files.RAW_SIZE
