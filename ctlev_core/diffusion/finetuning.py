"""Fine-tune a prior on event images: what both diffusion generators do.

The frozen parts run once: latents are cached, each distinct prompt is embedded once and the text encoder dropped.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ctlev_core.diffusion.denoising import Batch, Denoiser, NoiseSchedule, generator_for, validation_losses
from ctlev_core.diffusion.prior import (
    Prior,
    choose_device,
    conditions_to_tensor,
    encode_prompts,
    images_to_tensor,
    load_prior,
    save_prior,
)
from ctlev_core.diffusion.small_prior import break_zeros
from ctlev_core.diffusion.training import Trainer, run_training, sample_rows
from ctlev_core.diffusion.training_options import FineTuningOptions
from data_contracts.config import cache_material
from data_contracts.errors import DataError
from data_contracts.labels import Conditions, History

Tune = Literal["unet", "controlnet", "both"]
ENCODE_BATCH = 32
SPLIT_STREAM, LATENT_STREAM, DROPOUT_STREAM, WEIGHT_STREAM = 1, 2, 3, 4  # entropy that keeps random streams apart


@dataclass(frozen=True, eq=False)
class LatentCache:
    """Everything the loop needs of N frames, computed once.

    Attributes:
        mean: [N, C, h, w] posterior means, not scaled.
        std: [N, C, h, w] posterior standard deviations; None for a code without noise.
        scaling_factor: multiplies sampled latents.
        embeddings: [P, L, D] of the distinct prompts; the last is the empty prompt.
        prompt_rows: [N] index into `embeddings`.
        conditions: [N, H, W, 3] uint8, or None.
        reversed_condition: the ControlNet expects BGR.
    """

    mean: Tensor
    std: Tensor | None
    scaling_factor: float
    embeddings: Tensor
    prompt_rows: Tensor
    conditions: np.ndarray | None
    reversed_condition: bool

    def batch(self, rows: np.ndarray, generator: torch.Generator, prompt_dropout: float, device: torch.device) -> Batch:
        """The given rows, with latents drawn from their posteriors."""
        index = torch.from_numpy(rows)
        latents = self.mean[index]
        if self.std is not None:
            latents = latents + self.std[index] * torch.randn(latents.shape, generator=generator)
        prompts = self.prompt_rows[index]
        dropped = torch.rand(len(rows), generator=generator) < prompt_dropout
        prompts = torch.where(dropped, len(self.embeddings) - 1, prompts)
        conditions = None
        if self.conditions is not None:
            conditions = conditions_to_tensor(self.conditions[rows], self.reversed_condition).to(device)
        latents = latents * self.scaling_factor
        return Batch(latents.to(device), self.embeddings[prompts].to(device), conditions)


def cache_latents(prior: Prior, frames: np.ndarray, conditions: Conditions) -> LatentCache:
    """Run the frozen autoencoder and text encoder, once per frame and once per distinct prompt."""
    device = prior.vae.device
    means, deviations = [], []
    with torch.no_grad():
        for start in range(0, len(frames), ENCODE_BATCH):
            images = images_to_tensor(frames[start : start + ENCODE_BATCH]).to(device, prior.vae.dtype)
            posterior = prior.vae.encode(images).latent_dist
            means.append(posterior.mean.float().cpu())
            if hasattr(posterior, "std"):
                deviations.append(posterior.std.float().cpu())
    prompts = sorted(set(conditions.prompts))
    position = {prompt: row for row, prompt in enumerate(prompts)}
    return LatentCache(
        mean=torch.cat(means),
        std=torch.cat(deviations) if deviations else None,
        scaling_factor=prior.scaling_factor,
        embeddings=encode_prompts(prior, [*prompts, ""]).float().cpu(),
        prompt_rows=torch.tensor([position[prompt] for prompt in conditions.prompts]),
        conditions=conditions.images,
        reversed_condition=prior.reversed_condition,
    )


def check_training_data(frames: np.ndarray, conditions: Conditions, image_size: tuple[int, int]) -> None:
    """Raise `DataError` unless frames and conditions are images of the prior's size, one condition a frame."""
    width, height = image_size
    arrays = {"frames": frames} if conditions.images is None else {"frames": frames, "conditions": conditions.images}
    for name, array in arrays.items():
        if array.ndim != 4 or array.shape[1:] != (height, width, 3) or array.dtype != np.uint8:
            raise DataError(
                f"{name} must be [N, {height}, {width}, 3] uint8, the size this prior was trained on, "
                f"got {list(array.shape)} {array.dtype}; set the image size of the encoding"
            )
        if len(array) != len(conditions.prompts):
            raise DataError(f"{len(array)} {name} do not match {len(conditions.prompts)} prompts")
    if len(frames) == 0:
        raise DataError("fine-tuning needs at least one frame, got none")


def forget_weights(prior: Prior, seed: int) -> Prior:
    """The same architecture with random U-Net and ControlNet: the ablation without a prior."""
    state = int(np.random.SeedSequence([seed, WEIGHT_STREAM]).generate_state(1)[0])
    device = prior.unet.device
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(state)
        unet = type(prior.unet).from_config(prior.unet.config).to(device)
        controlnet = None
        if prior.controlnet is not None:
            controlnet = type(prior.controlnet).from_config(prior.controlnet.config)
            break_zeros(controlnet)
            controlnet = controlnet.to(device)
    return replace(prior, unet=unet, controlnet=controlnet)


def fine_tune(
    prior: Prior,
    frames: np.ndarray,
    conditions: Conditions,
    options: FineTuningOptions,
    *,
    tune: Tune,
    seed: int,
    work: Path,
) -> History:
    """Train the networks named by `tune` in place; autoencoder and text encoder stay frozen.

    Args:
        prior: on the device to train on; float32.
        frames: [N, H, W, 3] uint8 event images of the prior's image size.
        conditions: N prompts, with N condition images for a prior with a ControlNet.
        options: length, rates, averaging.
        tune: which networks learn. The paper: `unet` for text, `controlnet` for skeletons.
        seed: of order, noise and held-back frames.
        work: folder of the resumable state.
    Returns:
        Loss curves; `shuffled_loss` is the validation loss with the conditions of other frames.
    Raises:
        ValueError: frames and conditions do not fit the prior or one another.
    """
    check_training_data(frames, conditions, prior.image_size)
    device = prior.unet.device
    cache = cache_latents(prior, frames, conditions)
    prior.text_encoder.to("cpu")
    networks = {"unet": (prior.unet,), "controlnet": (prior.controlnet,), "both": (prior.unet, prior.controlnet)}[tune]
    parameters = []
    for network in networks:
        network.train().requires_grad_(True)
        parameters += list(network.parameters())
    order = np.random.default_rng([seed, SPLIT_STREAM]).permutation(len(frames))
    held_back = min(options.num_validation, len(frames) // 10)
    validation_rows, training_rows = order[:held_back], order[held_back:]
    denoiser = Denoiser(prior.unet, prior.controlnet)
    schedule = NoiseSchedule(prior.scheduler_config)
    trainer = Trainer(parameters, options, _identity(frames, conditions, options, tune, seed))

    def fetch(number: int) -> Batch:
        rows = training_rows[sample_rows(seed, number, options.batch_size, len(training_rows))]
        return cache.batch(rows, generator_for(seed, LATENT_STREAM, number), options.prompt_dropout, device)

    def validate() -> tuple[float, float]:
        batch = cache.batch(validation_rows, generator_for(seed, DROPOUT_STREAM), 0.0, device)
        return validation_losses(denoiser, schedule, batch, seed=seed, batch_size=options.batch_size)

    history = run_training(
        trainer,
        denoiser,
        schedule,
        fetch,
        seed=seed,
        work=work,
        # Two frames at least: one frame has no other's condition to be shuffled with.
        validate=validate if held_back >= 2 else None,
        description="fine-tuning",
    )
    for network in networks:
        network.eval().requires_grad_(False)
    return history


def train_checkpoint(
    frames: np.ndarray,
    conditions: Conditions,
    options: FineTuningOptions,
    *,
    tune: Tune,
    controlnet: Path | None = None,
    with_controlnet: bool,
    seed: int,
    out: Path,
    work: Path,
) -> History:
    """Load the prior, fine-tune it and write it to `out` as a diffusers folder: `train` of both generators."""
    prior = load_prior(
        options.prior, controlnet=controlnet, with_controlnet=with_controlnet, device=choose_device(options.device)
    )
    if options.random_init:
        prior = forget_weights(prior, seed)
    history = fine_tune(prior, frames, conditions, options, tune=tune, seed=seed, work=work)
    save_prior(prior, out)
    return history


def _identity(frames: np.ndarray, conditions: Conditions, options: FineTuningOptions, tune: str, seed: int) -> str:
    """Digest of what the saved state depends on, so that a work folder of another run is not resumed by mistake."""
    digest = hashlib.sha256(json.dumps([cache_material(options), tune, seed, conditions.prompts]).encode())
    for array in (frames, conditions.images):
        if array is not None:
            digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
