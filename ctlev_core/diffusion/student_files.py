"""What says that a checkpoint was distilled: its scheduler is diffusers' `TCDScheduler`. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

STUDENT_SCHEDULER = "TCDScheduler"
_EVALUATIONS = "original_inference_steps"


def evaluations_of(config: Mapping[str, Any]) -> int | None:
    """The number of evaluations that a checkpoint with this scheduler config was distilled for; None = it was not."""
    number = config.get(_EVALUATIONS) if config.get("_class_name") == STUDENT_SCHEDULER else None
    return number if isinstance(number, int) else None


def distilled_evaluations(checkpoint: Path) -> int | None:
    """The same of a checkpoint folder.

    Raises:
        DataError: its scheduler config is damaged.
    """
    from ctlev_core.diffusion.pretrained.components import read_json

    path = checkpoint / "scheduler" / "scheduler_config.json"
    return evaluations_of(read_json(path)) if path.is_file() else None
