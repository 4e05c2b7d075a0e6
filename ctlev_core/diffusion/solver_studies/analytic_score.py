"""Solvers without a network's error: latents whose denoiser is known in closed form.

The clean latents are a mixture of isotropic Gaussians, or (spread 0) a finite set of points. Noised, they are a mixture
again, and the mean of the clean latents given the noisy ones, which is all a perfect network could learn, follows from
Bayes' rule. In one dimension the exact solution of the probability-flow equation is known too: the flow keeps the order
of values, so that a value at quantile q of the noise ends at quantile q of the data.

What is left is the solver's own error. The denoiser is told the time step as schedulers give it, a whole number, as a
network is. Two errors stay however many steps are taken: the state starts from N(0, 1) where the schedule ends with a
little signal, and the last step, from the schedule's lowest noise to none, is one jump to the mean.

Source: Karras et al., Elucidating the Design Space of Diffusion-Based Generative Models, 2022, eq. 57 (finite sets).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ctlev_core.diffusion.denoising import NoiseSchedule
from ctlev_core.diffusion.sampling.options import STOCHASTIC, SamplingOptions
from ctlev_core.diffusion.sampling.schedulers import make_scheduler

_BISECTIONS = 80


@dataclass(frozen=True, eq=False)
class LatentMixture:
    """sum_k weights[k] N(means[k], spreads[k]^2 I).

    Attributes:
        weights: [K] float64, positive, adding up to 1.
        means: [K, D] float64.
        spreads: [K] float64, standard deviations; 0 = a point.
    """

    weights: Tensor
    means: Tensor
    spreads: Tensor

    @staticmethod
    def make(weights: Any, means: Any, spreads: Any) -> LatentMixture:
        """A checked mixture; means may be [K], of one dimension, and weights are normalised.

        Raises:
            ValueError: sizes differ, a weight is not positive, or a spread is negative.
        """
        w, s = (torch.as_tensor(values, dtype=torch.float64) for values in (weights, spreads))
        m = torch.as_tensor(means, dtype=torch.float64)
        m = m[:, None] if m.ndim == 1 else m
        if m.ndim != 2 or not len(m) or w.shape != s.shape or w.shape != m.shape[:1]:
            raise ValueError(
                f"weights, means and spreads must be [K], [K, D] and [K], "
                f"got {list(w.shape)}, {list(m.shape)}, {list(s.shape)}"
            )
        if not bool((w > 0).all() and (s >= 0).all() and torch.isfinite(m).all()):
            raise ValueError("weights must be positive, spreads at least 0 and means finite")
        return LatentMixture(w / w.sum(), m, s)

    @staticmethod
    def of_points(latents: Tensor) -> LatentMixture:
        """A finite set: each of the K latents [K, ...] with the same weight."""
        points = latents.flatten(1).double()
        return LatentMixture.make(torch.ones(len(points)), points, torch.zeros(len(points)))

    def denoise(self, noisy: Tensor, alpha_bar: float) -> Tensor:
        """The mean of the clean latents given noisy ones [N, ...] = sqrt(alpha_bar) clean + sqrt(1 - alpha_bar) noise.

        Computed in float64; of the shape and precision of `noisy`.
        """
        x = noisy.flatten(1).double()
        signal, noise = alpha_bar**0.5, 1 - alpha_bar
        variance = alpha_bar * self.spreads**2 + noise
        # Multiplied out: float64 leaves 12 digits, and a difference for each of K components and D dimensions is slow.
        centres = signal * self.means
        squared = x.square().sum(1, keepdim=True) - 2 * x @ centres.T + centres.square().sum(1)
        logits = self.weights.log() - 0.5 * self.means.shape[1] * variance.log() - 0.5 * squared / variance
        shares = logits.softmax(dim=1)
        # Each component draws the noisy latents towards its mean; a point entirely.
        kept = signal * self.spreads**2 / variance
        mean = shares @ (self.means - (kept * signal)[:, None] * self.means) + (shares @ kept)[:, None] * x
        return mean.reshape(noisy.shape).to(noisy.dtype)

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Clean latents [count, D] float64."""
        chosen = torch.multinomial(self.weights, count, replacement=True, generator=generator)
        noise = torch.randn((count, self.means.shape[1]), generator=generator, dtype=torch.float64)
        return self.means[chosen] + self.spreads[chosen, None] * noise

    def cumulative(self, values: Tensor, alpha_bar: float = 1.0) -> Tensor:
        """P(noisy latent <= value) of the one dimension; `alpha_bar` 1 is without noise."""
        spread = (alpha_bar * self.spreads**2 + 1 - alpha_bar).sqrt()
        scaled = (values.double().flatten()[:, None] - alpha_bar**0.5 * self.means[:, 0]) / spread
        return (torch.special.ndtr(scaled) @ self.weights).reshape(values.shape)

    def quantile(self, probability: Tensor) -> Tensor:
        """The value below which a clean latent of the one dimension lies with this probability, by bisection."""
        reach = 40 * self.spreads.max() + 1
        low = torch.full_like(probability, float(self.means.min() - reach), dtype=torch.float64)
        high = torch.full_like(probability, float(self.means.max() + reach), dtype=torch.float64)
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            below = self.cumulative(middle) < probability
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        return (low + high) / 2


def exact_prediction(mixture: LatentMixture, noisy: Tensor, alpha_bar: float, prediction_type: str) -> Tensor:
    """What a perfect network would say: the noise, the clean latents, or v."""
    clean = mixture.denoise(noisy, alpha_bar)
    if prediction_type == "sample":
        return clean
    signal, noise_level = alpha_bar**0.5, (1 - alpha_bar) ** 0.5
    noise = (noisy - signal * clean) / noise_level
    return noise if prediction_type == "epsilon" else signal * noise - noise_level * clean


def solve(
    mixture: LatentMixture,
    noise: Tensor,
    scheduler_config: dict[str, Any],
    options: SamplingOptions,
    generator: torch.Generator,
) -> Tensor:
    """What a solver makes of noise [N, D] with the exact denoiser, [N, D]; `generator` feeds solvers that draw more."""
    schedule = NoiseSchedule(scheduler_config)
    scheduler = make_scheduler(
        options.scheduler, scheduler_config, options.num_inference_steps, options.timestep_spacing
    )
    further = {"generator": generator} if options.scheduler in STOCHASTIC else {}
    # Solvers expect images.
    state = noise[:, :, None, None] * scheduler.init_noise_sigma
    for timestep in scheduler.timesteps:
        noisy = scheduler.scale_model_input(state, timestep)
        alpha_bar = float(schedule.alphas_cumprod[int(timestep)])
        predicted = exact_prediction(mixture, noisy, alpha_bar, schedule.prediction_type)
        state = scheduler.step(predicted, timestep, state, **further).prev_sample
    return state[:, :, 0, 0]


def exact_solution(mixture: LatentMixture, noise: Tensor, scheduler_config: dict[str, Any]) -> Tensor:
    """Where the probability-flow equation takes each value of one-dimensional noise [N, 1] at the last time step."""
    alpha_bar = float(NoiseSchedule(scheduler_config).alphas_cumprod[-1])
    return mixture.quantile(mixture.cumulative(noise, alpha_bar))


def wasserstein_1(values: Tensor, mixture: LatentMixture) -> float:
    """Wasserstein-1 distance of values [N] or [N, 1] from the one-dimensional mixture, by its quantiles."""
    ordered = values.double().flatten().sort().values
    middles = (torch.arange(len(ordered), dtype=torch.float64) + 0.5) / len(ordered)
    return float((ordered - mixture.quantile(middles)).abs().mean())


@dataclass(frozen=True)
class SolverError:
    """The error of one solver with one number of steps.

    Attributes:
        wasserstein_1: of the values it ends at from the exact distribution.
        trajectory_rms: root mean square distance of single values from where the probability-flow equation takes them;
            means nothing for solvers that add noise of their own.
        cpu_seconds: for all values, the exact denoiser's included.
    """

    wasserstein_1: float
    trajectory_rms: float
    cpu_seconds: float


def solver_error(
    mixture: LatentMixture, scheduler_config: dict[str, Any], options: SamplingOptions, *, count: int, seed: int
) -> SolverError:
    """Solve from `count` values of noise, the same for every solver, and compare with the exact solution.

    Raises:
        ValueError: the mixture has more than one dimension.
    """
    noise, generator = _noise(mixture, count, seed)
    started = time.process_time()
    made = solve(mixture, noise, scheduler_config, options, generator)
    seconds = time.process_time() - started
    exact = exact_solution(mixture, noise, scheduler_config)
    return SolverError(
        wasserstein_1=wasserstein_1(made, mixture),
        trajectory_rms=float((made.double() - exact).square().mean().sqrt()),
        cpu_seconds=seconds,
    )


def distribution_floors(
    mixture: LatentMixture, scheduler_config: dict[str, Any], *, count: int, seed: int
) -> dict[str, float]:
    """Wasserstein-1 distances no solver need beat: of the exact solution from the same noise, and of exact draws."""
    noise, generator = _noise(mixture, count, seed)
    found = {
        "exact solution": exact_solution(mixture, noise, scheduler_config),
        "exact draws": mixture.sample(count, generator),
    }
    return {name: wasserstein_1(values, mixture) for name, values in found.items()}


def _noise(mixture: LatentMixture, count: int, seed: int) -> tuple[Tensor, torch.Generator]:
    if mixture.means.shape[1] != 1:
        raise ValueError(f"the exact solution is known in one dimension, got {mixture.means.shape[1]}")
    state = np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]
    generator = torch.Generator().manual_seed(int(state) & (2**63 - 1))
    return torch.randn((count, 1), generator=generator), generator
