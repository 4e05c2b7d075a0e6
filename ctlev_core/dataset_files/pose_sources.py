"""Body motion of others, without events: SMPL sequences of a motion data set as labels before a virtual camera.

World frame: metres, y up, as in `ctlev_core.body.layer`; a dataset with another one is turned first. A still camera of
each recording looks at where the body goes, and labels come in its frame (x right, y down, z forward), which is the
only frame that `Labels` knows.

SMPL turns the body about its pelvis J, not about the origin: x = R (x_rest - J) + J + transl. A rigid motion of the
world, X' = A X + a, therefore makes R' = A R and transl' = A (J + transl) + a - J. J depends on the body that is
drawn later; here it is the mean SMPL body's. With any other body the whole recording is shifted by the constant
(I - A) (J_body - J), some centimetres, as if the camera stood a little elsewhere. Labels and pictures agree all the
same, because the pictures are made from the labels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.labels import Labels, check_labels

REST_PELVIS = np.array([0.0, -0.223, 0.025])
"""m, the root joint of the mean SMPL body in its rest pose; to the centimetre, which is all it is needed to."""

Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""World with z up to world with y up: a quarter turn about x, so that nothing is mirrored."""

CAMERA_STREAM = 20


class PoseSourceOptions(Frozen):
    """What all pose sources have in common: which moments are taken, and from where the camera looks."""

    rate_hz: float | None = Field(
        default=10.0, gt=0, description="moments a second, each the nearest frame, none interpolated; None = all frames"
    )
    max_moments: int | None = Field(default=None, ge=1, description="at most so many a recording, evenly spread")
    seed: int = Field(default=0, ge=0, description="of the side the camera looks from, drawn for each recording")
    camera: Literal["still", "centred"] = Field(
        default="still",
        description="one camera a recording, far enough to see all of the way; or, for single pictures, one that has "
        "the pelvis of each moment on its axis",
    )
    distance_m: float = Field(default=3.0, gt=0, description="smallest depth of the pelvis")
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


@dataclass(frozen=True, eq=False)
class SmplSequence:
    """The motion of one body.

    Attributes:
        pose: [T, 72] float64, rad, axis-angle of the 24 SMPL joints, the root's first.
        betas: [10] float64, shape coefficients.
        transl: [T, 3] float64, m.
        rate_hz: frames a second.
    """

    pose: np.ndarray
    betas: np.ndarray
    transl: np.ndarray
    rate_hz: float

    def __len__(self) -> int:
        return len(self.pose)


def check_sequence(sequence: SmplSequence, where: str) -> SmplSequence:
    """Raise `DataError` unless shapes agree, there is a frame, and every number is finite."""
    count = len(sequence)
    expected = {"pose": (count, 72), "betas": (10,), "transl": (count, 3)}
    for name, shape in expected.items():
        if getattr(sequence, name).shape != shape:
            raise DataError(f"{where}: {name} must be {list(shape)}, got {list(getattr(sequence, name).shape)}")
    if count == 0:
        raise DataError(f"{where}: expected a motion, got one of zero frames")
    if not 0 < sequence.rate_hz < np.inf:
        raise DataError(f"{where}: the frame rate must be positive, got {sequence.rate_hz}")
    for name in ("pose", "transl"):
        wrong = ~np.isfinite(getattr(sequence, name)).all(axis=1)
        if wrong.any():
            raise DataError(f"{where}: {name} of frame {int(np.argmax(wrong))} is not finite")
    if not np.isfinite(sequence.betas).all():
        raise DataError(f"{where}: betas are not finite: {sequence.betas.tolist()}")
    return sequence


def move_world(sequence: SmplSequence, rotation: np.ndarray, translation: np.ndarray) -> SmplSequence:
    """The same motion after the rigid motion X' = rotation X + translation of the world.

    Args:
        sequence: T frames.
        rotation: [3, 3] float64.
        translation: [3] or [T, 3] float64, m.
    """
    from ctlev_core.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle

    pose = sequence.pose.copy()
    pose[:, :3] = axis_angle_from_matrix(rotation @ matrix_from_axis_angle(pose[:, :3]))
    transl = (REST_PELVIS + sequence.transl) @ rotation.T + translation - REST_PELVIS
    return replace(sequence, pose=pose, transl=transl)


def choose_frames(count: int, rate_hz: float, options: PoseSourceOptions, where: str) -> np.ndarray:
    """Indices [N] int64 of the frames that are taken, rising.

    Raises:
        DataError: more moments a second are asked for than there are frames.
    """
    frames = np.arange(count, dtype=np.int64)
    if options.rate_hz is not None:
        if options.rate_hz > rate_hz * (1 + 1e-6):
            raise DataError(f"{where}: {options.rate_hz} moments a second asked for, it has {rate_hz} frames a second")
        nearest = np.floor(frames * (rate_hz / options.rate_hz) + 0.5).astype(np.int64)
        frames = np.unique(nearest[nearest < count])
    if options.max_moments is not None and len(frames) > options.max_moments:
        # The middle of each of max_moments equal stretches.
        middles = (2 * np.arange(options.max_moments) + 1) * len(frames) // (2 * options.max_moments)
        frames = frames[middles]
    return frames


def labels_before_camera(
    sequence: SmplSequence, class_name: str, recording_id: str, options: PoseSourceOptions
) -> Labels:
    """Labels of the chosen moments, seen by the recording's virtual camera.

    Args:
        sequence: in the world frame: metres, y up.
        class_name: of every moment.
        recording_id: decides, with the seed, from where the camera looks.
        options: moments and camera.
    Returns:
        SMPL labels in the camera frame; times in microseconds from the first frame on.
    Raises:
        DataError: see `check_sequence` and `choose_frames`.
    """
    check_sequence(sequence, recording_id)
    rotation = _camera_rotation(recording_id, options)
    pelvis = (REST_PELVIS + sequence.transl) @ rotation.T
    # Of the whole recording, so that the view does not depend on which moments are taken.
    if options.camera == "still":
        low, high = pelvis.min(axis=0), pelvis.max(axis=0)
        centre = (low + high) / 2
        translation = np.array([-centre[0], -centre[1], options.distance_m - low[2]])
    else:
        translation = np.array([0.0, 0.0, options.distance_m]) - pelvis
    seen = move_world(sequence, rotation, translation)
    frames = choose_frames(len(sequence), sequence.rate_hz, options, recording_id)
    labels = Labels(
        class_names=(class_name,) * len(frames),
        t_us=np.rint(frames * (1e6 / sequence.rate_hz)).astype(np.int64),
        smpl_pose=seen.pose[frames].astype(np.float32),
        smpl_betas=np.tile(sequence.betas.astype(np.float32), (len(frames), 1)),
        smpl_transl=seen.transl[frames].astype(np.float32),
    )
    return check_labels(labels, recording_id)


def _camera_rotation(recording_id: str, options: PoseSourceOptions) -> np.ndarray:
    """World to camera [3, 3]: the camera looks along -z of the world for yaw 0, and down for a positive pitch."""
    entropy = np.frombuffer(recording_id.encode(), np.uint8).tolist()
    random = np.random.default_rng([options.seed, CAMERA_STREAM, *entropy])
    yaw, pitch = (np.deg2rad(random.uniform(*r)) for r in (options.yaw_range_deg, options.pitch_range_deg))
    turn_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    turn_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    # World y points up and the camera's down; it looks along its +z towards the front of the body: half a turn about x.
    return np.diag([1.0, -1.0, -1.0]) @ turn_x @ turn_y
