"""Memory that runs out, half precision, empty and saturated images, reused residuals, shared noise."""

import dataclasses
import json
import logging
from typing import Any

import numpy as np
import pytest
import torch
from tiny_base_model import SIDE, make_base_model, make_data, shared_base_model

from ctlev_core.diffusion.patch_autoencoder import PatchAutoencoder
from ctlev_core.diffusion.pretrained.loading import images_to_tensor, save_base_model
from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL
from ctlev_core.diffusion.sampling import sampling
from ctlev_core.diffusion.sampling.options import STOCHASTIC, SamplingOptions, noise_seeds
from ctlev_core.diffusion.sampling.out_of_memory import is_out_of_memory
from ctlev_core.diffusion.sampling.sampling import decode_frames, sample_checkpoint, sample_frames, sample_latents
from data_contracts.errors import DataError
from data_contracts.labels import Conditions

FAST = SamplingOptions(num_inference_steps=3, batch_size=4, black_threshold=0)
SEEDS = [7, 1, 7, 3, 5, 2]


def options_of(**changes):
    return SamplingOptions.model_validate(FAST.model_dump(exclude={"timestep_spacing"}) | changes)


class Network:
    """A U-Net or ControlNet with something in the way; counts its calls."""

    def __init__(self, network, before=lambda noisy: None):
        self._network, self._before, self.batches = network, before, []

    def __getattr__(self, name):
        return getattr(self._network, name)

    def __call__(self, noisy, *arguments, **named):
        self.batches.append(len(noisy))
        self._before(noisy)
        return self._network(noisy, *arguments, **named)


def raising(error, limit):
    def before(noisy):
        if len(noisy) > limit:
            raise error

    return before


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Frames [6, H, W, 3] as sampled where memory does not run out."""
    work = tmp_path_factory.mktemp("whole")
    return sample_frames(shared_base_model(), make_data(6, seed=4)[1], FAST, seeds=SEEDS, work=work)


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
        RuntimeError("CUDA error: out of memory"),
        RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: can't allocate memory: you tried to ..."),
        MemoryError(),
    ],
)
def test_batches_are_halved_where_memory_runs_out(tmp_path, caplog, whole, error):
    conditions = make_data(6, seed=4)[1]
    unet = Network(shared_base_model().unet, raising(error, limit=1))
    failing = dataclasses.replace(shared_base_model(), unet=unet)
    with caplog.at_level(logging.WARNING):
        frames = sample_frames(failing, conditions, FAST, seeds=SEEDS, work=tmp_path / "halved")
    # Convolutions may sum in another order for another batch size: one grey level.
    assert np.abs(frames.astype(int) - whole.astype(int)).max() <= 1
    assert [record.args[:2] for record in caplog.records] == [(4, 2), (2, 1)]
    # 4 and 2 fail at their first step, then six images take three steps each: nothing is tried again.
    assert unet.batches == [4, 2] + [1] * 18


def test_what_was_sampled_is_not_sampled_again_for_a_decoder_that_takes_more_memory(tmp_path, monkeypatch, whole):
    conditions, unet = make_data(6, seed=4)[1], Network(shared_base_model().unet)
    decode, asked = sampling.decode_latents, []

    def narrow(base_model, latents):
        asked.append(len(latents))
        if len(latents) > 1:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return decode(base_model, latents)

    monkeypatch.setattr(sampling, "decode_latents", narrow)
    base_model = dataclasses.replace(shared_base_model(), unet=unet)
    frames = sample_frames(base_model, conditions, FAST, seeds=SEEDS, work=tmp_path / "narrow")
    assert np.abs(frames.astype(int) - whole.astype(int)).max() <= 1
    assert unet.batches == [4] * 3 + [2] * 3 and asked == [4, 2] + [1] * 6


def test_a_single_image_too_large_is_an_error_that_says_so(tmp_path):
    conditions = make_data(2, seed=4)[1]
    unet = Network(shared_base_model().unet, raising(torch.OutOfMemoryError("CUDA out of memory."), limit=0))
    failing = dataclasses.replace(shared_base_model(), unet=unet)
    with pytest.raises(torch.OutOfMemoryError) as caught:
        sample_frames(failing, conditions, FAST, seeds=[0, 1], work=tmp_path)
    assert "one image does not fit" in caught.value.__notes__[0]
    assert unet.batches == [2, 1]


def test_other_errors_are_not_mistaken_for_memory(tmp_path):
    conditions = make_data(2, seed=4)[1]
    unet = Network(shared_base_model().unet, raising(RuntimeError("shapes do not match"), limit=0))
    failing = dataclasses.replace(shared_base_model(), unet=unet)
    with pytest.raises(RuntimeError, match="shapes do not match"):
        sample_frames(failing, conditions, FAST, seeds=[0, 1], work=tmp_path)
    assert unet.batches == [2]
    assert not is_out_of_memory(ValueError("out of memory")) and is_out_of_memory(MemoryError())


@pytest.mark.parametrize(("every", "calls"), [(1, 5), (2, 3), (3, 2), (9, 1)])
def test_controlnet_every_k_steps(tmp_path, every, calls):
    conditions = make_data(2, seed=4)[1]
    controlnet: Any = Network(shared_base_model().controlnet)
    # The embedding is exchanged on the network itself, not on its stand-in.
    controlnet.controlnet_cond_embedding = shared_base_model().controlnet.controlnet_cond_embedding
    base_model = dataclasses.replace(shared_base_model(), controlnet=controlnet)
    options = options_of(num_inference_steps=5, controlnet_every=every)
    frames = sample_frames(base_model, conditions, options, seeds=[0, 1], work=tmp_path / "a")
    assert len(controlnet.batches) == calls
    plain = sample_frames(
        shared_base_model(), conditions, options_of(num_inference_steps=5), seeds=[0, 1], work=tmp_path / "b"
    )
    assert np.array_equal(frames, plain) == (every == 1)


@pytest.mark.parametrize("scheduler", ["unipc", *STOCHASTIC])
def test_shared_noise_is_the_first_rows(tmp_path, scheduler):
    motion = make_data(4, seed=4)[1]
    still = Conditions((motion.prompts[0],) * 4, np.repeat(motion.images[:1], 4, axis=0))
    options = options_of(scheduler=scheduler, noise="shared")
    frames = sample_frames(shared_base_model(), still, options, seeds=[3, 1, 4, 1], work=tmp_path / "still")
    assert all(np.array_equal(frame, frames[0]) for frame in frames), "equal conditions, equal frames"
    frames = sample_frames(shared_base_model(), motion, options, seeds=[3, 1, 4, 1], work=tmp_path / "motion")
    # A row by itself: its condition and the seed it was drawn with are enough, and say nothing of the others.
    alone = Conditions(motion.prompts[2:3], motion.images[2:3])
    seed = noise_seeds([3, 1, 4, 1], options)[2]
    own = sample_frames(
        shared_base_model(), alone, options_of(scheduler=scheduler), seeds=[seed], work=tmp_path / "alone"
    )
    assert np.abs(own[0].astype(int) - frames[2].astype(int)).max() <= 1  # another batch size: one grey level
    independent = options_of(scheduler=scheduler)
    drawn = sample_frames(shared_base_model(), still, independent, seeds=[3, 1, 4, 1], work=tmp_path / "still")
    assert np.array_equal(drawn[1], drawn[3]) and not np.array_equal(drawn[0], drawn[1])


def test_noise_of_stretches_is_that_of_their_first_rows(tmp_path):
    options = options_of(noise="stretches")
    assert noise_seeds([3, 1, 4, 1, 5], options, [2, 3]) == [3, 3, 4, 4, 4]
    assert noise_seeds([3, 1, 4], options) == noise_seeds([3, 1, 4], options_of(), [2, 1]) == [3, 1, 4]
    conditions = make_data(5, seed=4)[1]
    stretches = dataclasses.replace(conditions, stretches=("a", "a", "b", "b", "b"))
    frames = sample_frames(shared_base_model(), stretches, options, seeds=[3, 1, 4, 1, 5], work=tmp_path)
    plain = sample_frames(shared_base_model(), conditions, options_of(), seeds=[3, 3, 4, 4, 4], work=tmp_path)
    np.testing.assert_array_equal(frames, plain)


def test_shards_of_shared_noise_are_named_by_the_seed_that_counts(tmp_path):
    conditions, options = make_data(4, seed=4)[1], options_of(noise="shared")
    first = sample_frames(shared_base_model(), conditions, options, seeds=[3, 1, 4, 1], work=tmp_path)
    again = sample_frames(shared_base_model(), conditions, options, seeds=[3, 5, 9, 2], work=tmp_path)
    assert np.array_equal(first, again) and len(list(tmp_path.glob("shard_*.npy.zst"))) == 1
    other = sample_frames(shared_base_model(), conditions, options, seeds=[5, 1, 4, 1], work=tmp_path)
    assert not np.array_equal(first, other) and len(list(tmp_path.glob("shard_*.npy.zst"))) == 2


def event_images(side=64):
    """Nothing, everything, one polarity everywhere, single pixels, and counts of all sizes."""
    images = np.zeros((7, side, side, 3), np.uint8)
    images[1], images[2, ..., 0], images[3, ..., 2] = 255, 255, 255
    random = np.random.default_rng(0)
    images[4, ..., 0], images[4, ..., 2] = (255 * (random.random((2, side, side)) < 0.05)).astype(np.uint8)
    images[5, side // 2, side // 2] = 255
    images[6] = random.integers(0, 256, (side, side, 3))
    return images


@pytest.fixture(scope="module")
def bundled_config() -> Any:
    return PatchAutoencoder.from_pretrained(BUNDLED_BASE_MODEL / "vae").config


@pytest.mark.parametrize(
    # Grey levels of 255. Sums are accumulated in float32; in bfloat16 they then lose what is below 1 / 256 of them. The
    # mean of a white block is 11 in latents, rounded by up to 1 / 32: .0045 for each of its 48 values, where half a
    # level is .0039. A few values in a hundred end on the next level.
    ("dtype", "worst_level", "worst_mean"),
    [(torch.float32, 0, 0.0), (torch.float16, 0, 0.0), (torch.bfloat16, 1, 0.04)],
)
def test_extreme_images_through_the_bundled_code_and_back(bundled_config, dtype, worst_level, worst_mean):
    code: Any = PatchAutoencoder.from_config(bundled_config)
    code.to(dtype)
    images = event_images()
    latents = code.encode(images_to_tensor(images).to(dtype))[0].mode()
    # Multiplied and divided as in training and sampling, where the latents are float32.
    latents = (latents.float() * code.config.scaling_factor) / code.config.scaling_factor
    back = code.decode(latents.to(dtype))[0].float()
    assert bool(torch.isfinite(back).all())
    levels = ((back + 1) * 127.5).clamp(0, 255).round().to(torch.uint8).permute(0, 2, 3, 1).numpy()
    error = np.abs(levels.astype(int) - images.astype(int))
    assert error.max() <= worst_level
    assert error.mean() <= worst_mean


@pytest.mark.usefixtures("native_bfloat16")
@pytest.mark.parametrize("precision", ["float16", "bfloat16"])
def test_low_precision_is_that_of_the_networks_alone(tmp_path, precision):
    save_base_model(make_base_model(), tmp_path / "base_model")
    conditions = make_data(2, seed=4)[1]

    def sample(precision):
        options = options_of(precision=precision, device="cpu")
        work = tmp_path / precision
        return sample_checkpoint(
            tmp_path / "base_model", conditions, options, with_controlnet=True, seeds=[0, 1], work=work
        )

    # A random network after three steps; 8 bits of mantissa in every layer. Another image would differ by 60 levels.
    difference = np.abs(sample(precision).astype(int) - sample("float32").astype(int))
    assert 0 < difference.mean() < (1.0 if precision == "float16" else 6.0)


def test_black_stays_black_in_half_precision():
    """The latents of an empty image, decoded as samples are, with networks in half precision: no event anywhere."""
    code: Any = PatchAutoencoder.from_pretrained(BUNDLED_BASE_MODEL / "vae")
    base_model = dataclasses.replace(shared_base_model(), vae=code)
    images = event_images()
    latents = code.encode(images_to_tensor(images))[0].mode() * base_model.scaling_factor
    assert np.array_equal(decode_frames(base_model, latents, SamplingOptions(black_threshold=0)), images)


def test_an_autoencoder_that_overflows_is_run_in_float32(caplog):
    """What lies within is beyond float16's 65504 here; in Stable Diffusion's larger autoencoders it is."""

    class Decoder(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = torch.nn.Parameter(torch.tensor(6e4, dtype=torch.float16))

        @property
        def dtype(self):
            return self.weight.dtype

        @property
        def config(self):
            return shared_base_model().vae.config

        def decode(self, latents):
            images = (latents * self.weight * 4) / (4 * self.weight)
            return type("Decoded", (), {"sample": images[:, :3]})

    base_model = dataclasses.replace(shared_base_model(), vae=Decoder())
    with caplog.at_level(logging.WARNING), torch.no_grad():
        frames = decode_frames(base_model, torch.ones(1, 48, 4, 4) * base_model.scaling_factor, SamplingOptions())
    assert (frames == 255).all() and "decodes them again in float32" in caplog.text


def test_latents_that_are_not_finite_are_an_error():
    base_model = dataclasses.replace(shared_base_model(), unet=Network(shared_base_model().unet, poison))
    embeddings = torch.zeros(1, 24, 64)
    images = torch.zeros(1, 3, SIDE, SIDE)
    with pytest.raises(FloatingPointError, match=r"unipc and networks in torch\.float32 are not finite"):
        sample_latents(base_model, embeddings, embeddings, images, [0], FAST)


def poison(noisy):
    noisy[:] = float("inf")


def test_a_schedule_that_cannot_be_sampled_is_refused_before_anything_is_loaded(tmp_path):
    """The folder holds nothing but the scheduler's config: any loading would complain about that first."""
    config = shared_base_model().scheduler_config | {"prediction_type": "epsilon", "rescale_betas_zero_snr": True}
    place = tmp_path / "scheduler" / "scheduler_config.json"
    place.parent.mkdir()
    place.write_text(json.dumps(config))
    with pytest.raises(DataError, match=r"scheduler_config.json: .* expected v_prediction or sample"):
        sample_checkpoint(tmp_path, Conditions(("a",)), FAST, with_controlnet=False, seeds=[0], work=tmp_path / "work")
    place.write_text(json.dumps(shared_base_model().scheduler_config))
    with pytest.raises(DataError, match="missing: tokenizer"):
        sample_checkpoint(tmp_path, Conditions(("a",)), FAST, with_controlnet=False, seeds=[0], work=tmp_path / "work")
