"""The denoising training loop: one for fine-tuning and for pre-training, resumable bit for bit.

Everything random is a function of (seed, step): which rows make a batch, the noise, the time steps. A run that is
killed and resumed therefore ends in the same weights as one that was not.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from ctlev_core.determinism import deterministic
from ctlev_core.diffusion.denoising import Batch, Denoiser, Emphasis, NoiseSchedule, denoising_loss, generator_for
from ctlev_core.diffusion.flow_matching import FlowSchedule
from ctlev_core.diffusion.training.acceleration import accelerated, autocast, check_precision
from ctlev_core.diffusion.training.checks import check_validated
from ctlev_core.diffusion.training.distributed import SINGLE_PROCESS, DistributedContext
from ctlev_core.diffusion.training.options import TrainingOptions
from ctlev_core.diffusion.training.tensorboard import TrainingLog, training_log
from ctlev_core.diffusion.training.trainer import Trainer, TrainingHistory
from ctlev_core.progress import ProgressBar
from ctlev_core.supervised.batches import walk

BatchLoss = Callable[[Batch, torch.Generator], torch.Tensor]
"""From a batch and the stream of its noise to a loss [], whose gradients the trained weights get."""


def sample_rows(seed: int, step: int, batch_size: int, count: int) -> np.ndarray:
    """Rows [batch_size] of the batch of `step`: every epoch is a permutation of its own of 0 .. count - 1."""
    return walk(count, step * batch_size, batch_size, (seed,))


def check_run(trainer: Trainer, distributed: DistributedContext, *, validated: bool) -> None:
    """Raise ValueError where options do not go together: to be called before anything long starts.

    Float16 needs a CUDA device, best weights and early stopping a validation loss, and several processes batches that
    they can share evenly.
    """
    check_precision(trainer.options, trainer.parameters[0].device)
    if not validated:
        check_validated(trainer.keep, trainer.patience)
    distributed.batches(trainer.options.gradient_accumulation)


def run_training(
    trainer: Trainer,
    denoiser: Denoiser,
    schedule: NoiseSchedule | FlowSchedule,
    fetch: Callable[[int], Batch],
    *,
    seed: int,
    work: Path,
    validate: Callable[[], tuple[float, float]] | None = None,
    draw: Callable[[], np.ndarray] | None = None,
    max_seconds: float = math.inf,
    description: str = "training",
    distributed: DistributedContext = SINGLE_PROCESS,
    loss: BatchLoss | None = None,
) -> TrainingHistory:
    """Train until `num_steps`, or until `max_seconds` over all attempts; the kept weights end up in the models.

    Args:
        trainer: holds the parameters; restored from `work/state.pt` where that exists.
        denoiser: what is trained, wholly or in part.
        schedule: the noise schedule of the base model.
        fetch: micro-batch number to `Batch`; must depend on that number alone.
        seed: of noise and time steps.
        work: folder of the resumable state.
        validate: returns the loss with true and with shuffled conditions.
        draw: returns a picture [H, W, 3] uint8 of samples; it must leave torch's global random stream alone.
        max_seconds: a wall-clock budget; the learning rate decays towards whichever end comes first. Only a run without
            it is repeatable, and several processes would not end together.
        description: of the progress bar.
        distributed: which of several processes this is; they share the batches of a step.
        loss: of a batch; None = the denoising loss.
    Returns:
        The loss curves.
    Raises:
        ValueError: see `check_run`.
        TrainingError: the loss was not finite ten times in a row, or the state in `work` is of another run.
    """
    options, state, device = trainer.options, work / "state.pt", trainer.parameters[0].device
    loss_of = _denoising(denoiser, schedule, options) if loss is None else loss
    check_run(trainer, distributed, validated=validate is not None)
    if state.is_file():
        trainer.restore(state)
    saved = time.monotonic()
    folder = options.tensorboard if distributed.rank == 0 else None
    with (
        deterministic(device, strict=True),
        accelerated(denoiser, options, device),
        training_log(folder, trainer.identity[:12], pictures=work / "samples", first_step=trainer.step) as log,
        _progress_bar(trainer, description, distributed) as bar,
    ):
        while trainer.step < options.num_steps and trainer.seconds < max_seconds and not trainer.out_of_patience:
            started = time.monotonic()
            total = _compute_gradients(trainer, loss_of, fetch, seed, distributed)
            progress = max(trainer.step / options.num_steps, trainer.seconds / max_seconds)
            if math.isfinite(total) and trainer.update(progress):
                trainer.non_finite = 0
                trainer.losses.append(total)
            else:
                trainer.count_skipped()
            trainer.step += 1
            trainer.seconds += time.monotonic() - started
            bar.update()
            if trainer.step % options.log_every == 0:
                _log(trainer, bar, log)
            if validate and trainer.step % options.validation_every == 0 and trainer.step < options.num_steps:
                _validate(trainer, validate, log, distributed)
            _draw(trainer, draw, log, distributed)
            due = time.monotonic() - saved > options.checkpoint_every_s
            if distributed.agreed(due) if distributed.sharded else due:
                _save(trainer, state, distributed)
                saved = time.monotonic()
        if validate and trainer.history.validation_step[-1:] != [trainer.step]:
            _validate(trainer, validate, log, distributed)
    _save(trainer, state, distributed)
    return trainer.finish()


def _denoising(denoiser: Denoiser, schedule: NoiseSchedule | FlowSchedule, options: TrainingOptions) -> BatchLoss:
    emphasis = Emphasis(options.snr_gamma, options.max_loss_weight, options.timestep_power)
    return lambda batch, generator: denoising_loss(denoiser, schedule, batch, generator, emphasis)


def _compute_gradients(
    trainer: Trainer,
    loss_of: BatchLoss,
    fetch: Callable[[int], Batch],
    seed: int,
    distributed: DistributedContext,
) -> float:
    """Gradients of a step, summed over its batches and over all processes, into the parameters; returns the loss."""
    options, device = trainer.options, trainer.parameters[0].device
    trainer.optimizer.zero_grad(set_to_none=True)
    total = 0.0
    for part in distributed.batches(options.gradient_accumulation):
        number = trainer.step * options.gradient_accumulation + part
        noise = generator_for(seed, number)
        batch = fetch(number)  # whose frozen encoders compute as exactly as where their outputs are cached
        with autocast(options, device):
            loss = loss_of(batch, noise)
        trainer.scaler.scale(loss / options.gradient_accumulation).backward()
        total += loss.item() / options.gradient_accumulation
    return distributed.sum_gradients(trainer.parameters, total)


def _progress_bar(trainer: Trainer, description: str, distributed: DistributedContext) -> ProgressBar:
    disable = None if distributed.rank == 0 else True
    total = trainer.options.num_steps
    return ProgressBar(total=total, initial=trainer.step, desc=description, unit="step", disable=disable)


def _log(trainer: Trainer, bar: ProgressBar, log: TrainingLog) -> None:
    options = trainer.options
    loss = float(np.mean(trainer.losses)) if trainer.losses else math.nan
    trainer.history.step.append(trainer.step)
    trainer.history.loss.append(loss)
    trainer.losses = []
    images = trainer.step * options.batch_size * options.gradient_accumulation
    speed = images / max(trainer.seconds, 1e-9)
    bar.note(f"loss {loss:.4f}, {speed:.1f} img/s, skipped {trainer.skipped}")
    log.scalars(
        trainer.step,
        **{
            "loss/training": loss,
            "images_per_second": speed,
            "learning_rate": trainer.learning_rate,
            "gradient_norm": trainer.gradient_norm,
            "skipped_steps": trainer.skipped,
        },
    )


def _validate(
    trainer: Trainer, validate: Callable[[], tuple[float, float]], log: TrainingLog, distributed: DistributedContext
) -> None:
    with trainer.using_average():
        true_loss, shuffled_loss = distributed.agreed(validate())
    trainer.note_validation(true_loss, shuffled_loss)
    curves = {"validation": true_loss, "shuffled": shuffled_loss, "gap": shuffled_loss - true_loss}
    log.scalars(trainer.step, **{f"loss/{name}": value for name, value in curves.items()})


def _save(trainer: Trainer, path: Path, distributed: DistributedContext) -> None:
    """Process 0 writes; where weights are shared out, the others hand over their parts."""
    if distributed.rank == 0 or distributed.sharded:
        trainer.save(path, write=distributed.rank == 0)


def _draw(
    trainer: Trainer, draw: Callable[[], np.ndarray] | None, log: TrainingLog, distributed: DistributedContext
) -> None:
    every = trainer.options.sample_every
    if draw is not None and every and trainer.step % every == 0 and (distributed.rank == 0 or distributed.sharded):
        # Sampling swaps a part of the ControlNet and has other shapes: to compile that anew would take minutes.
        with trainer.using_average(), torch.compiler.set_stance("force_eager"):
            log.picture(trainer.step, draw())
