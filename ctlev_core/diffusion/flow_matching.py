"""The noise of transformers with flow matching, in the place of `denoising.NoiseSchedule`.

Noisy latents are (1 - sigma) latents + sigma noise, and the network predicts noise - latents, the speed from one to the
other. Of T time steps, t = 0 .. T - 1, sigma is (t + 1) / T moved towards more noise by `shift`, and the network is told
T sigma.

Source: Esser et al., Scaling Rectified Flow Transformers, ICML 2024 (Stable Diffusion 3), sections 2, 3.1 and 5.3.2;
diffusers' `FlowMatchEulerDiscreteScheduler`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ctlev_core.diffusion.pretrained.model_kinds import is_flow
from data_contracts.errors import DataError

if TYPE_CHECKING:
    from ctlev_core.diffusion.denoising import Emphasis


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

    def told(self, timesteps: Tensor) -> Tensor:
        """What the network is told of time steps [B]: T sigma, float32."""
        return self.num_timesteps * self.sigmas.to(timesteps.device)[timesteps]

    def noised(self, latents: Tensor, noise: Tensor, timesteps: Tensor) -> tuple[Tensor, Tensor]:
        """Noisy latents [B, C, h, w], and the target noise - latents."""
        sigma = self._of(timesteps)
        return (1 - sigma) * latents + sigma * noise, noise - latents

    def clean_of(self, predicted: Tensor, noisy: Tensor, timesteps: Tensor) -> Tensor:
        """The clean latents [B, C, h, w] that a prediction stands for."""
        return noisy - self._of(timesteps) * predicted

    def loss_weights(self, timesteps: Tensor, emphasis: Emphasis) -> Tensor:
        """Weights [B] of the squared errors: 1, or with `snr_gamma` min-SNR weights.

        The error in the latents is sigma times that in the speed, so min(snr, gamma) becomes
        min((1 - sigma)^2, gamma sigma^2).
        """
        if emphasis.snr_gamma is None:
            return torch.ones(len(timesteps))
        sigma = self.sigmas[timesteps]
        return torch.minimum((1 - sigma).square(), emphasis.snr_gamma * sigma.square())

    def _of(self, timesteps: Tensor) -> Tensor:
        return self.sigmas.to(timesteps.device)[timesteps][:, None, None, None]


def shifted(sigma: Tensor, shift: float) -> Tensor:
    """sigma in [0, 1] moved towards more noise; a shift of 1 leaves it (Esser et al., eq. 23)."""
    return shift * sigma / (1 + (shift - 1) * sigma)


def sampling_sigmas(config: dict[str, Any], num_inference_steps: int) -> Tensor:
    """sigma [S + 1] float32 of S steps from noise to clean latents, those that diffusers' pipeline takes.

    The first is a little less than 1: solvers divide by the signal, and there is none at 1.
    """
    from diffusers.schedulers.scheduling_flow_match_euler_discrete import FlowMatchEulerDiscreteScheduler

    reference: Any = FlowMatchEulerDiscreteScheduler.from_config(config)
    reference.set_timesteps(num_inference_steps)
    return reference.sigmas.float().clamp(max=1 - 1e-6)


def refuse_flow(config: dict[str, Any], what: str) -> None:
    """Raise `DataError` where something is asked of a base model with flow matching that it is not made for."""
    if is_flow(config):
        raise DataError(
            f"{what} is made for Stable Diffusion v1, 2 and XL; this base model is a transformer with flow matching "
            f"({config.get('_class_name')})"
        )
