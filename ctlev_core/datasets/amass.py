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

The files are read by the motion format `amass`, which says what becomes of fingers and shapes and turns z up to y up,
and seen by a virtual camera (`ctlev_core.dataset_files.pose_sources`).

Source: Mahmood et al., AMASS, ICCV 2019 (amass.is.tue.mpg.de, own licence); ControlEvents, section 4.3: challenging
poses from AMASS to sample from.
"""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from ctlev_core import plugins
from ctlev_core.dataset_files.pose_sources import PoseSourceOptions
from ctlev_core.dataset_files.pose_sources import labels_before_camera as _labels_before_camera
from ctlev_core.dataset_files.trees import check_inside, check_root, list_folder, recording_ids
from ctlev_core.events.windows import spread
from data_contracts.config import RUN_SETTING
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import Labels, Part, Recording

VERSION = 2

MOTION_ENDINGS = ("_poses.npz", "_stageii.npz")
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
    return [recordings[index] for index in spread(len(recordings), options.max_recordings)]


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
    clip = plugins.load("motions", "amass").read(recording.files[0])
    return _labels_before_camera(clip, recording.class_name, recording.recording_id, options)


def _is_root(folder: Path) -> bool:
    return any(next(folder.glob(f"*/*/*{ending}"), None) is not None for ending in MOTION_ENDINGS)


def _motions(subset: Path) -> list[Path]:
    """Files of motions of a sub-dataset, sorted."""
    subjects = [entry for entry in list_folder(subset) if entry.is_dir()]
    return [file for subject in subjects for file in list_folder(subject) if file.name.endswith(MOTION_ENDINGS)]
