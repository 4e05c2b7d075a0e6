"""Pairs of grey pictures, taken at the start and the end of a window: what frame-to-event networks are given.

Source: Event-GAN (Zhu et al., ICCP 2021) makes events of two consecutive intensity frames. ControlEvents compares with
it on data sets whose cameras also take pictures (CDEHP, Event-HPE).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.labels import Conditions, Labels

VERSION = 1
NEEDS = "intensity"


class Options(Frozen):
    """Options of the pair."""

    prompt: str = Field(default="A moving human", description="The same for every pair; Event-GAN reads none.")


def render(
    labels: Labels, image_size: tuple[int, int], options: Options, seeds: Sequence[int], pairs: np.ndarray
) -> Conditions:
    """Put the two pictures into the channels of one image; nothing is random, so `seeds` only has to fit.

    Args:
        labels: N rows, whose number alone matters.
        image_size: (width, height) px.
        options: see `Options`.
        seeds: N integers, unused.
        pairs: [N, H, W, 2] uint8, grey pictures at start and end of the row's window, in image pixels.
    Returns:
        N conditions with images [N, H, W, 3] uint8: red the picture at the start, green the one at the end, blue 0.
        What did not move is yellow.
    Raises:
        DataError: the pairs do not fit the labels, the seeds or the image.
    """
    width, height = image_size
    expected = (len(labels), height, width, 2)
    if pairs.shape != expected or pairs.dtype != np.uint8:
        raise DataError(
            f"condition 'intensity_pair': pairs must be {list(expected)} uint8, got {list(pairs.shape)} {pairs.dtype}"
        )
    if len(seeds) != len(labels):
        raise DataError(f"condition 'intensity_pair': {len(labels)} labels but {len(seeds)} seeds")
    images = np.zeros((*expected[:3], 3), np.uint8)
    images[..., :2] = pairs
    return Conditions((options.prompt,) * len(labels), images)
