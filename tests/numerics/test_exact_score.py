"""Solvers with a denoiser in closed form: what is wrong then is the solver's doing alone."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import ndtr, ndtri

from ctlev_core.diffusion.sampling.options import OF_STUDENTS, SPACINGS, STOCHASTIC
from ctlev_core.diffusion.sampling.schedulers import make_scheduler

CONFIG: dict[str, Any] = {
    "num_train_timesteps": 1000,
    "beta_start": 0.00085,
    "beta_end": 0.02,
    "beta_schedule": "scaled_linear",
    "prediction_type": "v_prediction",
}
ALPHA_BAR = np.cumprod(1 - np.linspace(0.00085**0.5, 0.02**0.5, 1000) ** 2)

# A latent value of event images: a narrow peak (no event), and a broad one.
WEIGHTS, MEANS, SPREADS = np.array([0.85, 0.15]), np.array([-0.6, 1.2]), np.array([0.05, 0.4])
COUNT = 10_000


def mixture_mean(noisy, alpha_bar, weights=WEIGHTS, means=MEANS, spreads=SPREADS):
    """E[clean | noisy] of a mixture of Gaussians by Bayes' rule, float64."""
    x = np.asarray(noisy, np.float64)[..., None]
    variance = alpha_bar * spreads**2 + 1 - alpha_bar
    logarithm = np.log(weights) - 0.5 * np.log(variance) - 0.5 * (x - np.sqrt(alpha_bar) * means) ** 2 / variance
    share = np.exp(logarithm - logarithm.max(axis=-1, keepdims=True))
    share /= share.sum(axis=-1, keepdims=True)
    each = means + np.sqrt(alpha_bar) * spreads**2 / variance * (x - np.sqrt(alpha_bar) * means)
    return (share * each).sum(axis=-1)


def velocity(noisy, clean, alpha_bar):
    """What a network of v-prediction says."""
    noise = (noisy - np.sqrt(alpha_bar) * clean) / np.sqrt(1 - alpha_bar)
    return torch.from_numpy(np.sqrt(alpha_bar) * noise - np.sqrt(1 - alpha_bar) * clean).float()


def mixture_quantiles(probability):
    """Inverse of the mixture's distribution function, from a table fine beside the tolerances here."""
    values = np.linspace(-2, 4, 200_001)
    return np.interp(probability, ndtr((values[:, None] - MEANS) / SPREADS) @ WEIGHTS, values)


QUANTILES = mixture_quantiles((np.arange(COUNT) + 0.5) / COUNT)


def distribution_error(name, spacing, steps):
    """Wasserstein-1 distance of what the solver makes of evenly spread noise from the exact distribution."""
    solver, generator = make_scheduler(name, CONFIG, steps, spacing), torch.Generator().manual_seed(3)
    noise = torch.from_numpy(ndtri((np.arange(COUNT) + 0.5) / COUNT)).float()
    state = noise[torch.randperm(COUNT, generator=generator)].reshape(COUNT, 1, 1, 1)
    further = {"generator": generator} if name in STOCHASTIC else {}
    for timestep in solver.timesteps:
        alpha_bar = ALPHA_BAR[int(timestep)]
        predicted = velocity(state.numpy(), mixture_mean(state, alpha_bar), alpha_bar)
        state = solver.step(predicted, timestep, state, **further).prev_sample
    return float(np.abs(np.sort(state.double().flatten().numpy()) - QUANTILES).mean())


@pytest.mark.parametrize("name", [name for name in SPACINGS if name != OF_STUDENTS])
def test_errors_fall_with_steps(name):
    spacing = "lu" if "lu" in SPACINGS[name] else "linspace"
    few, some, many = (distribution_error(name, spacing, steps) for steps in (8, 20, 50))
    # At 50 steps the best solvers stand at what is left by the first step, which starts from noise without the little
    # signal of the schedule's end: 0.0024 for exact solutions, and 0.006 for draws.
    assert many < max(0.8 * some, 0.008)
    assert some < 0.75 * few
    assert many < 0.05


def test_higher_orders_are_better_with_few_steps():
    error = {
        (name, spacing): distribution_error(name, spacing, 20)
        for name in ("ddim", "dpmpp_2m", "dpmpp_3m", "unipc", "deis")
        for spacing in ("karras", "lu")
    }
    for spacing in ("karras", "lu"):
        assert error["dpmpp_2m", spacing] < 0.6 * error["ddim", spacing]
        for third in ("dpmpp_3m", "unipc", "deis"):
            assert error[third, spacing] < 0.8 * error["dpmpp_2m", spacing]
    # The narrow peak is blurred by a last jump from much noise, whatever the order before.
    assert distribution_error("dpmpp_3m", "linspace", 20) > 3 * error["dpmpp_3m", "karras"]
    assert distribution_error("ddpm", "linspace", 20) > max(error.values())


def test_twenty_steps_of_the_default_beat_hundreds_of_the_ancestral_solver():
    assert distribution_error("unipc", "karras", 20) < distribution_error("ddpm", "linspace", 200)


def test_few_steps_of_unipc_are_no_worse_than_those_of_a_second_order_solver():
    """At order 3 eight steps overshoot: 0.139 with Karras steps, against 0.064."""
    for spacing in ("karras", "lu"):
        assert distribution_error("unipc", spacing, 8) < 1.1 * distribution_error("dpmpp_2m", spacing, 8)


def trajectory_error(name, steps, spread=0.5):
    """Largest error on the way to the last jump, for one Gaussian: there the flow only scales,
    x(t) = x(T) * (v(t) / v(T)) ** 0.5 with v = alpha_bar spread ** 2 + 1 - alpha_bar."""
    solver = make_scheduler(name, CONFIG, steps, "lu")
    state = torch.linspace(-2, 2, 9).reshape(-1, 1, 1, 1)
    start, errors = state.double().numpy(), []
    alpha_bars = 1 / (1 + solver.sigmas.double().numpy() ** 2)  # where the solver is, not at whole time steps
    variances = alpha_bars * spread**2 + 1 - alpha_bars
    for index, timestep in enumerate(solver.timesteps[:-1]):
        alpha_bar = alpha_bars[index]
        clean = np.sqrt(alpha_bar) * spread**2 / variances[index] * state.numpy()
        state = solver.step(velocity(state.numpy(), clean, alpha_bar), timestep, state).prev_sample
        errors.append(np.abs(state.double().numpy() - start * np.sqrt(variances[index + 1] / variances[0])).max())
    return max(errors)


@pytest.mark.parametrize(
    # A corrector adds one order to that of unipc's predictor.
    ("name", "order"),
    [("ddim", 1), ("dpmpp_2m", 2), ("dpmpp_3m", 3), ("unipc", 4), ("deis", 3)],
)
def test_errors_fall_by_the_solvers_order(name, order):
    """Twice the steps, errors 2 ** order times smaller; measured 1.0, 2.2, 3.0, 4.1 and 2.8."""
    measured = np.log2(trajectory_error(name, 20) / trajectory_error(name, 40))
    assert abs(measured - order) < 0.3


def test_deis_does_not_get_worse_with_many_steps():
    """With coefficients in float32 the error was 0.017 here, and 0.4 at 900 steps."""
    assert trajectory_error("deis", 320) < 1e-5
