"""A still picture on a screen, seen by a camera that moves: the scene of N-ImageNet and N-Caltech101.

The screen's own pixels, the texels, are squares of constant light, several to a pixel of the sensor, and a pixel sees
the mean over its area. That mean is linear in a shift between whole texels, along x and along y, so sums over whole
texels are made once, and a picture at any subpixel shift is the exact mean: four slices and their weights, with
nothing of the staircase that nearest or bilinear sampling of the screen would give.

A camera that moves in a plane parallel to the screen shifts the picture; one that pans and tilts by a degree or so does
so to first order, and we leave it at that.
"""

from __future__ import annotations

import numpy as np

from ctlev_core.studio.camera_paths import CameraPath
from data_contracts.errors import DataError
from data_contracts.events import SensorSize


class MovingScreen:
    """Pictures of a screen along a camera's path, for `ctlev_core.sensor.adaptive_rendering.simulate_rendered`.

    Args:
        screen: [h, w] linear intensity of the texels; the path starts from its middle.
        texels_per_px: texels along the side of a sensor's pixel.
        sensor_size: (width, height) px.
        path: where the camera looks over time.

    Raises:
        DataError: the screen is not two-dimensional, or the path sees beyond its edge.
    """

    def __init__(self, screen: np.ndarray, texels_per_px: int, sensor_size: SensorSize, path: CameraPath) -> None:
        if screen.ndim != 2 or texels_per_px < 1:
            raise DataError(f"screen: expected [h, w] and at least one texel a pixel, got {screen.shape}")
        self.sensor_size = sensor_size
        self.path = path
        self._texels_per_px = texels_per_px
        view = np.array(sensor_size) * texels_per_px
        self._margin = (np.array(screen.shape[::-1]) - view) / 2
        needed = path.extent_px * texels_per_px
        if (self._margin < needed).any():
            raise DataError(
                f"screen: {screen.shape[1]} x {screen.shape[0]} texels leave {self._margin.tolist()} around the view; "
                f"the path goes {needed.tolist()} from its middle"
            )
        means = _box_means(np.asarray(screen, np.float64), texels_per_px).astype(np.float32)
        # At the far edge the slice beyond has a weight of 0.
        self._means = np.pad(means, ((0, 1), (0, 1)), mode="edge")

    def __call__(self, time_s: float) -> np.ndarray:
        """The picture [H, W] float32, linear intensity, at a time."""
        origin = self._margin + self.path.position_px(time_s) * self._texels_per_px
        whole = np.floor(origin).astype(int)
        weights = np.stack([1 - (origin - whole), origin - whole]).astype(np.float32)
        return sum(
            (weights[i, 0] * weights[j, 1] * self._shifted(whole[0] + i, whole[1] + j) for i in (0, 1) for j in (0, 1)),
            np.zeros(self.sensor_size[::-1], np.float32),
        )

    def speed_bound(self, start_s: float, stop_s: float) -> float:
        """What nothing in the picture exceeds between two times, px/s."""
        return self.path.speed_bound_px_s(start_s, stop_s)

    def _shifted(self, x: int, y: int) -> np.ndarray:
        """The picture [H, W] whose first pixel starts at texel (x, y)."""
        step = self._texels_per_px
        width, height = self.sensor_size
        return self._means[y : y + step * (height - 1) + 1 : step, x : x + step * (width - 1) + 1 : step]


def _box_means(screen: np.ndarray, side: int) -> np.ndarray:
    """Means of all squares of side x side texels, by their first texel: [h - side + 1, w - side + 1]."""
    sums = np.pad(screen.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    total = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    return total / side**2
