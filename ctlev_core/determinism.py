"""Trainings on a GPU that end in the same bits each time."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

import torch

CUBLAS = "CUBLAS_WORKSPACE_CONFIG"


@contextlib.contextmanager
def deterministic(device: torch.device, *, strict: bool = False) -> Iterator[None]:
    """Within the context a GPU adds up gradients in a fixed order; on a CPU, which does so anyway, nothing changes.

    Without it, attention and some convolutions add them up in the order in which they are ready, cuDNN and Triton take
    the algorithm that a stop-watch prefers, and equal seeds end in other weights.

    Args:
        device: of the training.
        strict: attention, too; torch then raises where an operation has no deterministic algorithm, by its name.
            Without, such an operation runs as it is and torch warns of it; attention may be one.
    """
    if device.type != "cuda":
        yield
        return
    cudnn = torch.backends.cudnn
    before = cudnn.benchmark, cudnn.deterministic
    algorithms = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    memory: Any = torch.utils.deterministic
    filled = memory.fill_uninitialized_memory
    os.environ.setdefault(CUBLAS, ":4096:8")  # cuBLAS asks for it, several streams or not
    cudnn.benchmark, cudnn.deterministic = False, True
    torch.use_deterministic_algorithms(True, warn_only=not strict)
    memory.fill_uninitialized_memory = False  # it finds bugs, and takes time
    try:
        with _compiler_without_stop_watch():
            yield
    finally:
        cudnn.benchmark, cudnn.deterministic = before
        torch.use_deterministic_algorithms(algorithms[0], warn_only=algorithms[1])
        memory.fill_uninitialized_memory = filled


def _compiler_without_stop_watch() -> contextlib.AbstractContextManager[None]:
    import torch._inductor.config as inductor

    if hasattr(inductor, "deterministic"):
        return inductor.patch(deterministic=True)
    return contextlib.nullcontext()
