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

import math
import zipfile
from pathlib import Path

import numpy as np

from ctlev_core.body.motion_clip import Z_UP_TO_Y_UP, MotionClip, check_clip, move_world
from ctlev_core.format_files import array_files
from data_contracts.errors import DataError

VERSION = 1
SUFFIXES = (".npz",)

POSE_COLUMNS = {156: "SMPL-H", 165: "SMPL-X"}
NUM_BODY = 66
"""Columns of the root and the 21 body joints."""
MAX_BYTES = 2 * 2**30
"""Of one array; the longest motion takes a hundredth of it."""
RATE_KEYS = ("mocap_framerate", "mocap_frame_rate")


def sniff(path: Path) -> bool:
    """Is it an .npz with poses, positions and what only AMASS says: the rate of the capture, or the actor's gender?"""
    with path.open("rb") as file:
        if file.read(4) != b"PK\x03\x04":
            return False
    try:
        with zipfile.ZipFile(path) as archive:
            members = {name.removesuffix(".npy") for name in archive.namelist()}
    except (zipfile.BadZipFile, NotImplementedError, ValueError):
        return False
    return {"poses", "trans"} <= members and not members.isdisjoint({*RATE_KEYS, "gender"})


def read(path: Path) -> MotionClip:
    """The motion of a file, every frame, in a world with y up.

    Raises:
        DataError: the file cannot be read, lacks a key, has other shapes, no frames, or numbers that are not finite.
    """
    keys = _read_arrays(path)
    poses, transl, betas = keys["poses"], keys["trans"], keys["betas"]
    if poses.ndim != 2 or poses.shape[1] not in POSE_COLUMNS:
        known = " or ".join(f"[T, {columns}] ({name})" for columns, name in POSE_COLUMNS.items())
        raise DataError(f"{path}: poses must be {known}, got {list(poses.shape)}")
    if betas.ndim != 1 or len(betas) < 10:
        raise DataError(f"{path}: betas must be at least 10 numbers, got {list(betas.shape)}")
    if keys["rate"].size != 1:
        raise DataError(f"{path}: the frame rate must be one number, got {list(keys['rate'].shape)}")
    rate_hz = float(keys["rate"].reshape(()))
    if not 0 < rate_hz < np.inf:
        raise DataError(f"{path}: the frame rate must be positive, got {rate_hz}")
    pose = np.zeros((len(poses), 72))
    pose[:, :NUM_BODY] = poses[:, :NUM_BODY]
    clip = MotionClip(pose, betas[:10], transl, np.arange(len(poses)) / rate_hz)
    return move_world(check_clip(clip, str(path)), Z_UP_TO_Y_UP, np.zeros(3))


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
