"""Cameras drawn at random around a person: new views of a body, for pictures and for labels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctlev_core.geometry.camera import Camera, orbit_rotation
from data_contracts.errors import DataError


@dataclass(frozen=True)
class CameraRange:
    """What `sample_camera` draws from, uniformly.

    Attributes:
        distance_m: of the camera from the middle of the person.
        pitch_rad: positive looks down on the person.
        yaw_rad: turn around the person; 0 sees the front of somebody who faces +z.
        offset_m: largest shift of the person to the side and up or down.
        focal_per_side: focal length over the shorter side of the image; above 2 the person is cropped.
    """

    distance_m: tuple[float, float] = (3.2, 4.0)
    pitch_rad: tuple[float, float] = (-0.15, 0.3)
    yaw_rad: tuple[float, float] = (0.0, 2 * np.pi)
    offset_m: tuple[float, float] = (0.18, 0.12)
    focal_per_side: tuple[float, float] = (1.5, 1.5)


def sample_camera(
    rng: np.random.Generator,
    joints: np.ndarray,
    image_size: tuple[int, int],
    ranges: CameraRange | None = None,
) -> Camera:
    """A camera that looks at a person from a random side.

    Args:
        rng: source of the randomness.
        joints: [..., 3] m, world; the middle of their bounding box is what the camera looks at.
        image_size: (width, height) px.
        ranges: what to draw from.
    Raises:
        DataError: no joints, or joints that are not finite.
    """
    ranges = ranges or CameraRange()
    points = joints.reshape(-1, 3)
    if len(points) == 0 or not np.isfinite(points).all():
        raise DataError(f"a camera needs finite joints to look at, got {points.shape[0]} points")
    pitch, yaw = rng.uniform(*ranges.pitch_rad), rng.uniform(*ranges.yaw_rad)
    R = orbit_rotation(yaw, pitch)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    side, up = ranges.offset_m
    offset = np.array([rng.uniform(-side, side), rng.uniform(-up, up), rng.uniform(*ranges.distance_m)])
    width, height = image_size
    focal = rng.uniform(*ranges.focal_per_side) * min(width, height)
    K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(K, R, offset - R @ middle, image_size)
