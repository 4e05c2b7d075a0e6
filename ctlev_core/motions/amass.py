"""Motions of AMASS: motion capture as SMPL-H or SMPL-X parameters in .npz files.

    SMPL-H: poses [T, 156], trans [T, 3], betas [16], mocap_framerate, gender, dmpls
    SMPL-X: poses [T, 165], trans [T, 3], betas, mocap_frame_rate, gender and more

SMPL's 24 joints are the root and 21 body joints, which SMPL-H and SMPL-X have first and in the same order, and two
hands, which those have as fingers instead: the two hands are straight here (zero rotation). The first ten shape
coefficients are kept; those of SMPL-H, SMPL-X and of the female and male bodies are not quite SMPL's, so shapes are
plausible ones and not the actors'. Gender and soft tissue (dmpls) are ignored. AMASS has z up; it is turned to y up.

Source: Mahmood et al., AMASS, ICCV 2019 (amass.is.tue.mpg.de).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ctlev_core.body.motion.clip import Z_UP_TO_Y_UP, MotionClip, check_clip, move_world
from ctlev_core.safe_files.numpy_files import list_npz, read_npz
from data_contracts.errors import DataError

VERSION = 1
HAS_SIGNATURE = True
SUFFIXES = (".npz",)

RATE_KEYS = ("mocap_framerate", "mocap_frame_rate")


def sniff(path: Path) -> bool:
    """Is it an .npz with poses, positions and what only AMASS says: the rate of the capture, or the actor's gender?"""
    members = set(list_npz(path))
    return {"poses", "trans"} <= members and not members.isdisjoint({*RATE_KEYS, "gender"})


def read(path: Path) -> MotionClip:
    """The motion of a file, every frame, in a world with y up.

    Raises:
        DataError: the file cannot be read, lacks a key, has other shapes, no frames, or numbers that are not finite.
    """
    rate_key = next((key for key in RATE_KEYS if key in list_npz(path)), RATE_KEYS[0])
    names = ("poses", "trans", "betas", rate_key)
    poses, transl, betas, rate = read_npz(path, names, "a motion of AMASS").values()
    from ctlev_core.body.smpl_files import POSE_COLUMNS, smpl_pose_from_smplh

    if poses.ndim != 2 or poses.shape[1] not in POSE_COLUMNS:
        known = " or ".join(f"[T, {columns}] ({name})" for columns, name in POSE_COLUMNS.items())
        raise DataError(f"{path}: poses must be {known}, got {list(poses.shape)}")
    if betas.ndim != 1 or len(betas) < 10:
        raise DataError(f"{path}: betas must be at least 10 numbers, got {list(betas.shape)}")
    if rate.size != 1:
        raise DataError(f"{path}: the frame rate must be one number, got {list(rate.shape)}")
    rate_hz = float(rate.reshape(()))
    if not 0 < rate_hz < np.inf:
        raise DataError(f"{path}: the frame rate must be positive, got {rate_hz}")
    clip = MotionClip(smpl_pose_from_smplh(poses), betas[:10], transl, np.arange(len(poses)) / rate_hz)
    return move_world(check_clip(clip, str(path)), Z_UP_TO_Y_UP, np.zeros(3))
