"""Body motion of others, without events: the clips of a motion data set as labels before a virtual camera.

A still camera of each recording looks at where the body goes, and labels come in its frame (x right, y down, z
forward), which is the only frame that `Labels` knows.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from ctlev_core.body.motion.clip import (
    REST_PELVIS,
    MotionClip,
    check_clip,
    move_world,
    resample,
    times_at_rate,
)
from ctlev_core.events.windows import spread
from ctlev_core.geometry.camera import orbit_rotation
from data_contracts.config import Frozen
from data_contracts.labels import Labels, check_labels

CAMERA_STREAM = 20
MAX_OFF_AXIS_M = 0.1
"""A pelvis nearer than this to the axis of the camera asks for no more distance than was wished."""


class PoseSourceOptions(Frozen):
    """What all pose sources have in common: which moments are taken, and from where the camera looks."""

    rate_hz: float | None = Field(
        default=10.0, gt=0, description="moments a second, between frames on the shortest path; None = all frames"
    )
    max_moments: int | None = Field(default=None, ge=1, description="at most so many a recording, evenly spread")
    seed: int = Field(default=0, ge=0, description="of the side the camera looks from, drawn for each recording")
    camera: Literal["still", "centred"] = Field(
        default="still",
        description="one camera a recording, far enough to see all of the way; or, for single pictures, one that has "
        "the pelvis of each moment on its axis",
    )
    distance_m: float = Field(default=3.0, gt=0, description="smallest depth of the pelvis; more where the way asks it")
    yaw_range_deg: tuple[float, float] = Field(
        default=(-180.0, 180.0), description="turn about the vertical; 0 = from the front in the rest pose"
    )
    pitch_range_deg: tuple[float, float] = Field(default=(0.0, 15.0), description="how far the camera looks down")

    @model_validator(mode="after")
    def _ranges_rise(self) -> PoseSourceOptions:
        for name in ("yaw_range_deg", "pitch_range_deg"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} must be (low, high), got {low} .. {high}")
        return self


def choose_times(clip: MotionClip, options: PoseSourceOptions) -> np.ndarray:
    """Times [N] float64, s, of the moments that are taken, rising: those of frames, or any between the frames."""
    time_s = clip.time_s if options.rate_hz is None else times_at_rate(clip, options.rate_hz)
    return time_s[spread(len(time_s), options.max_moments)]


def labels_before_camera(clip: MotionClip, class_name: str, recording_id: str, options: PoseSourceOptions) -> Labels:
    """Labels of the chosen moments, seen by the recording's virtual camera.

    Args:
        clip: in the world frame: metres, y up.
        class_name: of every moment.
        recording_id: decides, with the seed, from where the camera looks.
        options: moments and camera.
    Returns:
        SMPL labels in the camera frame; times in microseconds on the clip's clock.
    Raises:
        DataError: see `check_clip`.
    """
    check_clip(clip, recording_id)
    rotation = _camera_rotation(recording_id, options)
    # Of the whole recording, so that the view does not depend on which moments are taken.
    way = (REST_PELVIS + clip.transl) @ rotation.T
    chosen = resample(clip, choose_times(clip, options))
    if options.camera == "still":
        translation = _still_translation(way, options.distance_m)
    else:
        translation = np.array([0.0, 0.0, options.distance_m]) - (REST_PELVIS + chosen.transl) @ rotation.T
    seen = move_world(chosen, rotation, translation)
    count = len(seen)
    labels = Labels(
        class_names=(class_name,) * count,
        t_us=np.rint(1e6 * seen.time_s).astype(np.int64),
        smpl_pose=seen.pose.astype(np.float32),
        smpl_betas=np.tile(seen.betas.astype(np.float32), (count, 1)),
        smpl_transl=seen.transl.astype(np.float32),
    )
    return check_labels(labels, recording_id)


def _still_translation(way: np.ndarray, distance_m: float) -> np.ndarray:
    """Where the world goes [3], m, so that a still camera sees a body along `way` [T, 3], m, axes of the camera."""
    from ctlev_core.labels.body_views import BODY_REACH_M, FOCAL_PER_SIDE

    low, high = way.min(axis=0), way.max(axis=0)
    centre = (low + high) / 2
    off_axis = np.abs(way - centre)[:, :2].max(axis=1)
    # At depth z the picture reaches z / (2 FOCAL_PER_SIDE) to each side.
    needed = 2 * FOCAL_PER_SIDE * (off_axis + BODY_REACH_M) - (way[:, 2] - low[2])
    needed = np.where(off_axis > MAX_OFF_AXIS_M, needed, 0.0).max()
    return np.array([-centre[0], -centre[1], max(distance_m, needed) - low[2]])


def _camera_rotation(recording_id: str, options: PoseSourceOptions) -> np.ndarray:
    """World to camera [3, 3]."""
    entropy = np.frombuffer(recording_id.encode(), np.uint8).tolist()
    random = np.random.default_rng([options.seed, CAMERA_STREAM, *entropy])
    yaw, pitch = (np.deg2rad(random.uniform(*limits)) for limits in (options.yaw_range_deg, options.pitch_range_deg))
    return orbit_rotation(yaw, pitch)
