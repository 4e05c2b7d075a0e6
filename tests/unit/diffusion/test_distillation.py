"""Targets of a student are exact where the teacher's equation is solved, and students are ordinary checkpoints."""

import json
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.models.controlnets.controlnet import ControlNetModel
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from diffusers.schedulers.scheduling_tcd import TCDScheduler
from pydantic import ValidationError
from tiny_base_model import make_base_model, make_data

from ctlev_core.diffusion.denoising import Batch, Denoiser, NoiseSchedule
from ctlev_core.diffusion.pretrained.loading import conditions_to_tensor, load_base_model, save_base_model
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.sampling import decode_frames, sample_latents
from ctlev_core.diffusion.sampling.schedulers import student_config
from ctlev_core.diffusion.student_files import distilled_evaluations
from ctlev_core.diffusion.training.distillation import Distillation, TrajectorySteps, distil
from ctlev_core.diffusion.training.options import StudentOptions
from ctlev_core.generators import controlnet, stable_diffusion
from ctlev_core.supervised.checkpoints import read_training_state
from ctlev_core.trained_generator import load_generator
from data_contracts.errors import DataError

CONFIG: dict[str, Any] = {
    "num_train_timesteps": 1000,
    "beta_start": 0.00085,
    "beta_end": 0.02,
    "beta_schedule": "scaled_linear",
    "prediction_type": "sample",
}
KINDS = ["sample", "epsilon", "v_prediction"]
MEAN, SPREAD = 0.4, 0.7
PLAIN = SamplingOptions()
OPTIONS = StudentOptions(
    num_evaluations=2, num_steps=6, batch_size=4, log_every=2, validation_every=3, checkpoint_every_s=1e-6
)


def gaussian(schedule, spread):
    """The perfect network for latents of N(MEAN, spread^2), by Bayes' rule."""

    def predict(noisy, timestep):
        alpha_bar = schedule.alphas_cumprod[int(timestep)].double()
        variance = alpha_bar * spread**2 + 1 - alpha_bar
        clean = MEAN + alpha_bar.sqrt() * spread**2 / variance * (noisy - alpha_bar.sqrt() * MEAN)
        noise = (noisy - alpha_bar.sqrt() * clean) / (1 - alpha_bar).sqrt()
        velocity = alpha_bar.sqrt() * noise - (1 - alpha_bar).sqrt() * clean
        return {"sample": clean, "epsilon": noise, "v_prediction": velocity}[schedule.prediction_type]

    return predict


def exact_map(schedule, noise, start, stop, spread):
    """Where the probability-flow equation of the Gaussian takes states: the flow keeps how many deviations off one is.

    `stop` None is without noise.
    """
    here, there = (1.0 if step is None else float(schedule.alphas_cumprod[step]) for step in (start, stop))
    deviations = (noise - here**0.5 * MEAN) / (here * spread**2 + 1 - here) ** 0.5
    return there**0.5 * MEAN + (there * spread**2 + 1 - there) ** 0.5 * deviations


def draw(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 2, 4])
def test_the_teacher_follows_the_exact_solution(kind, count):
    steps = TrajectorySteps.make(CONFIG | {"prediction_type": kind}, count, 200)
    noise = draw(50, 1, 2, 2)
    states = steps.follow(noise, gaussian(steps.schedule, SPREAD))
    assert len(states) == count + 1 and torch.equal(states[0], noise)
    for step, state in zip((*steps.student[1:], None), states[1:], strict=True):
        # The last jump goes from the schedule's lowest noise to the mean; elsewhere the solver's errors, of order 2.
        expected = exact_map(steps.schedule, noise, steps.student[0], step, SPREAD)
        assert (state - expected).abs().max() < (2e-3 if step is None else 5e-4)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_steps_of_the_scheduler_of_diffusers_from_the_targets_end_in_the_exact_solution(kind, count):
    """What a student that has learnt all would sample, in plain diffusers."""
    config = CONFIG | {"prediction_type": kind}
    steps = TrajectorySteps.make(config, count, 8)
    scheduler: Any = TCDScheduler.from_config(student_config(config, count))
    scheduler.set_timesteps(count)
    assert tuple(scheduler.timesteps.tolist()) == steps.student
    state = noise = draw(20, 1, 2, 2)
    stops = (*steps.student[1:], None)
    for number, (step, stop) in enumerate(zip(steps.student, stops, strict=True)):
        following = exact_map(steps.schedule, noise, steps.student[0], stop, SPREAD)
        predicted = steps.target(state, following, number)
        state = scheduler.step(predicted, step, state, eta=0.0).prev_sample
        # float32 tables of the schedule; from the noise at time step 999 an image is a difference 66 times as large.
        assert (state - following).abs().max() < 2e-5


def test_targets_of_a_point_are_the_point():
    """Whatever the solver: all states lie on straight lines to it. The last step leaves the noise of time step 0."""
    steps = TrajectorySteps.make(CONFIG, 4, 12)
    noise = draw(6, 1, 2, 2)
    states = steps.follow(noise, gaussian(steps.schedule, 0.0))
    for number in range(3):
        target = steps.target(states[number], states[number + 1], number)
        assert (target - MEAN).abs().max() < 1e-5
    assert (states[-1] - MEAN).abs().max() < 1e-12


@pytest.mark.parametrize(("count", "more"), [(1, 2), (1, 40), (2, 3), (3, 5), (4, 12), (8, 2), (8, 200)])
def test_time_steps_of_the_teacher_hold_those_of_the_student(count, more):
    steps = TrajectorySteps.make(CONFIG, count, more)
    assert set(steps.student) < set(steps.teacher) and steps.teacher[-1] == 0
    assert list(steps.teacher) == sorted(set(steps.teacher), reverse=True)
    assert len(steps.student) == count and steps.student[0] == (1000 // count) * count - 1
    assert len(steps.teacher) <= max(count, more + count - 1) + 1


@pytest.mark.parametrize("kind", KINDS)
def test_predictions_and_clean_latents_are_each_the_inverse_of_the_other(kind):
    schedule = NoiseSchedule(CONFIG | {"prediction_type": kind})
    clean, noisy, timesteps = draw(3, 2, 2, 2), draw(3, 2, 2, 2, seed=1), torch.tensor([10, 400, 900])
    again = schedule.clean_of(schedule.prediction_of(clean, noisy, timesteps), noisy, timesteps)
    torch.testing.assert_close(again, clean, rtol=0, atol=2e-5)
    alpha_bar = schedule.alphas_cumprod.double()[timesteps][:, None, None, None]
    noise = (noisy - alpha_bar.sqrt() * clean) / (1 - alpha_bar).sqrt()
    expected = {"sample": clean, "epsilon": noise, "v_prediction": alpha_bar.sqrt() * noise
                - (1 - alpha_bar).sqrt() * clean}[kind]  # fmt: skip
    torch.testing.assert_close(schedule.prediction_of(clean, noisy, timesteps), expected, rtol=0, atol=1e-4)


# Distillation and sampling, with the tiny base model.


@pytest.fixture(scope="module")
def teacher(tmp_path_factory):
    folder = tmp_path_factory.mktemp("teacher") / "checkpoint"
    save_base_model(make_base_model(), folder)
    return folder


def train(checkpoint, folder, options=OPTIONS, *, with_images=True, guidance=PLAIN, count=24):
    folder.mkdir(exist_ok=True)
    _, conditions = make_data(count, with_images=with_images)
    return distil(
        checkpoint, conditions, options, guidance=guidance, seed=3, out=folder / "checkpoint", work=folder / "work"
    )


@pytest.fixture(scope="module")
def student(teacher, tmp_path_factory):
    folder = tmp_path_factory.mktemp("student")
    train(teacher, folder)
    return folder / "checkpoint"


def files_of(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.slow
def test_a_killed_distillation_ends_the_same(tmp_path, teacher, student, monkeypatch):
    from ctlev_core.diffusion.training import loop

    save = loop._save

    def killed(trainer, *arguments):
        save(trainer, *arguments)
        if trainer.step == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(loop, "_save", killed)
    with pytest.raises(KeyboardInterrupt):
        train(teacher, tmp_path)
    assert not (tmp_path / "checkpoint").exists()
    assert read_training_state(tmp_path / "work" / "state.pt", "cpu")["step"] == 3
    monkeypatch.setattr(loop, "_save", save)
    train(teacher, tmp_path)
    assert files_of(tmp_path / "checkpoint") == files_of(student)


def test_what_learns(tmp_path, teacher, student):
    before, both = files_of(teacher), files_of(student)
    changed = {name for name in before if both[name] != before[name]}
    weights = {f"{name}/diffusion_pytorch_model.safetensors" for name in ("unet", "controlnet")}
    assert changed == {*weights, "model_index.json", "scheduler/scheduler_config.json"}
    assert both.keys() == before.keys()
    train(teacher, tmp_path, OPTIONS.model_copy(update={"tune": "unet"}))
    alone = files_of(tmp_path / "checkpoint")
    assert {name for name in weights if alone[name] != before[name]} == {"unet/diffusion_pytorch_model.safetensors"}


@torch.no_grad()
def test_plain_diffusers_samples_what_we_sample(tmp_path, student):
    """Networks and scheduler as diffusers loads them from the folder, in a loop as that of its pipelines."""
    unet: Any = UNet2DConditionModel.from_pretrained(student / "unet")
    steering: Any = ControlNetModel.from_pretrained(student / "controlnet")
    index = json.loads((student / "model_index.json").read_text())
    assert index["scheduler"] == ["diffusers", "TCDScheduler"]
    scheduler: Any = TCDScheduler.from_pretrained(student / "scheduler")
    scheduler.set_timesteps(2)
    base_model = load_base_model(student)
    _, conditions = make_data(3)
    images = conditions_to_tensor(conditions.images)
    embeddings = encode_prompts(base_model, list(conditions.prompts))
    seeds = [5, 6, 7]
    channels, side = unet.config.in_channels, unet.config.sample_size
    state = torch.stack(
        [torch.randn((channels, side, side), generator=torch.Generator().manual_seed(s)) for s in seeds]
    )
    for timestep in scheduler.timesteps:
        down, middle = steering(state, timestep, embeddings, images, return_dict=False)
        predicted = unet(
            state,
            timestep,
            embeddings,
            down_block_additional_residuals=down,
            mid_block_additional_residual=middle,
        ).sample
        state = scheduler.step(predicted, timestep, state, eta=0.0).prev_sample
    options = SamplingOptions(scheduler="tcd", num_inference_steps=2, black_threshold=0)
    ours = sample_latents(base_model, embeddings, embeddings[:1], images, seeds, options)
    torch.testing.assert_close(ours, state, rtol=0, atol=1e-5)
    frames = controlnet.sample(student, conditions, controlnet.SampleOptions(**options.model_dump()), seeds=seeds,
                               work=tmp_path)  # fmt: skip
    assert np.abs(frames.astype(int) - decode_frames(base_model, state, options)).max() <= 1
    # Each row by itself is the same.
    alone = controlnet.sample(student, conditions.take(slice(1, 2)), controlnet.SampleOptions(**options.model_dump()),
                              seeds=seeds[1:2], work=tmp_path)  # fmt: skip
    assert np.abs(frames[1:2].astype(int) - alone).max() <= 1


@torch.no_grad()
def distance(folder, teacher, count):
    """Root mean square distance of what is sampled in `count` evaluations from what the teacher samples in 60."""
    _, conditions = make_data(8, seed=9)
    images, seeds = conditions_to_tensor(conditions.images), range(8)
    reference = load_base_model(teacher)
    embeddings = encode_prompts(reference, list(conditions.prompts))
    own = {"scheduler": "tcd"} if distilled_evaluations(folder) else {}
    made, expected = (
        sample_latents(model, embeddings, embeddings[:1], images, seeds, options)
        for model, options in (
            (load_base_model(folder), SamplingOptions(num_inference_steps=count, **own)),
            (reference, SamplingOptions(num_inference_steps=60)),
        )
    )
    return float((made - expected).square().mean().sqrt())


@pytest.mark.slow
def test_a_student_is_nearer_to_its_teacher_than_the_teacher_in_as_few_evaluations(tmp_path, teacher):
    options = OPTIONS.model_copy(
        update={
            "num_steps": 40,
            "batch_size": 8,
            "learning_rate": 5e-3,
            "warmup_steps": 0,
            "ema_decay": 0.8,
            "checkpoint_every_s": 60.0,
        }
    )
    train(teacher, tmp_path, options)
    assert distance(tmp_path / "checkpoint", teacher, 2) < 0.8 * distance(teacher, teacher, 2)


@torch.no_grad()
def test_guidance_of_the_teacher_is_followed(teacher):
    """Guided predictions by hand, of networks called with and without their prompts."""
    base_model = load_base_model(teacher)
    _, conditions = make_data(3)
    images = conditions_to_tensor(conditions.images)
    embeddings = encode_prompts(base_model, [*conditions.prompts, ""])
    steps = TrajectorySteps.make(base_model.scheduler_config, 2, 4)
    denoiser = Denoiser(base_model.unet, base_model.controlnet)
    batch = Batch(draw(3, base_model.unet.config.in_channels, 4, 4).float(), embeddings[:-1], images)

    def guided(noisy, timestep):
        timesteps = timestep.expand(len(noisy))
        plain = denoiser.predict(noisy, timesteps, embeddings[-1:].expand(3, -1, -1), images)
        if timestep < 0.3 * 999:
            return denoiser.predict(noisy, timesteps, embeddings[:-1], images)
        return plain + 4 * (denoiser.predict(noisy, timesteps, embeddings[:-1], images) - plain)

    guidance = SamplingOptions(guidance_scale=4.0, guidance_interval=(0.3, 1.0))
    found = {
        scale: Distillation(base_model, denoiser, steps, embeddings[-1:], options).states(batch)
        for scale, options in ((4, guidance), (1, PLAIN))
    }
    for ours, expected in zip(found[4], steps.follow(batch.latents, guided), strict=True):
        torch.testing.assert_close(ours, expected, rtol=0, atol=1e-4)
    assert (found[4][-1] - found[1][-1]).abs().max() > 1e-2, "guidance has no effect here, so nothing was compared"


def test_a_student_says_how_it_is_sampled(student, teacher):
    assert distilled_evaluations(student) == 2 and distilled_evaluations(teacher) is None
    generator = load_generator(student)
    assert generator.defaults == {"scheduler": "tcd", "num_inference_steps": 2}
    _, conditions = make_data(2)
    assert generator.sample(conditions.prompts, images=conditions.images).shape == (2, 16, 16, 3)
    with pytest.raises(DataError, match="distilled for scheduler 'tcd' in num_inference_steps 2, got 'tcd' in 4"):
        generator.sample(conditions.prompts, images=conditions.images, num_inference_steps=4)
    with pytest.raises(DataError, match="distilled for scheduler 'tcd' in num_inference_steps 2, got 'unipc' in 2"):
        generator.sample(conditions.prompts, images=conditions.images, scheduler="unipc")
    with pytest.raises(DataError, match="scheduler 'tcd' is for distilled checkpoints, and this one was not"):
        load_generator(teacher).sample(conditions.prompts, images=conditions.images, scheduler="tcd")


def test_what_does_not_fit_is_refused(tmp_path, teacher):
    for changes, message in (
        ({"scheduler": "tcd", "guidance_scale": 2.0}, "takes no guidance_scale"),
        ({"scheduler": "tcd", "controlnet_every": 2}, "takes no controlnet_every"),
        ({"scheduler": "tcd", "timestep_spacing": "karras"}, "does not support timestep_spacing 'karras'"),
    ):
        with pytest.raises(ValidationError, match=message):
            SamplingOptions(**changes)
    for changes in ({"snr_gamma": 5.0}, {"timestep_power": 2.0}, {"max_loss_weight": 20.0}, {"sample_every": 5}):
        with pytest.raises(ValidationError, match="a student learns from trajectories"):
            StudentOptions(**changes)
    with pytest.raises(DataError, match="rot90_probability turns square condition images, and there are none"):
        train(teacher, tmp_path / "a", OPTIONS.model_copy(update={"rot90_probability": 0.5}), with_images=False)
    with pytest.raises(DataError, match="at least one condition, got none"):
        train(teacher, tmp_path / "b", count=0)


def test_options_leave_room_for_whole_trajectories():
    assert [StudentOptions(num_evaluations=4, batch_size=size).trajectories_at_a_time for size in (1, 4, 7, 8)] == [
        1, 1, 1, 2,
    ]  # fmt: skip


def test_the_text_route_too(tmp_path, teacher):
    train(teacher, tmp_path, with_images=False)
    _, conditions = make_data(2, with_images=False)
    options = stable_diffusion.SampleOptions(scheduler="tcd", num_inference_steps=2)
    frames = stable_diffusion.sample(tmp_path / "checkpoint", conditions, options, seeds=[1, 2], work=tmp_path)
    assert frames.shape == (2, 16, 16, 3)
    assert not (tmp_path / "checkpoint" / "controlnet").exists()
