"""AMASS: motion capture as SMPL-H or SMPL-X sequences; poses to sample from, without events.

Root and layout as published, one folder a sub-dataset, in it one a subject:

    AMASS/
      ACCAD/
        Female1General_c3d/
          A1 - Stand_poses.npz    (SMPL-H: poses [T, 156], trans [T, 3], betas [16], mocap_framerate, gender, dmpls)
          shape.npz               (not a motion; left alone)
      CMU/
        01/
          01_01_stageii.npz       (SMPL-X: poses [T, 165], trans, betas, mocap_frame_rate and more)
          neutral_stagei.npz      (not a motion; left alone)

SMPL's 24 joints are the root and 21 body joints, which SMPL-H and SMPL-X have first and in the same order, and two
hands, which those have as fingers instead: the two hands are straight here (zero rotation). The first ten shape
coefficients are kept; those of SMPL-H, SMPL-X and of the female and male bodies are not quite SMPL's, so shapes are
plausible ones and not the actors'. Gender and soft tissue (dmpls) are ignored.

AMASS has z up; it is turned to y up, then seen by a virtual camera (`ctlev_core.dataset_files.pose_sources`).

Source: Mahmood et al., AMASS, ICCV 2019 (amass.is.tue.mpg.de, own licence); ControlEvents, section 4.3: challenging
poses from AMASS to sample from.
"""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

import numpy as np
from pydantic import Field

from ctlev_core.dataset_files.pose_sources import (
    Z_UP_TO_Y_UP,
    PoseSourceOptions,
    SmplSequence,
    check_sequence,
    move_world,
)
from ctlev_core.dataset_files.pose_sources import labels_before_camera as _labels_before_camera
from ctlev_core.dataset_files.trees import check_inside, check_root, list_folder, recording_ids
from ctlev_core.format_files import array_files
from data_contracts.config import RUN_SETTING
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import Labels, Part, Recording

VERSION = 1

MOTION_ENDINGS = ("_poses.npz", "_stageii.npz")
POSE_COLUMNS = {156: "SMPL-H", 165: "SMPL-X"}
NUM_BODY = 66
"""Columns of the root and the 21 body joints."""
MAX_BYTES = 2 * 2**30
"""Of one array; the longest motion takes a hundredth of it."""
RATE_KEYS = ("mocap_framerate", "mocap_frame_rate")

EXPECTED_TREE = """expected unpacked sub-datasets of AMASS (SMPL+H G or SMPL-X):
  ROOT/
    ACCAD/
      Female1General_c3d/
        A1 - Stand_poses.npz       (SMPL-X: A1_-_Stand_stageii.npz)
    CMU/
      01/
        01_01_poses.npz"""


class Options(PoseSourceOptions):
    """Options of AMASS."""

    root: Path = Field(json_schema_extra=RUN_SETTING, description="the folder that holds the sub-datasets")
    subsets: tuple[str, ...] = Field(default=(), description="only these sub-datasets, such as ACCAD; empty = all")
    max_recordings: int | None = Field(default=None, ge=1, description="at most so many, evenly spread; None = all")


def list_recordings(options: Options) -> list[Recording]:
    """Every motion, sorted by path; label-only recordings of the split `condition`.

    The id is the path in the root, other characters than letters, digits, `.`, `_` and `-` as `_`; the subject is
    `<sub-dataset>/<subject folder>`.

    Raises:
        DataError: the tree is not as expected (the message says where and shows it), or an unknown sub-dataset.
    """
    root = check_root(options.root, EXPECTED_TREE, _is_root)
    folders = {entry.name: entry for entry in list_folder(root) if entry.is_dir()}
    unknown = [name for name in options.subsets if name not in folders]
    if unknown:
        raise DataError(f"{root}: no sub-dataset {unknown[0]!r}; there are: {', '.join(folders)}")
    files = []
    for name in sorted(set(options.subsets) or folders):
        motions = [check_inside(file, root) for file in _motions(folders[name])]
        if not motions:
            raise DataError(f"{folders[name]}: a sub-dataset without motions; {EXPECTED_TREE}")
        files += motions
    recordings = []
    for name, file in zip(recording_ids(files, root), files, strict=True):
        subject = name.rpartition("/")[0]
        recordings.append(Recording(name, subject, (Part("condition"),), has_events=False, files=(file,)))
    if options.max_recordings is None or len(recordings) <= options.max_recordings:
        return recordings
    middles = (2 * np.arange(options.max_recordings) + 1) * len(recordings) // (2 * options.max_recordings)
    return [recordings[index] for index in middles]


def read_events(recording: Recording, options: Options) -> Events:
    """There are none.

    Raises:
        DataError: always.
    """
    raise DataError(f"amass {recording.recording_id}: a pose source has no events")


def read_labels(recording: Recording, options: Options) -> Labels:
    """SMPL labels of the chosen moments, in the frame of the recording's virtual camera.

    Raises:
        DataError: the file cannot be read, lacks a key, has other shapes, no frames, or numbers that are not finite.
    """
    sequence = read_sequence(recording.files[0])
    return _labels_before_camera(sequence, recording.class_name, recording.recording_id, options)


def read_sequence(file: Path) -> SmplSequence:
    """The motion of a file, every frame, in a world with y up.

    Raises:
        DataError: as `read_labels`.
    """
    keys = _read_arrays(file)
    poses, transl, betas = keys["poses"], keys["trans"], keys["betas"]
    if poses.ndim != 2 or poses.shape[1] not in POSE_COLUMNS:
        known = " or ".join(f"[T, {columns}] ({name})" for columns, name in POSE_COLUMNS.items())
        raise DataError(f"{file}: poses must be {known}, got {list(poses.shape)}")
    if betas.ndim != 1 or len(betas) < 10:
        raise DataError(f"{file}: betas must be at least 10 numbers, got {list(betas.shape)}")
    if keys["rate"].size != 1:
        raise DataError(f"{file}: the frame rate must be one number, got {list(keys['rate'].shape)}")
    pose = np.zeros((len(poses), 72))
    pose[:, :NUM_BODY] = poses[:, :NUM_BODY]
    sequence = SmplSequence(pose, betas[:10], transl, float(keys["rate"].reshape(())))
    return move_world(check_sequence(sequence, str(file)), Z_UP_TO_Y_UP, np.zeros(3))


def _read_arrays(file: Path) -> dict[str, np.ndarray]:
    """`poses`, `trans`, `betas` and `rate` as float64; the other arrays, some of them pickled, stay unread."""
    try:
        with zipfile.ZipFile(file) as archive:
            members = {name.removesuffix(".npy"): name for name in archive.namelist()}
            rate_key = next((key for key in RATE_KEYS if key in members), RATE_KEYS[0])
            missing = [key for key in ("poses", "trans", "betas", rate_key) if key not in members]
            if missing:
                raise DataError(f"{file}: lacks {', '.join(missing)}; found {', '.join(members)}")
            wanted = {"poses": "poses", "trans": "trans", "betas": "betas", "rate": rate_key}
            return {name: _read_array(archive, members[key], f"{file}: {key}") for name, key in wanted.items()}
    except DataError:
        raise
    except Exception as error:  # a damaged archive can raise nearly any error
        raise DataError(
            f"{file}: cannot be read as a motion of AMASS (.npz): {type(error).__name__}: {error}"
        ) from error


def _read_array(archive: zipfile.ZipFile, member: str, where: str) -> np.ndarray:
    size = archive.getinfo(member).file_size
    if size > MAX_BYTES:
        raise DataError(f"{where} has {size} bytes, more than the limit of {MAX_BYTES}")
    with archive.open(member) as file:
        header = array_files.read_array_header(file, where, size)
        if header.dtype.kind not in "fiu":
            raise DataError(f"{where} must be numbers, got {header.dtype}")
        items = array_files.read_items(file, header.dtype, math.prod(header.shape), where)
    return items.reshape(header.shape, order="F" if header.fortran_order else "C").astype(np.float64)


def _is_root(folder: Path) -> bool:
    return any(next(folder.glob(f"*/*/*{ending}"), None) is not None for ending in MOTION_ENDINGS)


def _motions(subset: Path) -> list[Path]:
    """Files of motions of a sub-dataset, sorted."""
    subjects = [entry for entry in list_folder(subset) if entry.is_dir()]
    return [file for subject in subjects for file in list_folder(subject) if file.name.endswith(MOTION_ENDINGS)]
