"""Optical flow between two grey images, on at most `SIDE_PX` px a side.

Source: Farneback, Two-Frame Motion Estimation Based on Polynomial Expansion, SCIA 2003, as OpenCV has it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SIDE_PX = 64
"""Larger images are made smaller, by a whole factor."""
BLUR_PX, WINDOW_PX = 1.0, 21


@dataclass(frozen=True, eq=False)
class ImageFlow:
    """Displacement [h, w, 2] float32 (x, y) from an image to another, in px of one that is `factor` times smaller."""

    vectors: np.ndarray
    factor: float


def image_flow(first: np.ndarray, second: np.ndarray) -> ImageFlow:
    """Where the pixels of the first image lie in the second, from where they lie in the first.

    Args:
        first: [H, W] uint8.
        second: [H, W] uint8.
    """
    import cv2

    factor = max(1, -(-max(first.shape) // SIDE_PX))
    size = tuple(max(1, round(side / factor)) for side in first.shape[::-1])
    blurred = []
    for values in (first, second):
        small = values if factor == 1 else cv2.resize(values, size, interpolation=cv2.INTER_AREA)
        smooth = cv2.GaussianBlur(small.astype(np.float32), (0, 0), BLUR_PX)
        blurred.append(np.minimum(2 * smooth, 255).astype(np.uint8))
    start = np.zeros((*blurred[0].shape, 2), np.float32)
    vectors = cv2.calcOpticalFlowFarneback(blurred[0], blurred[1], start, 0.5, 3, WINDOW_PX, 3, 5, 1.1, 0)
    return ImageFlow(vectors, factor)
