"""What rounding costs: one trajectory in several precisions, from the same noise, against float64.

The networks and the state of the solver are rounded apart, for they need not share a precision: the solver adds many
small steps, and a state of few digits loses them. Coefficients of the solvers and embeddings of the time step are
float32 throughout, as diffusers makes them.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ctlev_core.diffusion.denoising import Denoiser
from ctlev_core.diffusion.pretrained.loading import (
    PretrainedModel,
    choose_device,
    conditions_to_tensor,
    load_base_model,
)
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.sampling import cached_condition_embedding
from ctlev_core.diffusion.sampling.schedulers import make_scheduler
from data_contracts.labels import Conditions
from data_contracts.speed_vs_error import KEEP_PRECISION

REFERENCE = torch.float64
PRECISIONS = (
    (torch.float32, torch.float32),
    (torch.bfloat16, torch.float32),
    (torch.bfloat16, torch.bfloat16),
    (torch.float16, torch.float32),
    (torch.float16, torch.float16),
)
"""Of the networks, and of the state of the solver."""
GREY_LEVELS = 127.5
"""Grey levels per unit of a decoded image, which lies in [-1, 1]."""


@dataclass(frozen=True)
class PrecisionError:
    """How far one trajectory ends from that of float64.

    Attributes:
        name: precision of the networks and of the state.
        latent_error: root mean square difference of the latents, over the root mean square of the latents.
        pixel_rms_levels: of the decoded images, in grey levels of 255.
        pixel_max_levels: the largest difference of a pixel.
        wall_seconds: of the trajectories, networks loaded but not warm.
    """

    name: str
    latent_error: float
    pixel_rms_levels: float
    pixel_max_levels: float
    wall_seconds: float


def precision_errors(
    checkpoint: Path, conditions: Conditions, options: Sequence[SamplingOptions], *, seeds: Sequence[int]
) -> list[list[PrecisionError]]:
    """Errors of each of `PRECISIONS` for each of `options`, without guidance.

    Args:
        checkpoint: a diffusers folder with what the conditions need.
        conditions: N prompts, with N condition images where the checkpoint has a ControlNet.
        options: solver, steps and device.
        seeds: of the noise, one a condition.
    Raises:
        ValueError: a solver is none of `KEEP_PRECISION`.
    """
    for chosen in options:
        if chosen.scheduler not in KEEP_PRECISION:
            raise ValueError(
                f"scheduler must be one that keeps the precision of its state, {' or '.join(KEEP_PRECISION)}, "
                f"got {chosen.scheduler!r}"
            )
    device, with_controlnet = choose_device(options[0].device), conditions.images is not None
    exact = load_base_model(checkpoint, with_controlnet=with_controlnet, dtype=REFERENCE, device=device)
    references = [_trajectory(exact, conditions, chosen, seeds, REFERENCE) for chosen in options]
    pictures = [_decode(exact, latents) for latents in references]
    found: list[list[PrecisionError]] = [[] for _ in options]
    for network, of_state in PRECISIONS:
        base_model = load_base_model(checkpoint, with_controlnet=with_controlnet, dtype=network, device=device)
        for number, chosen in enumerate(options):
            started = time.perf_counter()
            latents = _trajectory(base_model, conditions, chosen, seeds, of_state).double()
            seconds = time.perf_counter() - started
            difference = (_decode(exact, latents) - pictures[number]) * GREY_LEVELS
            found[number].append(
                PrecisionError(
                    name=f"networks {_name(network)}, state {_name(of_state)}",
                    latent_error=_rms(latents - references[number]) / _rms(references[number]),
                    pixel_rms_levels=_rms(difference),
                    pixel_max_levels=float(difference.abs().max()),
                    wall_seconds=seconds,
                )
            )
    return found


@torch.no_grad()
def _trajectory(
    base_model: PretrainedModel,
    conditions: Conditions,
    options: SamplingOptions,
    seeds: Sequence[int],
    of_state: torch.dtype,
) -> Tensor:
    """Latents [N, C, h, w] at the end, in the precision of the state."""
    device, network = base_model.unet.device, base_model.unet.dtype
    scheduler = make_scheduler(
        options.scheduler, base_model.scheduler_config, options.num_inference_steps, options.timestep_spacing
    )
    side = base_model.unet.config.sample_size
    shape = (base_model.unet.config.in_channels, side, side)
    noise = torch.stack([torch.randn(shape, generator=torch.Generator().manual_seed(int(seed))) for seed in seeds])
    state = (noise.double() * float(scheduler.init_noise_sigma)).to(device, of_state)
    embeddings = encode_prompts(base_model, list(conditions.prompts)).to(device, network)
    images = None
    if conditions.images is not None:
        images = conditions_to_tensor(conditions.images).to(device, network)
    denoiser = Denoiser(base_model.unet, base_model.controlnet)
    with cached_condition_embedding(base_model.controlnet, images):
        for timestep in scheduler.timesteps:
            noisy = scheduler.scale_model_input(state, timestep).to(network)
            predicted = denoiser.predict(noisy, timestep.expand(len(noisy)).to(device), embeddings, images)
            state = scheduler.step(predicted.to(of_state), timestep, state).prev_sample
    return state


@torch.no_grad()
def _decode(base_model: PretrainedModel, latents: Tensor) -> Tensor:
    """Images [N, 3, H, W] in [-1, 1], not clipped."""
    return base_model.vae.decode((latents / base_model.scaling_factor).to(base_model.vae.dtype)).sample.double()


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
