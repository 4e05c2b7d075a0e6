"""Fine-tune a base model on event images: what both diffusion generators do.

The frozen parts run once: latents are cached, each distinct prompt is embedded once and the text encoder dropped.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch

from ctlev_core.diffusion.denoising import Batch, Denoiser, generator_for, noise_schedule, validation_losses
from ctlev_core.diffusion.pretrained.fit import check_channel_order
from ctlev_core.diffusion.pretrained.loading import PretrainedModel, control_input
from ctlev_core.diffusion.pretrained.prompts import encode_prompts, put_text_encoders_aside
from ctlev_core.diffusion.pretraining.architecture import break_zeros
from ctlev_core.diffusion.pretraining.picture_scenes import Rehearsal
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.sampling import sample_frames
from ctlev_core.diffusion.sampling.value_table import fit_value_table, max_table_frames
from ctlev_core.diffusion.training.checks import check_text_route
from ctlev_core.diffusion.training.distributed import SINGLE_PROCESS, DistributedContext
from ctlev_core.diffusion.training.latent_cache import (
    LatentCache,
    cache_latents,
    check_cache,
    check_training_data,
    encode_images,
)
from ctlev_core.diffusion.training.latent_files import Latents
from ctlev_core.diffusion.training.loop import check_run, run_training, sample_rows
from ctlev_core.diffusion.training.lora import add_lora
from ctlev_core.diffusion.training.options import FineTuningOptions
from ctlev_core.diffusion.training.tensorboard import picture_of_samples
from ctlev_core.diffusion.training.trainer import Trainer, TrainingHistory
from ctlev_core.pictures.image_moves import move_image
from data_contracts.config import cache_material
from data_contracts.errors import DataError
from data_contracts.image_rows import Images, as_image_rows
from data_contracts.labels import Conditions

Tune = Literal["unet", "controlnet", "both"]
SHOWN, SHOWN_STEPS = 6, 10
"""Samples in a picture, and evaluations of the network for each."""
SPLIT_STREAM, LATENT_STREAM, DROPOUT_STREAM, WEIGHT_STREAM, TURN_STREAM = 1, 2, 3, 4, 5
MOVE_STREAM, REHEARSAL_STREAM, VALUE_STREAM = 6, 7, 8
"""Entropy that keeps random streams apart."""


def forget_weights(base_model: PretrainedModel, seed: int) -> PretrainedModel:
    """The same architecture with random U-Net and ControlNet: the ablation without a base model."""
    state = int(np.random.SeedSequence([seed, WEIGHT_STREAM]).generate_state(1)[0])
    device = base_model.unet.device
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(state)
        unet = type(base_model.unet).from_config(base_model.unet.config).to(device)
        controlnet = None
        if base_model.controlnet is not None:
            controlnet = type(base_model.controlnet).from_config(base_model.controlnet.config)
            break_zeros(controlnet)
            controlnet = controlnet.to(device)
    return replace(base_model, unet=unet, controlnet=controlnet)


def fine_tune(
    base_model: PretrainedModel,
    frames: Images,
    conditions: Conditions,
    options: FineTuningOptions,
    *,
    tune: Tune,
    seed: int,
    work: Path,
    class_names: Sequence[str] | None = None,
    latents: Latents | None = None,
    distributed: DistributedContext = SINGLE_PROCESS,
    start: str | None = None,
) -> TrainingHistory:
    """Train the networks named by `tune` in place; autoencoder and text encoder stay frozen.

    Args:
        base_model: on the device to train on; float32.
        frames: [N, H, W, 3] uint8 event images of the base model's image size.
        conditions: N prompts, with N condition images for a base model with a ControlNet.
        options: length, rates, averaging.
        tune: which networks learn. The paper: `unet` for text, `controlnet` for skeletons.
        seed: of order, noise and held-back frames.
        work: folder of the resumable state.
        class_names: N; at every step a frame is shown with a random one of the prompts that occur in its class, as the
            paper draws a class name per iteration. None = each frame keeps its own prompt.
        latents: of the frames, where they were encoded and checked before; None = they are encoded here.
        distributed: which of several processes this is.
        start: `digest_of_start` of the base model before its weights were shared out; None = they are whole.
    Returns:
        Loss curves; `shuffled_loss` is the validation loss with the conditions of other frames.
    Raises:
        ValueError: frames and conditions do not fit the base model or one another, latents are not finite, or options
            do not fit one another.
    """
    check_training_data(frames, conditions, base_model.image_size)
    check_channel_order("bgr" if base_model.reversed_condition else "rgb", conditions.made_by)
    if options.rot90_probability and frames.shape[1] != frames.shape[2]:
        raise DataError(
            f"rot90_probability needs square frames, got {frames.shape[2]} x {frames.shape[1]} px; set it to 0"
        )
    check_text_route(options, with_images=conditions.images is not None)
    device, start = base_model.unet.device, start or digest_of_start(base_model)
    names = ("unet", "controlnet") if tune == "both" else (tune,)
    networks = {name: getattr(base_model, name) for name in names}
    parameters = _start_to_learn(networks, options, seed)
    validation_rows, training_rows = split_rows(len(frames), options, seed)
    identity = _identity(start, frames, conditions, options, tune, seed, class_names)
    trainer = Trainer(parameters, options, identity, options.optimizer, keep=options.keep, patience=options.patience)
    # Two frames at least: one frame has no other's condition to be shuffled with.
    validated = len(validation_rows) >= 2
    check_run(trainer, distributed, validated=validated)
    denoiser = Denoiser(base_model.unet, base_model.controlnet)
    schedule = noise_schedule(base_model.scheduler_config)
    cache = cache_latents(
        base_model,
        frames,
        conditions,
        class_names,
        num_turns=options.num_turns,
        latents=latents,
        folder=work,
        distributed=distributed,
    )
    check_cache(cache, conditions, latents_are_checked=latents is not None)
    put_text_encoders_aside(base_model)
    rehearsal = Rehearsal(options.rehearsal, base_model.image_size[0]) if options.num_pictures else None

    def steered(batch: Batch) -> Batch:
        return replace(batch, conditions=control_input(base_model, batch.conditions))

    def fetch(number: int) -> Batch:
        rows = training_rows[sample_rows(seed, number, options.batch_size - options.num_pictures, len(training_rows))]
        turns = draw_turns(len(rows), options.rot90_probability, seed, number) if options.rot90_probability else None
        generator = generator_for(seed, LATENT_STREAM, number)
        batch = steered(cache.batch(rows, generator, options.prompt_dropout, device, turns))
        if options.moves.moves_anything:
            moved = move_frames(frames[rows], options, seed, number)
            batch = replace(batch, latents=encode_images(base_model, moved, generator).to(device))
        return batch if rehearsal is None else _with_pictures(batch, base_model, rehearsal, options, seed, number)

    def validate() -> tuple[float, float]:
        batch = steered(cache.batch(validation_rows, generator_for(seed, DROPOUT_STREAM), 0.0, device))
        return validation_losses(denoiser, schedule, batch, seed=seed, batch_size=options.batch_size)

    shown = np.sort(validation_rows if len(validation_rows) else training_rows)[:SHOWN]
    history = run_training(
        trainer,
        denoiser,
        schedule,
        fetch,
        seed=seed,
        work=work,
        validate=validate if validated else None,
        draw=partial(draw_samples, base_model, frames[shown], _rows_of(conditions, shown)),
        description="fine-tuning",
        distributed=distributed,
    )
    for network in networks.values():
        network.eval().requires_grad_(False)
    if options.values_at and (distributed.rank == 0 or distributed.sharded):  # of shards no process has the whole
        history.value_table = _value_table(base_model, frames, cache, training_rows, options, seed)
    return history


def _start_to_learn(networks: dict[str, Any], options: FineTuningOptions, seed: int) -> list[torch.nn.Parameter]:
    """The weights that learn."""
    for network in networks.values():
        network.train()
    if options.lora_rank is not None:
        return add_lora(networks, options, seed)
    return [parameter for network in networks.values() for parameter in network.requires_grad_(True).parameters()]


def split_rows(count: int, options: FineTuningOptions, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows held back for validation and rows to learn from; another `max_frames` changes only where the latter end."""
    order = np.random.default_rng([seed, SPLIT_STREAM]).permutation(count)
    held_back = min(options.num_validation, count // 10)
    return order[:held_back], order[held_back:][: options.max_frames]


def draw_turns(count: int, share: float, seed: int, number: int) -> np.ndarray:
    """Quarter turns [count] of micro-batch `number`: 0 but for `share` of them, which are 1, 2 or 3 alike."""
    rng = np.random.default_rng([seed, TURN_STREAM, number])
    return np.where(rng.random(count) < share, rng.integers(1, 4, count), 0)


def move_frames(frames: np.ndarray, options: FineTuningOptions, seed: int, number: int) -> np.ndarray:
    """The frames [B, H, W, 3] uint8 of micro-batch `number`, each moved at random."""
    rng = np.random.default_rng([seed, MOVE_STREAM, number])
    return np.stack([move_image(frame, options.moves, rng, interpolation="nearest") for frame in frames])


def _with_pictures(
    batch: Batch, base_model: PretrainedModel, rehearsal: Rehearsal, options: FineTuningOptions, seed: int, number: int
) -> Batch:
    """The batch, and behind it pictures with their captions up to the whole batch size."""
    rng = np.random.default_rng([seed, REHEARSAL_STREAM, number])
    images, captions = rehearsal.draw(options.batch_size - len(batch.latents), rng)
    captions = ["" if rng.random() < options.prompt_dropout else caption for caption in captions]
    latents = encode_images(base_model, images, generator_for(seed, REHEARSAL_STREAM, number)).to(batch.latents)
    embeddings = encode_prompts(base_model, captions).to(batch.embeddings)
    return Batch(torch.cat([batch.latents, latents]), torch.cat([batch.embeddings, embeddings]))


def _value_table(
    base_model: PretrainedModel,
    frames: Images,
    cache: LatentCache,
    rows: np.ndarray,
    options: FineTuningOptions,
    seed: int,
) -> np.ndarray:
    rows = rows[: max_table_frames(frames.shape[1:])]
    batch = cache.batch(rows, generator_for(seed, VALUE_STREAM), 0.0, torch.device("cpu"))
    timestep = round(options.values_at * (noise_schedule(base_model.scheduler_config).num_timesteps - 1))
    return fit_value_table(base_model, frames[rows], batch.latents, batch.embeddings, timestep=timestep, seed=seed)


def draw_samples(base_model: PretrainedModel, frames: np.ndarray, conditions: Conditions) -> np.ndarray:
    """A picture of conditions, real frames and samples, from noise that is the same at every call.

    Args:
        base_model: with the weights to sample from.
        frames: [N, H, W, 3] uint8 real frames.
        conditions: what the N samples are asked for.
    Returns:
        [N * H, 3 * W, 3] uint8; without condition images 2 * W.
    """
    if conditions.images is None:
        base_model = replace(base_model, controlnet=None)
    options = SamplingOptions(num_inference_steps=SHOWN_STEPS, batch_size=SHOWN)
    with TemporaryDirectory() as folder:
        samples = sample_frames(base_model, conditions, options, seeds=range(len(frames)), work=Path(folder))
    asked = None if conditions.images is None else np.asarray(conditions.images)
    return picture_of_samples([asked, frames, samples])


def _rows_of(conditions: Conditions, rows: np.ndarray) -> Conditions:
    images = None if conditions.images is None else np.asarray(conditions.images[rows])
    return Conditions(tuple(conditions.prompts[row] for row in rows), images)


def digest_of_start(base_model: PretrainedModel) -> str:
    """Of the weights that a training starts from, also those that stay frozen, and of the noise schedule."""
    digest = hashlib.sha256(json.dumps(base_model.scheduler_config, sort_keys=True).encode())
    for network in filter(None, (base_model.unet, base_model.controlnet)):
        for name, weight in network.state_dict().items():
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(weight.detach().float().cpu().numpy()).data)
    return digest.hexdigest()


def _identity(
    start: str,
    frames: Images,
    conditions: Conditions,
    options: FineTuningOptions,
    tune: str,
    seed: int,
    class_names: Sequence[str] | None,
) -> str:
    """Digest of what the saved state depends on, so that a work folder of another run is not resumed by mistake."""
    material = {
        name: value for name, value in cache_material(options).items() if name in FineTuningOptions.model_fields
    }
    named = None if class_names is None else list(class_names)
    made_by = conditions.made_by.model_dump(mode="json") if conditions.made_by and options.rot90_probability else None
    digest = hashlib.sha256(json.dumps([start, material, tune, seed, conditions.prompts, named, made_by]).encode())
    for array in (frames, conditions.images):
        if array is not None:
            digest.update(as_image_rows(array).digest().encode())
    return digest.hexdigest()
