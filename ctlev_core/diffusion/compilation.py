"""When `torch.compile` pays: not what networks compute, but how soon. Imports nothing heavy."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import torch

logger = logging.getLogger(__name__)

Compile = Literal["auto"] | bool
"""`auto` = as `pays` says."""

TRAINING_PASSES = 3000
"""Forward and backward passes from which compiling takes less time than it saves, on a GPU."""
SAMPLING_PASSES = 5000
"""Evaluations of the networks, likewise."""


def pays(asked: Compile, device: torch.device, num_passes: int, break_even: int) -> bool:
    """Whether networks are to be compiled: as asked, or for `auto` on a GPU and from so many passes.

    It depends on what a whole run does, not on what is left of it: a run that goes on must compute as one that was not
    interrupted. On a CPU two minutes of compiling save a sixth of a training step, which `auto` leaves alone.
    """
    if asked == "auto":
        return device.type == "cuda" and num_passes >= break_even
    return asked


def compiler_works(device: torch.device) -> bool:
    """Compile one addition: cheaper than to find out in the middle of a run that there is no compiler."""
    import torch

    try:
        torch.compile(lambda x: x + 1)(torch.zeros(4, device=device))
    except Exception as error:  # whatever a missing or broken compiler raises, networks run without
        logger.warning("torch.compile does not work here, networks run uncompiled: %s", error)
        return False
    return True
