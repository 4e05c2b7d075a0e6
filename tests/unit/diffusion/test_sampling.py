"""A frame depends on its own condition and seed, whatever else is sampled with it."""

import dataclasses

import numpy as np
import pytest
import torch
from tiny_base_model import SIDE, make_base_model, make_data, shared_base_model

from ctlev_core.diffusion.pretrained.loading import load_base_model, save_base_model
from ctlev_core.diffusion.pretraining.architecture import break_zeros
from ctlev_core.diffusion.sampling import sampling, shards
from ctlev_core.diffusion.sampling.options import STOCHASTIC, SamplingOptions
from ctlev_core.diffusion.sampling.sampling import cached_condition_embedding, decode_frames, sample_frames
from ctlev_core.generators import controlnet, stable_diffusion
from data_contracts.labels import Conditions

FAST = SamplingOptions(num_inference_steps=3, batch_size=4, black_threshold=0)
SEEDS = [7, 1, 7, 3, 5, 2]


def conditions_of(count=6):
    return make_data(count, seed=4)[1]


def take(conditions, rows):
    return Conditions(tuple(conditions.prompts[row] for row in rows), conditions.images[rows])


@pytest.mark.parametrize("scheduler", ["unipc", *STOCHASTIC])
def test_rows_do_not_depend_on_the_batch(tmp_path, scheduler):
    options = SamplingOptions(scheduler=scheduler, num_inference_steps=3, batch_size=4, black_threshold=0)
    conditions = conditions_of()
    together = sample_frames(shared_base_model(), conditions, options, seeds=SEEDS, work=tmp_path / "a")
    single = options.model_copy(update={"batch_size": 1})
    rows = [4, 0, 5]
    alone = sample_frames(
        shared_base_model(), take(conditions, rows), single, seeds=[SEEDS[row] for row in rows], work=tmp_path / "b"
    )
    # Convolutions may sum in another order for another batch size: one grey level.
    assert np.abs(alone.astype(int) - together[rows].astype(int)).max() <= 1


def test_seed_and_condition_matter_and_repeat(tmp_path):
    conditions = take(conditions_of(), [0, 0, 0, 1])
    frames = sample_frames(shared_base_model(), conditions, FAST, seeds=[1, 1, 2, 1], work=tmp_path)
    assert np.array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], frames[2])
    assert not np.array_equal(frames[0], frames[3])


def test_killed_run_reuses_finished_shards(tmp_path, monkeypatch):
    monkeypatch.setattr(shards, "SHARD", 2)
    conditions = conditions_of()
    whole = sample_frames(shared_base_model(), conditions, FAST, seeds=SEEDS, work=tmp_path / "whole")
    calls = []
    original = sampling.sample_latents

    def counted(*arguments):
        if len(calls) == 2:
            raise KeyboardInterrupt
        calls.append(arguments)
        return original(*arguments)

    monkeypatch.setattr(sampling, "sample_latents", counted)
    with pytest.raises(KeyboardInterrupt):
        sample_frames(shared_base_model(), conditions, FAST, seeds=SEEDS, work=tmp_path / "killed")
    calls[:] = [None]
    resumed = sample_frames(shared_base_model(), conditions, FAST, seeds=SEEDS, work=tmp_path / "killed")
    assert len(calls) == 2, "only the last of three shards was still to be sampled"
    assert np.array_equal(resumed, whole)


def test_shards_of_other_options_or_checkpoints_are_not_reused(tmp_path):
    conditions = conditions_of(2)
    first = sample_frames(shared_base_model(), conditions, FAST, seeds=[0, 1], work=tmp_path, identity="a")
    monochrome = FAST.model_copy(update={"palette": "grey"})
    assert not np.array_equal(
        first, sample_frames(shared_base_model(), conditions, monochrome, seeds=[0, 1], work=tmp_path, identity="a")
    )
    other = make_base_model(seed=1)
    assert not np.array_equal(first, sample_frames(other, conditions, FAST, seeds=[0, 1], work=tmp_path, identity="b"))


@pytest.mark.parametrize("order", ["rgb", "bgr"])
def test_cached_condition_embedding_is_exact(order):
    network = make_base_model().controlnet.eval()
    network.register_to_config(controlnet_conditioning_channel_order=order)
    break_zeros(network)
    noisy, embeddings = torch.randn(2, 48, 4, 4), torch.randn(2, 24, 64)
    images = torch.rand(2, 3, SIDE, SIDE)

    def residuals():
        with torch.no_grad():
            return network(noisy, 10, encoder_hidden_states=embeddings, controlnet_cond=images, return_dict=False)[1]

    plain = residuals()
    original = network.controlnet_cond_embedding
    with torch.no_grad(), cached_condition_embedding(network, images):
        assert torch.equal(residuals(), plain)
    assert network.controlnet_cond_embedding is original


def test_dark_level_and_palette():
    base_model = shared_base_model()
    images = torch.tensor([10.0, 30.0, 200.0])[None, :, None, None].expand(1, 3, 8, 8) / 127.5 - 1
    latents = base_model.vae.encode(images)[0].mode() * base_model.scaling_factor
    colour = decode_frames(base_model, latents, SamplingOptions(black_threshold=20))
    assert colour[0, 0, 0].tolist() == [0, 30, 200]
    grey = decode_frames(base_model, latents, SamplingOptions(black_threshold=20, palette="grey"))
    assert grey[0, 0, 0].tolist() == [80, 80, 80]
    red_blue = decode_frames(base_model, latents, SamplingOptions(black_threshold=0, palette="red_blue"))
    assert red_blue[0, 0, 0].tolist() == [10, 0, 200]
    beyond = decode_frames(base_model, 3 * latents, SamplingOptions(black_threshold=0))
    assert beyond[0, 0, 0, 2] == 255, "values are clipped, not wrapped"


def test_guidance_of_one_is_no_guidance_and_more_changes_frames(tmp_path):
    conditions = conditions_of(2)
    plain = sample_frames(shared_base_model(), conditions, FAST, seeds=[0, 1], work=tmp_path)
    guided = sample_frames(
        shared_base_model(), conditions, FAST.model_copy(update={"guidance_scale": 4.0}), seeds=[0, 1], work=tmp_path
    )
    barely = sample_frames(
        shared_base_model(),
        conditions,
        FAST.model_copy(update={"guidance_scale": 1.000001}),
        seeds=[0, 1],
        work=tmp_path,
    )
    assert np.abs(plain.astype(int) - barely.astype(int)).max() <= 1
    assert not np.array_equal(plain, guided)


@pytest.mark.parametrize("images", [True, False])
def test_guidance_interval_guides_the_steps_within_it(tmp_path, images):
    """Nowhere is without guidance, everywhere with it, and the noisier half is the loop written out."""
    conditions = conditions_of(2) if images else Conditions(conditions_of(2).prompts, None)
    base_model = shared_base_model() if images else dataclasses.replace(shared_base_model(), controlnet=None)

    def frames(name, **changed):
        return sample_frames(
            base_model, conditions, FAST.model_copy(update=changed), seeds=[0, 1], work=tmp_path / name
        )

    guided = {"guidance_scale": 4.0, "num_inference_steps": 6, "timestep_spacing": "linspace"}
    nowhere = frames("nowhere", **guided, guidance_interval=(0.99999, 0.99999))
    assert np.array_equal(nowhere, frames("none", **guided | {"guidance_scale": 1.0}))
    everywhere = frames("everywhere", **guided, guidance_interval=(0.0, 1.0))
    assert np.array_equal(everywhere, frames("default", **guided))
    half = FAST.model_copy(update=guided | {"guidance_interval": (0.5, 1.0)})
    tensors = sampling.conditions_to_tensor(conditions.images) if images else None
    table = sampling.encode_prompts(base_model, [*conditions.prompts, ""])
    latents = sampling.sample_latents(base_model, table[:2], table[2:], tensors, [0, 1], half)
    torch.testing.assert_close(latents, guided_by_hand(base_model, table, tensors, half), atol=1e-4, rtol=1e-4)
    assert not torch.allclose(
        latents, guided_by_hand(base_model, table, tensors, FAST.model_copy(update=guided)), atol=1e-2
    )


@torch.no_grad()
def guided_by_hand(base_model, table, images, options):
    """Two images of seeds 0 and 1, one at a time, the prompt and the empty one in passes of their own."""
    made = []
    for seed in (0, 1):
        scheduler = sampling.make_scheduler(
            options.scheduler, base_model.scheduler_config, options.num_inference_steps, options.timestep_spacing
        )
        state = torch.randn((1, 48, 4, 4), generator=torch.Generator().manual_seed(seed)) * scheduler.init_noise_sigma
        condition = None if images is None else images[seed : seed + 1]
        for timestep in scheduler.timesteps:
            denoiser = sampling.Denoiser(base_model.unet, base_model.controlnet)
            prompted, plain = (
                denoiser.predict(state, timestep[None], table[row : row + 1], condition) for row in (seed, 2)
            )
            if timestep / 999 >= options.guidance_interval[0]:
                prompted = plain + options.guidance_scale * (prompted - plain)
            state = scheduler.step(prompted, timestep, state).prev_sample
        made.append(state)
    return torch.cat(made)


@pytest.mark.parametrize("interval", [(0.6, 0.4), (-0.1, 1.0), (0.0, 1.1)])
def test_a_guidance_interval_lies_within_the_schedule(interval):
    with pytest.raises(ValueError, match="guidance_interval must be"):
        SamplingOptions(guidance_interval=interval)


def test_low_precision_keeps_the_state_in_float32(tmp_path):
    base_model = make_base_model()
    base_model.unet.to(torch.bfloat16), base_model.controlnet.to(torch.bfloat16), base_model.vae.to(torch.bfloat16)
    base_model.text_encoder.to(torch.bfloat16)
    images = sampling.conditions_to_tensor(conditions_of(2).images)
    table = sampling.encode_prompts(base_model, ["a", ""])
    latents = sampling.sample_latents(base_model, table[[0, 0]], table[-1:], images, [0, 1], FAST)
    assert latents.dtype == torch.float32
    assert bool(torch.isfinite(latents).all())


def test_wrong_conditions_are_named(tmp_path):
    base_model, conditions = shared_base_model(), conditions_of(2)
    with pytest.raises(ValueError, match="got 1 seeds for 2 conditions"):
        sample_frames(base_model, conditions, FAST, seeds=[0], work=tmp_path)
    with pytest.raises(ValueError, match="takes condition images, got none"):
        sample_frames(base_model, Conditions(("a",)), FAST, seeds=[0], work=tmp_path)
    with pytest.raises(ValueError, match=r"must be \[1, 16, 16, 3\] uint8"):
        sample_frames(base_model, Conditions(("a",), np.zeros((1, 8, 8, 3), np.uint8)), FAST, seeds=[0], work=tmp_path)
    no_rows = sample_frames(
        base_model, Conditions((), np.zeros((0, 16, 16, 3), np.uint8)), FAST, seeds=[], work=tmp_path
    )
    assert no_rows.shape == (0, 16, 16, 3)


@pytest.mark.parametrize("module", [stable_diffusion, controlnet])
def test_generators_train_and_sample(tmp_path, module):
    """The plug-ins end to end, on a tiny base model of their own."""
    save_base_model(make_base_model(), tmp_path / "base_model")
    frames, conditions = make_data(with_images=module is controlnet)
    options = module.Options(
        base_model=tmp_path / "base_model", num_steps=3, batch_size=2, num_validation=0, log_every=1
    )
    assert module.base_model_folders(options) == [tmp_path / "base_model"]
    history = module.train(frames, conditions, options, seed=0, out=tmp_path / "checkpoint", work=tmp_path / "work")
    assert history.step == [1, 2, 3]
    checkpoint = load_base_model(tmp_path / "checkpoint")
    assert (checkpoint.controlnet is not None) == (module is controlnet)
    settings = module.SampleOptions(num_inference_steps=2, palette="grey")
    sampled = module.sample(
        tmp_path / "checkpoint", conditions, settings, seeds=range(len(frames)), work=tmp_path / "shards"
    )
    assert sampled.shape == frames.shape and sampled.dtype == np.uint8
    assert np.array_equal(sampled[..., 0], sampled[..., 2])


def test_generators_refuse_the_other_kind_of_condition(tmp_path):
    frames, with_images = make_data(2)
    folders = {"out": tmp_path / "out", "work": tmp_path / "work"}
    with pytest.raises(ValueError, match="takes prompts only"):
        stable_diffusion.train(frames, with_images, stable_diffusion.Options(), seed=0, **folders)
    with pytest.raises(ValueError, match="needs condition images"):
        controlnet.train(frames, Conditions(with_images.prompts), controlnet.Options(), seed=0, **folders)
