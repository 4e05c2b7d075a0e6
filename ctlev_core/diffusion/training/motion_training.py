"""Train motion layers in a fine-tuned image generator: nothing else learns, so that each frame stays as good as it was.

Source: Guo et al., AnimateDiff, ICLR 2024. Differences: the layers learn from event frames of the same camera as the
generator, all frames of a stretch are equally noisy at a time and share some of their noise, and the generator's
ControlNet steers each of them.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from ctlev_core.diffusion.denoising import Batch, Denoiser, NoiseSchedule, generator_for, validation_losses
from ctlev_core.diffusion.flow_matching import refuse_flow
from ctlev_core.diffusion.motion_files import MotionSettings
from ctlev_core.diffusion.motion_layers import MotionLayers, new_adapter, save_motion_layers
from ctlev_core.diffusion.pretrained.loading import choose_device, load_base_model
from ctlev_core.diffusion.pretrained.prompts import put_text_encoders_aside
from ctlev_core.diffusion.training.latent_cache import cache_latents, check_cache, check_training_data
from ctlev_core.diffusion.training.loop import run_training, sample_rows
from ctlev_core.diffusion.training.options import MotionOptions
from ctlev_core.diffusion.training.trainer import Trainer, TrainingHistory
from ctlev_core.supervised.frame_sequences import stretch_lengths
from data_contracts.config import cache_material
from data_contracts.errors import DataError
from data_contracts.file_lists import file_digest
from data_contracts.image_rows import Images, as_image_rows
from data_contracts.labels import Conditions

SPLIT_STREAM, LATENT_STREAM, WEIGHT_STREAM = 1, 2, 3


def train_motion_layers(
    checkpoint: Path,
    frames: Images,
    conditions: Conditions,
    options: MotionOptions,
    *,
    interval_us: int,
    seed: int,
    out: Path,
    work: Path,
) -> TrainingHistory:
    """Train motion layers and write the checkpoint with them to `out`.

    Args:
        checkpoint: folder of the fine-tuned generator.
        frames: [N, H, W, 3] uint8.
        conditions: N, with the stretch of each.
        options: length, rates, context.
        interval_us: from one frame of a stretch to the next.
        seed: of weights, order and noise.
        out: the checkpoint folder to write.
        work: resumable state.
    Returns:
        Loss curves; `shuffled_loss` is that with the conditions of other stretches.
    Raises:
        DataError: no stretch is as long as the context, or frames do not fit the generator.
        TrainingError: the loss stayed not finite.
    """
    firsts = first_frames(conditions, options.context)  # raises before anything is loaded
    base_model = load_base_model(
        checkpoint, with_controlnet=conditions.images is not None, device=choose_device(options.device)
    )
    refuse_flow(base_model.scheduler_config, "a set of motion layers (`motion_layers`)")
    check_training_data(frames, conditions, base_model.image_size)
    state = int(np.random.SeedSequence([seed, WEIGHT_STREAM]).generate_state(1)[0])
    adapter = new_adapter(base_model.unet, state).train()
    layers = MotionLayers(base_model.unet, adapter, MotionSettings(options.context, interval_us, options.shared_noise))
    cache = cache_latents(base_model, frames, conditions, folder=work)
    check_cache(cache, conditions)
    put_text_encoders_aside(base_model)
    order = np.random.default_rng([seed, SPLIT_STREAM]).permutation(len(firsts))
    num_held_back = min(options.num_validation, len(firsts) // 10)
    held_back = np.array([firsts[number][0] for number in order[:num_held_back]], np.int64)
    learnt = np.concatenate([firsts[number] for number in order[num_held_back:]])
    parameters = [parameter for parameter in adapter.requires_grad_(True).parameters() if parameter.requires_grad]
    identity = _identity(checkpoint, frames, conditions, options, seed)
    trainer = Trainer(parameters, options, identity, options.optimizer)
    denoiser = Denoiser(base_model.unet, base_model.controlnet)
    schedule = NoiseSchedule(base_model.scheduler_config)
    device = base_model.unet.device

    def batch_of(starts: np.ndarray, *entropy: int) -> Batch:
        rows = (starts[:, None] + np.arange(options.context)).ravel()
        batch = cache.batch(rows, generator_for(seed, *entropy), 0.0, device)
        return replace(batch, num_frames=options.context, shared_noise=options.shared_noise)

    def fetch(number: int) -> Batch:
        starts = learnt[sample_rows(seed, number, options.stretches_at_a_time, len(learnt))]
        return batch_of(starts, LATENT_STREAM, number)

    def validate() -> tuple[float, float]:
        batch = batch_of(held_back, LATENT_STREAM)
        whole = options.stretches_at_a_time * options.context
        return validation_losses(denoiser, schedule, batch, seed=seed, batch_size=whole)

    with layers.of([options.context]):
        history = run_training(
            trainer,
            denoiser,
            schedule,
            fetch,
            seed=seed,
            work=work,
            validate=validate if len(held_back) >= 2 else None,
            description="motion layers",
        )
    adapter.eval().requires_grad_(False)
    shutil.copytree(checkpoint, out, copy_function=_link)
    save_motion_layers(layers, out)
    return history


def first_frames(conditions: Conditions, context: int) -> list[np.ndarray]:
    """Of each stretch that is long enough, the first rows of all runs of `context` consecutive frames in it.

    Raises:
        DataError: there is none.
    """
    lengths = np.array(stretch_lengths(conditions.stretches or range(len(conditions))))
    ends = np.cumsum(lengths)
    firsts = [np.arange(end - length, end - context + 1) for end, length in zip(ends, lengths, strict=True)]
    found = [rows for rows in firsts if len(rows)]
    if not found:
        raise DataError(
            f"motion layers learn from stretches of {context} consecutive frames, the longest has "
            f"{lengths.max(initial=0)}: take longer recordings or shorter windows, or lower motion_layers.context"
        )
    return found


def _link(source: str, target: str) -> None:
    """The same file once more; a copy where the disk has no links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def _identity(checkpoint: Path, frames: Images, conditions: Conditions, options: MotionOptions, seed: int) -> str:
    """Digest of what the saved state depends on."""
    weights = [file_digest(path) for path in sorted(checkpoint.rglob("*.safetensors"))]
    material = [cache_material(options), seed, weights, conditions.prompts, conditions.stretches]
    digest = hashlib.sha256(json.dumps(material).encode())
    for array in (frames, conditions.images):
        if array is not None:
            digest.update(as_image_rows(array).digest().encode())
    return digest.hexdigest()
