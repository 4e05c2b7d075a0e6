"""Adapters: small checkpoints that change a base model, here and in plain diffusers."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from safetensors.torch import load_file, save_file
from tiny_base_model import make_base_model, make_data

from ctlev_core.diffusion.pretrained.adapters import ADAPTER_FILE, WEIGHTS_FILE
from ctlev_core.diffusion.pretrained.loading import load_base_model, save_base_model
from ctlev_core.diffusion.pretrained.name_embeddings import embed_names
from ctlev_core.diffusion.sampling.devices import spread_over_cores
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.sampling import sample_checkpoint
from ctlev_core.diffusion.training import finetuning, loop
from ctlev_core.diffusion.training.entry import train_checkpoint
from ctlev_core.diffusion.training.options import FineTuningOptions
from ctlev_core.trained_generator import load_generator
from data_contracts.errors import DataError, TrainingError

pytestmark = pytest.mark.usefixtures("one_thread")

OPTIONS = FineTuningOptions(
    num_steps=6, batch_size=4, warmup_steps=1, log_every=2, num_validation=4, ema_decay=0.5, lora_rank=2, device="cpu",
    learning_rate=0.02,
)  # fmt: skip


@pytest.fixture(scope="module")
def base_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("base") / "base_model"
    save_base_model(make_base_model(), folder)
    return folder


def trained(base_folder, folder, tune="both", **changes):
    frames, conditions = make_data(40)
    folder.mkdir(exist_ok=True)
    train_checkpoint(
        frames,
        conditions,
        OPTIONS.model_copy(update={"base_model": base_folder, **changes}),
        tune=tune,
        with_controlnet=True,
        seed=1,
        out=folder / "checkpoint",
        work=folder,
    )
    return folder / "checkpoint"


@pytest.fixture(scope="module")
def adapter(base_folder, tmp_path_factory):
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield trained(base_folder, tmp_path_factory.mktemp("adapter"), lora_layers="all")
    torch.set_num_threads(before)


def sampled(checkpoint, folder):
    _, conditions = make_data(3, seed=5)
    folder.mkdir()
    options = SamplingOptions(num_inference_steps=3, device="cpu")
    return sample_checkpoint(checkpoint, conditions, options, with_controlnet=True, seeds=range(3), work=folder)


def test_an_adapter_changes_the_base_model_and_leaves_it_alone(base_folder, adapter, tmp_path):
    base, changed = load_base_model(base_folder), load_base_model(adapter)
    for name in ("unet", "controlnet"):
        before, after = (dict(getattr(model, name).named_parameters()) for model in (base, changed))
        assert before.keys() == after.keys()
        differ = [key for key in before if not torch.equal(before[key], after[key])]
        assert differ and all(key.endswith(".weight") for key in differ)
    one, other = sampled(base_folder, tmp_path / "base"), sampled(adapter, tmp_path / "adapter")
    assert not np.array_equal(one, other)


def test_the_change_is_the_product_of_two_small_matrices(base_folder, adapter):
    stored = {key.removeprefix("unet."): value for key, value in load_file(adapter / WEIGHTS_FILE).items()}
    base, changed = (dict(load_base_model(path).unet.named_parameters()) for path in (base_folder, adapter))
    seen = set()
    for key in [key for key in stored if key.endswith("lora_A.weight")]:
        layer = key.removesuffix(".lora_A.weight")
        first, second = stored[key].double(), stored[f"{layer}.lora_B.weight"].double()
        assert first.shape[0] == second.shape[1] == 2
        if first.ndim == 4:
            product = torch.einsum("or,rihw->oihw", second[:, :, 0, 0], first)
        else:
            product = second @ first
        expected = base[f"{layer}.weight"].double() + product
        torch.testing.assert_close(changed[f"{layer}.weight"].double(), expected, rtol=0, atol=1e-6)
        seen.add(first.ndim)
    assert seen == {2, 4}


def test_plain_diffusers_loads_it(base_folder, adapter):
    """`load_lora_weights` and `load_lora_adapter`, whose networks give what ours give."""
    from diffusers.models.controlnets.controlnet import ControlNetModel
    from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel

    ours = load_base_model(adapter)
    unet = UNet2DConditionModel.from_pretrained(base_folder / "unet")
    unet.load_lora_adapter(adapter, prefix="unet", weight_name=WEIGHTS_FILE)
    controlnet = ControlNetModel.from_pretrained(base_folder / "controlnet")
    controlnet.load_lora_adapter(adapter / "controlnet", prefix=None, weight_name=WEIGHTS_FILE)
    generator = torch.Generator().manual_seed(0)
    shape = (2, ours.unet.config.in_channels, 4, 4)
    noisy, steps = torch.randn(shape, generator=generator), torch.tensor([3, 700])
    text = torch.randn((2, 5, ours.unet.config.cross_attention_dim), generator=generator)
    asked = torch.rand((2, 3, 16, 16), generator=generator)
    with torch.no_grad():
        for mine, theirs in ((ours.unet, unet), (ours.controlnet, controlnet)):
            kwargs = {"controlnet_cond": asked} if mine is ours.controlnet else {}
            found, expected = (
                network(noisy, steps, encoder_hidden_states=text, return_dict=False, **kwargs)
                for network in (mine, theirs)
            )
            found, expected = (torch.cat([part.flatten() for part in flat(parts)]) for parts in (found, expected))
            torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def flat(parts):
    return [inner for part in parts for inner in (flat(part) if isinstance(part, tuple | list) else [part])]


def test_a_pipeline_of_diffusers_loads_it(base_folder, adapter):
    from diffusers.pipelines.stable_diffusion.pipeline_stable_diffusion import StableDiffusionPipeline

    ours = load_base_model(adapter).unet
    loaded = load_base_model(base_folder)
    pipeline = StableDiffusionPipeline(
        vae=loaded.vae, text_encoder=loaded.text_encoder, tokenizer=loaded.tokenizer, unet=loaded.unet,
        scheduler=DDPMScheduler.from_config(loaded.scheduler_config), safety_checker=None, feature_extractor=None,
        requires_safety_checker=False,
    )  # fmt: skip
    pipeline.load_lora_weights(adapter)
    pipeline.fuse_lora()
    pipeline.unload_lora_weights()
    for name, weight in pipeline.unet.named_parameters():
        torch.testing.assert_close(weight, dict(ours.named_parameters())[name], rtol=0, atol=1e-6)


@pytest.mark.parametrize("tune", ["unet", "controlnet"])
def test_what_does_not_learn_has_no_weights(base_folder, tmp_path, tune):
    checkpoint = trained(base_folder, tmp_path, tune)
    files = sorted(path.relative_to(checkpoint).as_posix() for path in checkpoint.rglob(WEIGHTS_FILE))
    assert files == ([WEIGHTS_FILE] if tune == "unet" else [f"controlnet/{WEIGHTS_FILE}"])
    assert json.loads((checkpoint / ADAPTER_FILE).read_text())["networks"] == [tune]
    assert len(load_file(checkpoint / files[0])) > 0
    load_base_model(checkpoint)


def test_a_generator_is_of_the_route_that_it_was_trained_on(base_folder, tmp_path, monkeypatch):
    """Also where the ControlNet did not learn, or lies elsewhere."""
    shutil.copytree(base_folder / "controlnet", tmp_path / "nets" / "own")
    monkeypatch.chdir(tmp_path)
    frames, conditions = make_data(40)
    options = OPTIONS.model_copy(update={"base_model": base_folder, "num_steps": 1})
    routes = {"steered": ("unet", None), "elsewhere": ("both", Path("nets/own")), "text": ("unet", None)}
    for name, (tune, controlnet) in routes.items():
        asked = replace(conditions, images=None) if name == "text" else conditions
        job = {"tune": tune, "with_controlnet": name != "text", "controlnet": controlnet, "seed": 1}
        train_checkpoint(frames, asked, options, **job, out=tmp_path / name, work=tmp_path / f"work of {name}")
    monkeypatch.chdir("/")
    for name in routes:
        assert load_generator(tmp_path / name).name == ("stable_diffusion" if name == "text" else "controlnet")
    assert load_base_model(tmp_path / "elsewhere").controlnet is not None
    names = ["cup", "ball"]
    assert np.array_equal(embed_names(tmp_path / "text", names), embed_names(base_folder, names))


def test_a_training_that_was_killed_ends_in_the_same_adapter(base_folder, tmp_path, monkeypatch):
    whole = trained(base_folder, tmp_path / "whole")
    sample, calls = loop.sample_rows, []

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return sample(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(finetuning, "sample_rows", interrupted)
        with pytest.raises(KeyboardInterrupt):
            trained(base_folder, tmp_path / "cut", checkpoint_every_s=1e-9)
    assert (tmp_path / "cut" / "state.pt").is_file()
    with pytest.raises(TrainingError, match="another run"):
        trained(base_folder, tmp_path / "cut", lora_rank=3)
    cut = trained(base_folder, tmp_path / "cut")
    for name in (WEIGHTS_FILE, f"controlnet/{WEIGHTS_FILE}"):
        assert (whole / name).read_bytes() == (cut / name).read_bytes()


def test_another_base_model_is_refused(base_folder, adapter, tmp_path, monkeypatch):
    other = tmp_path / "other"
    save_base_model(make_base_model(seed=9), other)
    monkeypatch.setenv("CTLEV_BASE_MODEL", str(other))
    with pytest.raises(DataError, match=r"other is not the base model that this adapter belongs to"):
        load_base_model(adapter)
    moved = shutil.copytree(base_folder, tmp_path / "moved")
    monkeypatch.setenv("CTLEV_BASE_MODEL", str(moved))
    load_base_model(adapter)
    # Parts that several base models share are often links.
    for name, of in (("unet", base_folder), ("unet", other)):
        shutil.rmtree(moved / name) if not (moved / name).is_symlink() else (moved / name).unlink()
        (moved / name).symlink_to(of / name)
        if of == base_folder:
            load_base_model(adapter)
    with pytest.raises(DataError, match="moved is not the base model"):
        load_base_model(adapter)
    monkeypatch.setenv("CTLEV_BASE_MODEL", str(tmp_path / "none"))
    with pytest.raises(DataError, match=r"is not at .*none; set CTLEV_BASE_MODEL"):
        load_base_model(adapter)


def damage_pairs(path):
    weights = load_file(path)
    weights.pop(next(key for key in weights if key.endswith("lora_B.weight")))
    save_file(weights, path)


def damage_layer(path):
    weights = load_file(path)
    save_file({key.replace("mid_block", "no_block"): value for key, value in weights.items()}, path)


def damage_shape(path):
    weights = load_file(path)
    save_file({key: value[:1].contiguous() if "lora_B" in key else value for key, value in weights.items()}, path)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (damage_pairs, "expected pairs of weights lora_A and lora_B"),
        (damage_layer, "the unet has no layer no_block"),
        (damage_shape, "has the shape .* its adapter"),
        (lambda path: path.write_bytes(path.read_bytes()[:100]), "truncated"),
        (lambda path: path.unlink(), "nothing there"),
        (lambda path: (path.parent / ADAPTER_FILE).write_text("{}"), "expected base_model, controlnet, digest"),
        (lambda path: (path.parent / ADAPTER_FILE).write_text("[1]"), "expected a JSON object"),
    ],
)
def test_damage_is_named(adapter, tmp_path, damage, says):
    damaged = shutil.copytree(adapter, tmp_path / "damaged")
    damage(damaged / WEIGHTS_FILE)
    with pytest.raises(DataError, match=says):
        load_base_model(damaged)


def test_an_adapter_is_as_large_as_its_base_model_to_processes(base_folder, adapter, monkeypatch):
    from ctlev_core.diffusion.sampling import devices

    size = sum(path.stat().st_size for path in base_folder.glob("*/*.safetensors"))
    monkeypatch.setattr(devices, "num_cores", lambda: 4)
    monkeypatch.setattr(devices, "SMALL_BYTES", size - 1)
    assert spread_over_cores("cpu", adapter, 9) == ["cpu"]
    monkeypatch.setattr(devices, "SMALL_BYTES", size)
    assert spread_over_cores("cpu", adapter, 9) == ["cpu"] * 4


def test_what_cannot_be_is_refused_before_training(base_folder, tmp_path, monkeypatch):
    with pytest.raises(DataError, match="random_init forgets it"):
        trained(base_folder, tmp_path, random_init=True)
    with pytest.raises(ValueError, match="set fsdp to false"):
        trained(base_folder, tmp_path, num_processes=2, fsdp=True)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(DataError, match=r"needs the package peft"):
        trained(base_folder, tmp_path)
