"""What downstream models share beside their training loop: devices, checks, seeded weights and model folders."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from ctlev_core.cpu_precision import computed_in
from ctlev_core.supervised.options import SupervisedOptions
from data_contracts.array_rows import ArrayRows, Images
from data_contracts.errors import DataError
from data_contracts.file_lists import file_digest
from data_contracts.image_rows import as_image_rows

MODEL_NAME = "model.safetensors"
CONFIG_NAME = "config.json"


def resolve_device(name: str) -> torch.device:
    """The named device; "auto" is CUDA where there is one and otherwise the CPU."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


def check_frames(frames: Images, where: str) -> None:
    """Raise `DataError` unless frames are [N, H, W, 3] uint8 with at least one row and one pixel."""
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or 0 in frames.shape[1:3]:
        raise DataError(f"{where}: frames must be [N, H, W, 3] uint8, got {frames.shape} {frames.dtype}")


def digest(*parts: Any) -> str:
    """SHA-256 of arrays and JSON-ready values: two training runs with the same digest are the same run."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, ArrayRows):
            total.update(as_image_rows(part).digest().encode())
        elif isinstance(part, np.ndarray):
            total.update(f"{part.dtype}{part.shape}".encode())
            total.update(np.ascontiguousarray(part).data)
        else:
            total.update(json.dumps(part, sort_keys=True).encode())
    return total.hexdigest()


def file_digests(files: Sequence[Path]) -> dict[str, str]:
    """SHA-256 of files, by their names."""
    return {path.name: file_digest(path) for path in files}


def mixed_precision(options: SupervisedOptions, device: torch.device) -> torch.autocast:
    """The context of a network's forward pass in training; losses belong outside it, in float32."""
    enabled = computed_in(options.precision, device.type) == "bfloat16"
    return torch.autocast(device.type, torch.bfloat16, enabled=enabled)


def build_seeded(build: Callable[[], nn.Module], seed: int) -> nn.Module:
    """`build()` with its weights drawn from `seed`; the caller's random state is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return build()


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
    model: nn.Module, function: Callable[[torch.Tensor], Any], inputs: Images, batch_size: int = 64
) -> list[Any]:
    """`function(batch)` over all rows of `inputs` without gradients, `model` in evaluation mode."""
    device = next(model.parameters()).device
    model.eval()
    with torch.inference_mode():
        return [
            function(torch.from_numpy(inputs[start : start + batch_size]).to(device))
            for start in range(0, len(inputs), batch_size)
        ]
