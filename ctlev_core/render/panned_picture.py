"""A still picture before a camera that pans and tilts, as frames of linear light.

A picture's pixel is a square of constant light, a sensor's pixel takes the mean over its area, and optics blur evenly
over a square. Of squares that is a product of one matrix for the rows and one for the columns, both in closed form, so
a picture at any subpixel place is exact, without texels.
"""

from __future__ import annotations

import numpy as np

from data_contracts.events import SensorSize


def pan(
    picture: np.ndarray,
    background: float,
    side_px: float,
    sensor_size: SensorSize,
    middles_px: np.ndarray,
    blur_px: float,
) -> np.ndarray:
    """What the sensor sees while the picture moves over it.

    Args:
        picture: [S, S] linear light.
        background: linear light around the picture.
        side_px: side of the picture on the sensor, px.
        sensor_size: (width, height) px.
        middles_px: [T, 2] where the middle of the picture is, px from the sensor's left upper corner, x right, y down.
        blur_px: standard deviation of the blur along an axis; 0 = none.
    Returns:
        [T, H, W] float32 linear light.
    """
    width, height = sensor_size
    columns = _shares(middles_px[:, 0], len(picture), side_px, width, blur_px)
    rows = _shares(middles_px[:, 1], len(picture), side_px, height, blur_px)
    light = rows @ (picture - background).astype(np.float32) @ columns.transpose(0, 2, 1)
    # Rounding may leave a black screen a little below zero.
    return np.maximum(light + np.float32(background), 0.0)


def _shares(middles_px: np.ndarray, count: int, side_px: float, length: int, blur_px: float) -> np.ndarray:
    """[T, length, count] float32: how much of each sensor pixel each of the picture's pixels covers, along one axis."""
    step = side_px / count
    edges = middles_px[:, None, None] + step * np.arange(count + 1) - side_px / 2
    covered = _twice_integrated((np.arange(length + 1.0)[:, None] - edges).astype(np.float32), blur_px)
    return np.diff(covered[..., :-1] - covered[..., 1:], axis=1)


def _twice_integrated(distance: np.ndarray, blur_px: float) -> np.ndarray:
    """The integral of the integral of an even density of standard deviation `blur_px` around 0."""
    if blur_px == 0:
        return np.maximum(distance, 0)
    half = np.float32(np.sqrt(3) * blur_px)
    rising = np.clip(distance + half, 0, 2 * half)
    return rising * rising / (4 * half) + np.maximum(distance - half, 0)
