"""The file that a killed training goes on from."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch

from data_contracts.errors import TrainingError


def write_training_state(path: Path, state: dict[str, Any]) -> None:
    """Write tensors and plain data; a kill at any moment leaves the old file or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def read_training_state(path: Path, device: torch.device | str) -> dict[str, Any]:
    """What was written, its tensors on `device`; no pickle is run.

    Raises:
        TrainingError: the file cannot be read.
    """
    try:
        return torch.load(path, map_location=device, weights_only=True)
    except Exception as error:
        raise TrainingError(f"{path}: saved state cannot be read, delete it to start anew: {error}") from error
