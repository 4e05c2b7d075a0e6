"""Denoising as a regression: the noise schedule, the networks as one function, the loss and its validation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ctlev_core.diffusion.flow_matching import FlowSchedule, refuse_flow
from ctlev_core.diffusion.pretrained.model_kinds import is_flow, is_transformer
from ctlev_core.diffusion.pretrained.prompts import prompt_arguments


@dataclass(frozen=True)
class Emphasis:
    """Which time steps a training dwells on; the options of `TrainingOptions` of the same names."""

    snr_gamma: float | None = None
    max_loss_weight: float = 5.0
    timestep_power: float = 1.0

    def draw(self, count: int, num_timesteps: int, generator: torch.Generator) -> Tensor:
        """Time steps [count] int64 in 0 .. num_timesteps - 1, of density proportional to t ** (timestep_power - 1)."""
        if self.timestep_power == 1.0:
            return torch.randint(0, num_timesteps, (count,), generator=generator)
        shares = torch.rand(count, generator=generator, dtype=torch.float64) ** (1 / self.timestep_power)
        return (num_timesteps * shares).long().clamp(max=num_timesteps - 1)


PLAIN = Emphasis()


@dataclass(frozen=True, eq=False)
class Batch:
    """What one denoising step sees.

    Attributes:
        latents: [B, C, h, w] clean latents, already multiplied by the scaling factor.
        embeddings: [B, L, D] prompt embeddings, as `encode_prompts` gives them.
        conditions: of the first K <= B rows what `control_input` makes of condition images, or None; the other rows go
            through the U-Net alone.
        num_frames: of each stretch, whose rows lie behind one another and are equally noisy; 1 = images.
        shared_noise: share of the noise's variance that the frames of a stretch have in common.
    """

    latents: Tensor
    embeddings: Tensor
    conditions: Tensor | None = None
    num_frames: int = 1
    shared_noise: float = 0.0


@dataclass(frozen=True, eq=False)
class Denoiser:
    """U-Net or transformer, and ControlNet, as one function of (noisy latents, time step, prompt, condition)."""

    unet: Any
    controlnet: Any | None = None

    def predict(self, noisy: Tensor, timesteps: Tensor, embeddings: Tensor, conditions: Tensor | None) -> Tensor:
        """The network's output [B, C, h, w]; rows beyond those of `conditions` get no residuals."""
        if is_transformer(self.unet):
            return self._predict_by_transformer(noisy, timesteps, embeddings, conditions)
        if self.controlnet is None or conditions is None or len(conditions) == 0:
            return self.unet(noisy, timesteps, **prompt_arguments(self.unet, embeddings)).sample
        steered, total = len(conditions), len(noisy)
        down, middle = self.controlnet(
            noisy[:steered],
            timesteps[:steered],
            controlnet_cond=conditions,
            **prompt_arguments(self.unet, embeddings[:steered]),
            return_dict=False,
        )
        return self.unet(
            noisy,
            timesteps,
            **prompt_arguments(self.unet, embeddings),
            down_block_additional_residuals=[_padded(residual, total) for residual in down],
            mid_block_additional_residual=_padded(middle, total),
        ).sample

    def _predict_by_transformer(
        self, noisy: Tensor, timesteps: Tensor, embeddings: Tensor, conditions: Tensor | None
    ) -> Tensor:
        residuals = None
        if self.controlnet is not None and conditions is not None and len(conditions):
            steered, arguments = len(conditions), prompt_arguments(self.unet, embeddings[: len(conditions)])
            if self.controlnet.config.get("force_zeros_for_pooled_projection"):
                arguments["pooled_projections"] = torch.zeros_like(arguments["pooled_projections"])
            made = self.controlnet(
                noisy[:steered],
                controlnet_cond=conditions,
                timestep=timesteps[:steered],
                **arguments,
                return_dict=False,
            )[0]
            residuals = [_padded(residual, len(noisy)) for residual in made]
        return self.unet(
            noisy,
            timestep=timesteps,
            **prompt_arguments(self.unet, embeddings),
            block_controlnet_hidden_states=residuals,
            return_dict=False,
        )[0]


def _padded(residual: Tensor, total: int) -> Tensor:
    """[B, ...] with rows of zeros up to `total`."""
    return torch.nn.functional.pad(residual, (0, 0) * (residual.ndim - 1) + (0, total - len(residual)))


def generator_for(*entropy: int) -> torch.Generator:
    """A CPU random stream of its own for each tuple of non-negative integers."""
    state = int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0])
    return torch.Generator().manual_seed(state & (2**63 - 1))


class NoiseSchedule:
    """alpha_bar(t) of a scheduler config, and what the network must predict.

    Source: Ho et al., DDPM, 2020 (eq. 4); Salimans and Ho, 2022 (v-prediction); Hang et al., 2023 (min-SNR weights).
    """

    def __init__(self, scheduler_config: dict[str, Any]) -> None:
        refuse_flow(scheduler_config, "a noise schedule with alpha_bar")
        from diffusers.schedulers.scheduling_ddpm import DDPMScheduler

        self._scheduler: Any = DDPMScheduler.from_config(scheduler_config)
        self.prediction_type = str(self._scheduler.config["prediction_type"])
        if self.prediction_type not in ("epsilon", "v_prediction", "sample"):
            raise ValueError(f"prediction_type must be epsilon, v_prediction or sample, got {self.prediction_type!r}")
        self.alphas_cumprod = self._scheduler.alphas_cumprod
        self.num_timesteps = len(self.alphas_cumprod)

    def draw(self, count: int, emphasis: Emphasis, generator: torch.Generator) -> Tensor:
        """Time steps [count] int64 of a training."""
        return emphasis.draw(count, self.num_timesteps, generator)

    def times(self, timesteps: Tensor) -> Tensor:
        """What the network gets as its time [B] at time steps [B]: themselves."""
        return timesteps

    def mixture(self, timestep: int) -> tuple[float, float]:
        """Shares of latents and of noise in noisy latents: sqrt(a) and sqrt(1 - a)."""
        alpha_bar = float(self.alphas_cumprod[timestep])
        return alpha_bar**0.5, (1 - alpha_bar) ** 0.5

    def noised(self, latents: Tensor, noise: Tensor, timesteps: Tensor) -> tuple[Tensor, Tensor]:
        """Noisy latents, and the target: the noise, the latents, or v = sqrt(a) noise - sqrt(1 - a) latents."""
        noisy = self._scheduler.add_noise(latents, noise, timesteps)
        if self.prediction_type != "v_prediction":
            return noisy, noise if self.prediction_type == "epsilon" else latents
        return noisy, self._scheduler.get_velocity(latents, noise, timesteps)

    def clean_of(self, predicted: Tensor, noisy: Tensor, timesteps: Tensor) -> Tensor:
        """The clean latents [B, C, h, w] that a prediction stands for."""
        if self.prediction_type == "sample":
            return predicted
        alpha_bar = self.alphas_cumprod.to(noisy.device)[timesteps][:, None, None, None]
        signal, noise = alpha_bar.sqrt(), (1 - alpha_bar).sqrt()
        if self.prediction_type == "epsilon":
            return (noisy - noise * predicted) / signal
        return signal * noisy - noise * predicted

    def prediction_of(self, clean: Tensor, noisy: Tensor, timesteps: Tensor) -> Tensor:
        """What the network must predict [B, C, h, w] for these clean latents: `clean_of` the other way round."""
        if self.prediction_type == "sample":
            return clean
        alpha_bar = self.alphas_cumprod.to(noisy.device)[timesteps][:, None, None, None]
        signal, noise = alpha_bar.sqrt(), (1 - alpha_bar).sqrt()
        if self.prediction_type == "epsilon":
            return (noisy - signal * clean) / noise
        return (signal * noisy - clean) / noise

    def loss_weights(self, timesteps: Tensor, emphasis: Emphasis = PLAIN) -> Tensor:
        """Weights [B] of the squared errors.

        With `snr_gamma` min-SNR weights: min(snr, gamma) of the error in the latents, which over snr is of that in the
        noise and over snr + 1 of that in v. Without: 1; for networks that predict the latents what makes the loss equal
        to that of v, snr + 1, up to `max_loss_weight` and with mean 1 over the schedule.
        """
        alpha_bar, snr_gamma = self.alphas_cumprod[timesteps], emphasis.snr_gamma
        if snr_gamma is None and self.prediction_type == "sample":
            weights = (1 / (1 - self.alphas_cumprod)).clamp(max=emphasis.max_loss_weight)
            return weights[timesteps] / weights.mean()
        if snr_gamma is None:
            return torch.ones(len(timesteps))
        if self.prediction_type == "sample":
            return (alpha_bar / (1 - alpha_bar)).clamp(max=snr_gamma)
        # min(snr, g) / (snr + 1) and min(snr, g) / snr, multiplied out: no end of the schedule divides 0 by 0.
        signal, noise = alpha_bar, 1 - alpha_bar
        clipped = torch.minimum(signal, snr_gamma * noise)
        return clipped if self.prediction_type == "v_prediction" else clipped / signal.clamp(min=1e-8)


def noise_schedule(scheduler_config: dict[str, Any]) -> NoiseSchedule | FlowSchedule:
    """The noise that a base model was trained with."""
    return FlowSchedule(scheduler_config) if is_flow(scheduler_config) else NoiseSchedule(scheduler_config)


def denoising_loss(
    denoiser: Denoiser,
    schedule: NoiseSchedule | FlowSchedule,
    batch: Batch,
    generator: torch.Generator,
    emphasis: Emphasis = PLAIN,
) -> Tensor:
    """Weighted mean squared error of the prediction at random time steps; noise comes from the CPU stream."""
    num_draws = len(batch.latents) // batch.num_frames
    timesteps = schedule.draw(num_draws, emphasis, generator).repeat_interleave(batch.num_frames)
    noise = torch.randn(batch.latents.shape, generator=generator)
    if batch.shared_noise:
        shared = torch.randn((num_draws, *noise.shape[1:]), generator=generator)
        noise = mix_noise(noise, shared.repeat_interleave(batch.num_frames, 0), batch.shared_noise)
    device = batch.latents.device
    noisy, target = schedule.noised(batch.latents, noise.to(device), timesteps.to(device))
    predicted = denoiser.predict(noisy, schedule.times(timesteps.to(device)), batch.embeddings, batch.conditions)
    error = (predicted.float() - target.float()).square().mean(dim=(1, 2, 3))
    return (schedule.loss_weights(timesteps, emphasis).to(device) * error).mean()


def mix_noise(own: Tensor, shared: Tensor, share: float) -> Tensor:
    """Standard normal noise [B, C, h, w]; rows with the same `shared` have this share of the variance in common.

    Source: Ge et al., Preserve Your Own Correlation, ICCV 2023 (mixed noise; their alpha^2 / (1 + alpha^2) is `share`).
    """
    return share**0.5 * shared + (1 - share) ** 0.5 * own


def validation_losses(
    denoiser: Denoiser, schedule: NoiseSchedule | FlowSchedule, batch: Batch, *, seed: int, batch_size: int
) -> tuple[float, float]:
    """Unweighted loss with the true and with shuffled conditions, over the same noise.

    The difference says how much the network uses its condition; the loss alone does not. Prompts are shuffled where
    there are no condition images. `batch_size` is a multiple of the batch's `num_frames`; stretches stay whole.
    """
    count, num_frames = len(batch.latents), batch.num_frames
    order = torch.arange(count).roll(max(1, count // num_frames // 2) * num_frames)
    losses = []
    for shuffled in (False, True):
        conditions, embeddings = batch.conditions, batch.embeddings
        if shuffled and conditions is not None:
            conditions = conditions[order]
        elif shuffled:
            embeddings = embeddings[order]
        total = 0.0
        for start in range(0, count, batch_size):
            rows = slice(start, start + batch_size)
            images = None if conditions is None else conditions[rows]
            part = Batch(batch.latents[rows], embeddings[rows], images, num_frames, batch.shared_noise)
            with torch.no_grad():
                loss = denoising_loss(denoiser, schedule, part, generator_for(seed, start))
            total += float(loss) * len(part.latents)
        losses.append(total / count)
    return losses[0], losses[1]
