"""Skeletons that show where they move: three in one picture, red a moment before, green the labelled one, blue after.

Events come from what moves, and which way an edge moves decides their polarity; one pose says neither. Which limb is
which is told by shape alone, for the three colours are taken. `reach_us` before and after, joints lie where the labels
of the recording have them, between two labels on the straight line; beyond the first or last label they go on as they
moved.

An addition to ControlEvents, whose condition is one pose. It makes frames that follow one another agree on what moves.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.labels import Conditions, Labels

VERSION = 1
NEEDS = "displacement"


class Options(Frozen):
    """Options of the moving skeleton."""

    prompt: str = Field(default="A moving human", description="The same prompt for every image, as in the paper.")
    reach_us: int = Field(default=40_000, gt=0, description="how long before and after the labelled moment")


def render(
    labels: Labels, image_size: tuple[int, int], options: Options, seeds: Sequence[int], displacements: np.ndarray
) -> Conditions:
    """Draw the three skeletons of each row; nothing is random, so `seeds` only has to fit.

    Args:
        labels: N rows with joints in pixels of an image of `image_size`.
        image_size: (width, height) px.
        options: the prompt.
        seeds: N integers, unused.
        displacements: [N, 2, J, 2] px, from where a joint is to where it was, and to where it will be; NaN = unknown,
            drawn as if it stood still.
    Returns:
        N conditions with images [N, H, W, 3] uint8: grey where nothing moves.
    Raises:
        DataError: the labels have no joints, or numbers differ.
    """
    from ctlev_core.render.skeleton import draw_skeleton

    if labels.joints2d is None or labels.visible is None:
        raise DataError("condition 'moving_skeleton': the labels have no joints2d")
    expected = (len(labels), 2, labels.joints2d.shape[1], 2)
    if len(seeds) != len(labels) or displacements.shape != expected:
        raise DataError(
            f"condition 'moving_skeleton': {len(labels)} labels, {len(seeds)} seeds and displacements of shape "
            f"{displacements.shape}, which must be {expected}"
        )
    width, height = image_size
    images = np.empty((len(labels), height, width, 3), dtype=np.uint8)
    known = np.where(np.isfinite(displacements), displacements, 0)
    for row, (joints2d, visible) in enumerate(zip(labels.joints2d, labels.visible, strict=True)):
        moments = (joints2d + known[row, 0], joints2d, joints2d + known[row, 1])
        for channel, joints in enumerate(moments):
            drawn = draw_skeleton(joints.astype(np.float32), visible, labels.joint_set, image_size)
            images[row, ..., channel] = drawn.max(axis=-1)
    return Conditions((options.prompt,) * len(labels), images)
