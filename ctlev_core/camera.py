"""The pinhole camera. OpenCV frame: x right, y down, z forward; pixel centres lie at integer + 0.5."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: x_camera = R x_world + translation, pixel = K x_camera / depth.

    Attributes:
        K: [3, 3] float64, px; the origin is the outer corner of the top left pixel.
        R: [3, 3] float64, world to camera.
        translation: [3] float64, m, camera frame.
        image_size: (width, height) px.
    """

    K: np.ndarray
    R: np.ndarray
    translation: np.ndarray
    image_size: tuple[int, int]

    def scaled(self, factor: float) -> Camera:
        """The same view on a grid `factor` times as fine; sizes are rounded to whole pixels."""
        width, height = self.image_size
        K = self.K.copy()
        K[:2] *= factor
        return replace(self, K=K, image_size=(round(width * factor), round(height * factor)))


def orbit_rotation(yaw_rad: float, pitch_rad: float) -> np.ndarray:
    """World-to-camera rotation [3, 3] float64 of a camera that looks at the middle of an upright world (y up).

    Yaw turns around the vertical axis, 0 sees the front of somebody who faces +z; positive pitch looks down.
    """
    pitch, yaw = pitch_rad, yaw_rad
    turn_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    turn_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    # World y points up and people face +z; the camera has y down and looks along +z: half a turn about x.
    return np.diag([1.0, -1.0, -1.0]) @ turn_x @ turn_y


def project(camera: Camera, points_world: np.ndarray) -> np.ndarray:
    """Pixels [..., 2] float64 of world points [..., 3] m; NaN on or behind the plane of the camera."""
    points = points_world @ camera.R.T + camera.translation
    depth = points[..., 2:]
    in_front = depth > 0.0
    normalised = points / np.where(in_front, depth, 1.0)
    pixels = (normalised @ camera.K.T)[..., :2]
    return np.where(in_front, pixels, np.nan)


def is_inside(pixels: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """[...] bool: does the pixel position [..., 2] lie in the image? NaN does not."""
    return np.all((pixels >= 0.0) & (pixels < np.asarray(image_size, dtype=np.float64)), axis=-1)
