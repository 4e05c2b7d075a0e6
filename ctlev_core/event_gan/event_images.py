"""Event images and intensity pairs as the networks see them, and back.

The published network predicts nine temporal bins a polarity, scaled by the 98th percentile of the volume's values. An
event image is such a volume with one bin a polarity, already scaled by its encoding. What is compared downstream are
images, so the network makes them directly, with one channel a polarity, or one in all where polarity is discarded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ctlev_core.event_gan.options import SamplingOptions
from data_contracts.errors import DataError
from data_contracts.image_rows import Images, image_chunks
from data_contracts.labels import Conditions

Palette = Literal["grey", "red_blue"]
NUM_CHANNELS: dict[str, int] = {"grey": 1, "red_blue": 2}


def check_pairs(conditions: Conditions, where: str) -> Images:
    """The intensity pairs [N, H, W, 3] uint8 of `conditions`: frame at the window's start, at its end, zeros.

    Raises:
        ValueError: there are no condition images.
        DataError: they are not pairs: wrong shape or dtype, or a third channel that is not zero.
    """
    images = conditions.images
    if images is None:
        raise ValueError(f"{where}: Event-GAN needs pairs of intensity frames as condition images, got prompts only")
    if images.ndim != 4 or images.shape[-1] != 3 or images.dtype != np.uint8 or 0 in images.shape[1:3]:
        raise DataError(f"{where}: pairs must be [N, H, W, 3] uint8, got {list(images.shape)} {images.dtype}")
    if len(images) != len(conditions):
        raise DataError(f"{where}: {len(images)} pairs do not match {len(conditions)} prompts")
    for row, image in enumerate(images):
        if image[..., 2].any():
            raise DataError(
                f"{where}: condition images must hold the intensity frames at start and end of a window in channels 0 "
                f"and 1, and zeros in channel 2, which row {row} has not; is it a picture of another kind?"
            )
    return images


def check_event_images(frames: Images, pairs: Images, where: str) -> Palette:
    """The palette of real event images, which must fit their pairs.

    Returns:
        `grey`: three equal channels, polarity discarded; `red_blue`: no green, positive red and negative blue.
    Raises:
        DataError: wrong shape or dtype, a palette that is neither, or no event at all.
    """
    if len(frames) == 0:
        raise DataError(f"{where}: needs at least one frame, got none")
    if frames.shape != pairs.shape or frames.dtype != np.uint8:
        raise DataError(
            f"{where}: frames must have the shape of the pairs, {list(pairs.shape)} uint8, "
            f"got {list(frames.shape)} {frames.dtype}"
        )
    has_event = has_green = False
    is_grey = True
    for chunk in image_chunks(frames):
        has_event |= bool(chunk.any())
        has_green |= bool(chunk[..., 1].any())
        is_grey &= bool((chunk == chunk[..., :1]).all())
    if not has_event:
        raise DataError(f"{where}: none of the {len(frames)} frames has an event")
    if not has_green:
        return "red_blue"
    if is_grey:
        return "grey"
    raise DataError(
        f"{where}: event images must be grey (three equal channels) or red and blue (no green), got another colour"
    )


def one_event_value(frames: Images) -> float:
    """The value in (0, 1] that one event has in event images: the median over images of the smallest value above 0.

    The encodings scale every window by itself, so that there is no one value for all. Images that are averages over
    areas have values far below that of an event; so may those that are made, and hardly any is drawn by lot then.
    """
    smallest = [int(image[image > 0].min()) for image in frames if image.any()]
    return float(np.median(smallest)) / 255


def pairs_to_tensor(pairs: np.ndarray) -> Tensor:
    """[N, H, W, 3] uint8 to [N, 2, H, W] float32 in [-1, 1], the published range."""
    frames = np.ascontiguousarray(np.moveaxis(pairs[..., :2], -1, 1))
    return torch.from_numpy(frames).float() / 127.5 - 1


def frames_to_volumes(frames: np.ndarray, palette: Palette) -> Tensor:
    """[N, H, W, 3] uint8 to [N, C, H, W] float32 in [0, 1]; channels (positive, negative), or one without polarity."""
    channels = frames[..., :1] if palette == "grey" else frames[..., ::2]
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(channels, -1, 1))).float() / 255


def volumes_to_frames(
    volumes: np.ndarray, palette: Palette, one_event: float, options: SamplingOptions, seeds: Sequence[int]
) -> np.ndarray:
    """Event images [N, H, W, 3] uint8 of real-valued volumes, sparse as event images are.

    Args:
        volumes: [N, C, H, W] float32, at least 0; what exceeds 1 is clipped.
        palette: of the images.
        one_event: what `one_event_value` returned for the training frames.
        options: the rounding rule.
        seeds: N non-negative integers; used by stochastic rounding alone.
    """
    values = np.minimum(volumes.astype(np.float64), 1.0)
    if options.rounding == "threshold":
        values[values < options.threshold * one_event] = 0
    elif options.rounding == "stochastic":
        for value, seed in zip(values, seeds, strict=True):
            fires = np.random.default_rng(seed).random(value.shape) * one_event < value
            value[...] = np.where(value < one_event, fires * one_event, value)
    channels = np.moveaxis(np.rint(255 * values).astype(np.uint8), 1, -1)
    if palette == "grey":
        return np.repeat(channels, 3, axis=-1)
    frames = np.zeros((*channels.shape[:-1], 3), np.uint8)
    frames[..., ::2] = channels
    return frames
