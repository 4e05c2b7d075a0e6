"""SMPL parameters as bare arrays, as text-to-motion and pose estimation tools write them (.npy, .npz).

Layouts, T frames of 24 joints:

    [T, 72] [T, 24, 3]             axis-angle
    [T, 75]                        position, axis-angle
    [T, 82]                        axis-angle, shape
    [T, 85]                        position, axis-angle, shape (the order of Event-HPE's files)
    [T, 24, 3, 3]                  matrices
    [T, 24, 6] [24, 6, T]          6D: the first two rows of the matrix
    [25, 6, T] [1, 25, 6, T]       6D, then in the first three of the last row the position of the pelvis (MDM)

A .npy file holds one of these, or the dictionary of MDM's `sample##_rep##_smpl_params.npy` (`thetas` [24, 6, T],
`root_translation` [3, T], `text`). An .npz holds poses, and it may hold positions, shape and frame rate, under any of
the names below; `global_orient` and `body_pose` ([T, 69], or [T, 63] without hands) are taken as well. Arrays of joint
positions are not of this format; [T, 24, 3] is one of them where its bones have lengths such as a body's.

Nothing in such a file says which way is up or how fast it is: y is taken as up, as MDM and HumanML3D have it, and
20 frames a second unless the file, or who reads it, says another rate.

Source: Tevet et al., MDM, ICLR 2023 (github.com/GuyTevet/motion-diffusion-model `visualize/vis_utils.py`, which writes
the 6D of PyTorch3D: rows, where Zhou et al., CVPR 2019, have columns); Event-HPE (github.com/JimmyZou/EventHPE).
"""

from __future__ import annotations

import mmap
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.body.motion.clip import REST_PELVIS, MotionClip, check_clip
from ctlev_core.safe_files import numpy_files
from data_contracts.errors import DataError

VERSION = 1
SUFFIXES = (".npy", ".npz")
HAS_SIGNATURE = False
RATE_HZ = 20.0
"""Frames a second where the file does not say: HumanML3D's, and of the tools that learn from it."""

POSE_NAMES = ("poses", "pose", "smpl_poses", "smpl_pose", "thetas", "full_pose")
TRANSL_NAMES = ("trans", "transl", "tran", "smpl_trans")
BETAS_NAMES = ("betas", "beta", "shape", "smpl_betas")
RATE_NAMES = ("fps", "frame_rate", "framerate", "mocap_framerate", "mocap_frame_rate")

_COLUMNS = {
    72: (("pose", 72),),
    75: (("transl", 3), ("pose", 72)),
    82: (("pose", 72), ("betas", 10)),
    85: (("transl", 3), ("pose", 72), ("betas", 10)),
}
_LAYOUTS = (
    "[T, 72], [T, 75], [T, 82], [T, 85], [T, 24, 3] (axis-angle), [T, 24, 3, 3] (matrices), [T, 24, 6], [24, 6, T], "
    "[25, 6, T] or [1, 25, 6, T] (6D)"
)
_LARGEST = 1e6


def sniff(path: Path) -> bool:
    """Has the array, or the dictionary of arrays, one of the layouts, and is it no array of joint positions?"""
    names = numpy_files.list_npz(path)
    if names:
        return not {*POSE_NAMES, "body_pose"}.isdisjoint(names)
    shape = numpy_files.read_shape(path)
    if shape is not None:
        from ctlev_core.body.motion.inverse_kinematics import are_positions

        return _is_known(shape) and not (shape[1:] == (24, 3) and are_positions(_read_array(path)))
    with path.open("rb") as file:
        if file.read(6) != b"\x93NUMPY":
            return False
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            return content.find(b"thetas") >= 0


def read(path: Path, rate_hz: float = RATE_HZ) -> MotionClip:
    """The motion of a file, every frame; the world is that of the file.

    Args:
        path: the file.
        rate_hz: frames a second where the file does not say.
    Raises:
        DataError: the file cannot be read, holds code, an array has an unknown layout or another number of frames,
            there are several motions or no frames, a rotation is degenerate, or a number is not finite.
    """
    where = str(path)
    if numpy_files.list_npz(path):
        found = _read_npz(path)
    elif numpy_files.read_shape(path) is not None:
        found = _split(_read_array(path), where)
    else:
        loaded = numpy_files.read_dictionary(path)
        if "thetas" not in loaded:
            raise DataError(f"{where}: lacks thetas; found {', '.join(map(str, loaded))}")
        found = _of_dictionary(loaded, where)
    rate = found.get("rate", np.array(rate_hz))
    if rate.size != 1 or not 0 < float(rate.reshape(())) < np.inf:
        raise DataError(f"{where}: the frame rate must be one positive number, got {rate.tolist()}")
    pose = found["pose"]
    transl = found.get("transl", np.zeros((len(pose), 3)))
    betas = _one_shape(found.get("betas", np.zeros(10)), where)
    time_s = np.arange(len(pose)) / float(rate.reshape(()))
    return check_clip(MotionClip(pose, betas, transl, time_s, str(found.get("text", ""))), where)


def _is_known(shape: tuple[int, ...]) -> bool:
    flat = len(shape) == 2 and shape[1] in _COLUMNS
    by_joint = shape[1:] in ((24, 3), (24, 3, 3), (24, 6))
    time_last = len(shape) == 3 and shape[:2] in ((24, 6), (25, 6))
    return flat or by_joint or time_last or (len(shape) == 4 and shape[1:3] == (25, 6))


def _read_array(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        return numpy_files.read_numbers(file, path.stat().st_size, str(path))


def _split(array: np.ndarray, where: str) -> dict[str, Any]:
    """`pose` [T, 72] and what else an array of a known layout holds."""
    from ctlev_core.body.rotations import axis_angle_from_matrix

    if not _is_known(array.shape):
        raise DataError(f"{where}: poses must be {_LAYOUTS}, got {list(array.shape)}")
    if array.size == 0:
        raise DataError(f"{where}: expected a motion, got one of zero frames: {list(array.shape)}")
    # SciPy refuses or repairs wrong rotations without saying where, so they are looked for before.
    frames = np.moveaxis(array, -1, 0) if array.ndim > 2 and array.shape[-2] == 6 else array
    wrong = ~(np.abs(frames.reshape(len(frames), -1)) < _LARGEST).all(axis=1)
    if wrong.any():
        raise DataError(f"{where}: frame {int(np.argmax(wrong))} holds a number that is not finite, or no pose's")
    if frames.ndim == 2:
        widths = _COLUMNS[frames.shape[1]]
        ends = np.cumsum([width for _, width in widths])
        return dict(zip([name for name, _ in widths], np.split(frames, ends[:-1], axis=1), strict=True))
    if frames.shape[1:] == (24, 3):
        return {"pose": frames.reshape(-1, 72)}
    if frames.ndim == 4 and frames.shape[-1] == 6:
        if frames.shape[1] != 1:
            raise DataError(f"{where}: holds {frames.shape[1]} motions; expected one a file")
        frames = frames[:, 0]
    found = {}
    if frames.shape[1] == 25:
        found["transl"] = frames[:, 24, :3] - REST_PELVIS
    matrices = frames if frames.shape[1:] == (24, 3, 3) else _matrices_of_rows(frames[:, :24], where)
    _check_rotations(matrices, where)
    return {"pose": axis_angle_from_matrix(matrices).reshape(-1, 72), **found}


def _matrices_of_rows(sixes: np.ndarray, where: str) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of their first two rows [..., 6]."""
    from ctlev_core.body.rotations import matrix_from_rotation_6d

    try:
        # That function takes columns, as Zhou et al. have it.
        return np.swapaxes(matrix_from_rotation_6d(sixes), -1, -2)
    except DataError as error:
        raise DataError(f"{where}: {error}") from None


def _check_rotations(matrices: np.ndarray, where: str) -> None:
    # Float32 tools leave 1e-6, and networks that predict nine numbers a little more.
    error = np.abs(np.swapaxes(matrices, -1, -2) @ matrices - np.eye(3)).reshape(len(matrices), -1).max(axis=1)
    wrong = ~(error < 1e-2) | (np.linalg.det(matrices) < 0).any(axis=-1)
    if wrong.any():
        raise DataError(f"{where}: a matrix of frame {int(np.argmax(wrong))} is no rotation")


def _of_dictionary(arrays: dict[Any, Any], where: str) -> dict[str, Any]:
    """Pose, position and the rest of named arrays."""
    found: dict[str, Any] = {}
    pose = _first(arrays, POSE_NAMES, where)
    root, body = (_first(arrays, (name,), where) for name in ("global_orient", "body_pose"))
    if pose is not None:
        found = _split(pose, where)
    elif root is not None and body is not None:
        found["pose"] = _joined(root, body, where)
    else:
        raise DataError(f"{where}: lacks poses; found {', '.join(map(str, arrays))}")
    for name, names in (("transl", TRANSL_NAMES), ("betas", BETAS_NAMES), ("rate", RATE_NAMES)):
        array = _first(arrays, names, where)
        if array is not None:
            found[name] = array
    pelvis = _first(arrays, ("root_translation",), where)
    if pelvis is not None:
        # MDM's: the pelvis itself, time last.
        if pelvis.ndim != 2 or len(pelvis) != 3:
            raise DataError(f"{where}: root_translation must be [3, T], got {list(pelvis.shape)}")
        found["transl"] = pelvis.T - REST_PELVIS
    if isinstance(arrays.get("text"), str):
        found["text"] = arrays["text"]
    return found


def _first(arrays: dict[Any, Any], names: tuple[str, ...], where: str) -> np.ndarray | None:
    name = next((name for name in names if name in arrays), None)
    if name is None:
        return None
    array = np.asarray(arrays[name])
    if array.dtype.kind not in "fiu" or (array.ndim == 0 and name not in RATE_NAMES):
        raise DataError(f"{where}: {name} must be numbers, got {type(arrays[name]).__name__} {array.dtype}")
    if array.size == 0:
        raise DataError(f"{where}: {name} is empty: {list(array.shape)}")
    with np.errstate(invalid="ignore"):  # a signalling NaN; it is refused later
        return array.astype(np.float64)


def _joined(root: np.ndarray, body: np.ndarray, where: str) -> np.ndarray:
    root, body = (part.reshape(len(part), -1) for part in (root, body))
    if root.shape[1] != 3 or body.shape[1] not in (63, 69) or len(root) != len(body):
        raise DataError(
            f"{where}: global_orient and body_pose must be [T, 3] and [T, 69] or [T, 63], got {list(root.shape)} and "
            f"{list(body.shape)}"
        )
    pose = np.zeros((len(root), 72))
    pose[:, :3], pose[:, 3 : 3 + body.shape[1]] = root, body
    return pose


def _read_npz(path: Path) -> dict[str, Any]:
    known = {*POSE_NAMES, *TRANSL_NAMES, *BETAS_NAMES, *RATE_NAMES, "global_orient", "body_pose", "root_translation"}
    names = [name for name in numpy_files.list_npz(path) if name in known]
    return _of_dictionary(dict(numpy_files.read_npz(path, names, "SMPL poses")), str(path))


def _one_shape(betas: np.ndarray, where: str) -> np.ndarray:
    """The first ten coefficients; rows of a shape that is given anew in every frame must agree."""
    rows = np.atleast_2d(betas)
    if rows.ndim != 2 or rows.shape[1] < 10 or len(rows) == 0:
        raise DataError(f"{where}: the shape must be at least 10 numbers, got {list(betas.shape)}")
    other = ~(np.abs(rows[:, :10] - rows[0, :10]) < 1e-3).all(axis=1)
    if other.any():
        raise DataError(f"{where}: the shape changes in frame {int(np.argmax(other))}; expected one body")
    return rows[0, :10]
