"""2D skeletons: a coloured drawing of the joints on black, and one fixed prompt.

Source: ControlEvents, the human-pose experiments; drawing as in `ctlev_core/render/skeleton.py`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.labels import Conditions, Labels

VERSION = 1


class Options(Frozen):
    """Options of the skeleton condition."""

    prompt: str = Field(default="A moving human", description="The same prompt for every image, as in the paper.")


def render(labels: Labels, image_size: tuple[int, int], options: Options, seeds: Sequence[int]) -> Conditions:
    """Draw the skeleton of each row; nothing is random, so `seeds` only has to fit.

    Args:
        labels: N rows with joints in pixels of an image of `image_size`.
        image_size: (width, height) px.
        options: the prompt.
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
        images[row] = draw_skeleton(joints2d, visible, labels.joint_set, image_size)
    return Conditions((options.prompt,) * len(labels), images)
