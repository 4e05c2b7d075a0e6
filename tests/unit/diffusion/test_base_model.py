"""Base models are ordinary diffusers folders: what is written loads again, also in diffusers itself."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers.pipelines.controlnet.pipeline_controlnet import StableDiffusionControlNetPipeline
from diffusers.pipelines.stable_diffusion.pipeline_stable_diffusion import StableDiffusionPipeline
from tiny_base_model import SIDE, make_base_model, shared_base_model
from tiny_stable_diffusion import make_models, tiny_changes, write_folder

from ctlev_core.diffusion.pretrained.loading import load_base_model, save_base_model
from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL, check_base_model_folder
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from data_contracts.errors import DataError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("base_model") / "tiny"
    save_base_model(shared_base_model(), path)
    return path


@pytest.fixture
def broken(folder, tmp_path):
    """A copy to damage."""
    return shutil.copytree(folder, tmp_path / "copy")


def test_round_trip_keeps_every_weight(folder):
    saved, loaded = shared_base_model(), load_base_model(folder)
    for name in ("unet", "controlnet", "text_encoder", "vae"):
        before, after = getattr(saved, name).state_dict(), getattr(loaded, name).state_dict()
        assert before.keys() == after.keys()
        assert all(torch.equal(before[key], after[key]) for key in before), name
    assert loaded.image_size == (SIDE, SIDE)
    assert loaded.scheduler_config["prediction_type"] == "v_prediction"
    assert not any(parameter.requires_grad for parameter in loaded.unet.parameters())
    prompts = ["a photo of a cup", "unseen wörds 42!", ""]
    assert torch.equal(encode_prompts(saved, prompts), encode_prompts(loaded, prompts))


def test_half_precision_is_written_for_networks_but_not_for_the_code(tmp_path):
    base_model = make_base_model()
    before = base_model.unet.conv_in.weight.clone()
    save_base_model(base_model, tmp_path / "half", torch.float16)
    assert torch.equal(base_model.unet.conv_in.weight, before)
    loaded = load_base_model(tmp_path / "half")
    assert torch.equal(loaded.unet.conv_in.weight, before.half().float())
    assert torch.equal(loaded.vae.analysis, base_model.vae.analysis)


def test_diffusers_loads_the_folder(folder):
    pipeline = StableDiffusionControlNetPipeline.from_pretrained(folder, trust_remote_code=True)
    pipeline.set_progress_bar_config(disable=True)
    image = pipeline(
        "a photo of a cup", image=torch.zeros(1, 3, SIDE, SIDE), num_inference_steps=2, output_type="np"
    ).images
    assert image.shape == (1, SIDE, SIDE, 3) and np.isfinite(image).all()


def test_diffusers_loads_the_folder_where_there_is_no_ctlev(folder, tmp_path):
    """In an interpreter that cannot import ctlev: the code of the autoencoder lies in the folder."""
    checkpoints = [str(tmp_path / "ControlNet"), str(tmp_path / "text")]
    for checkpoint, with_controlnet in zip(checkpoints, (True, False), strict=True):
        save_base_model(load_base_model(folder, with_controlnet=with_controlnet), Path(checkpoint))
    script = f"""
import importlib.util, sys
assert importlib.util.find_spec("ctlev_core") is None
import torch
from diffusers import DiffusionPipeline
image = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
for checkpoint in {checkpoints!r}:
    pipeline = DiffusionPipeline.from_pretrained(checkpoint, trust_remote_code=True)
    print(float((pipeline.vae.decode(pipeline.vae.encode(image).latent_dist.mode()).sample - image).abs().max()) < 1e-5)
    print(type(pipeline).__name__)
"""
    # -P and a folder elsewhere: no path to the repository; an editable install is found by a finder of its own.
    lines = ["import sys", "sys.meta_path = [one for one in sys.meta_path if 'editable' not in repr(one).lower()]"]
    run = subprocess.run(
        [sys.executable, "-P", "-c", "\n".join(lines) + script],
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"HF_HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-2000:]
    assert run.stdout.split() == ["True", "StableDiffusionControlNetPipeline", "True", "StableDiffusionPipeline"]


def test_text_checkpoint_is_a_stable_diffusion_folder(folder, tmp_path):
    save_base_model(load_base_model(folder, with_controlnet=False), tmp_path / "text")
    assert not (tmp_path / "text" / "controlnet").exists()
    pipeline = StableDiffusionPipeline.from_pretrained(tmp_path / "text", trust_remote_code=True)
    assert pipeline.unet.config.in_channels == 48


def test_stable_diffusion_layout_loads(tmp_path):
    """AutoencoderKL with its own factor and scale, weights without ControlNet, ControlNet in a folder of its own."""
    path = write_folder(make_models(tiny_changes()), tmp_path / "sd")
    config = json.loads((tmp_path / "sd-controlnet" / "config.json").read_text())
    config["controlnet_conditioning_channel_order"] = "bgr"
    (tmp_path / "sd-controlnet" / "config.json").write_text(json.dumps(config))
    plain = load_base_model(path)
    assert plain.controlnet is None and not plain.reversed_condition
    base_model = load_base_model(path, controlnet=tmp_path / "sd-controlnet")
    assert base_model.scaling_factor == 0.25 and base_model.reversed_condition
    assert base_model.image_size == (32, 32)


def test_missing_parts_are_named(broken, tmp_path):
    with pytest.raises(DataError, match="nowhere: the base model must be a diffusers folder"):
        load_base_model(tmp_path / "nowhere")
    with pytest.raises(DataError, match="nowhere: the ControlNet must be"):
        load_base_model(broken, controlnet=tmp_path / "nowhere")
    shutil.rmtree(broken / "tokenizer")
    with pytest.raises(DataError, match="missing: tokenizer; found: controlnet, scheduler"):
        load_base_model(broken)


def test_missing_controlnet_is_named_before_training(broken):
    check_base_model_folder(broken, needs_controlnet=True)
    shutil.rmtree(broken / "controlnet")
    with pytest.raises(DataError, match="no subfolder 'controlnet'"):
        check_base_model_folder(broken, needs_controlnet=True)


def test_bundled_base_model_loads_and_is_small():
    check_base_model_folder(BUNDLED_BASE_MODEL, needs_controlnet=True)
    base_model = load_base_model()
    assert base_model.image_size == (64, 64) and base_model.controlnet is not None
    assert sum(path.stat().st_size for path in BUNDLED_BASE_MODEL.rglob("*")) < 25e6
    words = base_model.tokenizer.tokenize("A photo of a moving human, a street light")
    assert "human</w>" in words and "street</w>" in words


def test_written_folder_does_not_tell_where_the_base_model_was(tmp_path):
    shutil.copytree(BUNDLED_BASE_MODEL, tmp_path / "elsewhere")
    save_base_model(load_base_model(), tmp_path / "first")
    save_base_model(load_base_model(tmp_path / "elsewhere"), tmp_path / "second")
    for file in (tmp_path / "first").rglob("*"):
        if file.is_file():
            again = tmp_path / "second" / file.relative_to(tmp_path / "first")
            assert again.read_bytes() == file.read_bytes(), file.name
