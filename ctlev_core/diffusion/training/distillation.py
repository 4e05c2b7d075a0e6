"""Distil a fine-tuned generator: a student takes in one evaluation of the network what the teacher takes in several.

The teacher follows the probability-flow equation from pure noise to clean latents, for the conditions of training
frames. The student is evaluated at a few time steps of it, those of diffusers' `TCDScheduler`. For each of them it is
known what the student must predict so that the scheduler's step from the teacher's state ends in the teacher's state at
the next one: that is its target. No frame is needed, nor does anything but the solver of the teacher stand between the
two: what a student that has learnt its targets samples is what the teacher samples from the same noise.

Source: Luhman and Luhman, Knowledge Distillation in Iterative Generative Models, 2021 (learning from the teacher's own
trajectories); Salimans and Ho, Progressive Distillation, ICLR 2022, appendix G (the target); Zheng et al., Trajectory
Consistency Distillation, 2024 (the scheduler, here without noise of its own).
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ctlev_core.diffusion.denoising import Batch, Denoiser, NoiseSchedule, generator_for
from ctlev_core.diffusion.flow_matching import refuse_flow
from ctlev_core.diffusion.pretrained.loading import (
    PretrainedModel,
    choose_device,
    conditions_to_tensor,
    load_base_model,
    save_base_model,
)
from ctlev_core.diffusion.pretrained.prompts import encode_prompts, put_text_encoders_aside
from ctlev_core.diffusion.sampling.options import OF_STUDENTS, SamplingOptions
from ctlev_core.diffusion.sampling.sampling import guided_predictions
from ctlev_core.diffusion.sampling.schedulers import make_scheduler, student_config, trajectory_scheduler
from ctlev_core.diffusion.sampling.value_table import TABLE_FOLDER
from ctlev_core.diffusion.student_files import STUDENT_SCHEDULER
from ctlev_core.diffusion.training.acceleration import accelerated
from ctlev_core.diffusion.training.finetuning import draw_turns
from ctlev_core.diffusion.training.latent_cache import turn_conditions
from ctlev_core.diffusion.training.loop import run_training, sample_rows
from ctlev_core.diffusion.training.options import StudentOptions
from ctlev_core.diffusion.training.trainer import Trainer, TrainingHistory
from data_contracts.config import cache_material
from data_contracts.errors import DataError
from data_contracts.file_lists import file_digest
from data_contracts.image_rows import as_image_rows
from data_contracts.labels import Conditions

SPLIT_STREAM, NOISE_STREAM = 1, 2
RHO = 7.0
"""Of the spread of the teacher's time steps, as Karras et al., 2022, eq. 5."""

Predict = Callable[[Tensor, Tensor], Tensor]
"""From noisy latents [B, C, h, w] and their time step to the teacher's prediction [B, C, h, w] float32."""


@dataclass(frozen=True, eq=False)
class TrajectorySteps:
    """Time steps of a student and of its teacher.

    Attributes:
        schedule: the noise schedule of both.
        config: the scheduler config of the teacher.
        student: of the student's evaluations, descending.
        teacher: of the teacher's, descending; those of the student are among them, and 0 is the last.
    """

    schedule: NoiseSchedule
    config: dict[str, Any]
    student: tuple[int, ...]
    teacher: tuple[int, ...]

    @staticmethod
    def make(config: dict[str, Any], num_evaluations: int, teacher_evaluations: int) -> TrajectorySteps:
        """Of a teacher's scheduler config; the teacher's evaluations are shared out among those of the student."""
        schedule = NoiseSchedule(config)
        scheduler = make_scheduler(OF_STUDENTS, student_config(config, num_evaluations), num_evaluations)
        student = tuple(int(step) for step in scheduler.timesteps)
        alpha_bar = schedule.alphas_cumprod.double().clamp(min=2.0**-24)
        sigmas = ((1 - alpha_bar) / alpha_bar).sqrt().numpy() ** (1 / RHO)
        teacher: list[int] = []
        each = math.ceil(teacher_evaluations / num_evaluations)
        for start, stop in zip(student, (*student[1:], 0), strict=True):
            between = np.linspace(sigmas[start], sigmas[stop], each, endpoint=False)
            teacher += [start, *np.searchsorted(sigmas, between[1:]).tolist()]
        return TrajectorySteps(schedule, config, student, tuple(sorted({*teacher, 0}, reverse=True)))

    def follow(self, noise: Tensor, predict: Predict) -> list[Tensor]:
        """The teacher's states at the student's time steps, the first of which is the noise, and its clean latents.

        Args:
            noise: [B, C, h, w] standard normal.
            predict: the teacher.
        Returns:
            One more than the student has evaluations, [B, C, h, w] each.
        """
        scheduler = trajectory_scheduler(self.config, list(self.teacher))
        state, states = noise, []
        for timestep in scheduler.timesteps:
            if int(timestep) in self.student:
                states.append(state)
            state = scheduler.step(predict(state, timestep), timestep, state).prev_sample
        return [*states, state]

    def target(self, state: Tensor, following: Tensor, number: int) -> Tensor:
        """What the student must predict at its evaluation `number`, [B, C, h, w].

        The scheduler's step is x_s = a x_t + b x_0, with a = ((1 - abar_s) / (1 - abar_t))^1/2 and
        b = abar_s^1/2 - a abar_t^1/2; the last goes to time step 0. It is solved for x_0, with the teacher's next state
        for x_s.

        Args:
            state: [B, C, h, w] at the evaluation.
            following: [B, C, h, w] where the step is to end.
            number: from 0.
        """
        time, then = self.student[number], (*self.student[1:], 0)[number]
        here, there = (float(self.schedule.alphas_cumprod[step]) for step in (time, then))
        kept = ((1 - there) / (1 - here)) ** 0.5
        clean = (following - kept * state) / (there**0.5 - kept * here**0.5)
        return self.schedule.prediction_of(clean, state, torch.full((len(state),), time, device=state.device))


@dataclass(frozen=True, eq=False)
class Distillation:
    """What a student learns from a teacher.

    Attributes:
        teacher: the fine-tuned generator, frozen.
        student: networks that learn.
        steps: of both.
        empty_embedding: [1, L, D], for guidance.
        guidance: of the teacher.
    """

    teacher: PretrainedModel
    student: Denoiser
    steps: TrajectorySteps
    empty_embedding: Tensor
    guidance: SamplingOptions

    @torch.no_grad()
    def states(self, batch: Batch) -> list[Tensor]:
        """The teacher's states, as `TrajectorySteps.follow`, from the noise that the latents of the batch are."""
        conditions = batch.conditions
        with guided_predictions(
            self.teacher, batch.embeddings, self.empty_embedding, conditions, self.guidance
        ) as predict:
            return self.steps.follow(batch.latents, predict)

    def loss(self, states: Sequence[Tensor], batch: Batch) -> Tensor:
        """Mean squared error of the student's predictions at the teacher's states, all evaluations alike."""
        count, number = len(batch.latents), len(self.steps.student)
        pairs = itertools.pairwise(states)
        targets = torch.cat([self.steps.target(here, there, index) for index, (here, there) in enumerate(pairs)])
        timesteps = torch.tensor(self.steps.student, device=targets.device).repeat_interleave(count)
        conditions = None if batch.conditions is None else batch.conditions.repeat(number, 1, 1, 1)
        embeddings = batch.embeddings.repeat(number, 1, 1)
        predicted = self.student.predict(torch.cat(list(states[:-1])), timesteps, embeddings, conditions)
        return (predicted.float() - targets).square().mean()

    def validation_losses(self, batch: Batch, size: int) -> tuple[float, float]:
        """The loss with the true conditions and with those of other rows, `size` trajectories at a time."""
        count, totals = len(batch.latents), np.zeros(2)
        order = torch.arange(count).roll(max(1, count // 2))
        for start in range(0, count, size):
            rows = torch.arange(start, min(start + size, count))
            part = _rows_of(batch, rows, rows)
            states = self.states(part)
            others = _rows_of(batch, rows, order[rows])
            with torch.no_grad():
                losses = [float(self.loss(states, asked)) for asked in (part, others)]
            totals += np.array(losses) * len(rows)
        true_loss, shuffled_loss = (totals / count).tolist()
        return true_loss, shuffled_loss


def _rows_of(batch: Batch, rows: Tensor, asked: Tensor) -> Batch:
    """Noise of some rows, with the conditions of the same or of others; prompts where there are no condition images."""
    images = batch.conditions
    embeddings = batch.embeddings[asked if images is None else rows]
    return Batch(batch.latents[rows], embeddings, None if images is None else images[asked])


def distil(
    checkpoint: Path,
    conditions: Conditions,
    options: StudentOptions,
    *,
    guidance: SamplingOptions,
    seed: int,
    out: Path,
    work: Path,
) -> TrainingHistory:
    """Distil the generator in `checkpoint` and write the student to `out`, a diffusers folder with a `TCDScheduler`.

    Args:
        checkpoint: folder of the fine-tuned generator; an adapter's is read with its base model.
        conditions: N prompts, with N condition images for a generator with a ControlNet.
        options: evaluations, length, rates.
        guidance: sampling options of the teacher, of which its guidance is distilled.
        seed: of order and noise.
        out: the checkpoint folder to write.
        work: resumable state.
    Returns:
        Loss curves; `shuffled_loss` is that with the conditions of other rows.
    Raises:
        DataError: conditions do not fit the generator.
        TrainingError: the loss stayed not finite.
    """
    device, with_controlnet = choose_device(options.device), conditions.images is not None
    teacher, student = (
        load_base_model(checkpoint, with_controlnet=with_controlnet, device=device) for _ in ("teacher", "student")
    )
    refuse_flow(teacher.scheduler_config, "a student")
    _check_conditions(conditions, teacher, options)
    table, row_of = _embeddings(teacher, conditions)
    steps = TrajectorySteps.make(teacher.scheduler_config, options.num_evaluations, options.teacher_evaluations)
    denoiser = Denoiser(student.unet, student.controlnet)
    distillation = Distillation(teacher, denoiser, steps, table[-1:].to(device), guidance)
    networks = [student.unet] + ([student.controlnet] if with_controlnet and options.tune == "both" else [])
    parameters = [weight for network in networks for weight in network.train().requires_grad_(True).parameters()]
    order = np.random.default_rng([seed, SPLIT_STREAM]).permutation(len(conditions))
    num_held_back = min(options.num_validation, len(conditions) // 10)
    held_back, learnt = order[:num_held_back], order[num_held_back:]
    identity = _identity(checkpoint, conditions, options, guidance, seed)
    trainer = Trainer(parameters, options, identity, options.optimizer)
    count, side = options.trajectories_at_a_time, teacher.unet.config.sample_size

    def batch_of(rows: np.ndarray, generator: torch.Generator, turns: np.ndarray | None = None) -> Batch:
        noise = torch.randn((len(rows), teacher.unet.config.in_channels, side, side), generator=generator)
        images = None
        if conditions.images is not None:
            images = np.asarray(conditions.images[rows])
            images = images if turns is None else turn_conditions(images, turns, conditions.made_by)
            images = conditions_to_tensor(images).to(device)
        embeddings = table[[row_of[conditions.prompts[row]] for row in rows]]
        return Batch(noise.to(device), embeddings.to(device), images)

    def fetch(number: int) -> Batch:
        rows = learnt[sample_rows(seed, number, count, len(learnt))]
        turns = draw_turns(count, options.rot90_probability, seed, number) if options.rot90_probability else None
        return batch_of(rows, generator_for(seed, NOISE_STREAM, number), turns)

    def validate() -> tuple[float, float]:
        return distillation.validation_losses(batch_of(held_back, generator_for(seed, NOISE_STREAM)), count)

    with accelerated(Denoiser(teacher.unet, teacher.controlnet), options, device):
        history = run_training(
            trainer,
            denoiser,
            steps.schedule,
            fetch,
            seed=seed,
            work=work,
            validate=validate if num_held_back >= 2 else None,
            description="distillation",
            loss=lambda batch, _: distillation.loss(distillation.states(batch), batch),
        )
    for network in networks:
        network.eval().requires_grad_(False)
    _save(student, checkpoint, options.num_evaluations, out)
    return history


def _check_conditions(conditions: Conditions, teacher: PretrainedModel, options: StudentOptions) -> None:
    width, height = teacher.image_size
    images = conditions.images
    if not len(conditions):
        raise DataError("distillation needs at least one condition, got none")
    if images is not None and (images.shape[1:] != (height, width, 3) or images.dtype != np.uint8):
        raise DataError(
            f"conditions must be [N, {height}, {width}, 3] uint8, the size of this generator, "
            f"got {list(images.shape)} {images.dtype}"
        )
    if options.rot90_probability and (images is None or width != height):
        raise DataError("rot90_probability turns square condition images, and there are none")


def _embeddings(teacher: PretrainedModel, conditions: Conditions) -> tuple[Tensor, dict[str, int]]:
    """Embeddings [P + 1, L, D] of the distinct prompts and, last, of the empty one; and the row of each prompt."""
    prompts = sorted(set(conditions.prompts))
    table = encode_prompts(teacher, [*prompts, ""]).float().cpu()
    put_text_encoders_aside(teacher)
    return table, {prompt: row for row, prompt in enumerate(prompts)}


def _save(student: PretrainedModel, checkpoint: Path, num_evaluations: int, out: Path) -> None:
    """The folder of the teacher, with the student's networks and scheduler."""
    from diffusers.schedulers.scheduling_tcd import TCDScheduler

    save_base_model(student, out)
    config = student_config(student.scheduler_config, num_evaluations)
    scheduler: Any = TCDScheduler.from_config(config)
    scheduler.save_pretrained(out / "scheduler")
    index = json.loads((out / "model_index.json").read_text())
    index["scheduler"] = ["diffusers", STUDENT_SCHEDULER]
    (out / "model_index.json").write_text(json.dumps(index, indent=2) + "\n")
    if (checkpoint / TABLE_FOLDER).is_dir():
        shutil.copytree(checkpoint / TABLE_FOLDER, out / TABLE_FOLDER)


def _identity(
    checkpoint: Path, conditions: Conditions, options: StudentOptions, guidance: SamplingOptions, seed: int
) -> str:
    """Digest of what the saved state depends on."""
    weights = [file_digest(path) for path in sorted(checkpoint.rglob("*.safetensors"))]
    guided: list[Any] = [guidance.guidance_scale, guidance.guidance_interval]
    if guidance.autoguidance_scale > 1:
        guided += [guidance.autoguidance_scale, guidance.autoguidance_layers]
    digest = hashlib.sha256(json.dumps([cache_material(options), guided, seed, weights, conditions.prompts]).encode())
    if conditions.images is not None:
        digest.update(as_image_rows(conditions.images).digest().encode())
    return digest.hexdigest()
