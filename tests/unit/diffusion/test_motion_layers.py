"""Motion layers compute what diffusers' `UNetMotionModel` does, change nothing before they have learnt, and learn."""

import dataclasses
import itertools
import json
import shutil

import numpy as np
import pytest
import torch
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from diffusers.models.unets.unet_motion_model import MotionAdapter, UNetMotionModel
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from tiny_base_model import SIDE, make_base_model, make_data

from ctlev_core.diffusion.denoising import mix_noise
from ctlev_core.diffusion.motion_files import MotionSettings, has_motion_layers, read_settings
from ctlev_core.diffusion.motion_layers import (
    MotionLayers,
    load_motion_layers,
    new_adapter,
    pyramid,
    save_motion_layers,
    window_starts,
)
from ctlev_core.diffusion.pretrained.loading import load_base_model, save_base_model
from ctlev_core.diffusion.sampling import sampling
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.schedulers import make_scheduler
from ctlev_core.diffusion.training.motion_training import train_motion_layers
from ctlev_core.diffusion.training.options import MotionOptions
from ctlev_core.generators import controlnet
from ctlev_core.supervised.checkpoints import read_training_state
from data_contracts.errors import DataError

SETTINGS = MotionSettings(context=4, interval_us=20_000, shared_noise=0.0)
FAST = SamplingOptions(num_inference_steps=3, batch_size=8, black_threshold=0)
COUNT, LENGTH = 24, 6


def make_unet():
    """Of the blocks and layers of Stable Diffusion's, narrow."""
    torch.manual_seed(0)
    unet = UNet2DConditionModel(
        sample_size=8,
        block_out_channels=(32, 64),
        layers_per_block=2,
        cross_attention_dim=16,
        attention_head_dim=8,
        norm_num_groups=8,
        down_block_types=("CrossAttnDownBlock2D", "DownBlock2D"),
        up_block_types=("UpBlock2D", "CrossAttnUpBlock2D"),
    )
    return unet.eval()


def random_adapter(unet, deviation=0.1):
    """As if it had learnt something."""
    adapter = new_adapter(unet, 1)
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for parameter in adapter.parameters():
            parameter.copy_(deviation * torch.randn(parameter.shape, generator=generator))
    return adapter.eval()


def inputs(count):
    generator = torch.Generator().manual_seed(3)
    return torch.randn(count, 4, 8, 8, generator=generator), torch.randn(1, 5, 16, generator=generator).expand(
        count, 5, 16
    )


@torch.no_grad()
def predict(unet, noisy, embeddings):
    return unet(noisy, torch.tensor(300), encoder_hidden_states=embeddings).sample


def test_they_compute_what_the_motion_model_of_diffusers_does():
    unet = make_unet()
    adapter = random_adapter(unet)
    reference = UNetMotionModel.from_unet2d(unet, adapter).eval()
    layers = MotionLayers(unet, adapter, SETTINGS)
    noisy, embeddings = inputs(8)
    alone = predict(unet, noisy, embeddings)
    with layers.of([4, 4]):
        ours = predict(unet, noisy, embeddings)
    as_video = noisy.unflatten(0, (2, 4)).transpose(1, 2)
    theirs = predict(reference, as_video, embeddings).transpose(1, 2).flatten(0, 1)
    assert (ours - theirs).abs().max() < 1e-5
    assert (ours - alone).abs().max() > 0.1, "the layers have no effect here, so nothing was compared"


def test_new_layers_change_nothing_and_without_a_stretch_none_do():
    unet = make_unet()
    noisy, embeddings = inputs(4)
    before = predict(unet, noisy, embeddings)
    layers = MotionLayers(unet, new_adapter(unet, 5), SETTINGS)
    with layers.of([4]):
        assert torch.equal(predict(unet, noisy, embeddings), before)
    learnt = make_unet()
    MotionLayers(learnt, random_adapter(learnt), SETTINGS)
    assert torch.equal(predict(learnt, noisy, embeddings), before)


@pytest.mark.parametrize("lengths", [[4, 4], [3, 5], [1, 7], [2, 2, 4]])
def test_a_stretch_does_not_depend_on_those_beside_it(lengths):
    unet = make_unet()
    layers = MotionLayers(unet, random_adapter(unet), SETTINGS)
    noisy, embeddings = inputs(8)
    with layers.of(lengths):
        together = predict(unet, noisy, embeddings)
        both = predict(unet, torch.cat([noisy, noisy]), torch.cat([embeddings, embeddings]))
    assert (both - torch.cat([together, together])).abs().max() < 1e-5, "guidance takes all stretches twice"
    start = 0
    for length in lengths:
        rows = slice(start, start + length)
        with layers.of([length]):
            assert (predict(unet, noisy[rows], embeddings[rows]) - together[rows]).abs().max() < 1e-5
        start += length


def test_long_stretches_are_averages_over_windows():
    unet = make_unet()
    layers = MotionLayers(unet, random_adapter(unet), SETTINGS)
    module = layers.adapter.down_blocks[0].motion_modules[0]
    hidden = torch.randn(9, 32, 3, 2, generator=torch.Generator().manual_seed(1))
    with torch.no_grad(), layers.of([9]):
        ours = layers.apply(module, hidden)
        # Windows 0..3, 2..5, 4..7 and, so that it ends with the stretch, 5..8; weights 1 2 2 1.
        expected = torch.zeros_like(hidden)
        for frame in range(9):
            parts, weights = [], []
            for start in (0, 2, 4, 5):
                if start <= frame < start + 4:
                    made = module(hidden[start : start + 4], num_frames=4)
                    weights.append([1.0, 2.0, 2.0, 1.0][frame - start])
                    parts.append(weights[-1] * made[frame - start])
            expected[frame] = sum(parts) / sum(weights)
    assert (ours - expected).abs().max() < 1e-5


@given(st.integers(2, 32), st.integers(0, 200))
def test_windows_cover_every_frame_and_overlap_by_half(context, more):
    length = context + more
    starts = window_starts(length, context)
    covered = {frame for start in starts for frame in range(start, start + context)}
    assert covered == set(range(length))
    assert starts[0] == 0 and starts[-1] == length - context
    assert all(0 < after - before <= context // 2 for before, after in itertools.pairwise(starts))
    weights = pyramid(context)
    assert len(weights) == context and weights.min() == 1 and torch.equal(weights, weights.flip(0))


def test_wrong_lengths_are_refused():
    unet = make_unet()
    layers = MotionLayers(unet, random_adapter(unet), SETTINGS)
    noisy, embeddings = inputs(4)
    with layers.of([3]), pytest.raises(ValueError, match="stretches of 3 frames in all are not a batch of 4"):
        predict(unet, noisy, embeddings)


def test_files_are_those_of_diffusers(tmp_path):
    unet = make_unet()
    layers = MotionLayers(unet, random_adapter(unet), SETTINGS)
    assert not has_motion_layers(tmp_path)
    save_motion_layers(layers, tmp_path)
    assert has_motion_layers(tmp_path) and read_settings(tmp_path) == SETTINGS
    theirs = MotionAdapter.from_pretrained(tmp_path / "motion_adapter").state_dict()
    ours = load_motion_layers(tmp_path, make_unet()).adapter.state_dict()
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(value, theirs[name]) for name, value in ours.items())


def test_damaged_files_are_refused(tmp_path):
    unet = make_unet()
    save_motion_layers(MotionLayers(unet, random_adapter(unet), SETTINGS), tmp_path)
    with pytest.raises(DataError, match=r"block_out_channels must be \(32, 32\) for this U-Net, got \[32, 64\]"):
        load_motion_layers(tmp_path, make_base_model().unet)
    settings = tmp_path / "motion_adapter" / "ctlev_motion.json"
    settings.write_text(json.dumps({"context": 64, "interval_us": 1, "shared_noise": 0}))
    with pytest.raises(DataError, match="context must be a whole number from 1 to 32, got 64"):
        load_motion_layers(tmp_path, make_unet())
    settings.write_text(json.dumps({"context": 4, "interval_us": 1, "shared_noise": 1}))
    with pytest.raises(DataError, match="shared_noise must be a number from 0 to below 1, got 1"):
        load_motion_layers(tmp_path, make_unet())
    settings.unlink()
    with pytest.raises(DataError, match=r"ctlev_motion\.json"):
        load_motion_layers(tmp_path, make_unet())


# Training and sampling, with the tiny base model.


def moving_bars(count=COUNT, length=LENGTH):
    """Stretches of a bar that moves, whose brightness is that of its stretch: what frames alone do not know."""
    frames, conditions = make_data(count)
    random = np.random.default_rng(0)
    for first in range(0, count, length):
        brightness, start = random.integers(60, 255), random.integers(0, SIDE - 4 - length)
        for step in range(length):
            frame = frames[first + step]
            frame[:] = 0
            frame[:, start + step : start + step + 4] = brightness
            conditions.images[first + step] = np.where(frame > 0, 255, 0)
    prompts = ("a photo of a cup",) * count
    names = tuple(str(row // length) for row in range(count))
    return frames, dataclasses.replace(conditions, prompts=prompts, stretches=names)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("image_generator") / "checkpoint"
    save_base_model(make_base_model(), folder)
    return folder


OPTIONS = MotionOptions(context=4, batch_size=8, num_steps=6, log_every=2, validation_every=3, checkpoint_every_s=1e-6)


def train(checkpoint, folder, options=OPTIONS, **changes):
    frames, conditions = moving_bars(**changes)
    return train_motion_layers(
        checkpoint,
        frames,
        conditions,
        options,
        interval_us=20_000,
        seed=3,
        out=folder / "checkpoint",
        work=folder / "work",
    )


def files_of(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_only_the_layers_learn_and_a_killed_run_ends_the_same(tmp_path, checkpoint, monkeypatch):
    before = files_of(checkpoint)
    (tmp_path / "whole").mkdir()
    train(checkpoint, tmp_path / "whole")
    whole = files_of(tmp_path / "whole" / "checkpoint")
    assert {name: whole[name] for name in before} == before == files_of(checkpoint)
    assert {name.split("/")[0] for name in whole.keys() - before.keys()} == {"motion_adapter"}

    from ctlev_core.diffusion.training import loop

    save, saved = loop._save, []

    def killed(trainer, *arguments):
        save(trainer, *arguments)
        saved.append(trainer.step)
        if trainer.step == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(loop, "_save", killed)
    (tmp_path / "killed").mkdir()
    with pytest.raises(KeyboardInterrupt):
        train(checkpoint, tmp_path / "killed")
    assert not (tmp_path / "killed" / "checkpoint").exists()
    assert read_training_state(tmp_path / "killed" / "work" / "state.pt", "cpu")["step"] == 3
    monkeypatch.setattr(loop, "_save", save)
    train(checkpoint, tmp_path / "killed")
    assert files_of(tmp_path / "killed" / "checkpoint") == whole


@pytest.mark.slow
def test_they_lower_the_loss_of_stretches_held_back(tmp_path, checkpoint):
    """Below that of the generator without them, which validation after a step of next to nothing gives."""
    losses = []
    for number, changes in enumerate(({"num_steps": 1, "learning_rate": 1e-12}, {"num_steps": 60})):
        folder = tmp_path / str(number)
        folder.mkdir()
        options = OPTIONS.model_copy(update={"validation_every": 60, "num_validation": 4, "log_every": 60} | changes)
        losses += train(checkpoint, folder, options, count=240).validation_loss
    assert losses[1] < losses[0] - 0.02, losses


def test_stretches_that_are_too_short_are_refused(tmp_path, checkpoint):
    with pytest.raises(DataError, match="stretches of 4 consecutive frames, the longest has 3"):
        train(checkpoint, tmp_path, length=3)
    with pytest.raises(ValidationError, match="a training of motion layers has none"):
        MotionOptions(sample_every=1)
    assert [MotionOptions(context=5, batch_size=size).stretches_at_a_time for size in (4, 5, 14, 15)] == [1, 1, 2, 3]


@pytest.fixture(scope="module")
def with_motion(tmp_path_factory, checkpoint):
    """A checkpoint whose layers hold anything."""
    folder = tmp_path_factory.mktemp("motion") / "checkpoint"
    shutil.copytree(checkpoint, folder)
    unet = load_base_model(folder).unet
    save_motion_layers(MotionLayers(unet, random_adapter(unet), SETTINGS), folder)
    return folder


def sample(checkpoint, work, conditions, seeds, **changes):
    options = FAST.model_copy(update=changes)
    return controlnet.sample(checkpoint, conditions, options, seeds=seeds, work=work)


def test_frames_depend_on_their_stretch_alone(tmp_path, with_motion, monkeypatch):
    _, conditions = moving_bars()
    seeds = list(range(COUNT))
    whole = sample(with_motion, tmp_path / "a", conditions, seeds, batch_size=64)
    small = sample(with_motion, tmp_path / "b", conditions, seeds, batch_size=1)
    assert np.abs(whole.astype(int) - small).max() <= 1
    rows = np.arange(LENGTH, 2 * LENGTH)
    alone = sample(with_motion, tmp_path / "c", conditions.take(rows), [seeds[row] for row in rows])
    assert np.abs(whole[rows].astype(int) - alone).max() <= 1
    other_seed = [99, *seeds[1:]]
    changed = sample(with_motion, tmp_path / "d", conditions, other_seed)
    differ = np.array([(a != b).any() for a, b in zip(whole, changed, strict=True)])
    assert differ[:LENGTH].all(), "the frames of a stretch do not see one another"
    assert np.abs(whole[LENGTH:].astype(int) - changed[LENGTH:]).max() <= 1


def test_shards_hold_whole_stretches_and_a_killed_run_reuses_them(tmp_path, with_motion, monkeypatch):
    from ctlev_core.diffusion.sampling import shards

    _, conditions = moving_bars()
    seeds = list(range(COUNT))
    whole = sample(with_motion, tmp_path / "whole", conditions, seeds)
    monkeypatch.setattr(shards, "SHARD", LENGTH + 1)
    calls, original = [], sampling.sample_latents

    def counted(*arguments):
        calls.append(arguments[-1])
        if len(calls) == 3:
            raise KeyboardInterrupt
        return original(*arguments)

    monkeypatch.setattr(sampling, "sample_latents", counted)
    with pytest.raises(KeyboardInterrupt):
        sample(with_motion, tmp_path / "killed", conditions, seeds)
    assert calls == [[LENGTH]] * 3
    resumed = sample(with_motion, tmp_path / "killed", conditions, seeds)
    assert len(calls) == 3 + COUNT // LENGTH - 2
    assert np.abs(resumed.astype(int) - whole).max() <= 1


def test_without_stretches_frames_are_those_of_the_image_generator(tmp_path, checkpoint, with_motion):
    _, conditions = moving_bars()
    single = dataclasses.replace(conditions, stretches=None)
    seeds = list(range(COUNT))
    expected = sample(checkpoint, tmp_path / "a", single, seeds)
    assert np.array_equal(sample(with_motion, tmp_path / "b", single, seeds), expected)
    assert not np.array_equal(sample(with_motion, tmp_path / "c", conditions, seeds), expected)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_frames_of_a_stretch_share_noise(share):
    """Each value stays standard normal; those of one stretch are correlated by the share, others not at all."""
    noise = []
    for seed in range(40):
        seeds = [100 * seed + row for row in range(6)]
        stretches = sampling._noise_of_stretches((4, 8, 8), seeds, [4, 2])
        own = torch.stack([torch.randn(4, 8, 8, generator=torch.Generator().manual_seed(each)) for each in seeds])
        noise.append(mix_noise(own, stretches, share).flatten(1))
    values = torch.stack(noise, dim=1).flatten(1)
    correlations = torch.corrcoef(values)
    expected = torch.block_diag(torch.full((4, 4), share), torch.full((2, 2), share)).fill_diagonal_(1.0)
    assert (correlations - expected).abs().max() < 0.05  # 10,240 pairs of values each: sd .01
    assert (values.var(dim=1) - 1).abs().max() < 0.06


def test_a_trajectory_is_that_of_the_motion_model_of_diffusers():
    """DDIM by hand with `UNetMotionModel`, from the same noise."""
    unet = make_unet()
    adapter = random_adapter(unet)
    reference = UNetMotionModel.from_unet2d(unet, adapter).eval()
    base_model = dataclasses.replace(
        make_base_model(), unet=unet, controlnet=None, motion=MotionLayers(unet, adapter, SETTINGS)
    )
    options = SamplingOptions(scheduler="ddim", timestep_spacing="linspace", num_inference_steps=4)
    _, embeddings = inputs(4)
    ours = sampling.sample_latents(base_model, embeddings, embeddings[:1], None, [1, 2, 3, 4], options, [4])
    scheduler = make_scheduler("ddim", base_model.scheduler_config, 4, "linspace")
    state = torch.stack([torch.randn(4, 8, 8, generator=torch.Generator().manual_seed(seed)) for seed in (1, 2, 3, 4)])
    state = state * scheduler.init_noise_sigma
    for timestep in scheduler.timesteps:
        with torch.no_grad():
            video = scheduler.scale_model_input(state, timestep)[None].transpose(1, 2)
            made = reference(video, timestep, encoder_hidden_states=embeddings).sample.transpose(1, 2)[0]
        state = scheduler.step(made, timestep, state).prev_sample
    assert (ours - state).abs().max() < 1e-4
