"""Processes that train together end where one alone does."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_base_model import make_base_model, make_data
from tiny_families import write_family
from tiny_stable_diffusion import SIDE

from ctlev_core.diffusion.pretrained.loading import load_base_model, save_base_model
from ctlev_core.diffusion.sampling.value_table import read_value_table
from ctlev_core.diffusion.training import loop
from ctlev_core.diffusion.training.distributed import DistributedContext
from ctlev_core.diffusion.training.entry import train_checkpoint
from ctlev_core.diffusion.training.launch import child_environment
from ctlev_core.diffusion.training.options import FineTuningOptions
from ctlev_core.generators import controlnet
from ctlev_core.processes import num_cores
from data_contracts.errors import TrainingError
from data_contracts.labels import Conditions

OPTIONS = FineTuningOptions(
    num_steps=4, batch_size=2, gradient_accumulation=4, warmup_steps=1, log_every=2, num_validation=4, ema_decay=0.5,
    validation_every=2, keep="best", device="cpu",
)  # fmt: skip


def trained(folder, base_model, options, tune="both", data=None):
    frames, conditions = data or make_data(40)
    return train_checkpoint(
        frames,
        conditions,
        options.model_copy(update={"base_model": base_model}),
        tune=tune,
        with_controlnet=True,
        seed=5,
        out=folder / "out",
        work=folder / "work",
    )


@pytest.fixture(scope="module")
def base_model_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("base_model")
    save_base_model(make_base_model(), folder)
    return folder


@given(st.integers(1, 9), st.integers(1, 9))
def test_every_batch_of_a_step_is_one_processs(count, share):
    shares = [DistributedContext(rank, count).batches(count * share) for rank in range(count)]
    assert sorted(number for each in shares for number in each) == list(range(count * share))
    assert {len(each) for each in shares} == {share}


def assert_alike(one, two, has_gradient=True):
    """Sums in another order: rounding, 1e-7 of weights of about 1.

    Adam divides by the gradient's size, so that where it is nothing but rounding a single weight goes elsewhere, by
    less than a step. The key bias of an attention is such a weight throughout: softmax takes any constant away.
    """
    difference = (one - two).abs()
    assert difference.max() < OPTIONS.learning_rate / 10
    assert not has_gradient or difference.mean() < 1e-7


def assert_same_run(one, two, start):
    """The checkpoints in two folders are those of one training that began in a third."""
    base_models = [load_base_model(folder) for folder in (one, two, start)]
    for name in ("unet", "controlnet"):
        states = [getattr(base_model, name).state_dict() for base_model in base_models]
        for key, value in states[0].items():
            assert_alike(value, states[1][key], has_gradient=not key.endswith("k_proj.bias"))
        assert max((states[0][key] - states[2][key]).abs().max().item() for key in states[0]) > 1e-3


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(
    "shared",
    [
        pytest.param({}, marks=pytest.mark.slow),
        pytest.param({"fsdp": True, "sample_every": 2}, marks=pytest.mark.slow),
        pytest.param({"fsdp": True, "gradient_checkpointing": True}, marks=pytest.mark.slow),
    ],
)
def test_two_processes_end_in_the_weights_of_one(tmp_path, base_model_folder, shared):
    alone = trained(tmp_path / "alone", base_model_folder, OPTIONS)
    together = trained(
        tmp_path / "together", base_model_folder, OPTIONS.model_copy(update={"num_processes": 2, **shared})
    )
    assert_same_run(tmp_path / "alone" / "out", tmp_path / "together" / "out", base_model_folder)
    assert together.step == alone.step and together.kept_step == alone.kept_step
    for name in ("loss", "validation_loss", "shuffled_loss"):
        np.testing.assert_allclose(getattr(together, name), getattr(alone, name), rtol=1e-4)
    assert len(list((tmp_path / "together" / "work" / "samples").glob("*.png"))) == (
        2 if "sample_every" in shared else 0
    )
    # The state is that of the run, not of its processes: one alone takes it up, and finds it finished.
    states = [torch.load(tmp_path / name / "work" / "state.pt", weights_only=True) for name in ("alone", "together")]
    moments_of = states[0]["optimizer"]["state"]
    for name in ("parameters", "average", "best"):
        for index, (one, two) in enumerate(zip(states[0][name], states[1][name], strict=True)):
            assert_alike(one, two, has_gradient=moments_of[index]["exp_avg_sq"].sqrt().max() > 1e-10)
    for index, moments in moments_of.items():
        for name, value in moments.items():
            assert_alike(value, states[1]["optimizer"]["state"][index][name])
    again = trained(tmp_path / "together", base_model_folder, OPTIONS)
    assert vars(again) == vars(together)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_a_transformer_is_shared_out_as_a_unet_is(tmp_path):
    """Weights of Stable Diffusion 3 in two processes, beside one with whole weights."""
    base_model = write_family("sd3", tmp_path / "sd3")
    frames = np.random.default_rng(0).integers(0, 256, (24, SIDE, SIDE, 3), np.uint8)
    data = frames, Conditions(("a photo of a cup", "a photo of a ball") * 12, frames[::-1].copy())
    options = OPTIONS.model_copy(update={"num_steps": 2, "gradient_accumulation": 2, "validation_every": 1})
    alone = trained(tmp_path / "alone", base_model, options, data=data)
    shared = options.model_copy(update={"num_processes": 2, "fsdp": True})
    together = trained(tmp_path / "together", base_model, shared, data=data)
    for name in ("loss", "validation_loss", "shuffled_loss"):
        np.testing.assert_allclose(getattr(together, name), getattr(alone, name), rtol=1e-4)
    places = [tmp_path / name / "out" for name in ("alone", "together")]
    one, two, start = (load_base_model(folder) for folder in (*places, base_model))
    for name in ("unet", "controlnet"):
        before, after = getattr(start, name).state_dict(), getattr(two, name).state_dict()
        assert max((after[key] - before[key]).abs().max().item() for key in after) > 1e-4
        for key, value in getattr(one, name).state_dict().items():
            # The last block of a ControlNet as deep as its transformer is of no use: without a gradient nothing happens
            # to its weights, with zeros in its place, as in parts of weights, they decay.
            is_used = not torch.equal(value, before[key])
            assert_alike(value, after[key], has_gradient=is_used and not key.endswith(("to_k.bias", "k_proj.bias")))


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_parts_of_weights_give_a_table_of_values(tmp_path):
    frames, conditions = make_data(with_images=False)
    save_base_model(replace(make_base_model(), controlnet=None), tmp_path / "base_model")
    options = OPTIONS.model_copy(update={"num_steps": 1, "values_at": 0.4, "keep": "last"})
    asked = {"alone": {}, "shared": {"num_processes": 2, "fsdp": True}}
    for name, changed in asked.items():
        train_checkpoint(
            frames, conditions, options.model_copy(update={"base_model": tmp_path / "base_model", **changed}),
            tune="unet", with_controlnet=False, seed=0, out=tmp_path / name, work=tmp_path / f"work of {name}",
        )  # fmt: skip
    one, two = (read_value_table(tmp_path / name) for name in asked)
    np.testing.assert_allclose(one, two, atol=1e-2)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_parts_of_weights_go_on_from_whole_ones(tmp_path, base_model_folder, monkeypatch):
    """One process is killed in its third step; two that share out the weights end where it would have."""
    trained(tmp_path / "alone", base_model_folder, OPTIONS)
    loss = loop.denoising_loss
    calls = iter(range(2 * OPTIONS.gradient_accumulation))

    def killed(*arguments):
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return loss(*arguments)

    monkeypatch.setattr(loop, "denoising_loss", killed)
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "resumed", base_model_folder, OPTIONS.model_copy(update={"checkpoint_every_s": 1e-9}))
    assert torch.load(tmp_path / "resumed" / "work" / "state.pt", weights_only=True)["step"] == 2
    trained(tmp_path / "resumed", base_model_folder, OPTIONS.model_copy(update={"num_processes": 2, "fsdp": True}))
    assert_same_run(tmp_path / "alone" / "out", tmp_path / "resumed" / "out", base_model_folder)


@pytest.mark.slow
def test_failure_of_a_process_is_reported(tmp_path):
    base_model = make_base_model()
    with torch.no_grad():
        base_model.unet.conv_in.weight[0] = torch.nan
    save_base_model(base_model, tmp_path / "base_model")
    with pytest.raises(TrainingError, match=r"in 2 processes failed: process \d: .*'conv_in.weight'.* not finite"):
        trained(tmp_path, tmp_path / "base_model", OPTIONS.model_copy(update={"num_processes": 2}))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"num_processes": 3}, "gradient_accumulation must be a multiple of the 3 processes.*got 4; halve batch_size"),
        ({"num_processes": 2, "device": "cuda:1"}, "device must be auto, cuda or cpu with 2 processes.*got 'cuda:1'"),
        ({"num_processes": 2, "fsdp": True, "optimizer": "muon"}, "fsdp needs optimizer=adamw, got muon"),
        ({"num_processes": 2, "fsdp": True, "compile_networks": True}, "fsdp needs compile_networks=False, got True"),
        ({"num_processes": 2, "fsdp": True, "precision": "float16"}, "fsdp needs precision float32 or bfloat16"),
    ],
)
def test_what_processes_cannot_share_is_refused_before_they_start(tmp_path, base_model_folder, changed, message):
    with pytest.raises(ValueError, match=message):
        trained(tmp_path, base_model_folder, OPTIONS.model_copy(update=changed))
    assert not (tmp_path / "work").exists()


def test_an_outer_launcher_says_how_many(tmp_path, base_model_folder, monkeypatch):
    """`accelerate launch --num_processes 3 flows/train_generator.py ...` is asked for three here too."""
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "3")
    with pytest.raises(ValueError, match="a multiple of the 3 processes"):
        trained(tmp_path, base_model_folder, OPTIONS)


def test_an_outer_launcher_says_whether_weights_are_shared_out(tmp_path, base_model_folder, monkeypatch):
    """`accelerate launch --use_fsdp`, or an `accelerate config` that chose it, leaves that in the environment."""
    monkeypatch.setenv("ACCELERATE_USE_FSDP", "true")
    options = OPTIONS.model_copy(update={"num_processes": 2, "optimizer": "muon"})
    with pytest.raises(ValueError, match="fsdp needs optimizer=adamw"):
        trained(tmp_path, base_model_folder, options)
    with pytest.raises(ValueError, match="a multiple of the 3 processes"):  # a preset that says no is heeded
        trained(tmp_path, base_model_folder, options.model_copy(update={"fsdp": False, "num_processes": 3}))


def test_children_hear_nothing_of_an_outer_launcher():
    outer = {"RANK": "1", "MASTER_PORT": "29500", "TORCHELASTIC_RUN_ID": "x", "GROUP_RANK": "0", "HOME": "/home/me"}
    inner = child_environment({**outer, "ACCELERATE_USE_CPU": "true", "OMP_NUM_THREADS": "3"}, 2)
    assert not set(inner) & (set(outer) - {"HOME"})
    assert inner["HOME"] == "/home/me" and inner["ACCELERATE_USE_CPU"] == "true" and inner["OMP_NUM_THREADS"] == "3"
    assert int(inner["CTLEV_CORES"]) == max(num_cores() // 2, 1)


def test_the_number_of_processes_is_no_part_of_a_result():
    from data_contracts.config import cache_material

    plain, shared = (
        cache_material(controlnet.Options(num_processes=count, gradient_accumulation=4)) for count in (None, 4)
    )
    assert json.dumps(plain) == json.dumps(shared)
