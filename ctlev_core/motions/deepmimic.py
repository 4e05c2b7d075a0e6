"""Motions of DeepMimic's humanoid: JSON text with 44 numbers a frame.

    {"Loop": "wrap", "Frames": [[duration, root x y z, root w x y z, chest w x y z, ...], ...]}

A frame is its duration in seconds (that of the last one means nothing), the root's position in metres, and rotations:
quaternions in the order w, x, y, z, and for knees and elbows one angle about z. x is forward, y up, z to the right; the
rest pose stands with its arms hanging. The neck turns the head, and hands and toes do not move.

Whether a motion loops is not heeded; left and right are those of the joint names.

Source: Peng et al., DeepMimic, ACM TOG 2018 (github.com/xbpeng/DeepMimic, `data/motions`, and for the joints' places
`data/characters/humanoid3d.txt`).
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from ctlev_core.body.motion.clip import MotionClip
from ctlev_core.body.motion.retargeting import retarget
from ctlev_core.body.motion.source_skeleton import SkeletonMotion
from data_contracts.errors import DataError

VERSION = 1
HAS_SIGNATURE = True
SUFFIXES = (".txt", ".json")

MAX_BYTES = 2**28
NUM_COLUMNS = 44
# Name, index of the parent, place on it in metres, first column, number of columns (0: does not turn).
_JOINTS = (
    ("root", -1, (0.0, 0.0, 0.0), 4, 4),
    ("chest", 0, (0.0, 0.236151, 0.0), 8, 4),
    ("neck", 1, (0.0, 0.223894, 0.0), 12, 4),
    ("right_hip", 0, (0.0, 0.0, 0.084887), 16, 4),
    ("right_knee", 3, (0.0, -0.421546, 0.0), 20, 1),
    ("right_ankle", 4, (0.0, -0.40987, 0.0), 21, 4),
    ("right_shoulder", 1, (-0.02405, 0.2435, 0.18311), 25, 4),
    ("right_elbow", 6, (0.0, -0.274788, 0.0), 29, 1),
    ("right_wrist", 7, (0.0, -0.258947, 0.0), 0, 0),
    ("left_hip", 0, (0.0, 0.0, -0.084887), 30, 4),
    ("left_knee", 9, (0.0, -0.421546, 0.0), 34, 1),
    ("left_ankle", 10, (0.0, -0.40987, 0.0), 35, 4),
    ("left_shoulder", 1, (-0.02405, 0.2435, -0.18311), 39, 4),
    ("left_elbow", 12, (0.0, -0.274788, 0.0), 43, 1),
    ("left_wrist", 13, (0.0, -0.258947, 0.0), 0, 0),
)
_TOES = (0.2, 0.0, 0.0)
"""m, from an ankle; the humanoid's feet are boxes that point forward."""


def sniff(path: Path) -> bool:
    """Is it JSON text that names frames before anything else but flags? The humanoid itself is no motion."""
    with path.open("rb") as file:
        head = file.read(4096).removeprefix(b"\xef\xbb\xbf")
    return re.match(rb'\s*\{\s*("\w+"\s*:\s*("\w*"|\w+|\[[^\[\]]*\])\s*,\s*)*"Frames"\s*:', head) is not None


def read(path: Path) -> MotionClip:
    """The motion on SMPL's joints: metres, y up, every frame; the caption is what the file's name says.

    Raises:
        DataError: the file cannot be read, is no JSON, or cut; there are no frames, one has not 44 numbers, a number is
            not finite, a quaternion is zero, or a duration is not positive.
    """
    motion = read_skeleton_motion(path)
    landmarks = {name: number for number, (name, *_) in enumerate(_JOINTS) if name.startswith(("left", "right"))}
    clip = retarget(motion, {**landmarks, "head": 2}, str(path))
    return replace(clip, caption=path.stem.removeprefix("humanoid3d_").replace("_", " "))


def read_skeleton_motion(path: Path) -> SkeletonMotion:
    """The motion of the humanoid itself, x forward, y up.

    Raises:
        DataError: as `read`.
    """
    from ctlev_core.body.rotations import matrix_from_euler, matrix_from_quaternion

    frames = _read_frames(path)
    count, num_frames = len(_JOINTS), len(frames)
    rest = np.zeros((count, 3))
    orientation, positions = np.zeros((count, num_frames, 3, 3)), np.zeros((count, num_frames, 3))
    for number, (name, parent, place, column, size) in enumerate(_JOINTS):
        local = np.broadcast_to(np.eye(3), (num_frames, 3, 3))
        if size == 1:
            local = matrix_from_euler("Z", np.rad2deg(frames[:, column : column + 1]))
        elif size == 4:
            quaternions = frames[:, column : column + 4]
            zero = np.linalg.norm(quaternions, axis=1) < 1e-6
            if zero.any():
                raise DataError(f"{path}: the quaternion of {name} in frame {int(np.argmax(zero))} is zero")
            local = matrix_from_quaternion(quaternions[:, [1, 2, 3, 0]])
        if parent < 0:
            orientation[number], positions[number] = local, frames[:, 1:4]
        else:
            rest[number] = rest[parent] + place
            orientation[number] = orientation[parent] @ local
            positions[number] = positions[parent] + orientation[parent] @ np.array(place)
    parents = tuple(parent for _, parent, *_ in _JOINTS)
    time_s = np.concatenate([[0.0], np.cumsum(frames[:-1, 0])])
    names = tuple(name for name, *_ in _JOINTS)
    return SkeletonMotion(names, parents, rest, rest + np.array(_TOES), orientation, positions, time_s)


def _read_frames(path: Path) -> np.ndarray:
    """[T, 44] float64."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DataError(f"{path}: {path.stat().st_size} bytes, more than the limit of {MAX_BYTES}")
        loaded = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path}: damaged, or no JSON: {error}") from error
    rows = loaded.get("Frames") if isinstance(loaded, dict) else None
    if not isinstance(rows, list):
        raise DataError(f"{path}: expected an object with a list of Frames, got {type(loaded).__name__}")
    if not rows:
        raise DataError(f"{path}: expected a motion, got one of zero frames")
    for number, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != NUM_COLUMNS:
            got = f"{len(row)}" if isinstance(row, list) else type(row).__name__
            raise DataError(f"{path}: frame {number} must have {NUM_COLUMNS} numbers, got {got}")
        if not all(isinstance(value, float | int) and abs(value) < 1e9 for value in row):
            raise DataError(f"{path}: frame {number} holds something that is no finite number")
    return np.array(rows, dtype=np.float64)
