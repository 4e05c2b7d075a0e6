"""Draw the counts of sampled images: from nothing but noise to whole counts in a few passes of the network.

Each pass gives, for every pixel, the probability of every class of counts. Classes are drawn, and the noisy counts of
the next, lower noise level given them and the noisy counts before (the posterior of a Gaussian diffusion). What is
drawn in one pass is drawn pixel by pixel; the passes after it see the neighbours, so that an edge becomes an edge. One
pass alone would leave pixels independent of one another.

Every image has a random stream of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from ctlev_core.count_decoder.count_classes import CountClasses
from ctlev_core.count_decoder.network import MAX_NOISE, MIN_NOISE, CountNetwork
from data_contracts.image_rows import Images

BATCH = 16
"""Images in memory at a time."""
DRAW_STREAM = 11
"""Entropy that keeps what is drawn here apart from the noise an image was sampled from, whose seed is the same."""


def noise_levels(num_passes: int, classes: CountClasses) -> np.ndarray:
    """[num_passes] float64 descending, geometric; a single pass sees nothing but noise."""
    return np.geomspace(MAX_NOISE, MIN_NOISE, num_passes) * classes.event_step


def image_planes(frames: np.ndarray, polarities: int) -> np.ndarray:
    """[N, H, W, 3] uint8 as planes [N, P, H, W] float32 in [-1, 1]: red and blue, or the mean of all channels."""
    planes = frames[..., [0, 2]] if polarities == 2 else frames.mean(axis=3, keepdims=True)
    return np.ascontiguousarray(planes.transpose(0, 3, 1, 2), np.float32) / 127.5 - 1


def condition_planes(images: np.ndarray) -> np.ndarray:
    """[N, H, W, 3] uint8 as planes [N, 3, H, W] float32 in [0, 1]."""
    return np.ascontiguousarray(images.transpose(0, 3, 1, 2), np.float32) / 255


def even_sided(planes: Tensor) -> Tensor:
    """Planes [B, C, H, W] with a last row and column repeated where a side is odd."""
    bottom, right = planes.shape[2] % 2, planes.shape[3] % 2
    return torch.nn.functional.pad(planes, (0, right, 0, bottom), mode="replicate") if bottom or right else planes


@torch.inference_mode()
def draw_counts(
    network: CountNetwork,
    classes: CountClasses,
    frames: Images,
    conditions: Images | None,
    *,
    seeds: Sequence[int],
    num_passes: int,
    precision: str = "float32",
) -> Iterator[np.ndarray]:
    """Counts of sampled images, one after another; image i depends on image, condition and seed i alone.

    Args:
        network: trained, on the device to compute on.
        classes: of its counts.
        frames: [N, H, W, 3] uint8 as the generator gives them.
        conditions: [N, H, W, 3] uint8 that they were asked for, where the network takes some; else None.
        seeds: N non-negative integers.
        num_passes: at least 1.
        precision: of the convolutions.
    Yields:
        [P, H, W] uint16.
    Raises:
        ValueError: numbers do not match.
    """
    if len(seeds) != len(frames) or (conditions is not None and len(conditions) != len(frames)):
        asked = "none" if conditions is None else len(conditions)
        raise ValueError(f"expected one seed and condition a frame, got {len(frames)}, {len(seeds)} and {asked}")
    levels = noise_levels(num_passes, classes)
    for start in range(0, len(frames), BATCH):
        rows = slice(start, min(start + BATCH, len(frames)))
        images = torch.from_numpy(image_planes(np.asarray(frames[rows]), network.polarities))
        asked = None if conditions is None else torch.from_numpy(condition_planes(np.asarray(conditions[rows])))
        streams = [np.random.default_rng([seed, DRAW_STREAM]) for seed in seeds[rows]]
        drawn = _draw_batch(network, levels, images, asked, streams, getattr(torch, precision))
        for one, stream in zip(drawn, streams, strict=True):
            yield classes.draw(one, stream.random(one.shape))


def _draw_batch(
    network: CountNetwork,
    levels: np.ndarray,
    images: Tensor,
    conditions: Tensor | None,
    streams: Sequence[np.random.Generator],
    dtype: torch.dtype,
) -> np.ndarray:
    """Classes [B, P, H, W] int64 of images on the CPU."""
    device, (height, width) = network.embeddings.device, images.shape[2:]
    images = even_sided(images).to(device)
    conditions = None if conditions is None else even_sided(conditions).to(device)
    shape = images.shape[1:]

    def normal() -> Tensor:
        return torch.from_numpy(np.stack([stream.standard_normal(shape, np.float32) for stream in streams])).to(device)

    noisy = float(levels[0]) * normal()
    for level, following in zip(levels, [*levels[1:], None], strict=True):
        with torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
            logits = network(noisy, torch.full((len(images),), float(level), device=device), images, conditions)
        uniform = torch.from_numpy(np.stack([stream.random(shape, np.float32) for stream in streams]))
        drawn = draw_classes(logits, uniform.to(device))
        if following is not None:
            kept = float(following / level) ** 2
            mean = kept * noisy + (1 - kept) * network.embeddings[drawn]
            noisy = mean + float(following) * (1 - kept) ** 0.5 * normal()
    return drawn[:, :, :height, :width].cpu().numpy()


def draw_classes(logits: Tensor, uniform: Tensor) -> Tensor:
    """A class for each pixel.

    Args:
        logits: [B, P, K, H, W] unnormalised log-probabilities.
        uniform: [B, P, H, W] in [0, 1).
    Returns:
        [B, P, H, W] int64.
    """
    cumulated = torch.softmax(logits, dim=2).cumsum(dim=2)
    return (uniform[:, :, None] > cumulated[:, :, :-1]).sum(dim=2)
