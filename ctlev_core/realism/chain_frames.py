"""Recorded frames after one part of a latent-diffusion generator or another.

Each part includes what the parts before it do to a frame: what is denoised is decoded, and its values are treated, as
what is sampled is. Row i depends on frame, condition and seed i alone, whatever the batch.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ctlev_core.diffusion.denoising import noise_schedule
from ctlev_core.diffusion.pretrained.loading import PretrainedModel, conditions_to_tensor
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.out_of_memory import ShrinkingBatches
from ctlev_core.diffusion.sampling.partial_denoising import (
    check_time_step,
    denoise,
    denoising_times,
    encode_frames,
    noise_to,
)
from ctlev_core.diffusion.sampling.sampling import decode_frames, guided_predictions
from data_contracts.errors import DataError
from data_contracts.image_rows import Images
from data_contracts.labels import Conditions
from data_contracts.realism_chain import Link

Rounding = Callable[[np.ndarray, Images | None, Sequence[int]], np.ndarray]
"""From images [B, H, W, 3] uint8, their condition images and B seeds to images of whole counts."""


@dataclass(frozen=True, eq=False)
class Parts:
    """What frames are sent through.

    Attributes:
        base_model: the fine-tuned checkpoint, with its table of values where the options ask for one.
        options: of sampling: how values are treated, guidance, batch size.
        rounding: to whole counts; None = the generator does not round.
    """

    base_model: PretrainedModel
    options: SamplingOptions
    rounding: Rounding | None = None


def send_through(
    link: Link, frames: np.ndarray, conditions: Conditions, parts: Parts, seeds: Sequence[int]
) -> Iterator[np.ndarray]:
    """Frames after a part, batch by batch; whole sampling is the generator's own `sample`.

    Args:
        link: any but `sampled`.
        frames: [N, H, W, 3] uint8 recorded frames.
        conditions: N prompts, with N condition images where the checkpoint has a ControlNet.
        parts: what they go through.
        seeds: N non-negative integers, one a frame.
    Yields:
        [B, H, W, 3] uint8, B rows at a time.
    Raises:
        DataError: frames are not of the checkpoint's size, or its noise schedule has no such time step.
        ValueError: numbers do not match, or the link is of another kind.
    """
    _check(link, frames, conditions, parts, seeds)
    work = functools.partial(_process, link, frames, conditions, parts, seeds)
    if link.kind == "denoised":
        table = encode_prompts(parts.base_model, [*(prompts := sorted(set(conditions.prompts))), ""])
        rows = [prompts.index(prompt) for prompt in conditions.prompts]
        work = functools.partial(work, embeddings=table[rows], empty=table[-1:])
    return (made for _, made in ShrinkingBatches(parts.options.batch_size).map(work, len(frames)))


def _check(link: Link, frames: np.ndarray, conditions: Conditions, parts: Parts, seeds: Sequence[int]) -> None:
    if link.kind == "sampled":
        raise ValueError("whole sampling starts from noise; use the generator's own `sample`")
    if link.kind == "counts" and parts.rounding is None:
        raise ValueError("the generator does not round to whole counts, so there is nothing to send frames through")
    if not len(frames) == len(conditions) == len(seeds):
        raise ValueError(
            f"expected one condition and one seed a frame, got {len(frames)} frames, {len(conditions)} conditions and "
            f"{len(seeds)} seeds"
        )
    width, height = parts.base_model.image_size
    if frames.shape[1:] != (height, width, 3) or frames.dtype != np.uint8:
        raise DataError(
            f"frames must be [N, {height}, {width}, 3] uint8, as the checkpoint's images are, got {frames.shape} "
            f"{frames.dtype}"
        )
    check_time_step(link.amount, noise_schedule(parts.base_model.scheduler_config))


def _process(
    link: Link,
    frames: np.ndarray,
    conditions: Conditions,
    parts: Parts,
    seeds: Sequence[int],
    rows: slice,
    embeddings: Tensor | None = None,
    empty: Tensor | None = None,
) -> np.ndarray:
    own = seeds[rows]
    latents = encode_frames(parts.base_model, frames[rows], own)
    if link.kind == "autoencoder":
        return _decode_alone(parts.base_model, latents)
    if embeddings is not None and empty is not None:
        images = None if conditions.images is None else conditions_to_tensor(conditions.images[rows])
        latents = _there_and_back(link, latents, parts, own, embeddings[rows], empty, images)
    made = decode_frames(parts.base_model, latents, parts.options, own)
    if parts.rounding is None or link.kind == "values":
        return made
    return parts.rounding(made, None if conditions.images is None else conditions.images[rows], own)


@torch.no_grad()
def _there_and_back(
    link: Link,
    latents: Tensor,
    parts: Parts,
    seeds: Sequence[int],
    embeddings: Tensor,
    empty: Tensor,
    images: Tensor | None,
) -> Tensor:
    schedule = noise_schedule(parts.base_model.scheduler_config)
    noisy = noise_to(latents, link.amount, schedule, seeds)
    with guided_predictions(parts.base_model, embeddings, empty, images, parts.options) as predict:
        return denoise(noisy, denoising_times(link.amount, link.max_evaluations), schedule, predict)


def _decode_alone(base_model: PretrainedModel, latents: Tensor) -> np.ndarray:
    """Decoded values, rounded to grey levels and otherwise as they are."""
    plain = SamplingOptions(black_threshold=0)
    return decode_frames(dataclasses.replace(base_model, value_table=None), latents, plain)
