"""Motions of AIST++: 3D dance as SMPL parameters in pickles, 60 frames a second.

    smpl_poses [T, 72], smpl_trans [T, 3], smpl_scaling [1], smpl_loss

The pickles are read by `safe_files.safe_pickle` without running what they may carry. Positions are those of a body
`smpl_scaling` times as large as SMPL's, about centimetres: trans / scaling are metres of SMPL's body, as the authors'
own feature extraction has it. y is up. Shape coefficients are not given: the mean body (zeros) dances.

Source: Li et al., AI Choreographer (AIST++), ICCV 2021 (github.com/google/aistplusplus_api `aist_plusplus/loader.py`,
`demos/extract_motion_feats.py`).
"""

from __future__ import annotations

import mmap
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.body.motion.clip import MotionClip, check_clip
from data_contracts.errors import DataError

VERSION = 1
HAS_SIGNATURE = True
SUFFIXES = (".pkl",)

FRAMES_PER_SECOND = 60.0


def sniff(path: Path) -> bool:
    """Does the file name `smpl_poses` and `smpl_scaling`, and is it neither text nor an archive?"""
    with path.open("rb") as file:
        # Protocols 2 to 5; protocols 0 and 1 start with a dictionary: a mark, then `d`, or `}`.
        if not file.read(2).startswith((b"\x80", b"(d", b"}")):
            return False
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            return all(content.find(key) >= 0 for key in (b"smpl_poses", b"smpl_scaling"))


def read(path: Path) -> MotionClip:
    """The motion of a file, every frame, metres of SMPL's body, y up.

    Raises:
        DataError: the file cannot be read, holds code, lacks a key, has other shapes, no frames, or numbers that are
            not finite.
    """
    from ctlev_core.safe_files import safe_pickle

    loaded = safe_pickle.load(path)
    if not isinstance(loaded, dict):
        raise DataError(f"{path}: expected a dictionary, got {type(loaded).__name__}")
    poses, transl, scaling = (_numbers(loaded, key, path) for key in ("smpl_poses", "smpl_trans", "smpl_scaling"))
    if poses.ndim == 3 and poses.shape[1:] == (24, 3):
        poses = poses.reshape(len(poses), 72)
    if poses.ndim != 2:
        raise DataError(f"{path}: smpl_poses must be [T, 72], got {list(poses.shape)}")
    if scaling.size != 1 or not 0 < float(scaling.reshape(())) < np.inf:
        raise DataError(f"{path}: smpl_scaling must be one positive number, got {scaling.tolist()}")
    time_s = np.arange(len(poses)) / FRAMES_PER_SECOND
    return check_clip(MotionClip(poses, np.zeros(10), transl / float(scaling.reshape(())), time_s), str(path))


def _numbers(loaded: dict[Any, Any], key: str, file: Path) -> np.ndarray:
    if key not in loaded:
        raise DataError(f"{file}: lacks {key}; found {', '.join(map(str, loaded))}")
    array = np.asarray(loaded[key])
    if array.dtype.kind not in "fiu":
        raise DataError(f"{file}: {key} must be numbers, got {array.dtype}")
    return array.astype(np.float64)
