"""Text route: fine-tune the U-Net of a text-to-image diffusion model, then sample frames from prompts.

Source: ControlEvents (Hu et al., WACV 2026), class-conditioned route: Stable Diffusion v1.4, U-Net trained,
autoencoder and text encoder frozen, prompts "A photo of {class}". The bundled small base model of objects stands in for
Stable Diffusion unless a folder is given. Differences: averaged weights, which can be switched off; a 20-step solver
instead of 1000 DDPM steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.training.options import FineTuningOptions
from data_contracts.image_rows import Images
from data_contracts.labels import Conditions, History

VERSION = 3


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
    )


def sample(
    checkpoint: Path, conditions: Conditions, options: SampleOptions, *, seeds: Sequence[int], work: Path
) -> np.ndarray:
    """Frames [N, H, W, 3] uint8 of N prompts; row i depends on prompt i and seed i alone."""
    from ctlev_core.diffusion.sampling.sampling import sample_checkpoint

    _check_text_only(conditions)
    return sample_checkpoint(checkpoint, conditions, options, with_controlnet=False, seeds=seeds, work=work)


def embed_names(checkpoint: Path, names: Sequence[str]) -> np.ndarray:
    """What the checkpoint's text encoder makes of N names: [N, D] float32."""
    from ctlev_core.diffusion.pretrained import name_embeddings

    return name_embeddings.embed_names(checkpoint, names)


def _check_text_only(conditions: Conditions) -> None:
    if conditions.images is not None:
        raise ValueError(
            "the text route takes prompts only, got condition images as well; use the generator 'controlnet' for them"
        )
