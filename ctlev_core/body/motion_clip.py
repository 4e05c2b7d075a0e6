"""Motion of one body as SMPL parameters over time: what every source of motion gives, files and sentences alike.

World frame: metres, y up, as in `ctlev_core.body.layer`; a source with another one is turned first (`move_world`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_contracts.errors import DataError


@dataclass(frozen=True, eq=False)
class MotionClip:
    """The motion of one body.

    Attributes:
        pose: [T, 72] float64, rad, axis-angle of the 24 SMPL joints, the root's first.
        betas: [10] float64, shape coefficients.
        transl: [T, 3] float64, m, added to the body that turned about its pelvis.
        time_s: [T] float64, strictly rising; 0 is the start of the source.
        caption: what happens, in words; empty where the source has none.
    """

    pose: np.ndarray
    betas: np.ndarray
    transl: np.ndarray
    time_s: np.ndarray
    caption: str = ""

    def __len__(self) -> int:
        return len(self.time_s)


def check_clip(clip: MotionClip, where: str) -> MotionClip:
    """Raise `DataError` unless shapes agree, there is a frame, times rise and every number is finite."""
    count = len(clip)
    expected = {"pose": (count, 72), "betas": (10,), "transl": (count, 3), "time_s": (count,)}
    for name, shape in expected.items():
        got = getattr(clip, name).shape
        if got != shape:
            raise DataError(f"{where}: {name} must be {list(shape)}, got {list(got)}")
    if count == 0:
        raise DataError(f"{where}: expected a motion, got one of zero frames")
    for name in ("pose", "transl", "time_s"):
        wrong = ~np.isfinite(getattr(clip, name).reshape(count, -1)).all(axis=1)
        if wrong.any():
            raise DataError(f"{where}: {name} of frame {int(np.argmax(wrong))} is not finite")
    if not np.isfinite(clip.betas).all():
        raise DataError(f"{where}: betas are not finite: {clip.betas.tolist()}")
    late = np.flatnonzero(np.diff(clip.time_s) <= 0)
    if len(late):
        frame = int(late[0]) + 1
        raise DataError(
            f"{where}: times must rise, frame {frame} follows {clip.time_s[frame - 1]} s at {clip.time_s[frame]} s"
        )
    return clip
