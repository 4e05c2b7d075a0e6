"""What makes a training step faster or smaller, and not what it computes: precision, checkpoints, compiled networks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

import torch

from ctlev_core.cpu_precision import computed_in
from ctlev_core.diffusion.compilation import TRAINING_PASSES, compiler_works, pays
from ctlev_core.diffusion.denoising import Denoiser
from ctlev_core.diffusion.training.options import TrainingOptions


def check_precision(options: TrainingOptions, device: torch.device) -> None:
    """Raise ValueError where a CPU is asked for float16: it has neither the speed nor all of the operations."""
    if options.precision == "float16" and device.type == "cpu":
        raise ValueError("precision float16 needs a CUDA device, got the CPU; use float32 or bfloat16 there")


def autocast(options: TrainingOptions, device: torch.device) -> AbstractContextManager:
    """The context of a forward pass: matrix products and convolutions in the precision asked for (`computed_in`)."""
    precision = computed_in(options.precision, device.type)
    dtype = torch.float16 if precision == "float16" else torch.bfloat16
    return torch.autocast(device.type, dtype, enabled=precision != "float32")


@contextmanager
def accelerated(denoiser: Denoiser, options: TrainingOptions, device: torch.device) -> Iterator[None]:
    """Within the context the networks keep fewer activations or run compiled, as the options ask.

    On a CPU attention stays in float32.

    Frozen networks too: on the way to a ControlNet the gradients pass through the frozen U-Net. Weights keep their
    names, so that saved states and checkpoints are those of plain networks.
    """
    networks = [network for network in (denoiser.unet, denoiser.controlnet) if network is not None]
    passes = options.num_steps * options.gradient_accumulation
    compiled = pays(options.compile_networks, device, passes, TRAINING_PASSES) and compiler_works(device)
    attention = [network.attn_processors for network in networks]
    if device.type == "cpu" and computed_in(options.precision, device.type) == "bfloat16":
        from ctlev_core.diffusion.training.float32_attention import use_float32_attention

        for network in networks:
            use_float32_attention(network)
    for network in networks:
        if options.gradient_checkpointing:
            network.enable_gradient_checkpointing()
        if compiled:
            network.compile()
    try:
        yield
    finally:
        for network, before in zip(networks, attention, strict=True):
            network.set_attn_processor(before)
            if options.gradient_checkpointing:
                network.disable_gradient_checkpointing()
            network._compiled_call_impl = None
