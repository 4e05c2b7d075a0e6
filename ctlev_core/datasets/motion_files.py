"""A folder of your own motion files, in any format of `ctlev_core/motions`; poses to sample from, without events.

    root/
      walks/
        cmu_12_01.bvh
        humanoid3d_walk.txt        (DeepMimic)
      mdm/
        sample00_rep00_smpl_params.npy
      README.md                    (no motion; left alone)

Folders may lie in one another as deep as they like, and the content decides, not the suffix. Hidden files are left
alone, and so are files that no format recognises, unless their suffix is one that only motions have here (.bvh, .npy,
.npz, .pkl): such a file is damaged or of an unknown layout, and leaving it out unsaid would be worse than saying so.

The class is what the file says happens in it (its caption), or else its name without suffix. Formats turn every motion
to y up as far as their files say what is up; the option `up` is for those that say nothing or something wrong.

Source: ControlEvents, sections 3.4 and 4.3: poses of motion datasets and text-to-motion models to sample from.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from ctlev_core.body.motion import files as motion_formats
from ctlev_core.body.motion.clip import Z_UP_TO_Y_UP, MotionClip
from ctlev_core.body.motion.clip import move_world as _move_world
from ctlev_core.dataset_files.pose_sources import PoseSourceOptions
from ctlev_core.dataset_files.pose_sources import labels_before_camera as _labels_before_camera
from ctlev_core.dataset_files.trees import check_inside, list_folder, recording_ids
from ctlev_core.events.windows import spread
from data_contracts.config import RUN_SETTING
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import Labels, Part, Recording

VERSION = 1

TEXT_SUFFIXES = (".txt", ".json")
"""Of motions and of much else."""
MAX_NAMED = 5
_UP_AXES = {
    "x": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "-x": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "-y": np.diag([1.0, -1.0, -1.0]),
    "z": Z_UP_TO_Y_UP,
    "-z": Z_UP_TO_Y_UP.T,
}
"""The turn that makes y of an axis."""


class Options(PoseSourceOptions):
    """Options of a folder of motions."""

    root: Path = Field(json_schema_extra=RUN_SETTING, description="the folder that holds the files")
    max_recordings: int | None = Field(default=None, ge=1, description="at most so many, evenly spread; None = all")
    up: Literal["x", "-x", "y", "-y", "z", "-z"] = Field(
        default="y", description="the axis that points up in motions as they are read, where it is not y"
    )
    source_rate_hz: float | None = Field(
        default=None, gt=0, description="frames a second of files that do not say (bare arrays); None = their format's"
    )
    on_ground: bool = Field(default=False, description="shift each motion so that its lowest sole is at a height of 0")


def list_recordings(options: Options) -> list[Recording]:
    """Every motion, sorted by path; label-only recordings of the split `condition`.

    The id, which is the subject as well, is the path in the root without suffix, other characters than letters, digits,
    `.`, `_` and `-` as `_`.

    Raises:
        DataError: no such folder, no motion in it, a file with the suffix of motions that is none, or two files whose
            ids are the same.
    """
    root = options.root
    if not root.is_dir():
        raise DataError(f"{root}: {'a file, not a folder' if root.exists() else 'no such folder'}")
    formats = motion_formats.list_formats()
    suffixes = {suffix for module in formats.values() for suffix in module.SUFFIXES}
    files, others = [], []
    for file in _all_files(root, root):
        if motion_formats.find_format(file) is not None:
            files.append(file)
        elif file.suffix.lower() in suffixes - set(TEXT_SUFFIXES):
            motion_formats.read_motion(file)  # raises
        else:
            others.append(str(file.relative_to(root)))
    if not files:
        known = ", ".join(f"{name} ({', '.join(module.SUFFIXES)})" for name, module in formats.items())
        got = f"{len(others)} other files ({', '.join(others[:MAX_NAMED])})" if others else "no files"
        raise DataError(f"{root}: expected motion files of the formats {known}, found {got}")
    recordings = [
        Recording(name, name, (Part("condition"),), file.stem, has_events=False, files=(file,))
        for name, file in zip(recording_ids(files, root), files, strict=True)
    ]
    return [recordings[index] for index in spread(len(recordings), options.max_recordings)]


def read_events(recording: Recording, options: Options) -> Events:
    """There are none.

    Raises:
        DataError: always.
    """
    raise DataError(f"motion_files {recording.recording_id}: a pose source has no events")


def read_labels(recording: Recording, options: Options) -> Labels:
    """SMPL labels of the chosen moments, in the frame of the recording's virtual camera.

    Raises:
        DataError: see the `read` of the file's format.
    """
    clip = _read_clip(recording.files[0], options)
    return _labels_before_camera(clip, clip.caption or recording.class_name, recording.recording_id, options)


def _read_clip(file: Path, options: Options) -> MotionClip:
    clip = motion_formats.read_motion(file, options.source_rate_hz)
    if options.up != "y":
        clip = _move_world(clip, _UP_AXES[options.up], np.zeros(3))
    if options.on_ground:
        from ctlev_core.body.motion.ground_level import put_feet_on_ground

        clip = put_feet_on_ground(clip)
    return replace(clip, caption=" ".join(clip.caption.split()))


def _all_files(folder: Path, root: Path) -> list[Path]:
    """Files of a folder and of all folders in it that are not hidden, sorted."""
    found = []
    for entry in list_folder(folder):
        if entry.is_dir() and entry.is_symlink():
            raise DataError(
                f"{entry}: a link to the folder {entry.resolve()}; folders are not read twice, nor from afar"
            )
        check_inside(entry, root)
        found += _all_files(entry, root) if entry.is_dir() else [entry]
    return found
