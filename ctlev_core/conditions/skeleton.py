"""2D skeletons: a coloured drawing of the joints on black, and one fixed prompt.

Source: ControlEvents, the human-pose experiments, which start from ControlNet v1.0's openpose checkpoint; the drawings
are in `ctlev_core/render/skeleton.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.labels import Conditions, Labels

VERSION = 2
NEEDS = ""


class Options(Frozen):
    """Options of the skeleton condition."""

    prompt: str = Field(default="A moving human", description="The same prompt for every image, as in the paper.")
    drawing: Literal["smooth", "openpose"] = Field(
        default="smooth",
        description="anti-aliased, what the bundled base model knows; or ControlNet v1.0's, for its published "
        "checkpoints",
    )
    stick_width_px: int | None = Field(
        default=None,
        ge=1,
        description="of openpose, half the width of limbs; null scales ControlNet's 4 px of 512 to the image",
    )

    @model_validator(mode="after")
    def _width_belongs_to_openpose(self) -> Options:
        if self.stick_width_px is not None and self.drawing != "openpose":
            raise ValueError("stick_width_px is of drawing 'openpose'; 'smooth' has widths of its own")
        return self


def render(labels: Labels, image_size: tuple[int, int], options: Options, seeds: Sequence[int]) -> Conditions:
    """Draw the skeleton of each row; nothing is random, so `seeds` only has to fit.

    Args:
        labels: N rows with joints in pixels of an image of `image_size`.
        image_size: (width, height) px.
        options: the prompt and the drawing.
        seeds: N integers, unused.
    Returns:
        N conditions with images [N, H, W, 3] uint8.
    Raises:
        DataError: the labels have no joints, or the number of seeds differs.
    """
    from ctlev_core.render.skeleton import draw_skeleton

    if labels.joints2d is None or labels.visible is None:
        raise DataError("condition 'skeleton': the labels have no joints2d; use condition 'text' for class labels")
    if len(seeds) != len(labels):
        raise DataError(f"condition 'skeleton': {len(labels)} labels but {len(seeds)} seeds")
    width, height = image_size
    images = np.empty((len(labels), height, width, 3), dtype=np.uint8)
    for row, (joints2d, visible) in enumerate(zip(labels.joints2d, labels.visible, strict=True)):
        images[row] = draw_skeleton(
            joints2d, visible, labels.joint_set, image_size, options.drawing, options.stick_width_px
        )
    return Conditions((options.prompt,) * len(labels), images)
