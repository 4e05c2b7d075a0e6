"""DHP19: 17 people, 33 movements, four event cameras with motion capture (Calabrese et al., CVPR workshops 2019).

Two layouts, told apart by what lies in the folder. `raw` is the download; `frames` are the event images which the
authors' MATLAB code makes of it. Each movement gives one recording a camera.

Camera N has projection matrix PN; the authors train and test on the cameras 2 and 3, which see the person from the
front. Subjects 1 to 12 are for training, 13 to 17 for tests (SensorsINI/DHP19, Eval_2D_triangulation_and_3D_tutorial;
MasterHow/EventPointPose, DHP19EPC.md). The dataset has polarities; its authors and ControlEvents discard them.

Windows: the authors close one as soon as the four cameras together have 30,000 events (window method `dataset`,
`read_windows`), 7,500 a camera on average. ControlEvents says 7,500 events a frame: window method `count` with
num_events 7500 counts those of the recording's own camera.

Source of all that follows: SensorsINI/DHP19 @12a3fe6, generate_DHP19/ and heatmap_generation_example.ipynb.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field, field_validator

from ctlev_core.dataset_files import dhp19_files as files
from ctlev_core.dataset_files.subject_splits import SubjectSplit
from data_contracts.config import RUN_SETTING
from data_contracts.errors import DataError
from data_contracts.events import Events, check_events
from data_contracts.labels import ImageTrack, Labels, Part, Recording, check_labels

if TYPE_CHECKING:
    from ctlev_core.geometry.camera import Camera

VERSION = 1
JOINT_SET = "dhp19"
FRAME_PERIOD_US = 10_000
"""Nominal, and not the truth: the frame files hold no times, only an order; frame i is dated (i + 1) times this."""

# Clocks gone wrong (more than 700 special events); the authors removed them from the dataset.
DAMAGED = {(4, 3, 4), (4, 3, 6)}

EXPECTED_TREE = """expected the download of DHP19 (layout `raw`):
  ROOT/
    DVS_movies/S1/session1/mov1.aedat
    Vicon_data/S1_1_1.mat
    P_matrices/P1.npy .. P4.npy
or the frames its MATLAB code writes (layout `frames`), with the matrices beside them:
  ROOT/
    h5_dataset_7500_events/346x260/S1_session1_mov1_7500events.h5
    h5_dataset_7500_events/346x260/S1_session1_mov1_7500events_label.h5
    P_matrices/P1.npy .. P4.npy"""


class Options(SubjectSplit):
    """Options of DHP19."""

    root: Path = Field(json_schema_extra=RUN_SETTING, description="the folder of the download")
    layout: Literal["auto", "raw", "frames"] = Field(
        default="auto", description="raw recordings or finished frames; needed only where a folder holds both"
    )
    cameras: tuple[int, ...] = Field(
        default=(2, 3), min_length=1, description="cameras 1 to 4, by the number of their projection matrix"
    )
    filters: bool = Field(
        default=True,
        description="drop hot pixels, background activity and the infra-red lights, as the authors do (raw)",
    )
    events_per_window: int = Field(
        default=30_000,
        gt=0,
        description="events of all four cameras that close a window (raw, window method `dataset`)",
    )
    test_subjects: tuple[int, ...] = Field(default=(13, 14, 15, 16, 17), description="subjects to test on")
    subjects: tuple[int, ...] | None = Field(default=None, description="only these of the subjects 1 to 17")
    sessions: tuple[int, ...] | None = Field(default=None, description="only these of the sessions 1 to 5")
    movements: tuple[int, ...] | None = Field(default=None, description="only these movements of each session")

    @field_validator("cameras")
    @classmethod
    def _known_cameras(cls, cameras: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(cameras)) != len(cameras) or not set(cameras) <= set(files.CHANNEL_OF_CAMERA):
            raise ValueError(f"expected different cameras of {sorted(files.CHANNEL_OF_CAMERA)}")
        return cameras


def list_recordings(options: Options) -> list[Recording]:
    """One recording for each movement and camera, by subject, session, movement and camera.

    Those of `condition_subjects` carry labels only. The id is `S1/session1/mov1/cam2`, the class `session1_mov1`. A
    movement without events is left out, as in the download some are missing; so are the two recordings whose clock is
    damaged.

    Raises:
        DataError: the tree is not as expected, a movement has no labels, or the options leave no recording.
    """
    root = options.root
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; {EXPECTED_TREE}")
    layout = _find_layout(root, options)
    matrices = {camera: root / "P_matrices" / f"P{camera}.npy" for camera in options.cameras}
    for path in matrices.values():
        if not path.is_file():
            raise DataError(f"{path}: no such file, the projection matrix is missing; {EXPECTED_TREE}")
    listed = sorted(_raw_movements(root) if layout == "raw" else _frame_movements(root))
    chosen = [entry for entry in listed if _is_chosen(entry[0], options)]
    if not chosen:
        found = "none at all" if not listed else f"{len(listed)} others, the first S{'/'.join(map(str, listed[0][0]))}"
        raise DataError(
            f"{root}: no movement of the subjects, sessions and movements asked for, {found}; {EXPECTED_TREE}"
        )
    recordings = []
    for (subject, session, movement), data, labels in chosen:
        if not labels.is_file():
            raise DataError(
                f"{labels}: no such file, but {data.name} is there: its labels are missing; {EXPECTED_TREE}"
            )
        split = options.split_of(subject)
        has_data = split != "condition"
        recordings += [
            Recording(
                recording_id=f"S{subject}/session{session}/mov{movement}/cam{camera}",
                subject=f"S{subject}",
                parts=(Part(split),),
                class_name=f"session{session}_mov{movement}",
                sensor_size=files.SENSOR_SIZE if layout == "raw" else None,
                has_events=has_data and layout == "raw",
                has_event_images=has_data and layout == "frames",
                files=(*([data] if has_data else []), labels, matrices[camera]),
            )
            for camera in options.cameras
        ]
    return recordings


def read_events(recording: Recording, options: Options) -> Events:
    """The events of one camera from the start to the stop of the motion capture; time 0 is its first row.

    x runs to the right and y down in the upright picture.

    Raises:
        DataError: a file is damaged, times go back, or this camera has no events.
    """
    stream = _read_stream(recording, options)
    of_camera = stream.channel == _channel(recording)
    columns = (column[of_camera] for column in (stream.t, stream.x, stream.y, stream.p))
    events = Events(*columns, sensor_size=files.SENSOR_SIZE)
    where = f"DHP19 {recording.recording_id}"
    if len(events) == 0:
        raise DataError(f"{where}: expected a recording, got no events of this camera among {len(stream.t)}")
    return check_events(events, where)


def read_windows(recording: Recording, options: Options) -> np.ndarray:
    """The authors' windows as ranges [W, 2] int64 into the events of `read_events`.

    A window closes with the 30,000th event of all four cameras after filtering; the incomplete last one is dropped,
    and so are windows that end after the motion capture. Window i is the same stretch of time in every camera. A
    camera without events in a window has an empty range there, so that windows stay numbered alike.

    Raises:
        DataError: a file is damaged.
    """
    return _windows(recording, options)[0]


def read_window_labels(recording: Recording, options: Options) -> Labels:
    """The authors' labels of the windows of `read_windows`, one row a window: the joints' mean position over it.

    The mean, without NaN, of the 3D positions from the row nearest the end of the window before (the first row for the
    first window) to the row nearest the end of this one, both included; then projected. `labels_at_windows` instead
    averages projected positions, over the rows between a window's first and last event.

    Raises:
        DataError: a file is damaged.
    Source: ExtractEventsToFramesAndMeanLabels.m (last_k .. k).
    """
    _, end_us, rows = _windows(recording, options)
    vicon = files.read_vicon(_label_file(recording))
    means = np.empty((len(rows), *vicon.shape[1:]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a joint never seen in the window has the mean NaN
        for number, (first, last) in enumerate(rows):
            means[number] = np.nanmean(vicon[first : last + 1], axis=0)
    return _labels(recording, means, end_us, options)


def read_labels(recording: Recording, options: Options) -> Labels:
    """Raw: the motion capture, 100 rows a second from time 0 on. Frames: the label of each frame.

    A joint is visible where 0 < u <= width and 0 < v <= height, as in the authors' mask, and its position is known.

    Raises:
        DataError: a file is damaged, or the numbers of frames and of labels differ.
    """
    path = _label_file(recording)
    if path.suffix == ".mat":
        vicon = files.read_vicon(path)
        return _labels(recording, vicon, np.arange(len(vicon), dtype=np.int64) * files.VICON_PERIOD_US, options)
    positions = files.read_frame_labels(path, recording.files[0] if recording.has_event_images else None)
    return _labels(recording, positions, _frame_times(len(positions)), options)


def read_event_images(recording: Recording, options: Options) -> ImageTrack:
    """The frames of one camera [N, 260, 346] uint8 (344 where they were cropped on the right), normalised by 3 sigma.

    Raises:
        DataError: a file is damaged, or the numbers of frames and of labels differ.
    """
    count = len(files.read_frame_labels(_label_file(recording), recording.files[0]))
    images = files.read_frames(recording.files[0], _channel(recording), count)
    return ImageTrack(images, _frame_times(count))


def read_camera(recording: Recording, options: Options) -> Camera:
    """The camera of a recording; the world is the motion capture's, in m.

    Raises:
        DataError: no projection matrix can be read.
    """
    path = recording.files[-1]
    return files.camera_of(files.read_projection(path), str(path))


def _find_layout(root: Path, options: Options) -> str:
    if options.layout != "auto":
        return options.layout
    found = [name for name, there in (("raw", _is_raw(root)), ("frames", bool(_frame_folders(root)))) if there]
    if len(found) == 2:
        raise DataError(f"{root}: holds raw recordings and frames; choose with dataset.options.layout")
    if not found:
        raise DataError(f"{root}: neither raw recordings nor frames; {EXPECTED_TREE}")
    return found[0]


def _is_raw(root: Path) -> bool:
    return (root / "DVS_movies").is_dir()


_Movement = tuple[tuple[int, int, int], Path, Path]
"""(subject, session, movement), file of events or frames, file of labels."""


def _raw_movements(root: Path) -> Iterator[_Movement]:
    for path in (root / "DVS_movies").glob("S*/session*/mov*.aedat"):
        match = re.fullmatch(r"S(\d+)/session(\d+)/mov(\d+)\.aedat", path.relative_to(root / "DVS_movies").as_posix())
        if match:
            number = _numbers(match)
            yield number, path, root / "Vicon_data" / f"S{'_'.join(map(str, number))}.mat"


def _frame_movements(root: Path) -> Iterator[_Movement]:
    folders = _frame_folders(root)
    if len(folders) != 1:
        found = ", ".join(str(folder) for folder in folders) or "none"
        raise DataError(f"{root}: expected one folder of frames, got {found}; {EXPECTED_TREE}")
    for path in folders[0].iterdir():
        match = _FRAME_FILE.fullmatch(path.name)
        if match:
            yield _numbers(match), path, path.with_name(f"{path.stem}_label.h5")


_FRAME_FILE = re.compile(r"S(\d+)_session(\d+)_mov(\d+)_\d+events\.h5")


def _frame_folders(root: Path) -> list[Path]:
    candidates = [root, *sorted(root.glob("h5_dataset_*_events/*"))]
    return [c for c in candidates if c.is_dir() and any(_FRAME_FILE.fullmatch(path.name) for path in c.iterdir())]


def _numbers(match: re.Match[str]) -> tuple[int, int, int]:
    subject, session, movement = (int(group) for group in match.groups())
    return subject, session, movement


def _is_chosen(number: tuple[int, int, int], options: Options) -> bool:
    wanted = (options.subjects, options.sessions, options.movements)
    return number not in DAMAGED and all(w is None or n in w for n, w in zip(number, wanted, strict=True))


def _label_file(recording: Recording) -> Path:
    return recording.files[-2]


def _channel(recording: Recording) -> int:
    return files.CHANNEL_OF_CAMERA[int(recording.recording_id.rpartition("/cam")[2])]


def _read_stream(recording: Recording, options: Options) -> files.Stream:
    path, labels = recording.files[0], _label_file(recording)
    return _read_unchanged_stream(path, path.stat().st_mtime_ns, labels, labels.stat().st_mtime_ns, options.filters)


@lru_cache(maxsize=4)
def _read_unchanged_stream(path: Path, written: int, labels: Path, labels_written: int, filters: bool) -> files.Stream:
    """A movement's stream is asked for by each of its cameras, for events, windows and labels: filtered once.

    The times of the last writing are there so that a file that has changed is read anew.
    """
    return files.read_stream(path, len(files.read_vicon(labels)), filters)


def _windows(recording: Recording, options: Options) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ranges [W, 2] of the authors' windows, their ends [W] us, and the first and last row [W, 2] of their labels."""
    stream, num_rows = _read_stream(recording, options), len(files.read_vicon(_label_file(recording)))
    ends = np.arange(options.events_per_window, len(stream.t) + 1, options.events_per_window, dtype=np.int64)
    end_us = stream.t[ends - 1]
    last_row = files.nearest_vicon_row(end_us)
    after = last_row >= num_rows
    count = int(np.argmax(after)) if after.any() else len(ends)
    passed = np.concatenate([[0], np.cumsum(stream.channel == _channel(recording))])
    bounds = passed[np.concatenate([[0], ends[:count]])].astype(np.int64)
    rows = np.concatenate([[0], last_row[:count]])
    return np.stack([bounds[:-1], bounds[1:]], axis=1), end_us[:count], np.stack([rows[:-1], rows[1:]], axis=1)


def _labels(recording: Recording, positions: np.ndarray, t_us: np.ndarray, options: Options) -> Labels:
    """Labels of joint positions [N, 13, 3], mm, of the motion capture, seen by the recording's camera."""
    from ctlev_core.geometry.camera import project

    camera = read_camera(recording, options)
    joints2d = project(camera, positions / 1000.0)
    labels = Labels(
        class_names=(recording.class_name,) * len(positions),
        t_us=t_us,
        joints2d=joints2d.astype(np.float32),
        visible=np.all((joints2d > 0) & (joints2d <= files.SENSOR_SIZE), axis=-1),
        joint_set=JOINT_SET,
        joints3d=(positions @ camera.R.T + 1000.0 * camera.translation).astype(np.float32),
    )
    return check_labels(labels, f"DHP19 {recording.recording_id}")


def _frame_times(count: int) -> np.ndarray:
    return (np.arange(count, dtype=np.int64) + 1) * FRAME_PERIOD_US
