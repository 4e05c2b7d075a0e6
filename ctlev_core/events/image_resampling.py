"""Pictures on another grid of pixels, by averages over areas."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

PointMap = Callable[[np.ndarray], np.ndarray]
"""[..., 2] points of the picture, px, to points of the result: a scale and an offset for each axis."""


class Overlaps(NamedTuple):
    """Which old pixels of an axis each new one covers: K neighbours from `first` on, with the share of each.

    Shares sum to 1 inside the old picture and to the covered share at its border.

    Attributes:
        first: [num_new] int64, the first of K old pixels.
        shares: [num_new, K] float64, of the new pixel; 0 for neighbours that it does not cover.
    """

    first: np.ndarray
    shares: np.ndarray


def find_overlaps(old_edges: np.ndarray, num_new: int) -> Overlaps:
    """The overlaps of old pixels, whose edges [num_old + 1] lie on the new axis, with new ones of size 1 from 0 on."""
    num_old = len(old_edges) - 1
    starts = np.arange(num_new, dtype=np.float64)
    first = np.clip(np.searchsorted(old_edges, starts, side="right") - 1, 0, num_old - 1)
    stop = np.searchsorted(old_edges, starts + 1, side="left")
    # As many neighbours for every new pixel: rows of one length are what the compiled loops are fast with.
    num_covered = min(max(int((stop - first).max(initial=1)), 1), num_old)
    first = np.minimum(first, num_old - num_covered)
    covered = first[:, None] + np.arange(num_covered)
    low = np.maximum(old_edges[covered], starts[:, None])
    high = np.minimum(old_edges[covered + 1], starts[:, None] + 1)
    return Overlaps(first, np.maximum(high - low, 0.0))


def average_areas(images: np.ndarray, columns: Overlaps, rows: Overlaps) -> np.ndarray:
    """Average pictures over the area of each new pixel; black where the new picture reaches beyond the old.

    Args:
        images: [N, H, W] uint8.
        columns: of W old columns with the new ones.
        rows: of H old rows with the new ones.
    Returns:
        [N, new rows, new columns] float32, 0 .. 255. Sums are made in 64 bits.
    """
    from ctlev_core.events import image_resampling_kernels as kernels

    out = np.empty((len(images), len(rows.first), len(columns.first)), np.float32)
    kernels.average_areas(np.ascontiguousarray(images), *columns, *rows, out)
    return out


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
    columns = find_overlaps(x0 + (x1 - x0) / width * np.arange(width + 1), image_size[0])
    rows = find_overlaps(y0 + (y1 - y0) / height * np.arange(height + 1), image_size[1])
    return average_areas(images, columns, rows)
