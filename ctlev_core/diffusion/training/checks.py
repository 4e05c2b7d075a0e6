"""Options of a fine-tuning that do not go together: told where a preset is read. Imports nothing heavy."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING

from data_contracts.errors import DataError

if TYPE_CHECKING:
    from ctlev_core.diffusion.training.options import FineTuningOptions


def check_together(options: FineTuningOptions) -> None:
    """Raise ValueError where options contradict one another, on whatever machine and with whatever frames."""
    if options.lora_rank is not None and options.random_init:
        raise DataError("lora_rank adapts a base model, and random_init forgets it: choose one")
    check_text_route(options, with_images=False)
    if options.num_validation < 2:
        check_validated(options.keep, options.patience)
    if options.fsdp:
        check_sharding(options)
    if options.num_processes is not None:
        check_processes(options, options.num_processes)


def check_text_route(options: FineTuningOptions, *, with_images: bool) -> None:
    """Raise `DataError` where something is asked for that holds for prompts alone."""
    asked = {"moves": options.moves.moves_anything, "rehearsal_share": options.rehearsal_share > 0}
    asked["values_at"] = options.values_at > 0
    for name, is_asked in asked.items():
        if is_asked and (with_images or options.rot90_probability):
            raise DataError(
                f"{name} is for the text route, whose prompts hold wherever a thing is, without rot90_probability"
            )


def check_validated(keep: str, patience: int | None) -> None:
    """Raise ValueError where a training that is not validated needs a validation loss."""
    if keep == "best" or patience is not None:
        raise ValueError(
            "the best weights and early stopping need a validation loss: num_validation of 2 and more, and 20 frames"
        )


def check_processes(options: FineTuningOptions, count: int) -> None:
    """Raise ValueError where `count` processes cannot train with these options."""
    check_shares(options.gradient_accumulation, count)
    if count == 1 and options.fsdp:
        raise ValueError("fsdp shares out weights over processes: set num_processes to 2 or more, got 1")
    if count > 1 and options.device not in ("auto", "cuda", "cpu"):
        raise ValueError(
            f"device must be auto, cuda or cpu with {count} processes, each takes a GPU of its own, got "
            f"{options.device!r}; choose among GPUs by CUDA_VISIBLE_DEVICES"
        )


def check_shares(gradient_accumulation: int, count: int) -> None:
    """Raise ValueError where `count` processes cannot share the batches of a step evenly."""
    if gradient_accumulation % count:
        raise ValueError(
            f"gradient_accumulation must be a multiple of the {count} processes, which share the batches of a "
            f"step, got {gradient_accumulation}; halve batch_size and double gradient_accumulation, say"
        )


def check_sharding(options: FineTuningOptions) -> None:
    """Raise ValueError where options need whole weights, or were never run with parts of them."""
    if options.optimizer != "adamw":
        raise ValueError(f"fsdp needs optimizer=adamw, got {options.optimizer}: a process holds parts of weights")
    if options.compile_networks is True:
        raise ValueError("fsdp needs compile_networks=False, got True: a process holds parts of weights")
    if options.lora_rank is not None:
        raise ValueError("fsdp shares out whole networks; what lora_rank trains is small: set fsdp to false")
    if options.precision == "float16":
        raise ValueError("fsdp needs precision float32 or bfloat16, got float16, whose scale of the loss is not shared")


def check_packages(options: FineTuningOptions) -> None:
    """Raise `DataError` where a package is not installed that options need."""
    if options.lora_rank is not None and importlib.util.find_spec("peft") is None:
        raise DataError("lora_rank needs the package peft: pip install -e '.[lora]'")
