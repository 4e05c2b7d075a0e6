"""Motion of one body as SMPL parameters over time: what every source of motion gives, files and sentences alike.

World frame: metres, y up, as in `ctlev_core.body.layer`; a source with another one is turned first (`move_world`).

SMPL turns the body about its pelvis J (`ctlev_core.body.rigid_motion`), which depends on the body that is drawn later;
here it is the mean SMPL body's. With any other body a motion that is turned by A is shifted by the constant
(I - A) (J_body - J), some centimetres, as if the camera stood a little elsewhere. Labels and pictures agree all the
same, because the pictures are made from the labels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from data_contracts.errors import DataError

REST_PELVIS = np.array([0.0, -0.223, 0.025])
"""m, the root joint of the mean SMPL body in its rest pose; to the centimetre, which is all it is needed to."""

Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""World with z up to world with y up: a quarter turn about x, so that nothing is mirrored."""

Y_UP_TO_Z_UP = Z_UP_TO_Y_UP.T.copy()
"""The way back, for tools that expect z up."""

LARGEST = 1e6
"""rad, m and s: no motion goes there, and not far beyond it squares of numbers overflow."""

_SAME_MOMENT = 1e-6
"""In frames: a time this close to a frame's means that frame, for times are sums of rounded numbers."""


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
    """Raise `DataError` unless shapes agree, there is a frame, times rise and every number is finite and sensible."""
    count = len(clip)
    expected = {"pose": (count, 72), "betas": (10,), "transl": (count, 3), "time_s": (count,)}
    for name, shape in expected.items():
        got = getattr(clip, name).shape
        if got != shape:
            raise DataError(f"{where}: {name} must be {list(shape)}, got {list(got)}")
    if count == 0:
        raise DataError(f"{where}: expected a motion, got one of zero frames")
    for name in ("pose", "transl", "time_s"):
        values = getattr(clip, name).reshape(count, -1)
        for what, is_right in (("not finite", np.isfinite(values)), (f"beyond {LARGEST:g}", np.abs(values) <= LARGEST)):
            wrong = ~is_right.all(axis=1)
            if wrong.any():
                raise DataError(f"{where}: {name} of frame {int(np.argmax(wrong))} is {what}")
    if not np.isfinite(clip.betas).all():
        raise DataError(f"{where}: betas are not finite: {clip.betas.tolist()}")
    late = np.flatnonzero(np.diff(clip.time_s) <= 0)
    if len(late):
        frame = int(late[0]) + 1
        raise DataError(
            f"{where}: times must rise, frame {frame} follows {clip.time_s[frame - 1]} s at {clip.time_s[frame]} s"
        )
    return clip


def take(clip: MotionClip, frames: np.ndarray) -> MotionClip:
    """The frames with the given rising indices [N], at their times."""
    return replace(clip, pose=clip.pose[frames], transl=clip.transl[frames], time_s=clip.time_s[frames])


def move_world(clip: MotionClip, rotation: np.ndarray, translation: np.ndarray) -> MotionClip:
    """The same motion after the rigid motion X' = rotation X + translation of the world.

    Args:
        clip: T frames.
        rotation: [3, 3] float64.
        translation: [3] or [T, 3] float64, m.
    """
    from ctlev_core.body.rigid_motion import move_roots
    from ctlev_core.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle

    pose = clip.pose.copy()
    root, transl = move_roots(matrix_from_axis_angle(pose[:, :3]), clip.transl, REST_PELVIS, rotation, translation)
    pose[:, :3] = axis_angle_from_matrix(root)
    return replace(clip, pose=pose, transl=transl)


def times_at_rate(clip: MotionClip, rate_hz: float) -> np.ndarray:
    """Times [N] float64, s, from the first frame on, `rate_hz` a second, none after the last frame.

    Raises:
        ValueError: the rate is not positive.
    """
    if not 0 < rate_hz < np.inf:
        raise ValueError(f"rate_hz must be positive, got {rate_hz}")
    start, stop = float(clip.time_s[0]), float(clip.time_s[-1])
    moments = np.arange(int(np.floor((stop - start) * rate_hz + _SAME_MOMENT)) + 1)
    # The sum may pass the last frame by its rounding.
    return np.minimum(start + moments / rate_hz, stop)


def resample(clip: MotionClip, time_s: np.ndarray) -> MotionClip:
    """The motion at other times, between two frames on the shortest path from one to the other.

    Each joint turns at constant angular speed on SO(3), so that an axis-angle vector that jumps by 2 pi between two
    frames means nothing; positions go straight. At the time of a frame the result is that frame, digit for digit.

    Args:
        clip: T frames; one is enough.
        time_s: [N] float64, rising, each between the first and the last frame.
    Returns:
        N frames; axis-angle vectors between frames have lengths of at most pi.
    Raises:
        ValueError: times do not rise, or one lies outside the clip.
    """
    from ctlev_core.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle, slerp

    time_s = np.asarray(time_s, dtype=np.float64)
    if time_s.ndim != 1 or not np.isfinite(time_s).all() or (np.diff(time_s) <= 0).any():
        raise ValueError(f"time_s must be [N], finite and rising, got {time_s.shape}")
    if len(time_s) and not (clip.time_s[0] <= time_s[0] and time_s[-1] <= clip.time_s[-1]):
        span = f"{clip.time_s[0]} .. {clip.time_s[-1]} s"
        raise ValueError(f"time_s must lie in {span} of the clip, got {time_s[0]} .. {time_s[-1]} s")
    # As a number of frames: 2.25 is a quarter of the way from frame 2 to frame 3.
    position = np.interp(time_s, clip.time_s, np.arange(len(clip)))
    nearest = np.rint(position).astype(np.int64)
    between = np.flatnonzero(np.abs(position - nearest) > _SAME_MOMENT)
    result = take(clip, nearest)
    before = np.floor(position[between]).astype(np.int64)
    fraction = position[between] - before
    start, end = (matrix_from_axis_angle(clip.pose[frames].reshape(-1, 24, 3)) for frames in (before, before + 1))
    result.pose[between] = axis_angle_from_matrix(slerp(start, end, fraction[:, None])).reshape(-1, 72)
    step = clip.transl[before + 1] - clip.transl[before]
    result.transl[between] = clip.transl[before] + fraction[:, None] * step
    return replace(result, time_s=time_s)
