"""Small random shifts, turns and changes of size: ordinary augmentation of pictures and of event images."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from data_contracts.config import Frozen


class Moves(Frozen):
    """How far an image is moved at most, whenever it is shown; every amount is drawn evenly."""

    shift: float = Field(default=0.0, ge=0, le=0.5, description="as a share of the side, along each axis")
    turn_deg: float = Field(default=0.0, ge=0, le=180, description="either way, about the centre")
    scale: float = Field(default=0.0, ge=0, lt=1, description="so much larger or smaller")
    mirror: bool = Field(default=False, description="half of them mirrored; letters and digits must not be")

    @property
    def moves_anything(self) -> bool:
        """Is there anything to do?"""
        return self.shift > 0 or self.turn_deg > 0 or self.scale > 0 or self.mirror


def move_image(
    image: np.ndarray,
    moves: Moves,
    rng: np.random.Generator,
    *,
    interpolation: Literal["linear", "nearest"],
    border: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> np.ndarray:
    """The image after one random move.

    Args:
        image: [H, W, C] uint8.
        moves: how far at most.
        rng: what is drawn: angle, size, shift in x and y, and the mirror.
        interpolation: `linear` for pictures; `nearest` for event images, whose values are counts and whose isolated
            pixels would be smeared.
        border: the colour of what comes into view.
    Returns:
        [H, W, C] uint8.
    """
    if not moves.moves_anything:
        return image
    import cv2

    height, width = image.shape[:2]
    angle, size = rng.uniform(-moves.turn_deg, moves.turn_deg), 1 + moves.scale * rng.uniform(-1, 1)
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle, size)
    shift = moves.shift * np.array([width, height]) * rng.uniform(-1, 1, 2)
    if interpolation == "nearest":
        shift = np.round(shift)  # where nothing else moves, every value then keeps its neighbours
    matrix[:, 2] += shift
    flags = cv2.INTER_LINEAR if interpolation == "linear" else cv2.INTER_NEAREST
    moved = cv2.warpAffine(
        image, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=border
    )
    return np.ascontiguousarray(moved[:, ::-1]) if moves.mirror and rng.random() < 0.5 else moved
