"""The denoising training loop: one for fine-tuning and for pre-training, resumable bit for bit.

Everything random is a function of (seed, step): which rows make a batch, the noise, the time steps. A run that is
killed and resumed therefore ends in the same weights as one that was not.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from ctlev_core.diffusion.denoising import Batch, Denoiser, NoiseSchedule, denoising_loss, generator_for
from ctlev_core.diffusion.muon import Muon
from ctlev_core.diffusion.training_options import TrainingOptions
from data_contracts.errors import TrainingError
from data_contracts.labels import History

MAX_NON_FINITE = 10
BETAS = (0.9, 0.999)


def sample_rows(seed: int, step: int, batch_size: int, count: int) -> np.ndarray:
    """Rows [batch_size] of the batch of `step`: every epoch is a permutation of its own of 0 .. count - 1."""
    positions = np.arange(step * batch_size, (step + 1) * batch_size)
    epochs = positions // count
    orders = {epoch: np.random.default_rng([seed, int(epoch)]).permutation(count) for epoch in np.unique(epochs)}
    return np.array([orders[epoch][position % count] for epoch, position in zip(epochs, positions, strict=True)])


class Trainer:
    """Optimiser, averaged weights and history of the trainable parameters, saved and restored as one."""

    def __init__(
        self,
        parameters: Sequence[torch.nn.Parameter],
        options: TrainingOptions,
        identity: str,
        optimizer: Literal["adamw", "muon"] = "adamw",
    ) -> None:
        """Prepare to train `parameters`; `identity` names the run, so that foreign state is refused."""
        self.parameters = list(parameters)
        self.options = options
        self.identity = identity
        settings: dict[str, Any] = {
            "lr": options.learning_rate,
            "betas": BETAS,
            "weight_decay": options.weight_decay,
        }
        if optimizer == "muon":
            self.optimizer: torch.optim.Optimizer = Muon(self.parameters, **settings)
        else:
            fused = self.parameters[0].device.type in ("cpu", "cuda")
            self.optimizer = torch.optim.AdamW(self.parameters, fused=fused, **settings)
        self.average = [parameter.detach().clone() for parameter in self.parameters]
        self.history = History()
        self.step = 0
        self.seconds = 0.0
        self.skipped = 0
        self.losses: list[float] = []

    def update(self, progress: float) -> None:
        """One optimiser step on the accumulated gradients, then the moving average."""
        options = self.options
        warmup = min(1.0, (self.step + 1) / (options.warmup_steps + 1))
        decay = 1 - progress * (1 - options.final_learning_rate)
        for group in self.optimizer.param_groups:
            group["lr"] = options.learning_rate * warmup * decay
        torch.nn.utils.clip_grad_norm_(self.parameters, options.max_gradient_norm)
        self.optimizer.step()
        # The average forgets its random start quickly: decay rises from 0.1 to its final value.
        ema_decay = min(options.ema_decay, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(self.average, [p.detach() for p in self.parameters], 1 - ema_decay)  # pyright: ignore[reportPrivateImportUsage]

    @contextmanager
    def using_average(self) -> Iterator[None]:
        """Within the context the parameters hold their moving average."""
        trained = [parameter.detach().clone() for parameter in self.parameters]
        self.apply_average()
        try:
            yield
        finally:
            _copy_into(self.parameters, trained)

    def apply_average(self) -> None:
        """Put the moving average into the parameters for good: the end of training."""
        _copy_into(self.parameters, self.average)

    def save(self, path: Path) -> None:
        """Write everything needed to go on, atomically."""
        path.parent.mkdir(parents=True, exist_ok=True)
        state = {
            "identity": self.identity,
            "step": self.step,
            "seconds": self.seconds,
            "skipped": self.skipped,
            "losses": self.losses,
            "history": vars(self.history),
            "parameters": [parameter.detach() for parameter in self.parameters],
            "average": self.average,
            "optimizer": self.optimizer.state_dict(),
        }
        temporary = path.with_suffix(".tmp")
        torch.save(state, temporary)
        os.replace(temporary, path)

    def restore(self, path: Path) -> None:
        """Go on from a saved state.

        Raises:
            TrainingError: the state is of another run or cannot be read.
        """
        try:
            state = torch.load(path, map_location=self.parameters[0].device, weights_only=True)
        except Exception as error:
            raise TrainingError(
                f"{path}: saved training state cannot be read, delete it to start anew: {error}"
            ) from error
        if state["identity"] != self.identity:
            raise TrainingError(
                f"{path}: saved training state is of another run, delete it to start anew; "
                f"expected {self.identity}, got {state['identity']}"
            )
        _copy_into(self.parameters, state["parameters"])
        self.average = list(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.history = History(**state["history"])
        self.step, self.seconds, self.skipped = state["step"], state["seconds"], state["skipped"]
        self.losses = state["losses"]


def _copy_into(parameters: Sequence[torch.nn.Parameter], values: Sequence[Tensor]) -> None:
    with torch.no_grad():
        for parameter, value in zip(parameters, values, strict=True):
            parameter.copy_(value)


def run_training(
    trainer: Trainer,
    denoiser: Denoiser,
    schedule: NoiseSchedule,
    fetch: Callable[[int], Batch],
    *,
    seed: int,
    work: Path,
    validate: Callable[[], tuple[float, float]] | None = None,
    max_seconds: float = math.inf,
    description: str = "training",
) -> History:
    """Train until `num_steps`, or until `max_seconds` over all attempts; the averaged weights end up in the models.

    Args:
        trainer: holds the parameters; restored from `work/state.pt` where that exists.
        denoiser: what is trained, wholly or in part.
        schedule: the noise schedule of the prior.
        fetch: micro-batch number to `Batch`; must depend on that number alone.
        seed: of noise and time steps.
        work: folder of the resumable state.
        validate: returns the loss with true and with shuffled conditions.
        max_seconds: a wall-clock budget; the learning rate decays towards whichever end comes first. Only a run without
            it is repeatable.
        description: of the progress bar.
    Returns:
        The loss curves.
    Raises:
        TrainingError: the loss was not finite ten times in a row, or the state in `work` is of another run.
    """
    options, state = trainer.options, work / "state.pt"
    if state.is_file():
        trainer.restore(state)
    saved = time.monotonic()
    non_finite = 0
    images_per_step = options.batch_size * options.gradient_accumulation
    autocast = options.precision == "bfloat16"
    device_type = trainer.parameters[0].device.type
    bar = tqdm(total=options.num_steps, initial=trainer.step, desc=description, unit="step", leave=False, disable=None)
    while trainer.step < options.num_steps and trainer.seconds < max_seconds:
        started = time.monotonic()
        trainer.optimizer.zero_grad(set_to_none=True)
        total = 0.0
        for part in range(options.gradient_accumulation):
            number = trainer.step * options.gradient_accumulation + part
            with torch.autocast(device_type, torch.bfloat16, enabled=autocast):
                loss = denoising_loss(denoiser, schedule, fetch(number), generator_for(seed, number), options.snr_gamma)
            (loss / options.gradient_accumulation).backward()
            total += loss.item() / options.gradient_accumulation
        progress = max(trainer.step / options.num_steps, trainer.seconds / max_seconds)
        if math.isfinite(total):
            non_finite = 0
            trainer.update(progress)
            trainer.losses.append(total)
        else:
            non_finite += 1
            trainer.skipped += 1
            if non_finite >= MAX_NON_FINITE:
                raise TrainingError(
                    f"the loss was not finite {non_finite} times in a row, the last at step {trainer.step}; "
                    "lower the learning rate, or check frames and prior for values that are not finite"
                )
        trainer.step += 1
        trainer.seconds += time.monotonic() - started
        bar.update()
        if trainer.step % options.log_every == 0:
            _log(trainer, bar, images_per_step)
        if validate is not None and trainer.step % options.validation_every == 0 and trainer.step < options.num_steps:
            _validate(trainer, validate)
        if time.monotonic() - saved > options.checkpoint_every_s:
            trainer.save(state)
            saved = time.monotonic()
    bar.close()
    if validate is not None and trainer.history.validation_step[-1:] != [trainer.step]:
        _validate(trainer, validate)
    trainer.save(state)
    trainer.apply_average()
    return trainer.history


def _log(trainer: Trainer, bar: tqdm, images_per_step: int) -> None:
    trainer.history.step.append(trainer.step)
    trainer.history.loss.append(float(np.mean(trainer.losses)) if trainer.losses else math.nan)
    trainer.losses = []
    speed = trainer.step * images_per_step / max(trainer.seconds, 1e-9)
    bar.set_postfix_str(f"loss {trainer.history.loss[-1]:.4f}, {speed:.1f} img/s, skipped {trainer.skipped}")


def _validate(trainer: Trainer, validate: Callable[[], tuple[float, float]]) -> None:
    with trainer.using_average():
        true_loss, shuffled_loss = validate()
    trainer.history.validation_step.append(trainer.step)
    trainer.history.validation_loss.append(true_loss)
    trainer.history.shuffled_loss.append(shuffled_loss)
