"""The files of motion layers in a checkpoint: diffusers' `motion_adapter/`, and what our own sampling must know.

Imports nothing heavy: plans look for them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

from data_contracts.errors import DataError

MOTION_FOLDER = "motion_adapter"
MAX_CONTEXT = 32
"""Positions that the layers know, as AnimateDiff's."""
_SETTINGS_FILE = "ctlev_motion.json"


class MotionSettings(NamedTuple):
    """What the layers learnt.

    Attributes:
        context: frames that attend to one another at most.
        interval_us: from one frame to the next.
        shared_noise: share of the noise's variance that the frames of a stretch have in common.
    """

    context: int
    interval_us: int
    shared_noise: float


def has_motion_layers(checkpoint: Path) -> bool:
    """Does a checkpoint folder make frames from one another?"""
    return (checkpoint / MOTION_FOLDER).is_dir()


def write_settings(checkpoint: Path, settings: MotionSettings) -> None:
    """Beside the weights."""
    (checkpoint / MOTION_FOLDER / _SETTINGS_FILE).write_text(json.dumps(settings._asdict(), indent=2) + "\n")


def read_settings(checkpoint: Path) -> MotionSettings:
    """What was written.

    Raises:
        DataError: the file is missing or holds something else.
    """
    from ctlev_core.diffusion.pretrained.components import read_json

    path = checkpoint / MOTION_FOLDER / _SETTINGS_FILE
    found = read_json(path)
    for name, most in (("context", MAX_CONTEXT), ("interval_us", None)):
        value = found.get(name)
        if type(value) is not int or value < 1 or (most is not None and value > most):
            upper = "" if most is None else f" to {most}"
            raise DataError(f"{path}: {name} must be a whole number from 1{upper}, got {value!r}")
    share = found.get("shared_noise")
    if isinstance(share, bool) or not isinstance(share, int | float) or not 0 <= share < 1:
        raise DataError(f"{path}: shared_noise must be a number from 0 to below 1, got {share!r}")
    return MotionSettings(found["context"], found["interval_us"], float(share))
