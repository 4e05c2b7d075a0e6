"""The training loop that all downstream models share: a fixed number of optimiser steps, resumable bit for bit.

Models are compared at equal numbers of steps, whatever the size of their training set, so the budget is counted in
steps and not in epochs. Everything a step does is a function of (seed, step, data) alone.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from ctlev_core.determinism import deterministic
from ctlev_core.progress import ProgressBar
from ctlev_core.supervised.batches import TrainingRows
from ctlev_core.supervised.checkpoints import read_training_state, write_training_state
from ctlev_core.supervised.models import digest
from ctlev_core.supervised.options import SupervisedOptions
from data_contracts.errors import TrainingError
from data_contracts.labels import History

CHECKPOINT_NAME = "training.pt"
MAX_NON_FINITE = 10
# Of the random streams of one seed; the others are those of `ctlev_core.supervised.batches`.
_STREAM_STEP, _STREAM_LAYERS = 1, 3

LossFunction = Callable[[np.ndarray, np.random.Generator | None], torch.Tensor]
"""Rows [B] of the training set and the random stream of this step -> scalar loss with a graph.

Without a stream the rows are taken as they are, without augmentation: that is how rows held back are looked at."""


class Training(NamedTuple):
    """What a training run did.

    Attributes:
        history: one row each `log_every` steps, and one for the last step; the losses of rows held back.
        record: for the model's `config.json`: `num_steps` taken, `skipped_steps`, `kept_step` (whose weights the model
            has) and `held_back_rows`.
    """

    history: History
    record: dict[str, int]


def learning_rate_at(step: int, options: SupervisedOptions) -> float:
    """Linear warm-up times linear decay; positive at every step."""
    warmup = min(1.0, (step + 1) / options.warmup_steps) if options.warmup_steps else 1.0
    return options.learning_rate * warmup * (1 - step / options.num_steps)


def train_model(
    model: nn.Module,
    compute_loss: LossFunction,
    rows: TrainingRows,
    options: SupervisedOptions,
    *,
    seed: int,
    work: Path,
    run_digest: str,
    description: str,
) -> Training:
    """Train `model` in place, from the checkpoint in `work` where it belongs to this run.

    Args:
        model: on its device, freshly initialised.
        compute_loss: the loss of given rows; it must draw random numbers from the generator it is given only.
        rows: what to learn from, and what to judge by which weights are best.
        options: budget and step sizes.
        seed: of the order of the rows, of the augmentation and of what layers draw, such as dropout.
        work: folder of the resumable state. A checkpoint of another run is ignored and overwritten.
        run_digest: identity of data, options and seed; the rows' own is added to it.
        description: of the progress bar.
    Raises:
        TrainingError: loss or gradient was not finite ten times in a row (the message names the step), or the state in
            `work` cannot be read.
    """
    work.mkdir(parents=True, exist_ok=True)
    if options.channels_last:
        # Weights decide: convolutions give their output the layout of their weights, or of their input.
        model.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    path = work / CHECKPOINT_NAME
    run = _Run(model, options, digest(run_digest, *rows.pools, rows.mixing, rows.held_back), description)
    run.restore(path)
    model.train()
    saved = time.monotonic()
    bar = ProgressBar(total=options.num_steps, initial=run.state.step, desc=description, unit="step")
    with bar, deterministic(next(model.parameters()).device), torch.random.fork_rng(devices=[]):
        while run.state.step < options.num_steps and not run.is_over():
            step = run.state.step
            # Layers such as dropout draw from torch's own stream.
            torch.manual_seed(int(np.random.SeedSequence([seed, _STREAM_LAYERS, step]).generate_state(1)[0]))
            batch = rows.batch(options.batch_size_at(step), seed, step)
            run.update(compute_loss(batch, np.random.default_rng([seed, _STREAM_STEP, step])))
            if len(rows.held_back) and (run.is_at(options.validation_every) or run.state.step == options.num_steps):
                run.validate(compute_loss, rows.held_back)
            bar.note(run.progress())
            bar.update()
            if time.monotonic() - saved >= options.checkpoint_every_s and run.state.step < options.num_steps:
                run.save(path)
                saved = time.monotonic()
    return run.finish(len(rows.held_back))


@dataclass
class _State:
    """What a run that goes on must know beside the weights and the optimiser's state."""

    step: int = 0
    pending: list[float] = field(default_factory=list)
    skipped: int = 0
    skipped_in_a_row: int = 0
    best_loss: float = math.inf
    best_step: int = 0
    looks_since_best: int = 0
    history: History = field(default_factory=History)


class _Run:
    """Model, optimiser and state of one run, saved and restored as one."""

    def __init__(self, model: nn.Module, options: SupervisedOptions, identity: str, description: str) -> None:
        self.model, self.options, self.identity, self.description = model, options, identity, description
        self.optimizer = torch.optim.AdamW(
            model.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay
        )
        self.state = _State()
        self.best: dict[str, torch.Tensor] = {}
        # A forward pass over numbers that are not finite spoils the running means of batch normalisation for good.
        self.buffers = list(model.buffers())
        self.buffers_before = [buffer.clone() for buffer in self.buffers]

    def update(self, loss: torch.Tensor) -> None:
        """One optimiser step; one whose loss or gradient is not finite is counted and leaves no trace."""
        state, options = self.state, self.options
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate_at(state.step, options)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        gradients = [parameter.grad for parameter in self.model.parameters() if parameter.grad is not None]
        gradient_norm = float(torch.nn.utils.get_total_norm(gradients))
        value = loss.item()
        if math.isfinite(value) and math.isfinite(gradient_norm):
            self.optimizer.step()
            state.pending.append(value)
            state.skipped_in_a_row = 0
            _copy(self.buffers, self.buffers_before)
        else:
            self._skip(value, gradient_norm)
        state.step += 1
        if (self.is_at(options.log_every) or state.step == options.num_steps) and state.pending:
            state.history.step.append(state.step)
            state.history.loss.append(sum(state.pending) / len(state.pending))
            state.pending.clear()

    def _skip(self, loss: float, gradient_norm: float) -> None:
        state = self.state
        state.skipped += 1
        state.skipped_in_a_row += 1
        _copy(self.buffers_before, self.buffers)
        if state.skipped_in_a_row >= MAX_NON_FINITE:
            raise TrainingError(
                f"{self.description}: the loss is {loss:g} and the length of its gradient {gradient_norm:g} at step "
                f"{state.step} of {self.options.num_steps}, not finite for {state.skipped_in_a_row} steps in a row; "
                f"lower learning_rate (now {self.options.learning_rate:g}), or look for labels far outside the image"
            )

    def is_at(self, every: int) -> bool:
        """Is the number of steps taken a multiple of `every`?"""
        return self.state.step % every == 0

    def is_over(self) -> bool:
        """Has nothing got better for as long as `patience` allows?"""
        return 0 < self.options.patience <= self.state.looks_since_best

    @torch.no_grad()
    def validate(self, compute_loss: LossFunction, rows: np.ndarray) -> None:
        """The mean loss of rows held back, and the weights if they are the best so far."""
        state, size = self.state, self.options.batch_size
        self.model.eval()
        batches = [rows[start : start + size] for start in range(0, len(rows), size)]
        loss = sum(float(compute_loss(batch, None)) * len(batch) for batch in batches) / len(rows)
        self.model.train()
        if math.isfinite(loss):
            state.history.validation_step.append(state.step)
            state.history.validation_loss.append(loss)
        state.looks_since_best += 1
        if loss < state.best_loss:
            state.best_loss, state.best_step, state.looks_since_best = loss, state.step, 0
            self.best = {name: value.detach().clone() for name, value in self.model.state_dict().items()}

    def progress(self) -> str:
        """What the progress bar says."""
        history, said = self.state.history, {}
        if history.loss:
            said["loss"] = f"{history.loss[-1]:.4g}"
        if history.validation_loss:
            said["held back"] = f"{history.validation_loss[-1]:.4g}"
        if self.state.skipped:
            said["skipped"] = str(self.state.skipped)
        return ", ".join(f"{name} {value}" for name, value in said.items())

    def finish(self, num_held_back: int) -> Training:
        """Put the best weights into the model, where rows were held back to judge them."""
        state = self.state
        if self.best:
            self.model.load_state_dict(self.best)
        record = {
            "num_steps": state.step,
            "skipped_steps": state.skipped,
            "kept_step": state.best_step if self.best else state.step,
            "held_back_rows": num_held_back,
        }
        return Training(state.history, record)

    def save(self, path: Path) -> None:
        """Write everything needed to go on, atomically."""
        content = {
            "identity": self.identity,
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "best": self.best,
            "state": asdict(self.state),
        }
        write_training_state(path, content)

    def restore(self, path: Path) -> None:
        """Go on from a saved state, if there is one of this run."""
        if not path.exists():
            return
        content = read_training_state(path, "cpu")
        if content.get("identity") != self.identity:
            return
        self.model.load_state_dict(content["model"])
        self.optimizer.load_state_dict(content["optimizer"])
        self.best = content["best"]
        self.state = _State(**{**content["state"], "history": History(**content["state"]["history"])})
        _copy(self.buffers, self.buffers_before)


def _copy(source: list[torch.Tensor], target: list[torch.Tensor]) -> None:
    with torch.no_grad():
        for value, place in zip(source, target, strict=True):
            place.copy_(value)
