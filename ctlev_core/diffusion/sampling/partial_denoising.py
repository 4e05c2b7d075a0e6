"""Latents noised to a time step of the schedule, and denoised back without drawing noise again.

What a denoiser makes of an image of which it still sees something says at how much noise it goes wrong; whole sampling
only says that it does. The way back is DDIM's (Song, Meng & Ermon, Denoising Diffusion Implicit Models, ICLR 2021,
eq. 12 with sigma = 0), a first-order solver of the probability-flow equation: with the exact denoiser and enough steps,
latents of a distribution, noised and denoised, are again of that distribution.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from ctlev_core.diffusion.denoising import NoiseSchedule, generator_for
from ctlev_core.diffusion.flow_matching import FlowSchedule
from ctlev_core.diffusion.pretrained.loading import PretrainedModel, encode_posterior
from data_contracts.errors import DataError

ENCODING_STREAM, NOISE_STREAM = 2, 3
"""Entropy that keeps what is drawn here apart from what else is drawn of the same seed."""

Predict = Callable[[Tensor, Tensor], Tensor]
"""From noisy latents [B, C, h, w] and their time step to the network's prediction [B, C, h, w] float32."""


def denoising_times(time_step: int, max_evaluations: int) -> list[int]:
    """Time steps at which the network is evaluated on the way back, from the noisiest to 0.

    Dense at little noise, where single events are made or lost: the square roots of the time steps are evenly spread
    (the quadratic steps of DDIM's appendix D.3). Steps that round to the same number are taken once.

    Args:
        time_step: where latents are noised to; 0 = they are not, and nothing is evaluated.
        max_evaluations: at least 2.
    """
    if time_step == 0:
        return []
    roots = np.linspace(time_step**0.5, 0, min(max_evaluations, time_step + 1))
    return list(dict.fromkeys(np.rint(roots**2).astype(int).tolist()))


@torch.no_grad()
def encode_frames(base_model: PretrainedModel, frames: np.ndarray, seeds: Sequence[int]) -> Tensor:
    """Scaled latents [B, C, h, w] float32, as the generator learns from them; row i depends on frame and seed i alone.

    Args:
        base_model: with its autoencoder.
        frames: [B, H, W, 3] uint8.
        seeds: B non-negative integers, of what is drawn from the posteriors; a code without noise needs none.
    """
    latents, deviations = encode_posterior(base_model.vae, frames)
    if deviations is not None:
        latents = latents + deviations * _noise(latents, seeds, ENCODING_STREAM)
    return base_model.scale_latents(latents)


def noise_to(latents: Tensor, time_step: int, schedule: NoiseSchedule | FlowSchedule, seeds: Sequence[int]) -> Tensor:
    """Latents with the noise of a time step of the schedule, the same noise for every time step.

    Args:
        latents: [B, C, h, w] clean, scaled.
        time_step: 0 = returned as they are.
        schedule: of the checkpoint.
        seeds: B non-negative integers, one a row.
    Raises:
        DataError: the schedule has no such time step.
    """
    check_time_step(time_step, schedule)
    if time_step == 0:
        return latents
    timesteps = torch.full((len(latents),), time_step, device=latents.device)
    return schedule.noised(latents, _noise(latents, seeds, NOISE_STREAM), timesteps)[0]


@torch.no_grad()
def denoise(noisy: Tensor, times: Sequence[int], schedule: NoiseSchedule | FlowSchedule, predict: Predict) -> Tensor:
    """Clean latents [B, C, h, w] float32.

    Args:
        noisy: [B, C, h, w] at the first of the time steps.
        times: of evaluations, descending; after the last the clean latents are taken. None = returned as they are.
        schedule: of the checkpoint.
        predict: the network.
    Raises:
        FloatingPointError: latents are not finite, because the network's precision does not reach.
    """
    state = noisy.float()
    for number, time in enumerate(times):
        timesteps = torch.full((len(state),), time, device=state.device)
        clean = schedule.clean_of(predict(state, schedule.times(torch.tensor(time))), state, timesteps)
        if number + 1 == len(times):
            state = clean
            break
        (signal, spread), (less, more) = (schedule.mixture(step) for step in (times[number + 1], time))
        noise = (state - less * clean) / more
        state = signal * clean + spread * noise
    if not bool(torch.isfinite(state).all()):
        raise FloatingPointError(f"latents denoised from time step {times[0]} are not finite; try float32")
    return state


def check_time_step(time_step: int, schedule: NoiseSchedule | FlowSchedule) -> None:
    """Raise `DataError` unless the schedule has the time step."""
    if not 0 <= time_step < schedule.num_timesteps:
        raise DataError(f"expected a time step of 0 to {schedule.num_timesteps - 1}, got {time_step}")


def _noise(latents: Tensor, seeds: Sequence[int], stream: int) -> Tensor:
    """Noise like `latents`, each row from a CPU stream of its own, so that it is the same on every device."""
    drawn = [torch.randn(latents.shape[1:], generator=generator_for(int(seed), stream)) for seed in seeds]
    return torch.stack(drawn).to(latents.device)
