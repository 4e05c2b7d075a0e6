"""What a training run carries from step to step: optimiser, averaged and best weights, loss scale and curves."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.distributed.tensor import DTensor

from ctlev_core.diffusion.training.fsdp import part_of, part_of_optimizer, whole
from ctlev_core.diffusion.training.muon import Muon
from ctlev_core.diffusion.training.options import TrainingOptions
from ctlev_core.supervised.checkpoints import read_training_state, write_training_state
from data_contracts.errors import TrainingError
from data_contracts.labels import History

MAX_NON_FINITE = 10
BETAS = (0.9, 0.999)


@dataclass
class TrainingHistory(History):
    """Curves of a diffusion training, and the step whose averaged weights were kept; None until it has ended."""

    kept_step: int | None = None
    value_table: np.ndarray | None = None
    """[256, 256], see `ctlev_core.diffusion.sampling.value_table`; None where it was not asked for."""


class Trainer:
    """Optimiser, averaged weights and history of the trainable parameters, saved and restored as one."""

    def __init__(
        self,
        parameters: Sequence[torch.nn.Parameter],
        options: TrainingOptions,
        identity: str,
        optimizer: Literal["adamw", "muon"] = "adamw",
        *,
        keep: Literal["last", "best"] = "last",
        patience: int | None = None,
    ) -> None:
        """Prepare to train `parameters`.

        Args:
            parameters: what learns.
            options: rates and averaging.
            identity: names the run, so that foreign state is refused.
            optimizer: with `muon` the learning rate is that of Adam, and matrices take `muon.MATRIX_RATE` times it.
            keep: the weights to end with, by time or by validation loss.
            patience: validations without a lower loss after which training is over; None = it never is.
        """
        self.parameters = list(parameters)
        self.options = options
        self.identity = identity
        self.keep = keep
        self.patience = patience
        settings: dict[str, Any] = {
            "lr": options.learning_rate,
            "betas": BETAS,
            "weight_decay": options.weight_decay,
        }
        device_type = self.parameters[0].device.type
        if optimizer == "muon":
            self.optimizer: torch.optim.Optimizer = Muon(self.parameters, **settings)
        else:
            self.optimizer = torch.optim.AdamW(self.parameters, fused=device_type in ("cpu", "cuda"), **settings)
        self.scaler = torch.amp.GradScaler(device_type, enabled=options.precision == "float16")  # pyright: ignore[reportPrivateImportUsage]
        self.average = self._new_average()
        self.best: list[Tensor] | None = None
        self.history = TrainingHistory()
        self.step = 0
        self.seconds = 0.0
        self.skipped = 0
        self.non_finite = 0
        self.losses: list[float] = []
        self.gradient_norm = math.nan

    @property
    def learning_rate(self) -> float:
        """Of the latest step."""
        return self.optimizer.param_groups[0]["lr"]

    @property
    def out_of_patience(self) -> bool:
        """Did the latest `patience` validations all fail to lower the loss?"""
        losses = self.history.validation_loss
        return self.patience is not None and len(losses) - 1 - _lowest(losses) >= self.patience

    def update(self, progress: float) -> bool:
        """One optimiser step on the accumulated gradients, then the moving average.

        Args:
            progress: share of the training that is over, for the decay of the learning rate.
        Returns:
            False where a gradient was not finite: nothing but the loss scale changed.
        """
        options = self.options
        warmup = min(1.0, (self.step + 1) / (options.warmup_steps + 1))
        decay = 1 - progress * (1 - options.final_learning_rate)
        for group in self.optimizer.param_groups:
            group["lr"] = options.learning_rate * warmup * decay
        self.scaler.unscale_(self.optimizer)
        self.gradient_norm = whole(torch.nn.utils.clip_grad_norm_(self.parameters, options.max_gradient_norm)).item()
        finite = math.isfinite(self.gradient_norm)
        if finite:
            self.scaler.step(self.optimizer)
        self.scaler.update()
        if not finite:
            return False
        # The average forgets its random start quickly: decay rises from 0.1 to its final value.
        ema_decay = min(options.ema_decay, (1 + self.step) / (10 + self.step))
        if options.ema_decay:
            with torch.no_grad():
                torch._foreach_lerp_(self.average, [p.detach() for p in self.parameters], 1 - ema_decay)  # pyright: ignore[reportPrivateImportUsage]
        return True

    def count_skipped(self) -> None:
        """Note a step that changed nothing.

        Raises:
            TrainingError: it is the tenth in a row.
        """
        self.non_finite += 1
        self.skipped += 1
        if self.non_finite >= MAX_NON_FINITE:
            raise TrainingError(
                f"loss or gradient was not finite {self.non_finite} times in a row, the last at step {self.step}; "
                "lower the learning rate, or check frames and base model for values that are not finite"
            )

    def note_validation(self, true_loss: float, shuffled_loss: float) -> None:
        """Add a point to the validation curves; the weights of the lowest loss are set aside where they are kept."""
        history = self.history
        history.validation_step.append(self.step)
        history.validation_loss.append(true_loss)
        history.shuffled_loss.append(shuffled_loss)
        latest = len(history.validation_loss) - 1
        if self.keep == "best" and _lowest(history.validation_loss) == latest:
            self.best = [value.clone() for value in self.average]

    @contextmanager
    def using_average(self) -> Iterator[None]:
        """Within the context the parameters hold their moving average."""
        if not self.options.ema_decay:
            yield
            return
        trained = [parameter.detach().clone() for parameter in self.parameters]
        _copy_into(self.parameters, self.average)
        try:
            yield
        finally:
            _copy_into(self.parameters, trained)

    def finish(self) -> TrainingHistory:
        """Put the averaged weights that are kept into the parameters for good.

        Raises:
            TrainingError: the best are to be kept, and no validation loss was finite.
        """
        if self.keep == "best" and self.best is None:
            raise TrainingError(
                f"no validation loss was finite, so that there are no best weights: {self.history.validation_loss}"
            )
        self.history.kept_step = self.step
        if self.best is not None:
            self.history.kept_step = self.history.validation_step[_lowest(self.history.validation_loss)]
        if self.best is not None or self.options.ema_decay:
            _copy_into(self.parameters, self.average if self.best is None else self.best)
        self.optimizer.zero_grad(set_to_none=True)
        return self.history

    def save(self, path: Path, *, write: bool = True) -> None:
        """Write everything needed to go on, atomically; the same whether weights are shared out or not.

        Where they are, all processes must call this, and one of them writes.
        """
        state = {
            "identity": self.identity,
            "step": self.step,
            "seconds": self.seconds,
            "skipped": self.skipped,
            "non_finite": self.non_finite,
            "losses": self.losses,
            "history": vars(self.history),
            "parameters": [parameter.detach() for parameter in self.parameters],
            "average": self.average,
            "best": self.best,
            "optimizer": self.optimizer.state_dict(),
            "scaler": self.scaler.state_dict(),
        }
        state = whole(state, keep=write)
        if write:
            write_training_state(path, state)

    def restore(self, path: Path) -> None:
        """Go on from a saved state.

        Raises:
            TrainingError: the state is of another run or cannot be read.
        """
        first = self.parameters[0]
        state = read_training_state(path, "cpu" if isinstance(first, DTensor) else first.device)
        if state["identity"] != self.identity:
            raise TrainingError(
                f"{path}: saved training state is of another run, delete it to start anew; "
                f"expected {self.identity}, got {state['identity']}"
            )
        _copy_into(self.parameters, self._parts_of(state["parameters"]))
        self.average = self._parts_of(state["average"]) if self.options.ema_decay else self._new_average()
        self.best = None if state.get("best") is None else self._parts_of(state["best"])
        self.optimizer.load_state_dict(part_of_optimizer(state["optimizer"], self.parameters))
        self.scaler.load_state_dict(state.get("scaler", {}))
        self.history = TrainingHistory(**state["history"])
        self.step, self.seconds, self.skipped = state["step"], state["seconds"], state["skipped"]
        self.non_finite = state.get("non_finite", 0)
        self.losses = state["losses"]

    def _new_average(self) -> list[Tensor]:
        """Copies of the weights; where nothing is averaged the weights themselves, a copy of which is gigabytes."""
        weights = [parameter.detach() for parameter in self.parameters]
        return [weight.clone() for weight in weights] if self.options.ema_decay else weights

    def _parts_of(self, values: Sequence[Tensor]) -> list[Tensor]:
        return [part_of(value, parameter) for value, parameter in zip(values, self.parameters, strict=True)]


def _lowest(losses: Sequence[float]) -> int:
    """Position of the first lowest loss, of those that are numbers; -1 where there is none."""
    finite = [(loss, position) for position, loss in enumerate(losses) if math.isfinite(loss)]
    return min(finite, default=(math.inf, -1))[1]


def _copy_into(parameters: Sequence[torch.nn.Parameter], values: Sequence[Tensor]) -> None:
    with torch.no_grad():
        for parameter, value in zip(parameters, values, strict=True):
            parameter.copy_(value)
