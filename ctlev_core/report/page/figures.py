"""Pictures of the report: grids of images and strips of films as PNG, animations as WebP."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np


def image_grid_png(rows: Sequence[Sequence[np.ndarray]], min_cell_px: int = 128, gap_px: int = 4) -> bytes:
    """All images of a grid as one PNG, enlarged without smoothing, on a transparent ground.

    Args:
        rows: images [H, W] or [H, W, 3] uint8, row by row; a short row leaves its last cells empty. Images
            smaller than the largest one are enlarged to it and centred.
        min_cell_px: cells are enlarged by the smallest whole factor that makes their longer side at least this.
        gap_px: transparent px between two cells.
    Returns:
        The PNG file.
    Raises:
        ValueError: there is no image, or one has another shape or dtype.
    """
    images = [[_to_rgb(image) for image in row] for row in rows]
    shapes = [image.shape for row in images for image in row]
    if not shapes:
        raise ValueError("a grid needs at least one image, got none")
    height, width = max(shape[0] for shape in shapes), max(shape[1] for shape in shapes)
    factor = max(1, math.ceil(min_cell_px / max(height, width)))
    height, width = height * factor, width * factor
    columns = max(len(row) for row in images)
    canvas = np.zeros((len(rows) * (height + gap_px) - gap_px, columns * (width + gap_px) - gap_px, 4), dtype=np.uint8)
    for y, row in enumerate(images):
        for x, image in enumerate(row):
            top, left = y * (height + gap_px), x * (width + gap_px)
            cell = canvas[top : top + height, left : left + width]
            cell[..., 3] = 255
            _paste_enlarged(image, cell[..., :3])
    return image_png(canvas)


def image_png(image: np.ndarray) -> bytes:
    """An image [H, W, 3 or 4] uint8, RGB or RGBA, as a PNG file.

    Raises:
        ValueError: it is too large for one.
    """
    import cv2

    order = cv2.COLOR_RGBA2BGRA if image.shape[-1] == 4 else cv2.COLOR_RGB2BGR
    encoded, data = cv2.imencode(".png", cv2.cvtColor(image, order))
    if not encoded:
        raise ValueError(f"an image of {image.shape[1]} x {image.shape[0]} px does not fit into a PNG")
    return data.tobytes()


def film_strip(frames: np.ndarray, max_side_px: int = 256) -> np.ndarray:
    """The frames of a film side by side.

    Args:
        frames: [T, H, W, 3] uint8 RGB.
        max_side_px: larger frames are made smaller, by a whole factor.
    Returns:
        [h, T * w, 3] uint8.
    Raises:
        ValueError: no frames, or another shape or dtype.
    """
    import cv2

    _check_frames(frames)
    factor = math.ceil(max(frames.shape[1:3]) / max_side_px)
    if factor > 1:
        height, width = (max(1, round(side / factor)) for side in frames.shape[1:3])
        frames = np.stack([cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA) for frame in frames])
    return np.concatenate(list(frames), axis=1)


def animation_webp(frames: np.ndarray, rate_hz: float, min_side_px: int = 192) -> bytes:
    """An endless animation, enlarged without smoothing.

    Args:
        frames: [T, H, W, 3] uint8 RGB.
        rate_hz: frames a second; viewers round times to milliseconds.
        min_side_px: frames are enlarged by the smallest whole factor that makes their shorter side at least this.
    Returns:
        The WebP file.
    Raises:
        ValueError: no frames, another shape or dtype, or a rate that is not positive.
    """
    import cv2

    _check_frames(frames)
    if not 0 < rate_hz < math.inf:
        raise ValueError(f"rate_hz must be positive, got {rate_hz}")
    factor = max(1, math.ceil(min_side_px / min(frames.shape[1:3])))
    animation = cv2.Animation()
    animation.frames = [
        cv2.cvtColor(frame.repeat(factor, axis=0).repeat(factor, axis=1), cv2.COLOR_RGB2BGRA) for frame in frames
    ]
    animation.durations = [max(1, round(1000 / rate_hz))] * len(frames)
    # A quality above 100 is lossless.
    encoded, data = cv2.imencodeanimation(".webp", animation, [cv2.IMWRITE_WEBP_QUALITY, 101])
    if not encoded:
        raise ValueError(f"{len(frames)} frames of {frames.shape[2]} x {frames.shape[1]} px do not fit into a WebP")
    return data.tobytes()


def _check_frames(frames: np.ndarray) -> None:
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or 0 in frames.shape:
        raise ValueError(f"frames must be [T, H, W, 3] uint8 with something in them, got {frames.shape} {frames.dtype}")


def _to_rgb(image: np.ndarray) -> np.ndarray:
    image = np.asarray(image)
    is_grey, is_rgb = image.ndim == 2, image.ndim == 3 and image.shape[-1] == 3
    if not (is_grey or is_rgb) or image.dtype != np.uint8 or image.size == 0:
        raise ValueError(f"an image must be [H, W] or [H, W, 3] uint8, got {image.shape} {image.dtype}")
    return np.repeat(image[..., None], 3, axis=-1) if is_grey else image


def _paste_enlarged(image: np.ndarray, cell: np.ndarray) -> None:
    """Nearest-neighbour copy of `image` into the middle of `cell`, as large as its proportions allow."""
    scale = min(cell.shape[0] / image.shape[0], cell.shape[1] / image.shape[1])
    height, width = (max(1, math.floor(size * scale)) for size in image.shape[:2])
    rows = np.arange(height) * image.shape[0] // height
    columns = np.arange(width) * image.shape[1] // width
    top, left = (cell.shape[0] - height) // 2, (cell.shape[1] - width) // 2
    cell[top : top + height, left : left + width] = image[rows[:, None], columns]
