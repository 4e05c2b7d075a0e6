"""Noise that moves along with what a stretch of images shows.

Where a picture moves, the noise of a pixel is that of its place in the image before, found by the optical flow between
the two; where it stands still, and where nothing came from, noise is drawn anew. What is drawn from the noise then
moves with an edge in place of appearing somewhere else along it. No two pixels of an image share their noise, so that
in each image it is white, whatever the flow.

Source: Chang et al., How I Warped Your Noise: a Temporally-Correlated Noise Prior for Diffusion Models, ICLR 2024. They
warp the noise that images start from by its integral over deformed pixels. We move it from whole pixel to whole pixel,
which also does for uniform numbers, and only where something moves.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ctlev_core.geometry.image_flow import image_flow

LEAST_MOTION = 0.3
"""Px between two images of at most `image_flow.SIDE_PX` a side. With 0.15 more of the pixels are the same again than in
recordings; with 0.6 less moves along."""
_STREAM = 12
_CANVAS, _ANEW = 0, 1


class Noise(Protocol):
    """What draws random numbers as `numpy.random.Generator` does."""

    def standard_normal(self, size: tuple[int, ...], dtype: type[np.float32]) -> np.ndarray:
        """Of a normal distribution."""
        ...

    def random(self, size: tuple[int, ...], dtype: type[np.float32]) -> np.ndarray:
        """Uniform in [0, 1)."""
        ...


class MovingNoise:
    """The noise of the images of one stretch, one image after another; each asks for the same numbers in turn.

    Args:
        size: (height, width) of the noise.
        seed: of the stretch.
    """

    def __init__(self, size: tuple[int, int], seed: int) -> None:
        self._seed, self._image, self._asked = seed, 0, 0
        self._y, self._x = np.mgrid[: size[0], : size[1]].astype(np.float32)
        self._cells = np.arange(size[0] * size[1]).reshape(size)

    def move(self, before: np.ndarray, after: np.ndarray) -> None:
        """Go on to the next image.

        Args:
            before: [H, W] uint8, the image so far; up to one row and column less than the noise.
            after: [H, W] uint8, the next one.
        """
        import cv2

        height, width = self._cells.shape
        flow = image_flow(after, before)
        vectors = cv2.resize(flow.vectors, (width, height), interpolation=cv2.INTER_LINEAR)
        rows, columns = np.mgrid[:height, :width].astype(np.float32)
        maps = columns + flow.factor * vectors[..., 0], rows + flow.factor * vectors[..., 1]
        # Places are kept as fractions: slow motion adds up.
        self._x, self._y = (
            cv2.remap(place, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for place in (self._x, self._y)
        )
        self._cells = np.where(np.hypot(*vectors.transpose(2, 0, 1)) >= LEAST_MOTION, self._own_cells(), -1)
        self._image, self._asked = self._image + 1, 0

    def standard_normal(self, size: tuple[int, ...], dtype: type[np.float32]) -> np.ndarray:
        """[..., height, width] of the present image."""
        canvas, anew = self._generators()
        return self._laid_out(canvas.standard_normal(size, dtype), anew.standard_normal(size, dtype))

    def random(self, size: tuple[int, ...], dtype: type[np.float32]) -> np.ndarray:
        """The same, uniform in [0, 1)."""
        canvas, anew = self._generators()
        return self._laid_out(canvas.random(size, dtype), anew.random(size, dtype))

    def _generators(self) -> tuple[np.random.Generator, np.random.Generator]:
        """Of this request, the same in all images, and of this request of this image."""
        asked, self._asked = self._asked, self._asked + 1
        canvas = np.random.default_rng([self._seed, _STREAM, _CANVAS, asked, 0])
        return canvas, np.random.default_rng([self._seed, _STREAM, _ANEW, asked, self._image])

    def _laid_out(self, canvas: np.ndarray, anew: np.ndarray) -> np.ndarray:
        flat = canvas.reshape(*canvas.shape[:-2], -1)
        return np.where(self._cells >= 0, flat[..., self._cells], anew)

    def _own_cells(self) -> np.ndarray:
        """The cell of the canvas that each pixel lies in; -1 where another pixel lies nearer to its middle."""
        x, y = np.rint(self._x), np.rint(self._y)
        cells = (y * self._cells.shape[1] + x).astype(np.int64).ravel()
        order = np.argsort((self._x - x).ravel() ** 2 + (self._y - y).ravel() ** 2, kind="stable")
        _, first = np.unique(cells[order], return_index=True)
        own = np.full(cells.shape, -1)
        own[order[first]] = cells[order[first]]
        return own.reshape(self._cells.shape)
