"""Text route: fine-tune the U-Net of a text-to-image diffusion model, then sample frames from prompts.

Source: ControlEvents (Hu et al., WACV 2026), class-conditioned route: Stable Diffusion v1.4, U-Net trained,
autoencoder and text encoder frozen, prompts "A photo of {class}". The bundled small base model of objects stands in for
Stable Diffusion unless a folder is given. Differences: averaged weights, which can be switched off; a 20-step solver
instead of 1000 DDPM steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.training.options import FineTuningOptions, LatentOptions
from data_contracts.config import ConditionChoice
from data_contracts.image_rows import Images
from data_contracts.labels import Conditions, History

if TYPE_CHECKING:  # torch, which plans do without
    from ctlev_core.diffusion.training.latent_files import Latents

VERSION = 4


class Options(FineTuningOptions):
    """Fine-tuning options; the U-Net learns, as in the paper."""

    tune: Literal["unet"] = Field(default="unet", description="what learns; the text route has only the U-Net")


class SampleOptions(SamplingOptions):
    """Sampling options."""


def base_model_folders(options: Options) -> list[Path]:
    """The folder, or the files, the weights come from.

    Raises:
        DataError: it is missing, or a part of it is.
    """
    from ctlev_core.diffusion.pretrained.paths import BUNDLED_OBJECT_MODEL, base_model_places

    return base_model_places(options.base_model or BUNDLED_OBJECT_MODEL)


def check_fit(options: Options, image_size: tuple[int, int] | None, condition: ConditionChoice) -> None:
    """Raise `DataError` where event images are not of the base model's size, before anything is computed."""
    from ctlev_core.diffusion.pretrained import fit
    from ctlev_core.diffusion.pretrained.paths import BUNDLED_OBJECT_MODEL
    from ctlev_core.diffusion.training.checks import check_packages

    check_packages(options)
    fit.check_fit(options.base_model or BUNDLED_OBJECT_MODEL, image_size, condition)


def latent_options(options: Options) -> LatentOptions | None:
    """How frames are encoded before a training; None where it encodes them itself."""
    from ctlev_core.diffusion.training.latent_choice import choose_latents

    return choose_latents(options)


def train(frames: Images, conditions: Conditions, options: Options, *, seed: int, out: Path, work: Path) -> History:
    """Fine-tune on event images and write a `StableDiffusionPipeline` folder.

    Args:
        frames: [N, H, W, 3] uint8, of the base model's image size.
        conditions: N prompts, no images.
        options: see `Options`.
        seed: of order and noise.
        out: the checkpoint folder to write.
        work: resumable state.
    Returns:
        Loss curves, and the step whose weights were kept.
    Raises:
        TrainingError: losses or gradients stayed not finite, or one of several processes failed.
        ValueError: options do not go together, frames do not fit the base model or the conditions, or
            the conditions have images.
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
    from ctlev_core.diffusion.pretrained.paths import BUNDLED_OBJECT_MODEL
    from ctlev_core.diffusion.training.entry import train_checkpoint

    _check_text_only(conditions)
    return train_checkpoint(
        frames,
        conditions,
        options.model_copy(update={"base_model": options.base_model or BUNDLED_OBJECT_MODEL}),
        tune=options.tune,
        with_controlnet=False,
        class_names=conditions.class_names,
        seed=seed,
        out=out,
        work=work,
        latents=latents,
    )


def sample(
    checkpoint: Path, conditions: Conditions, options: SampleOptions, *, seeds: Sequence[int], work: Path
) -> np.ndarray:
    """Frames [N, H, W, 3] uint8 of N prompts; row i depends on prompt i and seed i alone."""
    from ctlev_core.diffusion.sampling.sampling import sample_checkpoint

    _check_text_only(conditions)
    return sample_checkpoint(checkpoint, conditions, options, with_controlnet=False, seeds=seeds, work=work)


def sample_shards(
    checkpoint: Path, conditions: Conditions, options: SampleOptions, *, seeds: Sequence[int], work: Path, only: slice
) -> None:
    """Some of the files of `SHARD` rows that `sample` puts together, with the same N conditions."""
    from ctlev_core.diffusion.sampling.sampling import make_shards

    _check_text_only(conditions)
    make_shards(checkpoint, conditions, options, with_controlnet=False, seeds=seeds, work=work, only=only)


def embed_names(checkpoint: Path, names: Sequence[str]) -> np.ndarray:
    """What the checkpoint's text encoder makes of N names: [N, D] float32."""
    from ctlev_core.diffusion.pretrained import name_embeddings

    return name_embeddings.embed_names(checkpoint, names)


def _check_text_only(conditions: Conditions) -> None:
    if conditions.images is not None:
        raise ValueError(
            "the text route takes prompts only, got condition images as well; use the generator 'controlnet' for them"
        )
