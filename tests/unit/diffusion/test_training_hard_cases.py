"""What is wrong with data, base model or gradients is named, and nothing of it gets into the weights."""

import dataclasses
import logging
import math
import re

import numpy as np
import pytest
import torch
from tiny_base_model import CORPUS, make_base_model, make_data, shared_base_model

from ctlev_core.diffusion.denoising import Denoiser, NoiseSchedule, denoising_loss, generator_for
from ctlev_core.diffusion.pretrained.fit import check_channel_order
from ctlev_core.diffusion.pretrained.loading import save_base_model
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.sampling import sample_frames
from ctlev_core.diffusion.training import latent_files, trainer
from ctlev_core.diffusion.training.distributed import DistributedContext
from ctlev_core.diffusion.training.entry import train_checkpoint
from ctlev_core.diffusion.training.finetuning import fine_tune
from ctlev_core.diffusion.training.latent_cache import cache_latents, check_cache
from ctlev_core.diffusion.training.options import FineTuningOptions
from data_contracts.config import ConditionChoice
from data_contracts.errors import DataError, TrainingError
from data_contracts.labels import Conditions

OPTIONS = FineTuningOptions(num_steps=4, batch_size=2, warmup_steps=1, log_every=1, num_validation=0, ema_decay=0.5)
FRAMES, CONDITIONS = make_data(4)


def tuned(work, base_model=None, frames=FRAMES, conditions=CONDITIONS, options=OPTIONS):
    base_model = base_model or make_base_model()
    return base_model, fine_tune(base_model, frames, conditions, options, tune="both", seed=0, work=work)


def finite(base_model):
    parameters = [*base_model.unet.parameters(), *base_model.controlnet.parameters()]
    return all(bool(torch.isfinite(value).all()) for value in parameters)


@pytest.mark.parametrize("network", ["unet", "controlnet", "vae", "text_encoder"])
def test_weights_of_the_base_model_that_are_not_finite_are_named(tmp_path, network):
    base_model = make_base_model()
    key, tensor = next(
        (key, tensor) for key, tensor in getattr(base_model, network).state_dict().items() if tensor.ndim
    )
    tensor.view(-1)[-1] = math.nan
    save_base_model(base_model, tmp_path / "base_model")
    options = OPTIONS.model_copy(update={"base_model": tmp_path / "base_model"})
    folders = {"out": tmp_path / "out", "work": tmp_path / "work"}
    with pytest.raises(DataError, match=rf"{network}.*{re.escape(key)}.* not finite"):
        train_checkpoint(FRAMES, CONDITIONS, options, tune="both", with_controlnet=True, seed=0, **folders)
    assert not any(folder.exists() for folder in folders.values())


def test_latents_that_are_not_finite_name_their_frame(tmp_path):
    """Half-precision autoencoders overflow on saturated frames; the weights are all finite then."""
    base_model = make_base_model()
    frames = FRAMES.copy()
    frames[2] = 255
    encode = base_model.vae.encode

    def overflowing(images):
        posterior = encode(images)
        saturated = (images == 1).flatten(1).all(dim=1)
        posterior.latent_dist.mean[saturated, 0, 0, 0] = math.inf
        return posterior

    base_model.vae.encode = overflowing
    with pytest.raises(DataError, match="frame 2 of 4: the mean of its latents must be finite"):
        tuned(tmp_path, base_model, frames)


def test_embeddings_that_are_not_finite_name_their_prompt(tmp_path, monkeypatch):
    from ctlev_core.diffusion.training import latent_cache

    def broken(base_model, prompts):
        embeddings = encode_prompts(base_model, prompts)
        embeddings[prompts.index("a photo of a cup"), 0, 0] = math.nan
        return embeddings

    monkeypatch.setattr(latent_cache, "encode_prompts", broken)
    with pytest.raises(DataError, match="prompt 'a photo of a cup': its embedding is not finite"):
        tuned(tmp_path)


@pytest.mark.parametrize("batch_size", [1, 4])
def test_a_single_image_can_be_learnt(tmp_path, batch_size):
    options = OPTIONS.model_copy(
        update={"num_steps": 24, "batch_size": batch_size, "num_validation": 8, "learning_rate": 3e-3}
    )
    base_model, history = tuned(tmp_path, frames=FRAMES[:1], conditions=CONDITIONS.take(slice(0, 1)), options=options)
    assert finite(base_model) and history.validation_loss == []  # no frame is left to be held back
    assert np.mean(history.loss[-8:]) < np.mean(history.loss[:8])


def test_prompts_beyond_the_tokenizers_limit_are_cut_off_and_named(caplog):
    base_model = shared_base_model()
    limit = base_model.tokenizer.model_max_length
    long = "a photo of a cup " * limit
    with caplog.at_level(logging.WARNING):
        cache = cache_latents(base_model, FRAMES[:2], Conditions((long, "a photo of a ball")))
    (record,) = caplog.records
    assert repr(long) in record.getMessage() and f"cut to {limit}" in record.getMessage()
    # A word is a token here, and two are taken by the marks around them.
    kept = " ".join(long.split()[: limit - 2])
    ordered = sorted([long, "a photo of a ball"])
    torch.testing.assert_close(cache.embeddings[ordered.index(long)], encode_prompts(base_model, [kept])[0])
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        cache_latents(base_model, FRAMES[:2], Conditions(CORPUS[:2]))
    assert not caplog.records


@pytest.mark.parametrize(("times", "noticed"), [(0.1, True), (1.0, False), (10.0, True)])
def test_a_scaling_factor_that_does_not_fit_the_latents_is_noticed(caplog, times, noticed):
    cache = cache_latents(shared_base_model(), FRAMES, CONDITIONS)
    with caplog.at_level(logging.WARNING):
        check_cache(dataclasses.replace(cache, scaling_factor=times * cache.scaling_factor), CONDITIONS)
    assert [f"{times * cache.scaling_factor:g}" in record.getMessage() for record in caplog.records] == [True] * noticed


def overflow_at(monkeypatch, steps):
    """One gradient becomes infinite at the given steps; the loss stays finite."""
    original = trainer.Trainer.update

    def update(self, progress):
        if self.step in steps:
            self.parameters[0].grad.view(-1)[0] = math.inf
        return original(self, progress)

    monkeypatch.setattr(trainer.Trainer, "update", update)


def test_a_gradient_that_overflows_changes_nothing(tmp_path, monkeypatch):
    steps = OPTIONS.model_copy(update={"num_steps": 3})
    with monkeypatch.context() as patch:
        overflow_at(patch, {0, 2})
        base_model, history = tuned(tmp_path / "some", options=steps)
    assert finite(base_model)
    assert [math.isfinite(loss) for loss in history.loss] == [False, True, False]
    state = torch.load(tmp_path / "some" / "state.pt", weights_only=True)
    assert state["skipped"] == 2 and state["non_finite"] == 1
    # Adam counts the steps it made: one.
    assert {int(value["step"]) for value in state["optimizer"]["state"].values()} == {1}


def test_gradients_that_always_overflow_end_the_run(tmp_path, monkeypatch):
    overflow_at(monkeypatch, set(range(30)))
    with pytest.raises(TrainingError, match="gradient was not finite 10 times in a row, the last at step 9"):
        tuned(tmp_path, options=OPTIONS.model_copy(update={"num_steps": 30}))


def test_ten_in_a_row_are_counted_across_a_kill(tmp_path, monkeypatch):
    """Otherwise a run that is killed again and again would never say that it learns nothing."""
    overflow_at(monkeypatch, set(range(30)))
    first = OPTIONS.model_copy(update={"num_steps": 30, "checkpoint_every_s": 1e-9})
    with pytest.raises(TrainingError, match="the last at step 9"):
        tuned(tmp_path, options=first)
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    assert state["step"] == 9 and state["non_finite"] == 9
    with pytest.raises(TrainingError, match="10 times in a row, the last at step 9"):
        tuned(tmp_path, options=first)


def test_empty_and_saturated_frames_can_be_learnt(tmp_path):
    frames = FRAMES.copy()
    frames[0], frames[1] = 0, 255
    base_model, history = tuned(tmp_path, frames=frames, conditions=dataclasses.replace(CONDITIONS, images=frames))
    assert finite(base_model) and all(math.isfinite(loss) for loss in history.loss)


@pytest.mark.parametrize(("order", "convention"), [("bgr", "controlnet"), ("rgb", "controlnet_unreversed")])
def test_colours_that_are_exchanged_twice_or_never_are_refused(tmp_path, order, convention):
    base_model = make_base_model()
    base_model.controlnet.register_to_config(controlnet_conditioning_channel_order=order)
    asked = ConditionChoice(name="normals", options={"convention": convention})
    with pytest.raises(DataError, match=f"convention '{convention}' does not fit .* '{order}'; set condition.options"):
        tuned(tmp_path, base_model=base_model, conditions=dataclasses.replace(CONDITIONS, made_by=asked))
    check_channel_order("bgr" if order == "rgb" else "rgb", asked)
    check_channel_order(order, ConditionChoice(name="skeleton"))
    check_channel_order(order, None)


def test_latents_are_encoded_fewer_at_a_time_where_memory_runs_out(monkeypatch):
    base_model, encoded = make_base_model(), []
    whole = cache_latents(base_model, FRAMES, CONDITIONS)
    encode = base_model.vae.encode

    def narrow(images):
        encoded.append(len(images))
        if len(images) > 1:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return encode(images)

    monkeypatch.setattr(base_model.vae, "encode", narrow)
    cache = cache_latents(base_model, FRAMES, CONDITIONS, num_turns=4)
    assert encoded == [4, 2, *[1] * 16]
    torch.testing.assert_close(cache.latents.mean[:4], whole.latents.mean)


def with_deviations(base_model, monkeypatch):
    """The base model's code is without noise; here as if it had some."""
    encode = latent_files.encode_posterior

    def encode_with_deviations(vae, images):
        mean, _ = encode(vae, images)
        return mean, mean.abs() + 1

    monkeypatch.setattr(latent_files, "encode_posterior", encode_with_deviations)
    return base_model


def test_latents_on_disk_are_those_in_memory_and_are_encoded_once(tmp_path, monkeypatch):
    base_model = with_deviations(make_base_model(), monkeypatch)
    whole = cache_latents(base_model, FRAMES, CONDITIONS, num_turns=4)
    stored = cache_latents(base_model, FRAMES, CONDITIONS, num_turns=4, folder=tmp_path)
    np.testing.assert_array_equal(stored.latents.mean, whole.latents.mean)
    np.testing.assert_array_equal(stored.latents.std, whole.latents.std)
    rows, turns = np.array([3, 0, 2]), np.array([0, 3, 1])
    batches = [
        cache.batch(rows, torch.Generator().manual_seed(0), 0.0, torch.device("cpu"), turns).latents
        for cache in (whole, stored)
    ]
    torch.testing.assert_close(*batches, rtol=0, atol=0)

    def refuse(images):
        raise AssertionError("encoded again")

    monkeypatch.setattr(base_model.vae, "encode", refuse)
    again = cache_latents(base_model, FRAMES, CONDITIONS, num_turns=4, folder=tmp_path)
    np.testing.assert_array_equal(again.latents.mean, whole.latents.mean)
    for other in (FRAMES[::-1], FRAMES[:3]):  # a run of other frames does not take them for its own
        with pytest.raises(AssertionError, match="encoded again"):
            cache_latents(base_model, other, CONDITIONS, num_turns=4, folder=tmp_path)


def test_each_process_encodes_its_share_of_the_frames(tmp_path, monkeypatch):
    """Process 1 of 3 finds the shares of the others, which have been here before; together they are the whole."""
    monkeypatch.setattr(latent_files, "ENCODE_BATCH", 1)
    base_model, taken = with_deviations(make_base_model(), monkeypatch), []
    whole = cache_latents(base_model, FRAMES, CONDITIONS, num_turns=4)
    encode = base_model.vae.encode
    monkeypatch.setattr(base_model.vae, "encode", lambda images: taken.append(len(images)) or encode(images))
    monkeypatch.setattr(DistributedContext, "wait", lambda self: None)
    for rank in (0, 2):
        with pytest.raises(FileNotFoundError):  # that they wait for one another is tested with processes
            cache_latents(
                base_model, FRAMES, CONDITIONS, num_turns=4, folder=tmp_path, distributed=DistributedContext(rank, 3)
            )
    taken.clear()
    cache = cache_latents(
        base_model, FRAMES, CONDITIONS, num_turns=4, folder=tmp_path, distributed=DistributedContext(1, 3)
    )
    assert sum(taken) == 4 * 2, "two of the four frames in four turns"
    torch.testing.assert_close(np.asarray(cache.latents.mean), whole.latents.mean)
    torch.testing.assert_close(np.asarray(cache.latents.std), whole.latents.std)


def test_larger_frames_are_encoded_fewer_at_a_time(monkeypatch):
    base_model, taken = with_deviations(make_base_model(), monkeypatch), []
    encode = base_model.vae.encode
    monkeypatch.setattr(base_model.vae, "encode", lambda images: taken.append(len(images)) or encode(images))
    for side, limit in ((16, 3 * 16**2), (32, 16**2)):
        monkeypatch.setattr(latent_files, "ENCODE_PIXELS", limit)
        latent_files.latents_in_memory(base_model.vae, np.zeros((4, side, side, 3), np.uint8), 1)
    assert taken == [3, 1, 1, 1, 1, 1]


def test_many_prompts_are_embedded_some_at_a_time(monkeypatch):
    base_model, taken = make_base_model(), []
    prompts = [f"a photo of a {word}" for word in ("cup", "ball", "human", "moving")]
    whole = encode_prompts(base_model, prompts)
    monkeypatch.setattr("ctlev_core.diffusion.pretrained.prompts.PROMPT_BATCH", 3)
    base_model.text_encoder.register_forward_pre_hook(lambda module, inputs: taken.append(len(inputs[0])))
    torch.testing.assert_close(encode_prompts(base_model, prompts), whole)
    assert taken == [3, 1]


def test_a_controlnet_that_exchanges_colours_is_handed_them_as_they_are(tmp_path):
    """Once in its own forward pass; exchanged before, too, it would be trained on what it is never asked with."""
    base_model, seen = make_base_model(), []
    base_model.controlnet.register_to_config(controlnet_conditioning_channel_order="bgr")
    base_model.controlnet.controlnet_cond_embedding.register_forward_pre_hook(
        lambda module, inputs: seen.append(inputs[0])
    )
    red = np.zeros_like(FRAMES)
    red[..., 0] = 255
    batch = cache_latents(base_model, FRAMES, Conditions(CONDITIONS.prompts, red)).batch(
        np.arange(2), torch.Generator().manual_seed(0), 0.0, torch.device("cpu")
    )
    denoising_loss(
        Denoiser(base_model.unet, base_model.controlnet),
        NoiseSchedule(base_model.scheduler_config),
        batch,
        generator_for(0),
    )
    sample_frames(
        base_model, Conditions(("a",), red[:1]), SamplingOptions(num_inference_steps=1), seeds=[0], work=tmp_path
    )
    assert [image.mean(dim=(0, 2, 3)).tolist() for image in seen] == [[0.0, 0.0, 1.0]] * 2
