"""Joint positions over time, as text-to-motion models and HumanML3D write them (.npy).

    [T, 22, 3]                     m, HumanML3D's joints: SMPL's without hands (`new_joints`)
    [T, 24, 3]                     m, SMPL's joints
    results.npy of MDM             a dictionary: motion [N, 22, 3, T], lengths [N], text (N sentences), num_samples,
                                   num_repetitions

y is up, and 20 frames a second are taken unless who reads it says another rate; the files say neither. The poses come
from the positions in closed form (`ctlev_core.body.motion.inverse_kinematics`), after the person was scaled about the
origin to have legs as long as the bundled body's; other bone lengths that differ move joints, but do not turn bones.

[T, 24, 3] may be SMPL's rotations as well, which the format `smpl_arrays` reads: these are positions where bones have
lengths such as a body's.

`read` gives the one motion of a file, `read_all` each of those that MDM wrote into one.

Source: Guo et al., HumanML3D, CVPR 2022 (github.com/EricGuo5513/HumanML3D); Tevet et al., MDM, ICLR 2023
(github.com/GuyTevet/motion-diffusion-model, `sample/generate.py`).
"""

from __future__ import annotations

import mmap
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.body.motion.clip import MotionClip, check_clip
from ctlev_core.safe_files import numpy_files
from data_contracts.errors import DataError

VERSION = 1
SUFFIXES = (".npy",)
HAS_SIGNATURE = False
RATE_HZ = 20.0
"""Frames a second of HumanML3D and of models that learned from it."""

LEG_RANGE_M = (0.35, 1.3)
"""From hip to ankle, of a child and of the tallest man with some margin: others are in another unit."""
MAX_ERROR_M = 0.15
"""Mean distance that bone lengths may leave; another order of joints leaves more."""
_KEYS = (b"motion", b"lengths", b"num_repetitions")


def sniff(path: Path) -> bool:
    """Is it an array of 22 or 24 joints in three dimensions, or what MDM calls its results?"""
    shape = numpy_files.read_shape(path)
    if shape is not None:
        if len(shape) != 3 or shape[0] == 0 or shape[1:] not in ((22, 3), (24, 3)):
            return False
        from ctlev_core.body.motion.inverse_kinematics import are_positions

        return shape[1] == 22 or are_positions(_read_array(path))
    with path.open("rb") as file:
        if file.read(6) != b"\x93NUMPY":
            return False
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            return all(content.find(key) >= 0 for key in _KEYS) and content.find(b"thetas") < 0


def read(path: Path, rate_hz: float = RATE_HZ) -> MotionClip:
    """The motion of a file, every frame.

    Args:
        path: the file.
        rate_hz: frames a second, which the file does not say.
    Raises:
        DataError: several motions in it (see `read_all`), damaged, it holds code, an array has another shape, a
            position is not finite, or the joints are no person's: another unit, or another order.
    """
    clips = read_all(path, rate_hz)
    if len(clips) != 1:
        raise DataError(
            f"{path}: holds {len(clips)} motions; expected one a file. The dataset `text_motion` takes all of them "
            f"(option `results`)"
        )
    return clips[0]


def read_all(path: Path, rate_hz: float = RATE_HZ) -> list[MotionClip]:
    """Every motion of a file, in its order, with its sentence where there is one.

    Raises:
        DataError: as `read`, but for the number of motions.
        ValueError: the rate is not positive and finite.
    """
    if not 0 < rate_hz < np.inf:
        raise ValueError(f"rate_hz must be positive and finite, got {rate_hz}")
    shape = numpy_files.read_shape(path) if path.is_file() else None
    if shape is not None:
        return [_clip(_read_array(path), "", rate_hz, str(path))]
    return _read_results(path, rate_hz)


def _read_array(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        return numpy_files.read_numbers(file, path.stat().st_size, str(path))


def _read_results(path: Path, rate_hz: float) -> list[MotionClip]:
    results = numpy_files.read_dictionary(path)
    missing = [key for key in ("motion", "lengths") if key not in results]
    if missing:
        raise DataError(f"{path}: lacks {', '.join(missing)}; found {', '.join(map(str, results))}")
    motion, lengths = results["motion"], np.asarray(results["lengths"])
    if not isinstance(motion, np.ndarray) or motion.ndim != 4 or motion.shape[1:3] not in ((22, 3), (24, 3)):
        got = list(motion.shape) if isinstance(motion, np.ndarray) else type(motion).__name__
        raise DataError(f"{path}: motion must be [N, 22, 3, T], got {got}")
    if lengths.shape != (len(motion),) or lengths.dtype.kind not in "iu":
        raise DataError(f"{path}: lengths must be {len(motion)} whole numbers, got {lengths.dtype} {lengths.shape}")
    wrong = np.flatnonzero((lengths < 1) | (lengths > motion.shape[3]))
    if len(wrong):
        raise DataError(
            f"{path}: motion {wrong[0]} has a length of {lengths[wrong[0]]} frames; there are {motion.shape[3]}"
        )
    captions = _captions(results, len(motion), path)
    return [
        # Frames after the length are padding.
        _clip(np.moveaxis(joints[..., :length], -1, 0), caption, rate_hz, f"{path}: motion {number}")
        for number, (joints, length, caption) in enumerate(zip(motion, lengths, captions, strict=True))
    ]


def _captions(results: dict[Any, Any], count: int, path: Path) -> list[str]:
    text = results.get("text", [""] * count)
    captions = text.tolist() if isinstance(text, np.ndarray) else text
    if not isinstance(captions, list | tuple) or not all(isinstance(caption, str) for caption in captions):
        raise DataError(f"{path}: text must be sentences, got {type(text).__name__}")
    if len(captions) != count:
        raise DataError(f"{path}: {len(captions)} sentences for {count} motions")
    return list(captions)


def _clip(joints: np.ndarray, caption: str, rate_hz: float, where: str) -> MotionClip:
    from ctlev_core.body.motion.inverse_kinematics import fit_pose, leg_length
    from ctlev_core.body.rotations import axis_angle_from_matrix

    fitted = fit_pose(joints, where=where)
    leg_m = leg_length(joints, where)
    if not LEG_RANGE_M[0] <= leg_m <= LEG_RANGE_M[1]:
        raise DataError(f"{where}: legs of {leg_m:.3g} from hip to ankle; expected metres, so about 0.8")
    error_m = float(fitted.error_m.mean())
    if error_m > MAX_ERROR_M:
        raise DataError(
            f"{where}: the joints are {1000 * error_m:.0f} mm from those of any pose on average; expected SMPL's "
            f"joints in SMPL's order"
        )
    count = len(joints)
    pose = axis_angle_from_matrix(fitted.rotations).reshape(count, 72)
    return check_clip(MotionClip(pose, np.zeros(10), fitted.transl, np.arange(count) / rate_hz, caption), where)
