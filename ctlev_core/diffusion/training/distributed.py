"""One training shared by several processes: who computes what, and how gradients come together.

The batches of a step are numbered, and all that is random in a batch is a function of its number. Which process
computes a batch therefore changes nothing but the order of a sum.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch

from ctlev_core.diffusion.training.checks import check_shares

T = TypeVar("T")
MESSAGE_VALUES = 8_000_000
"""Gradients sent at a time, at most: 32 MB. A message for each of hundreds of small weights cost a third of a step on
two cores; a single one would copy all gradients of a network of Stable Diffusion's size."""


@dataclass(frozen=True)
class DistributedContext:
    """One of `count` processes that train together; number 0 alone writes files and shows progress.

    Attributes:
        rank: number of the process.
        count: of the processes.
        sharded: each holds a part of the weights, see `fsdp.py`; gradients are then summed on their way.
    """

    rank: int = 0
    count: int = 1
    sharded: bool = False

    def batches(self, gradient_accumulation: int) -> range:
        """The batches of a step that are this process's.

        Raises:
            ValueError: they cannot be shared evenly.
        """
        check_shares(gradient_accumulation, self.count)
        return range(self.rank, gradient_accumulation, self.count)

    def sum_gradients(self, parameters: Sequence[torch.nn.Parameter], loss: float) -> float:
        """Add up the gradients of all processes, in place, and the losses, which are returned."""
        if self.count == 1:
            return loss
        gradients = [] if self.sharded else [each.grad for each in parameters if each.grad is not None]
        for together in _messages(gradients):
            message = torch.cat([gradient.flatten() for gradient in together])
            torch.distributed.all_reduce(message)
            sums = message.split([gradient.numel() for gradient in together])
            for gradient, total in zip(together, sums, strict=True):
                gradient.copy_(total.view_as(gradient))
        summed = torch.tensor(loss, dtype=torch.float64, device=parameters[0].device)
        torch.distributed.all_reduce(summed)
        return summed.item()

    def wait(self) -> None:
        """Until all processes are here."""
        if self.count > 1:
            torch.distributed.barrier()

    def agreed(self, value: T) -> T:
        """The value of process 0: whether to stop must not hang on clocks or on rounding that differs."""
        if self.count == 1:
            return value
        shared = [value]
        torch.distributed.broadcast_object_list(shared, src=0)
        return shared[0]


def _messages(gradients: Sequence[torch.Tensor]) -> Iterator[list[torch.Tensor]]:
    """Gradients to be sent together, in their order: few messages, none of which needs much memory."""
    together: list[torch.Tensor] = []
    size = 0
    for gradient in gradients:
        if together and size + gradient.numel() > MESSAGE_VALUES:
            yield together
            together, size = [], 0
        together.append(gradient)
        size += gradient.numel()
    if together:
        yield together


SINGLE_PROCESS = DistributedContext()


def start_distributed(device: str) -> tuple[DistributedContext, torch.device]:
    """Join the processes that a launcher started together; each with a GPU takes the one of its number.

    Args:
        device: `auto`, `cuda` or `cpu`.
    """
    from accelerate import PartialState

    state = PartialState(cpu=device == "cpu")
    return DistributedContext(state.process_index, state.num_processes), torch.device(str(state.device))


def stop_distributed() -> None:
    """Wait for one another, and leave."""
    from accelerate import PartialState

    state = PartialState()
    state.wait_for_everyone()
    state.destroy_process_group()
