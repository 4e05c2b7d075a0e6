"""Flow matching: the noise against diffusers' own scheduler, solvers against closed forms, refusals by name."""

import json
import shutil
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_flow_match_euler_discrete import FlowMatchEulerDiscreteScheduler
from tiny_families import POOLED, T5_WIDTH, check_refusal, with_entries, write_family
from tiny_stable_diffusion import SIDE

from ctlev_core.diffusion.denoising import Batch, Denoiser, Emphasis, NoiseSchedule, denoising_loss, noise_schedule
from ctlev_core.diffusion.flow_matching import FlowSchedule, shifted
from ctlev_core.diffusion.pretrained.loading import control_input, load_base_model, save_base_model
from ctlev_core.diffusion.pretrained.prompts import encode_prompts, prompt_arguments
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.partial_denoising import denoise, denoising_times, noise_to
from ctlev_core.diffusion.sampling.sampling import guided_predictions, sample_latents
from ctlev_core.diffusion.sampling.schedulers import make_scheduler
from ctlev_core.diffusion.sampling.value_table import fit_value_table
from ctlev_core.diffusion.training.distillation import distil
from ctlev_core.diffusion.training.options import StudentOptions
from data_contracts.errors import DataError
from data_contracts.labels import Conditions

CONFIG: dict[str, Any] = {"_class_name": "FlowMatchEulerDiscreteScheduler", "num_train_timesteps": 1000, "shift": 3.0}
SOLVERS = ("unipc", "dpmpp_2m", "dpmpp_3m", "dpmpp_sde", "ddim")


@pytest.fixture(scope="module")
def sd3(tmp_path_factory):
    return write_family("sd3", tmp_path_factory.mktemp("families") / "sd3")


def solve(name, steps, clean_of, count=1, seed=0):
    """Latents [count, 1, 8, 8], with a denoiser E[clean | noisy] = clean_of(noisy, sigma)."""
    generator = torch.Generator().manual_seed(seed)
    solver = make_scheduler(name, CONFIG, steps)
    state = torch.randn((count, 1, 8, 8), generator=generator)
    further = {"generator": generator} if name == "dpmpp_sde" else {}
    for timestep in solver.timesteps:
        sigma = timestep / 1000
        speed = (state - clean_of(state, sigma)) / sigma
        state = solver.step(speed, timestep, state, **further).prev_sample
    return state


@pytest.mark.parametrize("shift", [1.0, 3.0])
def test_noise_and_times_are_those_of_diffusers(shift):
    config = CONFIG | {"shift": shift}
    reference, schedule = FlowMatchEulerDiscreteScheduler.from_config(config), FlowSchedule(config)
    generator = torch.Generator().manual_seed(0)
    latents, noise = (torch.randn((1000, 2, 3, 3), generator=generator) for _ in range(2))
    noisy, target = schedule.noised(latents, noise, torch.arange(1000))
    times = schedule.times(torch.arange(1000))
    torch.testing.assert_close(times, reference.timesteps.flip(0))
    expected = reference.scale_noise(latents, reference.timesteps.flip(0), noise)
    torch.testing.assert_close(noisy, expected, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(schedule.clean_of(target, noisy, torch.arange(1000)), latents, atol=1e-5, rtol=1e-5)
    assert times[0] > 0 and times[-1] == 1000


def test_time_steps_are_logit_normal_as_in_the_paper():
    steps = FlowSchedule(CONFIG).draw(100_000, Emphasis(), torch.Generator().manual_seed(0)).double()
    logits = torch.logit((steps + 0.5) / 1000)
    # 5 standard errors of a standard normal's mean and deviation, and half a step of rounding.
    assert abs(float(logits.mean())) < 5 / 100_000**0.5 + 2e-3
    assert abs(float(logits.std()) - 1) < 5 / (2 * 100_000) ** 0.5 + 2e-3
    powered = FlowSchedule(CONFIG).draw(1000, Emphasis(timestep_power=2.0), torch.Generator().manual_seed(0))
    assert torch.equal(powered, Emphasis(timestep_power=2.0).draw(1000, 1000, torch.Generator().manual_seed(0)))


def test_min_snr_weights_are_those_of_the_error_in_the_latents():
    schedule, steps, gamma = FlowSchedule(CONFIG), torch.tensor([0, 200, 500, 999]), 5.0
    sigma = schedule.sigmas[steps].double()
    snr = ((1 - sigma) / sigma).square()
    found = schedule.loss_weights(steps, Emphasis(snr_gamma=gamma)).double()
    torch.testing.assert_close(found, snr.clamp(max=gamma) * sigma.square(), atol=1e-6, rtol=1e-5)
    assert schedule.loss_weights(steps, Emphasis()).tolist() == [1.0] * 4


@pytest.mark.parametrize("name", SOLVERS)
def test_every_solver_ends_on_the_only_image_there_is(name):
    for steps in (1, 2, 3, 14, 15, 16, 61):
        made = solve(name, steps, lambda noisy, _: 0 * noisy + 3.0)
        assert (made - 3).abs().max() < 1e-4, steps


@pytest.mark.parametrize(("name", "most"), [("unipc", 0.02), ("dpmpp_2m", 0.03), ("dpmpp_3m", 0.03), ("ddim", 0.2)])
def test_solvers_find_the_closed_form_of_a_normal_distribution(name, most):
    """Latents N(m, s^2): the flow keeps how many standard deviations from the mean a value is."""
    mean, spread = 0.5, 0.3

    def clean_of(noisy, sigma):
        variance = (1 - sigma) ** 2 * spread**2 + sigma**2
        return mean + (1 - sigma) * spread**2 / variance * (noisy - (1 - sigma) * mean)

    noise = torch.randn((64, 1, 8, 8), generator=torch.Generator().manual_seed(0))
    made = solve(name, 20, clean_of, count=64)
    error = (made - (mean + spread * noise)).abs().max()
    assert error < most
    more = (solve(name, 80, clean_of, count=64) - (mean + spread * noise)).abs().max()
    assert more < max(0.5 * float(error), 0.004)  # the signal of 1 / 300 that noise at the start lacks


def test_the_random_solver_finds_mean_and_spread():
    def clean_of(noisy, sigma):
        variance = (1 - sigma) ** 2 * 0.09 + sigma**2
        return 0.5 + (1 - sigma) * 0.09 / variance * (noisy - (1 - sigma) * 0.5)

    made = solve("dpmpp_sde", 40, clean_of, count=256)  # 16,384 values
    assert float(made.mean()) == pytest.approx(0.5, abs=0.02)
    assert float(made.std()) == pytest.approx(0.3, rel=0.05)


@pytest.mark.parametrize("name", ["deis", "sa_solver", "ddpm", "tcd"])
def test_other_solvers_are_refused_by_name(name):
    with pytest.raises(
        DataError, match=f"{name!r} is not made for flow matching; with this base model take one of unipc"
    ):
        make_scheduler(name, CONFIG, 10)
    with pytest.raises(ValueError, match="1 to 1000 steps"):
        make_scheduler("unipc", CONFIG, 1001)


def test_the_loss_is_zero_for_the_true_speed_and_one_variance_off_it():
    latents = torch.zeros((4, 4, 4, 4))

    class Exact(torch.nn.Module):
        def forward(self, noisy, timesteps, **_):
            # Clean latents are zero: noisy / sigma is the noise, which is the speed.
            assert timesteps.dtype == torch.float32
            return Made(noisy / (timesteps[:, None, None, None] / 1000))

    class Made:
        def __init__(self, sample):
            self.sample = sample

    batch = Batch(latents, torch.zeros((4, 2, 3)))
    loss = denoising_loss(Denoiser(Exact()), noise_schedule(CONFIG), batch, torch.Generator().manual_seed(0))
    assert float(loss) < 1e-9


def test_guidance_reaches_to_the_first_step(sd3):
    """Its time is above 999, the last step of other schedules."""
    base_model = load_base_model(sd3, with_controlnet=False)
    table = encode_prompts(base_model, ["a cup", ""])
    noisy, first = torch.randn((1, 4, 4, 4), generator=torch.Generator().manual_seed(0)), torch.tensor(999.999)
    made = {}
    for scale in (1.0, 2.0, 3.0):
        options = SamplingOptions(guidance_scale=scale)
        with guided_predictions(base_model, table[:1], table[1:], None, options) as predict, torch.no_grad():
            made[scale] = predict(noisy, first)
    assert not torch.allclose(made[1.0], made[3.0], atol=1e-4)
    torch.testing.assert_close(made[3.0] - made[2.0], made[2.0] - made[1.0], atol=1e-5, rtol=1e-4)


def test_every_part_of_a_prompt_counts(sd3):
    base_model = load_base_model(sd3)
    table = encode_prompts(base_model, ["a cup", "a ball", ""])
    rows = -(-(12 + POOLED) // T5_WIDTH)
    assert table.shape == (3, 16 + 256 + rows, T5_WIDTH)
    arguments = prompt_arguments(base_model.unet, table)
    assert arguments["encoder_hidden_states"].shape == (3, 272, T5_WIDTH)
    assert arguments["pooled_projections"].shape == (3, 12 + POOLED)
    noisy, timesteps = torch.randn((1, 4, 4, 4), generator=torch.Generator().manual_seed(0)), torch.tensor([500.0])
    denoiser = Denoiser(base_model.unet, base_model.controlnet)
    image = control_input(base_model, torch.rand(1, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(1)))
    assert image is not None and image.shape == (1, 4, SIDE // 8, SIDE // 8)
    expected = denoiser.predict(noisy, timesteps, table[:1], image)
    for place in ((0, 3, 2), (0, 3, 31), (0, 16, 5), (0, 271, 5), (0, 272, 0), (0, 272 + rows - 1, 5)):
        changed = table[:1].clone()
        changed[place] += 3
        assert not torch.equal(denoiser.predict(noisy, timesteps, changed, image), expected), place
    assert not torch.equal(denoiser.predict(noisy, timesteps, table[:1], None), expected)


def test_rows_without_a_condition_go_through_the_transformer_alone(sd3):
    base_model = load_base_model(sd3)
    table = encode_prompts(base_model, ["a cup", "a ball"])
    generator = torch.Generator().manual_seed(0)
    noisy, timesteps = torch.randn((2, 4, 4, 4), generator=generator), torch.tensor([500.0, 700.0])
    image = torch.randn((1, 4, 4, 4), generator=generator)
    denoiser = Denoiser(base_model.unet, base_model.controlnet)
    both = denoiser.predict(noisy, timesteps, table, image)
    first = denoiser.predict(noisy[:1], timesteps[:1], table[:1], image)
    second = denoiser.predict(noisy[1:], timesteps[1:], table[1:], None)
    torch.testing.assert_close(both, torch.cat([first, second]), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("zeros", [False, True])
def test_a_controlnet_that_is_told_no_pooled_prompt_gets_latents_without_a_shift(sd3, tmp_path, zeros):
    folder = shutil.copytree(sd3, tmp_path / "changed")
    path = folder / "controlnet" / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "force_zeros_for_pooled_projection": zeros}))
    base_model = load_base_model(folder)
    images = torch.rand((1, 3, SIDE, SIDE), generator=torch.Generator().manual_seed(3))
    mean = base_model.vae.encode(2 * images - 1).latent_dist.mean
    shift = 0.0 if zeros else 0.06
    found = control_input(base_model, images)
    assert found is not None
    torch.testing.assert_close(found, (mean - shift) * base_model.scaling_factor)
    table = encode_prompts(base_model, ["a cup"])
    pooled = table.clone()
    pooled[:, 272:] += 1
    denoiser, noisy = Denoiser(base_model.unet, base_model.controlnet), torch.randn(1, 4, 4, 4)
    seen = []
    base_model.controlnet.register_forward_pre_hook(
        lambda _, __, named: seen.append(named["pooled_projections"]), with_kwargs=True
    )
    denoiser.predict(noisy, torch.tensor([500.0]), pooled, found)
    assert bool(seen[0].any()) != zeros


def test_without_t5_its_rows_are_zeros_as_in_diffusers(sd3, tmp_path):
    from diffusers import StableDiffusion3Pipeline

    folder = shutil.copytree(sd3, tmp_path / "small")
    shutil.rmtree(folder / "text_encoder_3")
    shutil.rmtree(folder / "tokenizer_3")
    shutil.rmtree(folder / "controlnet")
    base_model = load_base_model(folder)
    table = encode_prompts(base_model, ["a photo of a cup", ""])
    assert not table[:, 16:272].any()
    save_base_model(base_model, tmp_path / "saved")
    pipeline: Any = StableDiffusion3Pipeline.from_pretrained(
        tmp_path / "saved", text_encoder_3=None, tokenizer_3=None, local_files_only=True
    )
    embeddings, _, pooled, _ = pipeline.encode_prompt(
        "a photo of a cup", None, None, do_classifier_free_guidance=False, device="cpu"
    )
    arguments = prompt_arguments(base_model.unet, table[:1])
    torch.testing.assert_close(arguments["encoder_hidden_states"], embeddings)
    torch.testing.assert_close(arguments["pooled_projections"], pooled)


def test_a_table_of_values_is_made_with_flow_matching_too(sd3):
    base_model = load_base_model(sd3, with_controlnet=False)
    random = np.random.default_rng(0)
    frames = random.integers(0, 256, (4, SIDE, SIDE, 3), np.uint8)
    table = encode_prompts(base_model, ["a cup"]).expand(4, -1, -1)
    latents = torch.zeros((4, 4, 4, 4))
    found = fit_value_table(base_model, frames, latents, table, timestep=100, seed=0)
    assert found.shape == (256, 256) and np.allclose(found.sum(axis=1), 1, atol=1e-4)


def test_latents_that_are_noised_and_denoised_come_back():
    """With the exact denoiser of one image, and of a normal distribution in many small steps."""
    schedule = noise_schedule(CONFIG)
    latents = torch.randn((3, 1, 8, 8), generator=torch.Generator().manual_seed(0)) * 0.3 + 0.5
    times = denoising_times(600, 600)
    noisy = noise_to(latents, 600, schedule, [1, 2, 3])

    def only_one(state, time):
        return (state - 3.0) / (time / 1000)

    torch.testing.assert_close(denoise(noisy, times, schedule, only_one), torch.full_like(noisy, 3.0))
    signal, spread = schedule.mixture(600)
    assert signal == pytest.approx(1 - spread)

    def normal(state, time):
        sigma = time / 1000
        variance = (1 - sigma) ** 2 * 0.09 + sigma**2
        clean = 0.5 + (1 - sigma) * 0.09 / variance * (state - (1 - sigma) * 0.5)
        return (state - clean) / sigma

    # The flow keeps how many standard deviations from the mean a value is.
    scale = (signal**2 * 0.09 + spread**2) ** 0.5
    expected = 0.5 + 0.3 * (noisy - signal * 0.5) / scale
    torch.testing.assert_close(denoise(noisy, times, schedule, normal), expected, atol=1e-2, rtol=0)  # of first order


def test_what_is_made_for_u_nets_alone_is_refused_by_name(sd3, tmp_path):
    with pytest.raises(DataError, match="made for Stable Diffusion v1, 2 and XL; this base model is a transformer"):
        NoiseSchedule(CONFIG)
    base_model = load_base_model(sd3, with_controlnet=False)
    table = encode_prompts(base_model, ["a cup", ""])
    with pytest.raises(DataError, match="autoguidance_scale is made for U-Nets"):
        sample_latents(
            base_model, table[:1], table[1:], None, [0], SamplingOptions(autoguidance_scale=2.0, num_inference_steps=2)
        )
    with pytest.raises(DataError, match="a student is made for Stable Diffusion v1"):
        distil(
            sd3, Conditions(("a cup",)), StudentOptions(num_steps=1), guidance=SamplingOptions(), seed=0,
            work=tmp_path / "work", out=tmp_path / "out",
        )  # fmt: skip


def test_what_does_not_fit_is_named(sd3, tmp_path):
    refused, config = partial(check_refusal, sd3, tmp_path / "broken"), with_entries

    def schedule(**entries):
        return config("scheduler", "scheduler_config.json", **entries)

    def without(name):
        return lambda folder: shutil.rmtree(folder / name)

    refused("expected SD3Transformer2DModel", config("transformer", _class_name="FluxTransformer2DModel"))
    refused("missing: tokenizer_2", without("tokenizer_2"))
    refused("its tokenizer_3 is missing", without("tokenizer_3"))
    refused("must be one of CLIPTextModelWithProjection", config("text_encoder", architectures=["CLIPTextModel"]))
    refused("must be one of T5EncoderModel", config("text_encoder_3", architectures=["UMT5EncoderModel"]))
    refused("transformer takes 4 latent channels, .* makes 16", config("vae", latent_channels=16))
    refused("multiple of patch_size 2 of at most 16, got 5", config("transformer", sample_size=5))
    refused("of at most 16, got 64", config("transformer", sample_size=64))
    refused("must be a FlowMatchEulerDiscreteScheduler, got PNDM", schedule(_class_name="PNDMScheduler"))
    refused("use_dynamic_shifting", schedule(use_dynamic_shifting=True))
    refused("shift of the scheduler must be a positive number, got 0", schedule(shift=0))
    refused("takes neither prompt nor positions", config("controlnet", joint_attention_dim=None))
    refused("takes a mask beside its image", config("controlnet", extra_conditioning_channels=1))
    refused("expected 1 to 3 layers", config("controlnet", num_layers=4))
    refused("says joint_attention_dim 40", config("transformer", joint_attention_dim=40))
    refused("says pooled_projection_dim 40", config("transformer", pooled_projection_dim=40))
    refused("expected tokenizer.json", lambda folder: (folder / "tokenizer_3" / "tokenizer.json").unlink())


def test_shifting_keeps_the_ends_and_goes_back():
    sigma = torch.linspace(0, 1, 11, dtype=torch.float64)
    moved = shifted(sigma, 3.0)
    assert moved[0] == 0 and moved[-1] == 1 and bool((moved[1:-1] > sigma[1:-1]).all())
    torch.testing.assert_close(shifted(moved, 1 / 3), sigma)
