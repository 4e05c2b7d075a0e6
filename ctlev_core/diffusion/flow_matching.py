"""The noise of transformers with flow matching, in the place of `denoising.NoiseSchedule`.

Noisy latents are (1 - sigma) latents + sigma noise, and the network predicts noise - latents, the velocity from one to
the other. Of T time steps, t = 0 .. T - 1, sigma is (t + 1) / T moved towards more noise by `shift`, and the network
gets T sigma as its time.

Source: Esser et al., Scaling Rectified Flow Transformers, ICML 2024 (Stable Diffusion 3), sections 2, 3.1 and 5.3.2;
diffusers' `FlowMatchEulerDiscreteScheduler`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ctlev_core.diffusion.pretrained.model_kinds import is_flow
from data_contracts.errors import DataError

if TYPE_CHECKING:
    from ctlev_core.diffusion.denoising import Emphasis

NOISIEST, CLEANEST = 300.0, 0.03
"""Noise over signal at the first and the last evaluation of sampling."""


class FlowSchedule:
    """sigma(t) of a scheduler config; called as `NoiseSchedule`, but for alpha_bar, which there is not."""

    def __init__(self, scheduler_config: dict[str, Any]) -> None:
        self.prediction_type = "flow_prediction"
        self.num_timesteps = int(scheduler_config.get("num_train_timesteps", 1000))
        self.shift = float(scheduler_config.get("shift", 1.0))
        even = torch.arange(1, self.num_timesteps + 1, dtype=torch.float64) / self.num_timesteps
        self.sigmas = shifted(even, self.shift).float()

    def draw(self, count: int, emphasis: Emphasis, generator: torch.Generator) -> Tensor:
        """Time steps [count] int64: logit-normal, dense in the middle (Esser et al., eq. 19 with m = 0, s = 1).

        With another `timestep_power` than 1 those of `Emphasis`.
        """
        if emphasis.timestep_power != 1.0:
            return emphasis.draw(count, self.num_timesteps, generator)
        shares = torch.randn(count, generator=generator, dtype=torch.float64).sigmoid()
        return (self.num_timesteps * shares).long().clamp(max=self.num_timesteps - 1)

    def times(self, timesteps: Tensor) -> Tensor:
        """What the network gets as its time [B] at time steps [B]: T sigma, float32."""
        return self.num_timesteps * self.sigmas.to(timesteps.device)[timesteps]

    def mixture(self, timestep: int) -> tuple[float, float]:
        """Shares of latents and of noise in noisy latents: 1 - sigma and sigma."""
        sigma = float(self.sigmas[timestep])
        return 1 - sigma, sigma

    def noised(self, latents: Tensor, noise: Tensor, timesteps: Tensor) -> tuple[Tensor, Tensor]:
        """Noisy latents [B, C, h, w], and the target noise - latents."""
        sigma = self._of(timesteps)
        return (1 - sigma) * latents + sigma * noise, noise - latents

    def clean_of(self, predicted: Tensor, noisy: Tensor, timesteps: Tensor) -> Tensor:
        """The clean latents [B, C, h, w] that a prediction stands for."""
        return noisy - self._of(timesteps) * predicted

    def loss_weights(self, timesteps: Tensor, emphasis: Emphasis) -> Tensor:
        """Weights [B] of the squared errors: 1, or with `snr_gamma` min-SNR weights.

        The error in the latents is sigma times that in the velocity, so min(snr, gamma) becomes
        min((1 - sigma)^2, gamma sigma^2).
        """
        if emphasis.snr_gamma is None:
            return torch.ones(len(timesteps))
        sigma = self.sigmas[timesteps]
        return torch.minimum((1 - sigma).square(), emphasis.snr_gamma * sigma.square())

    def _of(self, timesteps: Tensor) -> Tensor:
        return self.sigmas.to(timesteps.device)[timesteps][:, None, None, None]


def shifted(sigma: Tensor, shift: float) -> Tensor:
    """Sigma in [0, 1] moved towards more noise; a shift of 1 leaves it (Esser et al., eq. 23)."""
    return shift * sigma / (1 + (shift - 1) * sigma)


def sampling_sigmas(num_inference_steps: int) -> Tensor:
    """Sigma [S + 1] float32 of S steps from noise to clean latents, even in the log of signal over noise.

    Steps of diffusers' pipeline are even in time, and multistep solvers go wrong on the long ones at the end.
    Wasserstein-1 distance of samples of UniPC from a mixture like event images' latents (0.85 of N(-0.6, 0.05) and 0.15
    of N(1.2, 0.4), denoiser in closed form, shift 3), at 6, 10, 20 and 40 steps: .31, .27, .028 and .012 with those,
    .075, .027, .008 and .007 with these; with these and Karras spacing .14, .068, .021 and .007.
    """
    noise_over_signal = torch.linspace(
        math.log(NOISIEST), math.log(CLEANEST), num_inference_steps, dtype=torch.float64
    ).exp()
    sigma = noise_over_signal / (1 + noise_over_signal)
    return torch.cat([sigma, torch.zeros(1, dtype=torch.float64)]).float()


def refuse_flow(config: dict[str, Any], what: str) -> None:
    """Raise `DataError` where something is asked of a base model with flow matching that it is not made for."""
    if is_flow(config):
        raise DataError(
            f"{what} is made for Stable Diffusion v1, 2 and XL; this base model is a transformer with flow matching "
            f"({config.get('_class_name')})"
        )
