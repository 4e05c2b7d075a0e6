"""The closed forms behind the oracle against numerical integration, and solvers against the closed forms."""

import json

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.special import logsumexp
from scipy.stats import norm, wasserstein_distance

from ctlev_core.diffusion.denoising import NoiseSchedule
from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.solver_studies.analytic_score import (
    LatentMixture,
    distribution_floors,
    exact_prediction,
    exact_solution,
    solve,
    solver_error,
    wasserstein_1,
)

CONFIG = json.loads((BUNDLED_BASE_MODEL / "scheduler" / "scheduler_config.json").read_text())
WEIGHTS, MEANS, SPREADS = (0.85, 0.15), (-0.6, 1.2), (0.05, 0.4)


def events_like():
    return LatentMixture.make(WEIGHTS, MEANS, SPREADS)


@pytest.mark.parametrize("alpha_bar", [0.999, 0.6, 0.01])
def test_denoiser_is_the_mean_of_the_clean_values_given_the_noisy_one(alpha_bar):
    """Bayes' rule by quadrature over the clean value."""
    clean = np.linspace(-3, 4, 200_001)
    base_model = sum(w * norm.pdf(clean, m, s) for w, m, s in zip(WEIGHTS, MEANS, SPREADS, strict=True))
    for noisy in (-1.5, -0.6, 0.1, 0.9, 2.0):
        likelihood = norm.logpdf(noisy, np.sqrt(alpha_bar) * clean, np.sqrt(1 - alpha_bar))
        weight = base_model * np.exp(likelihood - likelihood.max())
        expected = (weight * clean).sum() / weight.sum()
        found = events_like().denoise(torch.tensor([[noisy]], dtype=torch.float64), alpha_bar)
        # Trapezoids of 3.5e-5 under densities at least 0.03 wide.
        assert float(found) == pytest.approx(expected, abs=1e-7)


def test_a_finite_set_of_latents_is_denoised_by_a_softmax_over_its_distances():
    random = np.random.default_rng(0)
    points, noisy, alpha_bar = random.normal(size=(5, 3, 2, 2)), random.normal(size=(4, 3, 2, 2)), 0.7
    found = LatentMixture.of_points(torch.from_numpy(points)).denoise(torch.from_numpy(noisy), alpha_bar)
    for row in range(4):
        squared = np.square(noisy[row] - np.sqrt(alpha_bar) * points).sum(axis=(1, 2, 3))
        logits = -squared / (2 * (1 - alpha_bar))
        expected = np.tensordot(np.exp(logits - logsumexp(logits)), points, axes=1)
        np.testing.assert_allclose(found[row].numpy(), expected, rtol=0, atol=1e-12)


def test_almost_clean_latents_of_a_finite_set_are_recognised_in_many_dimensions():
    """The squared distances are multiplied out; at the schedule's lowest noise that must not blur neighbours."""
    points = torch.randn((8, 12_288), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    alpha_bar = float(NoiseSchedule(CONFIG).alphas_cumprod[0])
    noise = torch.randn(points.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    noisy = alpha_bar**0.5 * points + (1 - alpha_bar) ** 0.5 * noise
    torch.testing.assert_close(LatentMixture.of_points(points).denoise(noisy, alpha_bar), points, rtol=0, atol=1e-9)


def test_exact_solution_is_that_of_the_probability_flow_equation():
    """dx/dln(sigma) of the variance-exploding form, x - D(x), integrated by SciPy in double precision."""
    mixture, alphas = events_like(), NoiseSchedule(CONFIG).alphas_cumprod.double()
    start = torch.tensor([[-1.7], [-0.4], [0.3], [1.1], [2.2]])
    alpha_bar = float(alphas[-1])

    def slope(log_sigma, x):
        sigma = np.exp(log_sigma)
        scale = 1 / np.sqrt(1 + sigma**2)
        clean = mixture.denoise(torch.from_numpy(x * scale)[:, None], scale**2)
        return x - clean[:, 0].numpy()

    sigma = np.sqrt((1 - alpha_bar) / alpha_bar)
    begin = start[:, 0].double().numpy() / np.sqrt(alpha_bar)
    solved = solve_ivp(slope, (np.log(sigma), np.log(1e-6)), begin, rtol=1e-9, atol=1e-11)
    found = exact_solution(mixture, start, CONFIG)[:, 0].numpy()
    # SciPy's tolerance, amplified between the two peaks, where neighbours part.
    np.testing.assert_allclose(found, solved.y[:, -1], rtol=0, atol=2e-5)


def test_quantile_inverts_the_cumulative_distribution():
    probability = torch.tensor([1e-6, 0.02, 0.5, 0.85, 0.999999], dtype=torch.float64)
    mixture = events_like()
    torch.testing.assert_close(mixture.cumulative(mixture.quantile(probability)), probability, rtol=0, atol=1e-12)


def test_wasserstein_distance_agrees_with_scipy_on_a_large_sample():
    mixture = events_like()
    values = torch.randn(2000, generator=torch.Generator().manual_seed(3)) * 0.5
    drawn = mixture.sample(400_000, torch.Generator().manual_seed(4))[:, 0].numpy()
    # The large sample's own distance from the mixture.
    assert wasserstein_1(values, mixture) == pytest.approx(wasserstein_distance(values.numpy(), drawn), abs=3e-3)


@pytest.mark.parametrize("prediction_type", ["epsilon", "v_prediction", "sample"])
def test_every_prediction_type_leads_to_the_same_values(prediction_type):
    config = CONFIG | {"prediction_type": prediction_type}
    noise = torch.randn((200, 1), generator=torch.Generator().manual_seed(0))
    options = SamplingOptions(num_inference_steps=12)
    made = solve(events_like(), noise, config, options, torch.Generator())
    expected = solve(events_like(), noise, CONFIG, options, torch.Generator())
    # Between the peaks values tell the conversions apart, which take the noise level of the solver, not of the time
    # step rounded to a whole number; a wrong conversion moves values by tenths.
    assert float((made - expected).square().mean().sqrt()) < 0.01


def test_predictions_are_consistent():
    noisy = torch.tensor([[0.4]], dtype=torch.float64)
    clean, noise, v = (
        exact_prediction(events_like(), noisy, 0.3, kind) for kind in ("sample", "epsilon", "v_prediction")
    )
    torch.testing.assert_close(0.3**0.5 * clean + 0.7**0.5 * noise, noisy)
    torch.testing.assert_close(v, 0.3**0.5 * noise - 0.7**0.5 * clean)


def test_more_steps_are_nearer_to_the_exact_solution_down_to_the_last_jump():
    """From the schedule's lowest noise the last step goes to the mean: a peak of spread s becomes s^2 / (s^2 + n^2)
    times as wide in place of s / sqrt(s^2 + n^2), which alone is what 100 steps leave."""
    errors = [
        solver_error(events_like(), CONFIG, SamplingOptions(num_inference_steps=steps), count=2000, seed=0)
        for steps in (10, 20, 100)
    ]
    few, some, many = (error.trajectory_rms for error in errors)
    assert few > some > many
    alpha_bar = float(NoiseSchedule(CONFIG).alphas_cumprod[0])
    lowest = np.sqrt((1 - alpha_bar) / alpha_bar)
    jump = SPREADS[0] - SPREADS[0] ** 2 / np.sqrt(SPREADS[0] ** 2 + lowest**2)
    # Draws of the narrow peak, sampling noise of its spread, and the wide peak's own small share.
    assert many == pytest.approx(np.sqrt(WEIGHTS[0]) * jump, rel=0.1)
    assert (
        errors[2].wasserstein_1
        < 1.5 * distribution_floors(events_like(), CONFIG, count=2000, seed=0)["exact solution"] + jump
    )


def test_a_solver_with_noise_reaches_the_distribution_but_not_the_trajectory():
    error = solver_error(
        events_like(), CONFIG, SamplingOptions(scheduler="ddpm", num_inference_steps=200), count=2000, seed=0
    )
    assert error.wasserstein_1 < 0.05 < error.trajectory_rms


@pytest.mark.parametrize(
    ("weights", "means", "spreads", "message"),
    [
        ((1.0,), (0.0, 1.0), (1.0,), r"must be \[K\], \[K, D\] and \[K\], got \[1\], \[2, 1\], \[1\]"),
        ((0.0, 1.0), (0.0, 1.0), (1.0, 1.0), "weights must be positive"),
        ((1.0,), (0.0,), (-1.0,), "spreads at least 0"),
        ((1.0,), (np.nan,), (1.0,), "means finite"),
    ],
)
def test_wrong_mixtures_are_refused(weights, means, spreads, message):
    with pytest.raises(ValueError, match=message):
        LatentMixture.make(weights, means, spreads)


def test_the_exact_solution_needs_one_dimension():
    mixture = LatentMixture.make((1.0,), ((0.0, 1.0),), (1.0,))
    with pytest.raises(ValueError, match="in one dimension, got 2"):
        solver_error(mixture, CONFIG, SamplingOptions(), count=10, seed=0)
