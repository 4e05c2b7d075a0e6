"""The training loop that all downstream models share: a fixed number of optimiser steps, resumable bit for bit.

Models are compared at equal numbers of steps, whatever the size of their training set, so the budget is counted in
steps and not in epochs. Everything a step does is a function of (seed, step, data) alone.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from ctlev_core.supervised_options import SupervisedOptions
from data_contracts.errors import DataError, TrainingError
from data_contracts.labels import History

CHECKPOINT_NAME = "training.pt"
MODEL_NAME = "model.safetensors"
CONFIG_NAME = "config.json"
# Random streams of one seed; a stream never depends on how often another was used.
_STREAM_ORDER, _STREAM_STEP = 0, 1

LossFunction = Callable[[np.ndarray, np.random.Generator], torch.Tensor]
"""Rows [B] of the training set and the random stream of this step -> scalar loss with a graph."""


def resolve_device(name: str) -> torch.device:
    """The named device; "auto" is CUDA where there is one and otherwise the CPU."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


def check_frames(frames: np.ndarray, where: str) -> None:
    """Raise `DataError` unless frames are [N, H, W, 3] uint8 with at least one row and one pixel."""
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or 0 in frames.shape[1:3]:
        raise DataError(f"{where}: frames must be [N, H, W, 3] uint8, got {frames.shape} {frames.dtype}")


def digest(*parts: Any) -> str:
    """SHA-256 of arrays and JSON-ready values: two training runs with the same digest are the same run."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            total.update(f"{part.dtype}{part.shape}".encode())
            total.update(np.ascontiguousarray(part).data)
        else:
            total.update(json.dumps(part, sort_keys=True).encode())
    return total.hexdigest()


def batch_rows(count: int, batch_size: int, seed: int, step: int) -> np.ndarray:
    """Rows [batch_size] of step `step`: consecutive pieces of an endless row of permutations of the training set."""
    first = step * batch_size
    rows = np.empty(batch_size, dtype=np.int64)
    filled = 0
    while filled < batch_size:
        epoch, offset = divmod(first + filled, count)
        order = np.random.default_rng([seed, _STREAM_ORDER, epoch]).permutation(count)
        piece = order[offset : offset + batch_size - filled]
        rows[filled : filled + len(piece)] = piece
        filled += len(piece)
    return rows


def learning_rate_at(step: int, options: SupervisedOptions) -> float:
    """Linear warm-up times linear decay; positive at every step."""
    warmup = min(1.0, (step + 1) / options.warmup_steps) if options.warmup_steps else 1.0
    return options.learning_rate * warmup * (1 - step / options.num_steps)


def build_seeded(build: Callable[[], nn.Module], seed: int) -> nn.Module:
    """`build()` with its weights drawn from `seed`; the caller's random state is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return build()


def train_model(
    model: nn.Module,
    compute_loss: LossFunction,
    count: int,
    options: SupervisedOptions,
    *,
    seed: int,
    work: Path,
    run_digest: str,
    description: str,
) -> History:
    """Train `model` in place, from the checkpoint in `work` where it belongs to this run.

    Args:
        model: on its device, freshly initialised.
        compute_loss: the loss of given rows; it must draw random numbers from the generator it is given only.
        count: rows of the training set, at least 1.
        options: budget and step sizes.
        seed: of the order of the rows and of the augmentation.
        work: folder of the resumable state. A checkpoint with another `run_digest` is ignored and overwritten.
        run_digest: identity of data, options and seed.
        description: of the progress bar.
    Returns:
        One row each `log_every` steps, and one for the last step.
    Raises:
        TrainingError: the loss is not finite; the message names the step.
    """
    work.mkdir(parents=True, exist_ok=True)
    optimizer = torch.optim.AdamW(model.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay)
    history, pending, first_step = _resume(work / CHECKPOINT_NAME, model, optimizer, run_digest)
    model.train()
    progress = tqdm(
        total=options.num_steps, initial=first_step, desc=description, unit="step", leave=False, disable=None
    )
    with progress:
        for step in range(first_step, options.num_steps):
            for group in optimizer.param_groups:
                group["lr"] = learning_rate_at(step, options)
            rows = batch_rows(count, options.batch_size, seed, step)
            loss = compute_loss(rows, np.random.default_rng([seed, _STREAM_STEP, step]))
            value = loss.item()
            if not math.isfinite(value):
                raise TrainingError(
                    f"{description}: the loss is {value} at step {step} of {options.num_steps}; "
                    f"lower learning_rate (now {options.learning_rate:g})"
                )
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            pending.append(value)
            done = step + 1
            if done % options.log_every == 0 or done == options.num_steps:
                history.step.append(done)
                history.loss.append(sum(pending) / len(pending))
                pending.clear()
                progress.set_postfix(loss=f"{history.loss[-1]:.4g}", refresh=False)
            if done % options.checkpoint_every == 0 and done < options.num_steps:
                _write_checkpoint(work / CHECKPOINT_NAME, model, optimizer, history, pending, done, run_digest)
            progress.update()
    return history


def _write_checkpoint(
    path: Path,
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    history: History,
    pending: list[float],
    step: int,
    run_digest: str,
) -> None:
    state = {
        "run_digest": run_digest,
        "step": step,
        "model": model.state_dict(),
        "optimizer": optimizer.state_dict(),
        "history": asdict(history),
        "pending": list(pending),
    }
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def _resume(
    path: Path, model: nn.Module, optimizer: torch.optim.Optimizer, run_digest: str
) -> tuple[History, list[float], int]:
    if not path.exists():
        return History(), [], 0
    state = torch.load(path, map_location="cpu", weights_only=True)
    if state["run_digest"] != run_digest:
        return History(), [], 0
    model.load_state_dict(state["model"])
    optimizer.load_state_dict(state["optimizer"])
    return History(**state["history"]), state["pending"], state["step"]


def write_model(folder: Path, model: nn.Module, config: dict[str, Any]) -> None:
    """Write `model.safetensors` and `config.json` to `folder`, which is made where missing."""
    from safetensors.torch import save_file

    folder.mkdir(parents=True, exist_ok=True)
    weights = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()}
    save_file(weights, folder / MODEL_NAME)
    (folder / CONFIG_NAME).write_text(json.dumps(config, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def read_config(folder: Path, kind: str) -> dict[str, Any]:
    """The `config.json` of a model folder.

    Raises:
        DataError: there is no model in the folder, or it is one of another kind.
    """
    path = folder / CONFIG_NAME
    if not path.is_file() or not (folder / MODEL_NAME).is_file():
        raise DataError(f"{folder}: expected {CONFIG_NAME} and {MODEL_NAME} of a trained {kind} model, found none")
    config = json.loads(path.read_text(encoding="utf-8"))
    if config.get("model") != kind:
        raise DataError(f"{folder}: expected a {kind} model, got {config.get('model')!r}")
    return config


def read_weights(folder: Path, model: nn.Module) -> None:
    """Load `model.safetensors` of a model folder into `model`; every tensor must be there with its shape."""
    from safetensors.torch import load_file

    model.load_state_dict(load_file(folder / MODEL_NAME))


def predict_in_batches(
    model: nn.Module, function: Callable[[torch.Tensor], Any], inputs: np.ndarray, batch_size: int = 64
) -> list[Any]:
    """`function(batch)` over all rows of `inputs` without gradients, `model` in evaluation mode."""
    device = next(model.parameters()).device
    model.eval()
    with torch.inference_mode():
        return [
            function(torch.from_numpy(inputs[start : start + batch_size]).to(device))
            for start in range(0, len(inputs), batch_size)
        ]
