"""Checkpoints in one file give what the same weights give as a diffusers folder, and other files are refused."""

import json
import shutil
import socket
import sys
import types

import numpy as np
import pytest
import torch
from diffusers.loaders.single_file_utils import (
    convert_controlnet_checkpoint,
    convert_ldm_unet_checkpoint,
    convert_ldm_vae_checkpoint,
)
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from diffusers.models.controlnets.controlnet import ControlNetModel
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from diffusers.pipelines.controlnet.pipeline_controlnet import StableDiffusionControlNetPipeline
from tiny_stable_diffusion import (
    SIDE,
    make_models,
    original_checkpoint,
    original_controlnet,
    tiny_changes,
    write_folder,
    write_single,
)
from transformers import CLIPTextModel

from ctlev_core.diffusion.pretrained import single_file
from ctlev_core.diffusion.pretrained.loading import load_base_model, save_base_model
from ctlev_core.diffusion.pretrained.paths import base_model_places, check_base_model_folder
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from data_contracts.errors import DataError

STABLE_DIFFUSION_V1 = {"unet": 859_520_964, "controlnet": 361_279_120, "vae": 83_653_863, "text_encoder": 123_060_480}
"""Parameters of the published networks."""


@pytest.fixture(scope="module")
def models():
    return make_models(tiny_changes())


@pytest.fixture(scope="module")
def folder(models, tmp_path_factory):
    """Written by the libraries: what the single files are compared with."""
    return write_folder(models, tmp_path_factory.mktemp("folder") / "sd")


@pytest.fixture(scope="module")
def single(models, folder, tmp_path_factory):
    path = write_single(original_checkpoint(models), tmp_path_factory.mktemp("single") / "v1.safetensors")
    shutil.copytree(folder / "tokenizer", path.with_name("tokenizer"))
    return path


@pytest.fixture(scope="module")
def control(models, single):
    return write_single(original_controlnet(models), single.with_name("control.safetensors"))


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    def refuse(*_):
        raise AssertionError("something was to be fetched")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)


def outputs(unet, controlnet, vae, text_encoder):
    """What each network makes of the same input."""
    random = torch.Generator().manual_seed(0)
    latents, image, condition = (
        torch.randn(shape, generator=random) for shape in ((2, 4, 4, 4), (2, 3, 32, 32), (2, 3, 32, 32))
    )
    ids = torch.randint(0, 500, (2, 16), generator=random)
    time = torch.tensor([3, 900])
    with torch.no_grad():
        text = text_encoder(ids)[0]
        down, middle = controlnet(latents, time, text, condition, return_dict=False)
        predicted = unet(
            latents, time, text, down_block_additional_residuals=down, mid_block_additional_residual=middle
        ).sample
        posterior = vae.encode(image).latent_dist
        decoded = vae.decode(latents).sample
    return {"text": text, "middle": middle, "predicted": predicted, "mean": posterior.mean, "decoded": decoded}


def check_same(base_model, folder):
    """Bit for bit what the libraries themselves load from the folder."""
    control_folder = folder.with_name(f"{folder.name}-controlnet")
    expected = outputs(
        UNet2DConditionModel.from_pretrained(folder / "unet"),
        ControlNetModel.from_pretrained(control_folder),
        AutoencoderKL.from_pretrained(folder / "vae"),
        CLIPTextModel.from_pretrained(folder / "text_encoder"),
    )
    got = outputs(base_model.unet, base_model.controlnet, base_model.vae, base_model.text_encoder)
    for name, value in expected.items():
        assert torch.isfinite(value).all() and value.std() > 0, name
        assert torch.equal(got[name], value), name


def test_single_files_give_what_the_folders_give(single, control, folder):
    check_same(load_base_model(folder, controlnet=folder.with_name("sd-controlnet")), folder)
    base_model = load_base_model(single, controlnet=control)
    check_same(base_model, folder)
    assert (
        base_model.image_size == (SIDE, SIDE)
        and base_model.scaling_factor == 0.25
        and not base_model.reversed_condition
    )
    assert base_model.scheduler_config["prediction_type"] == "epsilon"
    assert base_model.scheduler_config["beta_end"] == 0.012 and base_model.scheduler_config["clip_sample"] is False
    prompts = ["a photo of a cup", ""]
    assert torch.equal(encode_prompts(base_model, prompts), encode_prompts(load_base_model(folder), prompts))
    assert load_base_model(single).controlnet is None


def write_lightning_checkpoint(tensors, path, monkeypatch):
    """As the first Stable Diffusion files: a training state that names a class of PyTorch Lightning."""
    package, callbacks = types.ModuleType("pytorch_lightning"), types.ModuleType("pytorch_lightning.callbacks")
    module = types.ModuleType("pytorch_lightning.callbacks.model_checkpoint")
    module.ModelCheckpoint = type("ModelCheckpoint", (), {"__module__": module.__name__})
    with monkeypatch.context() as patch:
        for one in (package, callbacks, module):
            patch.setitem(sys.modules, one.__name__, one)
        score = {"best_model_score": torch.tensor(0.5), "best": np.float64(0.25)}
        state = {"state_dict": tensors, "callbacks": {module.ModelCheckpoint: score}, "epoch": 7}
        torch.save(state, path)
    return path


def test_original_training_state_is_read_without_lightning(models, single, folder, tmp_path, monkeypatch):
    tensors = original_checkpoint(models) | original_controlnet(models)
    path = write_lightning_checkpoint(tensors, tmp_path / "control_sd15.ckpt", monkeypatch)
    path.with_suffix(".json").write_text(json.dumps(tiny_changes()))
    with pytest.raises(Exception, match="pytorch_lightning"):  # what torch does with such a file
        torch.load(path, weights_only=True)
    # Both in one file, as control_sd15_openpose.pth: it is a base model of its own, and a ControlNet for another.
    assert check_base_model_folder(single, controlnet=path, needs_controlnet=True) == single
    check_same(load_base_model(single, controlnet=path), folder)
    shutil.copytree(folder / "tokenizer", tmp_path / "tokenizer")
    check_same(load_base_model(path), folder)
    assert load_base_model(path, with_controlnet=False).controlnet is None


def test_tensors_that_share_storage_or_are_transposed_are_read_from_archives(models, single, folder, tmp_path):
    tensors = original_controlnet(models, prefix="")
    block = torch.zeros(3, *tensors["time_embed.2.weight"].shape)
    block[1] = tensors["time_embed.2.weight"]
    tensors["time_embed.2.weight"] = block[1]
    name = "middle_block.1.transformer_blocks.0.attn1.to_q.weight"
    tensors[name] = tensors[name].T.contiguous().T
    tensors["time_embed.0.weight"] = torch.nn.Parameter(tensors["time_embed.0.weight"])
    torch.save(tensors, tmp_path / "control.pth")
    (tmp_path / "control.json").write_text(json.dumps(tiny_changes()))
    check_same(load_base_model(single, controlnet=tmp_path / "control.pth"), folder)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("ending", [".safetensors", ".pth"])
def test_half_precision_files_load_as_the_rounded_weights(models, single, tmp_path, dtype, ending):
    halves = {name: value.to(dtype) for name, value in original_controlnet(models).items()}
    path = write_single(halves, tmp_path / "half.safetensors")
    if ending == ".pth":
        torch.save(halves, path.with_suffix(ending))
    loaded = load_base_model(single, controlnet=path.with_suffix(ending)).controlnet.state_dict()
    for name, value in models["controlnet"].state_dict().items():
        assert torch.equal(loaded[name], value.to(dtype).float()), name


def test_bundled_configs_are_stable_diffusion_v1_and_its_names_are_all_known():
    """At full size, without memory; diffusers' own converter is the reference for the names."""
    with torch.device("meta"):
        models = make_models({})
    for part, count in STABLE_DIFFUSION_V1.items():
        assert sum(parameter.numel() for parameter in models[part].parameters()) == count, part
    original = original_checkpoint(models) | original_controlnet(models)
    prefixes = {"unet": single_file.UNET, "vae": single_file.VAE, "controlnet": single_file.CONTROL}
    translate = {
        "unet": lambda name: single_file.translate_unet(name, 2),
        "vae": lambda name: single_file.translate_vae(name, 4),
        "controlnet": lambda name: single_file.translate_controlnet(name, 2, 4),
    }
    convert = {
        "unet": convert_ldm_unet_checkpoint,
        "vae": convert_ldm_vae_checkpoint,
        "controlnet": convert_controlnet_checkpoint,
    }
    for part, prefix in prefixes.items():
        ours = {
            translate[part](name.removeprefix(prefix)): value
            for name, value in original.items()
            if name.startswith(prefix)
        }
        theirs = convert[part](dict(original), models[part].config)
        assert ours.keys() == theirs.keys() == models[part].state_dict().keys(), part
        for name, tensor in theirs.items():
            squeezed = tuple(size for size in tensor.shape if size > 1)
            assert tuple(size for size in ours[name].shape if size > 1) == squeezed, name


def test_file_beside_the_checkpoint_changes_its_config(single, control, tmp_path):
    for path in (single, control):
        shutil.copy(path, tmp_path)
    shutil.copytree(single.with_name("tokenizer"), tmp_path / "tokenizer")
    changes = tiny_changes()
    changes = {
        **changes,
        "scheduler": {"prediction_type": "v_prediction", "clip_sample": True},
        "vae": {**changes["vae"], "scaling_factor": 0.5},
        "controlnet": {**changes["controlnet"], "controlnet_conditioning_channel_order": "bgr"},
    }
    for path in (single, control):
        (tmp_path / path.name).with_suffix(".json").write_text(json.dumps(changes))
    base_model = load_base_model(tmp_path / single.name, controlnet=tmp_path / control.name)
    assert base_model.scheduler_config["prediction_type"] == "v_prediction"
    assert base_model.scheduler_config["clip_sample"] is False  # latents are never clipped
    assert base_model.scaling_factor == 0.5 and base_model.reversed_condition
    beside = tmp_path / "v1.json"
    for wrong, message in (
        ({"unet": {"in_chanels": 4}}, "unet has no entry 'in_chanels'; known: sample_size, in_channels"),
        ({"u-net": {}}, "any of unet, controlnet, vae, text_encoder, scheduler, got 'u-net'"),
        ([1], "expected a JSON object, got list"),
    ):
        beside.write_text(json.dumps(wrong))
        with pytest.raises(DataError, match=message):
            check_base_model_folder(tmp_path / single.name)


def test_fine_tuned_single_file_loads_in_diffusers_alone(single, control, tmp_path):
    base_model = load_base_model(single, controlnet=control)
    save_base_model(base_model, tmp_path / "out")
    assert not [path for path in (tmp_path / "out").rglob("*") if path.suffix in (".bin", ".pt", ".pth", ".ckpt")]
    pipeline = StableDiffusionControlNetPipeline.from_pretrained(tmp_path / "out", local_files_only=True)
    for name in ("unet", "controlnet", "vae", "text_encoder"):
        expected = getattr(base_model, name).state_dict()
        got = getattr(pipeline, name).state_dict()
        assert got.keys() == expected.keys() and all(torch.equal(got[key], expected[key]) for key in got), name
    assert pipeline.vae.config.scaling_factor == 0.25
    assert pipeline.scheduler.config.prediction_type == "epsilon" and not pipeline.scheduler.config.clip_sample
    pipeline.set_progress_bar_config(disable=True)
    images = pipeline("a cup", image=torch.zeros(1, 3, SIDE, SIDE), num_inference_steps=2, output_type="np").images
    assert images.shape == (1, SIDE, SIDE, 3) and np.isfinite(images).all()
    again = load_base_model(tmp_path / "out")
    assert again.tokenizer.model_max_length == 16  # the text encoder's, which the tokenizer's folder does not know
    assert again.scheduler_config["prediction_type"] == "epsilon" and again.controlnet is not None


def test_cache_key_sees_every_file(single, control, folder):
    beside = [single.with_suffix(".json"), single.with_name("tokenizer")]
    assert base_model_places(single) == [single, *beside]
    places = base_model_places(single, controlnet=control, needs_controlnet=True)
    assert places == [single, *beside, control, control.with_suffix(".json")]
    control_folder = folder.with_name("sd-controlnet")
    assert base_model_places(folder, controlnet=control_folder) == [folder, control_folder]


def changed(models, tmp_path, drop=(), **tensors):
    """A single file with some tensors left out, others added."""
    kept = {name: value for name, value in original_checkpoint(models).items() if not name.startswith(drop)}
    return write_single({**kept, **tensors}, tmp_path / "changed.safetensors")


FOREIGN = {
    "xl": ("conditioner.embedders.0.transformer.text_model.final_layer_norm.weight", "got Stable Diffusion XL"),
    "sd2": ("cond_stage_model.model.ln_final.weight", "got Stable Diffusion 2, whose text encoder is OpenCLIP"),
    "sd3": ("model.diffusion_model.joint_blocks.0.x_block.attn.qkv.weight", "got Stable Diffusion 3"),
    "lora": ("lora_unet_down_blocks_0.lora_up.weight", "got a LoRA"),
    "folder": ("down_blocks.0.resnets.0.conv1.weight", "weights file of a diffusers folder; give the folder"),
    "control": ("control_model.input_hint_block.0.weight", "got a ControlNet; give it as the option controlnet"),
    "else": ("layer.weight", "got 1 tensors such as layer.weight"),
}


@pytest.mark.parametrize("case", list(FOREIGN))
def test_other_architectures_are_named(tmp_path, case):
    name, message = FOREIGN[case]
    path = write_single({name: torch.zeros(2, 2)}, tmp_path / "file.safetensors")
    with pytest.raises(DataError, match=message):
        check_base_model_folder(path)


def test_parts_that_a_single_file_lacks_are_named(models, single, tmp_path):
    for prefix, message in (
        ("first_stage_model.", "the autoencoder is missing: expected tensors named first_stage_model"),
        ("cond_stage_model.", "the text encoder is missing"),
    ):
        with pytest.raises(DataError, match=message):
            check_base_model_folder(changed(models, tmp_path, drop=prefix))
    path = changed(models, tmp_path)
    with pytest.raises(DataError, match=r"tokenizer: no such folder.*put a folder 'tokenizer' with CLIP's vocab.json"):
        check_base_model_folder(path)
    shutil.copytree(single.with_name("tokenizer"), tmp_path / "tokenizer")
    check_base_model_folder(path)
    lost = "model.diffusion_model.output_blocks.3.0.in_layers.2.weight"
    with pytest.raises(DataError, match=r"1 are missing and 0 others are there; missing: up_blocks.1.resnets.0.conv1"):
        load_base_model(changed(models, tmp_path, drop=lost))
    extra = {"model.diffusion_model.output_blocks.12.0.in_layers.2.weight": torch.zeros(1)}
    with pytest.raises(DataError, match=r"unknown: up_blocks.4.resnets.0.conv1"):
        load_base_model(changed(models, tmp_path, **extra))
    strange = {"first_stage_model.encoder.extra.weight": torch.zeros(1)}
    with pytest.raises(DataError, match=r"unknown: first_stage_model.encoder.extra.weight"):
        load_base_model(changed(models, tmp_path, **strange))
    with pytest.raises(DataError, match=r"nowhere.ckpt: the base model must be .* no such folder or file"):
        check_base_model_folder(tmp_path / "nowhere.ckpt")


def test_inpainting_and_other_text_widths_are_refused(models, single, tmp_path):
    shutil.copytree(single.with_name("tokenizer"), tmp_path / "tokenizer")
    first = "model.diffusion_model.input_blocks.0.0.weight"
    with pytest.raises(DataError, match=r"takes 9 latent channels \(a U-Net for inpainting.*makes 4"):
        check_base_model_folder(changed(models, tmp_path, **{first: torch.zeros(8, 9, 3, 3)}))
    attention = "model.diffusion_model.middle_block.1.transformer_blocks.0.attn2.to_k.weight"
    with pytest.raises(DataError, match=r"takes prompt embeddings 1024 wide \(Stable Diffusion 2\).*makes 12"):
        check_base_model_folder(changed(models, tmp_path, **{attention: torch.zeros(24, 1024)}))


def test_files_that_hold_no_fitting_controlnet_are_refused(models, single, tmp_path):
    tensors = original_controlnet(models)
    cases = {
        "difference": (tensors | {"difference": torch.zeros(1)}, "the difference of a ControlNet to a base model"),
        "stable": (original_checkpoint(models), "got Stable Diffusion without a ControlNet"),
        "wide": (
            original_controlnet(
                make_models(
                    {
                        **tiny_changes(),
                        "controlnet": {**tiny_changes()["controlnet"], "block_out_channels": [16, 16, 16, 24]},
                    }
                )
            ),
            r"made for another U-Net: conv_in.bias is \[16\], in the U-Net of .* \[8\]",
        ),
        "short": (
            {name: value for name, value in tensors.items() if "middle_block.2" not in name},
            "or a part of it is missing: 10 weights are only in one of them, such as mid_block.resnets.1",
        ),
    }
    for name, (held, message) in cases.items():
        with pytest.raises(DataError, match=message):
            check_base_model_folder(single, controlnet=write_single(held, tmp_path / f"{name}.safetensors"))
