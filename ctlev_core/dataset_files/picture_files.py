"""Picture files of datasets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from data_contracts.errors import DataError


def read_stored(path: Path, flags: int) -> np.ndarray | None:
    """What OpenCV makes of a picture file, [H, W] or [H, W, C] with blue first; None where it is none.

    Args:
        path: the file.
        flags: of `cv2.imread`.
    """
    import cv2

    try:
        return cv2.imread(str(path), flags)
    except cv2.error:  # damaged ones that claim more pixels than OpenCV reads
        return None


def read_grey_pictures(paths: Sequence[Path], size: tuple[int, int]) -> np.ndarray:
    """Pictures [N, H, W] uint8 of `size` (width, height) px; colour ones become grey.

    Raises:
        DataError: a file is no picture, or of another size.
    """
    import cv2

    width, height = size
    images = np.empty((len(paths), height, width), np.uint8)
    for image, path in zip(images, paths, strict=True):
        picture = read_stored(path, cv2.IMREAD_GRAYSCALE)
        if picture is None or picture.shape != (height, width):
            got = "none" if picture is None else f"{picture.shape[1]} x {picture.shape[0]}"
            raise DataError(f"{path}: expected a picture of {width} x {height} px, got {got}")
        image[:] = picture
    return images
