"""Noised and denoised: closed forms of a Gaussian, and rows that depend on their own seeds alone."""

import dataclasses

import numpy as np
import pytest
import torch
from tiny_base_model import make_data, shared_base_model

from ctlev_core.diffusion.denoising import NoiseSchedule
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.partial_denoising import denoise, denoising_times, encode_frames, noise_to
from ctlev_core.diffusion.sampling.sampling import guided_predictions

MEAN, DEVIATION = 0.7, 0.3
SHAPE = (64, 4, 4, 4)


def schedule(prediction_type="v_prediction"):
    return NoiseSchedule({**shared_base_model().scheduler_config, "prediction_type": prediction_type})


def exact_denoiser(of: NoiseSchedule):
    """Of latents distributed as N(MEAN, DEVIATION^2): the expectation of the clean ones, as `of` wants it told."""

    def predict(noisy, time):
        a = float(of.alphas_cumprod[int(time)])
        total = a * DEVIATION**2 + 1 - a
        clean = MEAN + a**0.5 * DEVIATION**2 / total * (noisy - a**0.5 * MEAN)
        noise = (noisy - a**0.5 * clean) / (1 - a) ** 0.5
        return {"sample": clean, "epsilon": noise}.get(of.prediction_type, a**0.5 * noise - (1 - a) ** 0.5 * clean)

    return predict


def gaussian():
    return MEAN + DEVIATION * torch.randn(SHAPE, generator=torch.Generator().manual_seed(5))


@pytest.mark.parametrize("prediction_type", ["sample", "v_prediction", "epsilon"])
@pytest.mark.parametrize("time_step", [20, 200, 700])
def test_the_exact_denoiser_follows_the_probability_flow(prediction_type, time_step):
    """Of a Gaussian the flow keeps how many standard deviations a value lies from the mean."""
    of, seeds = schedule(prediction_type), range(len(gaussian()))
    noisy = noise_to(gaussian(), time_step, of, seeds)
    a = float(of.alphas_cumprod[time_step])
    expected = MEAN + DEVIATION * (noisy - a**0.5 * MEAN) / (a * DEVIATION**2 + 1 - a) ** 0.5

    def error(evaluations):
        found = denoise(noisy, denoising_times(time_step, evaluations), of, exact_denoiser(of))
        return float((found - expected).abs().max()), found

    many, found = error(1000)
    assert many < 0.02, "the last step leaves out the noise of time step 0"
    assert many < error(8)[0], "a first-order solver errs more with fewer steps"
    narrowed = float(error(50)[1].std() / expected.std())
    assert 0.96 < narrowed < 1, "what docs/metrics.md says of the default"
    # 4,096 values: standard errors .005 of the mean and .003 of the deviation.
    assert float(found.mean()) == pytest.approx(MEAN, abs=0.02)
    assert float(found.std()) == pytest.approx(DEVIATION, abs=0.02)


def test_a_denoiser_that_blurs_gives_too_narrow_a_distribution():
    """The check above can fail: the mean of all clean latents is the best guess of a network that sees nothing."""
    of = schedule("sample")
    noisy = noise_to(gaussian(), 400, of, range(len(gaussian())))
    found = denoise(noisy, denoising_times(400, 50), of, lambda latents, _: torch.full_like(latents, MEAN))
    assert float(found.std()) < 0.01


def test_noise_has_the_variance_of_its_time_step_and_is_the_same_for_all():
    of, clean, seeds = schedule(), torch.zeros(SHAPE), range(SHAPE[0])
    noised = {time: noise_to(clean, time, of, seeds) for time in (50, 700)}
    for time, latents in noised.items():
        assert float(latents.std()) == pytest.approx(float(1 - of.alphas_cumprod[time]) ** 0.5, rel=0.05)
    scaled = [latents / float(1 - of.alphas_cumprod[time]) ** 0.5 for time, latents in noised.items()]
    torch.testing.assert_close(*scaled)


def test_time_step_0_is_the_identity_and_others_must_be_of_the_schedule():
    of, latents = schedule(), gaussian()
    assert denoising_times(0, 50) == []
    assert noise_to(latents, 0, of, range(len(latents))) is latents
    assert torch.equal(denoise(latents, [], of, exact_denoiser(of)), latents)
    with pytest.raises(ValueError, match="expected a time step of 0 to 999, got 1000"):
        noise_to(latents, 1000, of, range(len(latents)))


def test_steps_are_dense_at_little_noise_and_end_at_0():
    for time, most in ((1, 50), (20, 50), (400, 50), (999, 8)):
        times = denoising_times(time, most)
        assert times[0] == time and times[-1] == 0 and len(times) <= most
        gaps = -np.diff(times)
        assert (gaps > 0).all()
    gaps = -np.diff(denoising_times(900, 31))
    np.testing.assert_array_equal(gaps, [2 * 30 - 1 - 2 * k for k in range(30)])  # of squares: 900, 841 .. 1, 0


@pytest.mark.parametrize("guidance_scale", [1.0, 3.0])
def test_rows_do_not_depend_on_the_batch(guidance_scale):
    base_model, (frames, conditions) = shared_base_model(), make_data(5)
    options = SamplingOptions(guidance_scale=guidance_scale)
    seeds = [7, 1, 7, 3, 5]
    table = encode_prompts(base_model, [*conditions.prompts, ""])
    images = torch.from_numpy(conditions.images.astype(np.float32)).permute(0, 3, 1, 2) / 255
    of = NoiseSchedule(base_model.scheduler_config)

    def run(rows):
        own = [seeds[row] for row in rows]
        latents = encode_frames(base_model, frames[rows], own)
        with guided_predictions(base_model, table[rows], table[-1:], images[rows], options) as predict:
            return denoise(noise_to(latents, 300, of, own), denoising_times(300, 4), of, predict)

    together = run([0, 1, 2, 3, 4])
    torch.testing.assert_close(run([3, 1]), together[[3, 1]], atol=1e-4, rtol=1e-4)
    assert (together[0] - together[1]).abs().max() > 0.01, "seeds and frames matter"


def test_latents_are_drawn_from_posteriors_by_each_rows_seed():
    """An autoencoder with noise: its mean and deviation are known."""

    class Posterior:
        mean, std = torch.full((3, 2, 1, 1), 2.0), torch.full((3, 2, 1, 1), 0.5)

    class Encoder(torch.nn.Module):
        config = type("Config", (), {"scaling_factor": 10.0})
        device, dtype = torch.device("cpu"), torch.float32

        def encode(self, images):
            return type("Encoded", (), {"latent_dist": Posterior})

    base_model = dataclasses.replace(shared_base_model(), vae=Encoder())
    latents = encode_frames(base_model, np.zeros((3, 8, 8, 3), np.uint8), [4, 5, 4])
    assert torch.equal(latents[0], latents[2]) and not torch.equal(latents[0], latents[1])
    drawn = (latents / 10 - 2) / 0.5
    assert 0.01 < float(drawn.abs().max()) < 6, "standard normal numbers"
