"""Images moved by whole pixels: what the downstream models vary their training images with."""

from __future__ import annotations

import numpy as np


def shift_images(images: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Shift each image [B, H, W, ...] by its own (x, y) of `shifts` [B, 2] integers, px; black moves in."""
    height, width = images.shape[1:3]
    reach = int(np.abs(shifts).max(initial=0))
    padded = np.pad(images, ((0, 0), (reach, reach), (reach, reach), *((0, 0),) * (images.ndim - 3)))
    return np.stack(
        [
            image[reach - dy : reach - dy + height, reach - dx : reach - dx + width]
            for image, (dx, dy) in zip(padded, shifts, strict=True)
        ]
    )
