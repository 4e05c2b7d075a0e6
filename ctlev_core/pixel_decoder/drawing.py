"""Draw the pixel values of sampled images: from nothing but noise to whole counts in a few passes of the network.

Each pass gives, for every pixel, the probability of every class of values. Classes are drawn, and the noisy values of
the next, lower noise level given them and the noisy values before (the posterior of a Gaussian diffusion). What is
drawn in one pass is drawn pixel by pixel; the passes after it see the neighbours, so that an edge becomes an edge. One
pass alone would leave pixels independent of one another.

Every image has a random stream of its own. A network that sees the frame before draws the frames of a stretch one after
another, those of several stretches at a time; their noise may move along (`moving_noise`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from ctlev_core.cpu_precision import computed_in
from ctlev_core.pixel_decoder.moving_noise import MovingNoise, Noise
from ctlev_core.pixel_decoder.network import MAX_NOISE, MIN_NOISE, PixelNetwork
from ctlev_core.pixel_decoder.value_classes import ValueClasses
from data_contracts.image_rows import Images

BATCH = 16
"""Images, or stretches of images, in memory at a time."""
DRAW_STREAM = 11
"""Entropy that keeps what is drawn here apart from the noise an image was sampled from, whose seed is the same."""


def noise_levels(num_passes: int, classes: ValueClasses) -> np.ndarray:
    """[num_passes] float64 descending, geometric; a single pass sees nothing but noise."""
    return np.geomspace(MAX_NOISE, MIN_NOISE, num_passes) * classes.active_step


def image_planes(frames: np.ndarray, num_planes: int) -> np.ndarray:
    """The colours of frames [N, H, W, 3] that tell something, as planes [N, P, H, W] of the same dtype or float.

    One plane: the mean of all channels; two: red and blue, which polarities are; three: all.
    """
    if num_planes == 1:
        planes = frames.mean(axis=3, keepdims=True)
    else:
        planes = frames[..., [0, 2]] if num_planes == 2 else frames
    return np.ascontiguousarray(planes.transpose(0, 3, 1, 2))


def frames_of_planes(planes: np.ndarray) -> np.ndarray:
    """Frames [N, H, W, 3] uint8 of planes [N, P, H, W] of grey levels; the inverse of `image_planes`."""
    levels = planes.astype(np.uint8)
    if levels.shape[1] == 2:
        levels = np.stack([levels[:, 0], np.zeros_like(levels[:, 0]), levels[:, 1]], axis=1)
    return np.ascontiguousarray(np.broadcast_to(levels, (len(levels), 3, *levels.shape[2:])).transpose(0, 2, 3, 1))


def as_input(planes: np.ndarray) -> Tensor:
    """Grey levels as float32 in [-1, 1]."""
    return torch.from_numpy(planes.astype(np.float32) / 127.5 - 1)


def condition_planes(images: np.ndarray) -> np.ndarray:
    """[N, H, W, 3] uint8 as planes [N, 3, H, W] float32 in [0, 1]."""
    return np.ascontiguousarray(images.transpose(0, 3, 1, 2), np.float32) / 255


def even_sided(planes: Tensor) -> Tensor:
    """Planes [B, C, H, W] with a last row and column repeated where a side is odd."""
    bottom, right = planes.shape[2] % 2, planes.shape[3] % 2
    if not bottom and not right:
        return planes
    padded = torch.nn.functional.pad(planes.float(), (0, right, 0, bottom), mode="replicate")
    return padded.to(planes.dtype)


@torch.inference_mode()
def draw_values(
    network: PixelNetwork,
    classes: ValueClasses,
    frames: Images,
    conditions: Images | None,
    *,
    seeds: Sequence[int],
    num_passes: int,
    precision: str = "float32",
    lengths: Sequence[int] | None = None,
    moving_noise: bool = False,
) -> Iterator[np.ndarray]:
    """Values of sampled images, one after another; image i depends on image, condition and seed i alone.

    With `lengths` it depends on the images, conditions and seeds before it in its stretch, too.

    Args:
        network: trained, on the device to compute on.
        classes: of its values.
        frames: [N, H, W, 3] uint8 as the generator gives them.
        conditions: [N, H, W, 3] uint8 that they were asked for, where the network takes some; else None.
        seeds: N non-negative integers.
        num_passes: at least 1.
        precision: of the convolutions.
        lengths: images of each stretch, which lie behind one another, of a network that sees the frame before; None =
            each is by itself.
        moving_noise: whether the noise of a stretch moves with what its images show; see `MovingNoise`.
    Yields:
        [P, H, W] uint16.
    Raises:
        ValueError: numbers do not match.
    """
    if len(seeds) != len(frames) or (conditions is not None and len(conditions) != len(frames)):
        asked = "none" if conditions is None else len(conditions)
        raise ValueError(f"expected one seed and condition a frame, got {len(frames)}, {len(seeds)} and {asked}")
    if lengths is not None and (sum(lengths) != len(frames) or any(length < 1 for length in lengths)):
        raise ValueError(f"lengths must be 1 or more and add up to {len(frames)}, got {list(lengths)}")
    place = next(network.parameters()).device.type
    levels, dtype = noise_levels(num_passes, classes), getattr(torch, computed_in(precision, place))
    counts = np.ones(len(frames), np.int64) if lengths is None else np.array(lengths, np.int64)
    firsts = np.cumsum(counts) - counts
    for start in range(0, len(counts), BATCH):
        first, count = firsts[start : start + BATCH], counts[start : start + BATCH]
        rows = slice(int(first[0]), int(first[-1] + count[-1]))
        shown = np.asarray(frames[rows])
        images = as_input(image_planes(shown, network.num_planes))
        asked = None if conditions is None else torch.from_numpy(condition_planes(np.asarray(conditions[rows])))
        streams = [np.random.default_rng([seed, DRAW_STREAM]) for seed in seeds[rows]]
        noises: list[Noise] = list(streams)
        if moving_noise and lengths is not None:
            noises = _noise_of_stretches(count, [seeds[row] for row in first], images.shape[2:])
        drawn = np.empty(images.shape, np.int64)
        for position in range(int(count.max())):
            # The rows at this place of their stretch.
            at = first[count > position] - rows.start + position
            if position:
                _move_on(noises, shown, at)
            previous = None
            if network.sees_previous:
                previous = torch.from_numpy(drawn[at - 1] if position else np.full_like(drawn[at], -1))
            drawn[at] = _draw_batch(
                network,
                levels,
                images[at],
                None if asked is None else asked[at],
                previous,
                [noises[row] for row in at],
                dtype,
            )
        for one, stream in zip(drawn, streams, strict=True):
            yield classes.draw(one, stream.random(one.shape))


def _noise_of_stretches(lengths: np.ndarray, seeds: Sequence[int], image_size: Sequence[int]) -> list[Noise]:
    """Of each image that of its stretch."""
    height, width = (side + side % 2 for side in image_size)
    noises = [MovingNoise((height, width), seed) for seed in seeds]
    return [noise for noise, length in zip(noises, lengths, strict=True) for _ in range(length)]


def _move_on(noises: Sequence[Noise], frames: np.ndarray, rows: np.ndarray) -> None:
    """Noise that moves goes on to some rows of the frames from those before; the rest is drawn anew in any case."""
    for row in rows:
        if isinstance(noise := noises[row], MovingNoise):
            noise.move(*frames[row - 1 : row + 1].max(axis=3))


def _draw_batch(
    network: PixelNetwork,
    levels: np.ndarray,
    images: Tensor,
    conditions: Tensor | None,
    previous: Tensor | None,
    noises: Sequence[Noise],
    dtype: torch.dtype,
) -> np.ndarray:
    """Classes [B, P, H, W] int64 of images on the CPU; `previous`, likewise, are those of the frames before."""
    device, (height, width) = network.embeddings.device, images.shape[2:]
    images = even_sided(images).to(device)
    conditions = None if conditions is None else even_sided(conditions).to(device)
    previous = None if previous is None else even_sided(previous).to(device)
    shape = images.shape[1:]

    def normal() -> Tensor:
        return torch.from_numpy(np.stack([noise.standard_normal(shape, np.float32) for noise in noises])).to(device)

    noisy = float(levels[0]) * normal()
    for level, following in zip(levels, [*levels[1:], None], strict=True):
        with torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
            noise_level = torch.full((len(images),), float(level), device=device)
            logits = network(noisy, noise_level, images, conditions, previous)
        uniform = torch.from_numpy(np.stack([noise.random(shape, np.float32) for noise in noises]))
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
