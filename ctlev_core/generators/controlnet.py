"""Image route: fine-tune a ControlNet on condition images (skeletons, normals), then sample frames from new ones.

Source: ControlEvents (Hu et al., WACV 2026), skeleton- and SMPL-conditioned routes: only the trainable copy
(ControlNet) learns; U-Net, autoencoder and text encoder are frozen; the prompt is always "A moving human". The bundled
small base model stands in for Stable Diffusion with ControlNet v1.0 unless a folder is given. A small U-Net knows too
little to be left as it is: with the bundled base model `tune: both` is the better choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.training.options import FineTuningOptions, LatentOptions
from data_contracts.config import RUN_SETTING, ConditionChoice
from data_contracts.errors import DataError
from data_contracts.image_rows import Images
from data_contracts.labels import Conditions, History

if TYPE_CHECKING:  # torch, which plans do without
    from ctlev_core.diffusion.training.latent_files import Latents

VERSION = 3


class Options(FineTuningOptions):
    """Fine-tuning options."""

    tune: Literal["controlnet", "unet", "both"] = Field(
        default="controlnet", description="what learns; the paper: the ControlNet alone"
    )
    controlnet: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="subfolder of the base model, such as `controlnet_normals` of the bundled one, or a diffusers "
        "folder elsewhere; the base model's subfolder `controlnet` when null",
    )


class SampleOptions(SamplingOptions):
    """Sampling options."""


def base_model_folders(options: Options) -> list[Path]:
    """The folders and files the weights come from: the base model, and the ControlNet where it lies apart.

    Raises:
        DataError: it is missing, or a part of it is.
    """
    from ctlev_core.diffusion.pretrained.paths import base_model_places, find_controlnet

    try:
        return base_model_places(options.base_model, controlnet=options.controlnet, needs_controlnet=True)
    except DataError as error:
        if options.base_model is not None and not options.base_model.exists() and options.controlnet is not None:
            try:
                find_controlnet(options.base_model, options.controlnet)
            except DataError as other:  # neither is there: better said at once
                raise DataError(f"{error}; {other}") from other
        raise


def check_fit(options: Options, image_size: tuple[int, int] | None, condition: ConditionChoice) -> None:
    """Raise `DataError` where event images or conditions do not fit the base model, before anything is computed."""
    from ctlev_core.diffusion.pretrained import fit
    from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL
    from ctlev_core.diffusion.training.checks import check_packages, check_text_route

    check_packages(options)
    check_text_route(options, with_images=True)
    base_model = options.base_model or BUNDLED_BASE_MODEL
    fit.check_fit(base_model, image_size, condition, controlnet=options.controlnet, with_controlnet=True)


def latent_options(options: Options) -> LatentOptions | None:
    """How frames are encoded before a training; None where it encodes them itself."""
    from ctlev_core.diffusion.training.latent_choice import choose_latents

    return choose_latents(options)


def train(frames: Images, conditions: Conditions, options: Options, *, seed: int, out: Path, work: Path) -> History:
    """Fine-tune on event images and write a `StableDiffusionControlNetPipeline` folder.

    Args:
        frames: [N, H, W, 3] uint8, of the base model's image size.
        conditions: N prompts and [N, H, W, 3] uint8 condition images.
        options: see `Options`.
        seed: of order and noise.
        out: the checkpoint folder to write.
        work: resumable state.
    Returns:
        Loss curves, and the step whose weights were kept.
    Raises:
        TrainingError: losses or gradients stayed not finite, or one of several processes failed.
        ValueError: options do not go together, frames do not fit the base model or the conditions, or
            there are no condition images.
    """
    return train_from_latents(frames, conditions, options, latents=None, seed=seed, out=out, work=work)


def train_from_latents(
    frames: Images,
    conditions: Conditions,
    options: Options,
    *,
    latents: Latents | None,
    seed: int,
    out: Path,
    work: Path,
) -> History:
    """`train`, with the latents of its frames where they were encoded before: the weights are the same."""
    from ctlev_core.diffusion.training.entry import train_checkpoint

    _check_images(conditions)
    return train_checkpoint(
        frames,
        conditions,
        options,
        tune=options.tune,
        controlnet=options.controlnet,
        with_controlnet=True,
        seed=seed,
        out=out,
        work=work,
        latents=latents,
    )


def sample(
    checkpoint: Path, conditions: Conditions, options: SampleOptions, *, seeds: Sequence[int], work: Path
) -> np.ndarray:
    """Frames [N, H, W, 3] uint8 of N conditions; row i depends on condition i and seed i alone."""
    from ctlev_core.diffusion.sampling.sampling import sample_checkpoint

    _check_images(conditions)
    return sample_checkpoint(checkpoint, conditions, options, with_controlnet=True, seeds=seeds, work=work)


def sample_shards(
    checkpoint: Path, conditions: Conditions, options: SampleOptions, *, seeds: Sequence[int], work: Path, only: slice
) -> None:
    """Some of the files of `SHARD` rows that `sample` puts together, with the same N conditions."""
    from ctlev_core.diffusion.sampling.sampling import make_shards

    _check_images(conditions)
    make_shards(checkpoint, conditions, options, with_controlnet=True, seeds=seeds, work=work, only=only)


def _check_images(conditions: Conditions) -> None:
    if conditions.images is None:
        raise ValueError(
            "the ControlNet route needs condition images, got prompts only; "
            "the generator 'stable_diffusion' takes prompts alone"
        )
