"""Pictures that come finished (event images as released, intensity frames) onto the grid of an encoding."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

PointMap = Callable[[np.ndarray], np.ndarray]
"""[..., 2] points of the picture, px, to points of the result: a scale and an offset for each axis."""


def resample_images(images: np.ndarray, point_map: PointMap, image_size: tuple[int, int]) -> np.ndarray:
    """Average the pictures over the area of each new pixel; black where the new image reaches beyond the old.

    Exact for any scale and any fraction of a pixel of offset, so that joints mapped by `point_map` stay where they were
    seen.

    Args:
        images: [N, H, W] uint8.
        point_map: from picture to new pixels, the axes apart.
        image_size: (width, height) px of the result.
    Returns:
        [N, height, width] float32, 0 .. 255.
    """
    _, height, width = images.shape
    (x0, y0), (x1, y1) = np.asarray(point_map(np.array([[0.0, 0.0], [width, height]])), np.float64)
    rows = overlap_weights(height, image_size[1], (y1 - y0) / height, y0).astype(np.float32)
    columns = overlap_weights(width, image_size[0], (x1 - x0) / width, x0).astype(np.float32)
    out = np.empty((len(images), image_size[1], image_size[0]), np.float32)
    for number, image in enumerate(images):
        out[number] = np.clip(rows @ image.astype(np.float32) @ columns.T, 0, 255)
    return out


def overlap_weights(num_old: int, num_new: int, scale: float, offset: float) -> np.ndarray:
    """Share [num_new, num_old] of each new pixel that each old one covers.

    Old pixel i reaches from scale * i + offset to scale * (i + 1) + offset on the new axis.
    Rows sum to 1 inside the old image and to the covered share at its border.
    """
    old_edges = scale * np.arange(num_old + 1) + offset
    low = np.maximum(np.arange(num_new)[:, None], old_edges[None, :-1])
    high = np.minimum(np.arange(1, num_new + 1)[:, None], old_edges[None, 1:])
    return np.maximum(high - low, 0.0)
