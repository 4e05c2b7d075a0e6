"""Every family of base models: loaded, sampled as diffusers' pipeline does, trained, resumed, saved, and reloaded."""

import dataclasses
import shutil
from functools import partial

import numpy as np
import pytest
import torch
from diffusers import DiffusionPipeline
from tiny_families import FAMILIES, POOLED, check_refusal, with_entries, write_family
from tiny_stable_diffusion import SIDE
from transformers import T5Config, T5EncoderModel

from ctlev_core.diffusion.denoising import Denoiser
from ctlev_core.diffusion.pretrained.loading import conditions_to_tensor, load_base_model, save_base_model
from ctlev_core.diffusion.pretrained.prompts import encode_prompts, prompt_arguments
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.sampling import sample_latents
from ctlev_core.diffusion.sampling.schedulers import make_scheduler
from ctlev_core.diffusion.training import loop
from ctlev_core.diffusion.training.finetuning import fine_tune
from ctlev_core.diffusion.training.options import FineTuningOptions
from ctlev_core.generators import controlnet, stable_diffusion
from data_contracts.labels import Conditions

OPTIONS = FineTuningOptions(
    num_steps=4, batch_size=2, warmup_steps=0, num_validation=0, ema_decay=0.0, prompt_dropout=0.5, log_every=2
)
SAMPLING = SamplingOptions(scheduler="unipc", num_inference_steps=4, guidance_scale=3.0)
PROMPTS = ["a photo of a cup", "a photo of a ball"]
ROUTES = {"text": (stable_diffusion, "unet"), "ControlNet": (controlnet, "both")}


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=pytest.mark.slow) if name in ("v2", "xl") else name for name in FAMILIES],
)
def family(request, tmp_path_factory):
    return write_family(request.param, tmp_path_factory.mktemp(request.param) / request.param)


@pytest.fixture
def xl(tmp_path):
    return write_family("xl", tmp_path / "xl")


def make_data(route, count=8):
    random = np.random.default_rng(0)
    frames = random.integers(0, 256, (count, SIDE, SIDE, 3), np.uint8)
    prompts = tuple(PROMPTS[row % 2] for row in range(count))
    return frames, Conditions(prompts, frames[::-1].copy() if route == "ControlNet" else None)


def ours(base_model, images, options=SAMPLING):
    table = encode_prompts(base_model, [*PROMPTS, ""])
    return sample_latents(base_model, table[:2], table[2:], images, [0, 1], options)


def of_diffusers(folder, base_model, images, options=SAMPLING, lora=None):
    pipeline = DiffusionPipeline.from_pretrained(folder, local_files_only=True)
    if lora is not None:
        pipeline.load_lora_weights(lora)
    pipeline.set_progress_bar_config(disable=True)
    pipeline.scheduler = make_scheduler(
        options.scheduler, base_model.scheduler_config, options.num_inference_steps, options.timestep_spacing
    )
    if not isinstance(pipeline.scheduler.timesteps[0].item(), int):
        # The pipeline would set them anew, rounded, and at other places.
        pipeline.scheduler.set_timesteps = lambda *_, **__: None
    noise = [torch.randn((4, SIDE // 8, SIDE // 8), generator=torch.Generator().manual_seed(seed)) for seed in (0, 1)]
    further = {} if images is None else {"image": images}
    if images is not None and hasattr(pipeline, "transformer"):
        further = {"control_image": 2 * images - 1}  # tensors go to the autoencoder as they are
    return pipeline(
        PROMPTS, latents=torch.stack(noise), num_inference_steps=options.num_inference_steps, height=SIDE, width=SIDE,
        guidance_scale=options.guidance_scale, output_type="latent", **further,
    ).images  # fmt: skip


@pytest.mark.parametrize("route", ROUTES)
def test_diffusers_samples_the_same(family, tmp_path, route):
    base_model = load_base_model(family, with_controlnet=route == "ControlNet")
    assert base_model.zero_empty_prompt == (family.name == "xl")
    images = torch.rand((2, 3, SIDE, SIDE), generator=torch.Generator().manual_seed(3)) if route != "text" else None
    for zeros in {base_model.zero_empty_prompt, False}:
        base_model = dataclasses.replace(base_model, zero_empty_prompt=zeros)
        save_base_model(base_model, tmp_path / str(zeros))
        for guidance_scale in (1.0, 3.0):
            options = SAMPLING.model_copy(update={"guidance_scale": guidance_scale})
            found = ours(base_model, images, options)
            assert found.std() > 0.1
            torch.testing.assert_close(found, of_diffusers(tmp_path / str(zeros), base_model, images, options))


def test_t5_keeps_in_float16_what_its_own_library_keeps_in_float32(tmp_path):
    """Where the last layers of its feed-forward networks overflow in half precision, as those of the published T5."""
    folder = write_family("sd3", tmp_path / "sd3")
    config = T5Config(
        vocab_size=200, d_model=32, d_kv=8, num_heads=2, d_ff=32, num_layers=2, feed_forward_proj="gated-gelu"
    )
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        encoder = T5EncoderModel(config).eval()
        for block in encoder.encoder.block:
            layers = block.layer[1].DenseReluDense
            layers.wi_0.weight *= 25
            layers.wi_1.weight *= 25
            layers.wo.weight *= 300
    encoder.save_pretrained(folder / "text_encoder_3")

    def embedded(dtype):
        return encode_prompts(load_base_model(folder, dtype=dtype, with_controlnet=False), PROMPTS[:1]).float()

    exact, half = embedded(torch.float32), embedded(torch.float16)
    assert (half - exact).square().mean().sqrt() < 0.01 * exact.square().mean().sqrt()


@pytest.mark.parametrize("route", ROUTES)
def test_training_killed_and_resumed_ends_in_the_same_weights(family, tmp_path, monkeypatch, route):
    _, tune = ROUTES[route]
    frames, conditions = make_data(route)

    def train(work, checkpoint_every_s):
        base_model = load_base_model(family, with_controlnet=route == "ControlNet")
        before = {name: value.clone() for name, value in base_model.unet.state_dict().items()}
        options = OPTIONS.model_copy(update={"checkpoint_every_s": checkpoint_every_s})
        history = fine_tune(base_model, frames, conditions, options, tune=tune, seed=3, work=work)
        return before, base_model.unet.state_dict(), history

    before, whole, history = train(tmp_path / "whole", 300)
    original, calls = loop.Trainer.update, []

    def die(self, progress):
        calls.append(progress)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return original(self, progress)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(loop.Trainer, "update", die)
        train(tmp_path / "killed", 1e-9)
    _, resumed, again = train(tmp_path / "killed", 300)
    assert history.loss == again.loss and all(np.isfinite(history.loss))
    assert any(not torch.equal(value, before[name]) for name, value in whole.items())
    assert all(torch.equal(value, resumed[name]) for name, value in whole.items())


@pytest.mark.parametrize("route", ROUTES)
def test_checkpoints_of_generators_load_here_and_in_diffusers(family, tmp_path, route):
    module, _ = ROUTES[route]
    frames, conditions = make_data(route)
    options = module.Options(base_model=family, device="cpu", **OPTIONS.model_dump(include={"num_steps", "batch_size"}))
    module.train(frames, conditions, options, seed=0, work=tmp_path / "work", out=tmp_path / "made")
    checkpoint = next(path.parent for path in (tmp_path / "made").rglob("model_index.json"))
    base_model = load_base_model(checkpoint)
    images = None if route == "text" else conditions_to_tensor(conditions.images[:2])
    torch.testing.assert_close(ours(base_model, images), of_diffusers(checkpoint, base_model, images))
    names = {path.name for path in checkpoint.iterdir()}
    assert ("text_encoder_2" in names) == ("tokenizer_2" in names) == (family.name in ("xl", "sd3"))
    assert ("text_encoder_3" in names) == ("transformer" in names) == ("unet" not in names) == (family.name == "sd3")


def test_every_part_of_an_xl_prompt_counts(xl):
    base_model = load_base_model(xl)
    table = encode_prompts(base_model, ["a cup", "a ball", ""])
    assert table.shape == (3, 16 + 1, 32)
    arguments = prompt_arguments(base_model.unet, table)
    assert arguments["encoder_hidden_states"].shape == (3, 16, 32)
    added = arguments["added_cond_kwargs"]
    assert added["text_embeds"].shape == (3, POOLED)
    assert added["time_ids"].tolist() == [[SIDE, SIDE, 0, 0, SIDE, SIDE]] * 3
    assert not table[2, :16].any() and not added["text_embeds"][2].any()
    noisy, timesteps = torch.randn((1, 4, 4, 4), generator=torch.Generator().manual_seed(0)), torch.tensor([500])
    denoiser, image = Denoiser(base_model.unet, base_model.controlnet), torch.rand(1, 3, SIDE, SIDE)
    expected = denoiser.predict(noisy, timesteps, table[:1], image)
    for place in ((0, 3, 2), (0, 3, 25), (0, 16, 5), (0, 16, POOLED), (0, 16, POOLED + 4)):
        changed = table[:1].clone()
        changed[place] += 1
        assert not torch.equal(denoiser.predict(noisy, timesteps, changed, image), expected), place


def test_what_does_not_fit_an_xl_model_is_named(xl, tmp_path):
    refused, config = partial(check_refusal, xl, tmp_path / "broken"), with_entries

    refused("its tokenizer_2 is missing", lambda folder: shutil.rmtree(folder / "tokenizer_2"))
    refused(
        r"second text encoder \(text_encoder_2\) is missing", lambda folder: shutil.rmtree(folder / "text_encoder_2")
    )
    refused("takes one text encoder, but there is a second", config("unet", addition_embed_type=None))
    refused(
        "addition_embed_type must be null, text or text_time, got 'image'", config("unet", addition_embed_type="image")
    )
    refused(
        f"takes pooled embeddings {POOLED + 6} wide, the text encoder of .*text_encoder_2 makes {POOLED}",
        config("unet", addition_time_embed_dim=3),
    )
    refused("must be one of CLIPTextModelWithProjection", config("text_encoder_2", architectures=["T5EncoderModel"]))


def test_a_small_addition_loads_in_diffusers(family, tmp_path):
    frames, conditions = make_data("text")
    options = stable_diffusion.Options(
        base_model=family, device="cpu", lora_rank=2, learning_rate=5e-2, **OPTIONS.model_dump(include={"num_steps"})
    )
    stable_diffusion.train(frames, conditions, options, seed=0, work=tmp_path / "work", out=tmp_path / "made")
    adapter = next(path.parent for path in (tmp_path / "made").rglob("adapter.json"))
    save_base_model(load_base_model(family, with_controlnet=False), tmp_path / "saved")
    plain, changed = (load_base_model(place, with_controlnet=False) for place in (tmp_path / "saved", adapter))
    expected = ours(changed, None)
    assert not torch.allclose(ours(plain, None), expected, atol=1e-2)
    torch.testing.assert_close(
        of_diffusers(tmp_path / "saved", changed, None, lora=adapter), expected, rtol=1e-3, atol=1e-4
    )
