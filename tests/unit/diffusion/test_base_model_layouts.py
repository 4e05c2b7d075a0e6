"""The layouts that published folders have are all read; what is missing, foreign or damaged is named in time."""

import json
import logging
import pickle
import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_stable_diffusion import CHANGES, make_models, tiny_changes, write_folder

from ctlev_core.diffusion.patch_autoencoder import PatchAutoencoder
from ctlev_core.diffusion.pretrained.loading import PretrainedModel, decode_latents, load_base_model, save_base_model
from ctlev_core.diffusion.pretrained.paths import base_model_places, check_base_model_folder
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.generators import controlnet, stable_diffusion
from data_contracts.config import GeneratorChoice
from data_contracts.errors import DataError
from data_contracts.manifest import ManifestRef
from tasks.finetune import finetune
from tasks.stage import planning


@pytest.fixture(scope="module")
def models():
    return make_models(tiny_changes())


@pytest.fixture(scope="module")
def written(models, tmp_path_factory):
    return write_folder(models, tmp_path_factory.mktemp("layouts") / "sd")


@pytest.fixture
def folder(written, tmp_path):
    """A copy to change; the ControlNet lies beside it, in `sd-controlnet`."""
    shutil.copytree(written.with_name("sd-controlnet"), tmp_path / "sd-controlnet")
    return shutil.copytree(written, tmp_path / "sd")


def weights_of(part):
    return next(part.glob("*.safetensors"))


def change_json(path, **entries):
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, **entries}))


def change_weights(part, change):
    path = weights_of(part)
    save_file(change(load_file(path)), path, metadata={"format": "pt"})


def same_unet(base_model, models, dtype=torch.float32):
    expected = models["unet"].state_dict()
    return all(
        torch.equal(value, expected[name].to(dtype).float()) for name, value in base_model.unet.state_dict().items()
    )


# Layouts that are read


def test_half_precision_variants_are_read_where_there_is_nothing_else(folder, models):
    for name in ("unet", "vae", "text_encoder"):
        for path in (folder / name).glob("*.safetensors"):
            halves = {key: value.half() for key, value in load_file(path).items()}
            save_file(halves, path.with_name(path.name.replace(".safetensors", ".fp16.safetensors")))
    assert same_unet(load_base_model(folder), models)  # the full weights come first
    for name in ("unet", "vae", "text_encoder"):
        (full,) = [path for path in (folder / name).glob("*.safetensors") if ".fp16." not in path.name]
        full.unlink()
    base_model = load_base_model(folder)
    assert same_unet(base_model, models, torch.float16) and base_model.unet.dtype == torch.float32
    assert load_base_model(folder, dtype=torch.float16).unet.dtype == torch.float16
    half = folder / "unet" / "diffusion_pytorch_model.fp16.safetensors"
    shutil.copy(half, half.with_name("diffusion_pytorch_model.non_ema.safetensors"))
    assert same_unet(load_base_model(folder), models, torch.float16)
    half.rename(half.with_name("diffusion_pytorch_model.ema.safetensors"))
    with pytest.raises(DataError, match=r"which of .*ema.safetensors, .*non_ema.safetensors\? Keep one"):
        check_base_model_folder(folder)


@pytest.mark.parametrize("variant", ["", ".fp16"])
def test_shards_are_read_by_their_index(folder, models, variant):
    part = folder / "unet"
    shutil.rmtree(part)
    models["unet"].save_pretrained(part, max_shard_size="60KB", variant=variant[1:] or None)
    index = next(part.glob("*.index*.json"))
    shards = sorted(part.glob("*-of-*.safetensors"))
    assert len(shards) > 2
    assert same_unet(load_base_model(folder), models)
    content = shards[1].read_bytes()
    shards[1].unlink()
    with pytest.raises(DataError, match=rf"unet: missing {shards[1].name} of the {len(shards)} shards in {index.name}"):
        check_base_model_folder(folder)
    shards[1].write_bytes(content)
    weight_map = json.loads(index.read_text())["weight_map"]
    change_json(index, weight_map={**weight_map, "conv_in.weight": "../vae/diffusion_pytorch_model.safetensors"})
    with pytest.raises(DataError, match="shards lie in the same folder"):
        check_base_model_folder(folder)
    for wrong in ({}, [], None):
        change_json(index, weight_map=wrong)
        with pytest.raises(DataError, match="expected an object 'weight_map'"):
            check_base_model_folder(folder)


def test_torch_files_are_read_without_running_them(folder, models):
    for name, file in (("unet", "diffusion_pytorch_model.bin"), ("text_encoder", "pytorch_model.bin")):
        path = weights_of(folder / name)
        torch.save(load_file(path), path.with_name(file))
        path.unlink()
    base_model = load_base_model(folder)
    assert same_unet(base_model, models)
    expected = models["text_encoder"].state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in base_model.text_encoder.state_dict().items())


def test_weights_under_the_names_of_older_libraries_are_read(folder, models):
    """As in the published v1.4: transformers with its prefix and position_ids, diffusers with its old attention."""
    old = {"to_q": "query", "to_k": "key", "to_v": "value", "to_out.0": "proj_attn"}

    def old_attention(tensors):
        renamed = {}
        for name, value in tensors.items():
            for new_name, old_name in old.items():
                name = name.replace(f".{new_name}.", f".{old_name}.")
            renamed[name] = value
        assert any(".query." in name for name in renamed)
        return renamed

    def old_text(tensors):
        ids = {"text_model.embeddings.position_ids": torch.arange(16)[None]}
        return ids | {f"text_model.{name.removeprefix('text_model.')}": value for name, value in tensors.items()}

    change_weights(folder / "vae", old_attention)
    change_weights(folder / "text_encoder", old_text)
    base_model = load_base_model(folder)
    for name in ("vae", "text_encoder"):
        expected = models[name].state_dict()
        assert all(torch.equal(value, expected[key]) for key, value in getattr(base_model, name).state_dict().items())


def test_schedule_comes_from_the_folder(folder, caplog):
    """The first published configs do not say what is predicted; classes' defaults would clip latents."""
    path = folder / "scheduler" / "scheduler_config.json"
    assert "prediction_type" not in json.loads(path.read_text())
    config = load_base_model(folder).scheduler_config
    assert (config["prediction_type"], config["clip_sample"], config["beta_end"]) == ("epsilon", False, 0.012)
    assert not caplog.records
    change_json(path, prediction_type="v_prediction", clip_sample=True, beta_end=0.02)
    with caplog.at_level(logging.WARNING):
        config = load_base_model(folder).scheduler_config
    assert (config["prediction_type"], config["clip_sample"], config["beta_end"]) == ("v_prediction", False, 0.02)
    assert "clip_sample of its scheduler config is ignored" in caplog.text
    change_json(path, prediction_type="flow_prediction")
    with pytest.raises(DataError, match="prediction_type must be one of epsilon, v_prediction, sample, got 'flow"):
        check_base_model_folder(folder)
    change_json(path, prediction_type="epsilon")
    for changed, message in (
        ({"rescale_betas_zero_snr": True}, "expected prediction_type v_prediction or sample"),
        ({"rescale_betas_zero_snr": False, "num_train_timesteps": "many"}, "positive whole number, got 'many'"),
        ({"num_train_timesteps": 1000, "beta_schedule": "sigmoid"}, "one of linear, scaled_linear, .* got 'sigmoid'"),
        ({"beta_schedule": "linear", "beta_end": "x"}, "beta_end must be a number between 0 and 1, got 'x'"),
    ):
        change_json(path, **changed)
        with pytest.raises(DataError, match=message):
            check_base_model_folder(folder)
    path.write_text(json.dumps({"_class_name": "FlowMatchEulerDiscreteScheduler", "num_train_timesteps": 1000}))
    with pytest.raises(DataError, match=r"FlowMatchEuler.* lacks beta_start, beta_end, beta_schedule"):
        check_base_model_folder(folder)


# What is refused, by the call that a dry run makes


def refused(folder, message, **options):
    """Both generators' plan raises, before anything is loaded."""
    with pytest.raises(DataError, match=message):
        stable_diffusion.base_model_folders(stable_diffusion.Options(base_model=folder))
    with pytest.raises(DataError, match=message):
        controlnet.base_model_folders(
            controlnet.Options(base_model=folder, controlnet=folder.with_name("sd-controlnet"))
        )


@pytest.mark.parametrize("name", ["tokenizer", "text_encoder", "vae", "unet", "scheduler"])
def test_missing_subfolder(folder, name):
    shutil.rmtree(folder / name)
    refused(folder, rf"sd: a diffusers folder has the subfolders .*; missing: {name}; found: ")


def test_folder_of_a_hub_cache(folder):
    (folder / "snapshots" / "0123").mkdir(parents=True)
    shutil.move(folder / "unet", folder / "snapshots" / "0123")
    refused(folder, "a cache of Hugging Face's hub; give the folder of one revision in its snapshots")


def test_quantised_weights(folder):
    change_weights(folder / "vae", lambda tensors: {**tensors, "quant_conv.bias": torch.zeros(8, dtype=torch.int8)})
    with pytest.raises(DataError, match=r"quant_conv.bias is of type I8; expected F64, F32, F16, BF16"):
        load_base_model(folder)


@pytest.mark.parametrize("name", ["text_encoder", "vae", "unet"])
def test_missing_config_or_weights(folder, name):
    weights_of(folder / name).rename(folder / name / "notes.txt")
    refused(folder, rf"{name}: no weights; expected .* found config.json, notes.txt")
    (folder / name / "config.json").unlink()
    refused(folder, rf"{name}: config.json is missing")


def test_damaged_json(folder):
    for path in (folder / "unet" / "config.json", folder / "scheduler" / "scheduler_config.json"):
        content = path.read_text()
        for wrong in ("{", "[]", "\x00"):
            path.write_text(wrong)
            refused(folder, rf"{path.name}: (cannot be read as JSON|expected a JSON object)")
        path.write_text(content)
    (folder / "scheduler" / "scheduler_config.json").unlink()
    refused(folder, "scheduler_config.json: cannot be read as JSON")


def test_truncated_weights_tell_their_size(folder):
    path = weights_of(folder / "vae")
    size = path.stat().st_size
    path.write_bytes(path.read_bytes()[:-1000])
    refused(folder, rf"{path.name}: truncated: expected {size} bytes, got {size - 1000}")


def test_weights_that_are_not_finite_are_named(folder):
    def spoil(tensors):
        tensors["mid_block.resnets.0.conv1.weight"][3, 2, 1, 0] = np.nan
        return tensors

    change_weights(folder / "unet", spoil)
    refused(folder, r"tensor 'mid_block.resnets.0.conv1.weight' holds values that are not finite")


class Attack:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.parametrize("file", ["diffusion_pytorch_model.bin", "diffusion_pytorch_model.safetensors"])
@pytest.mark.parametrize("archive", [True, False])
def test_pickles_are_refused_and_nothing_runs(folder, tmp_path, file, archive):
    weights_of(folder / "unet").unlink()
    state = {"conv_in.weight": torch.zeros(1), "attack": Attack(tmp_path / "it_ran")}
    if archive:
        torch.save(state, folder / "unet" / file)
    else:
        (folder / "unet" / file).write_bytes(pickle.dumps(state["attack"]))
    refused(folder, "refused: it names _?io.open" if archive else "bare pickle")
    assert not (tmp_path / "it_ran").exists()


def test_inpainting_unet(folder):
    def widen(tensors):
        return {**tensors, "conv_in.weight": torch.zeros(8, 9, 3, 3)}

    change_weights(folder / "unet", widen)
    change_json(folder / "unet" / "config.json", in_channels=9)
    refused(folder, r"takes 9 latent channels \(a U-Net for inpainting.* makes 4")
    change_json(folder / "unet" / "config.json", in_channels=4)
    refused(folder, r"takes 9 latent channels")


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        (
            {"class_embed_type": "projection", "projection_class_embeddings_input_dim": 24},
            "embeddings of images .* got 'pr",
        ),
        ({"num_class_embeds": 10}, "takes class labels beside the prompt: expected num_class_embeds null, got 10"),
        (
            {"encoder_hid_dim_type": "image_proj", "encoder_hid_dim": 8},
            "expected encoder_hid_dim_type null, got 'image",
        ),
        (
            {"time_cond_proj_dim": 16},
            "scale of guidance, as latent consistency models do .* time_cond_proj_dim null, got 16",
        ),
        ({"out_channels": 8}, "gives 8 channels for latents of 4; expected one prediction"),
    ],
)
def test_unets_that_are_called_in_another_way(folder, entries, message):
    """As of Stable Diffusion 2.1 unCLIP or LCM: whole and consistent, and no part of them is missing."""
    changes = tiny_changes()
    unet = make_models({**changes, "unet": {**changes["unet"], **entries}})["unet"]
    unet.save_pretrained(folder / "unet")
    refused(folder, message)


def test_config_of_another_network(folder):
    change_json(folder / "unet" / "config.json", block_out_channels=[320, 640, 1280, 1280])
    refused(folder, r"config.json says block_out_channels 320, weight conv_in.weight has shape \[8, 4, 3, 3\]")
    change_json(folder / "unet" / "config.json", block_out_channels=[8, 16, 16, 32])
    check_base_model_folder(folder)  # deeper differences show when the network is built
    with pytest.raises(DataError, match=r"by its config has .* of shape \[.*32.*\], the weights file \["):
        load_base_model(folder)
    change_json(
        folder / "unet" / "config.json", block_out_channels=CHANGES["unet"]["block_out_channels"], act_fn="none"
    )
    with pytest.raises(DataError, match="its config does not make a unet"):
        load_base_model(folder)
    change_json(folder / "unet" / "config.json", sample_size=None)
    refused(folder, "sample_size in its config must be the side of square latents, got None")


def test_text_encoder_of_stable_diffusion_2(folder):
    name = "embeddings.token_embedding.weight"
    change_weights(folder / "text_encoder", lambda tensors: {
        key: torch.zeros(600, 1024) if key.endswith(name) else value for key, value in tensors.items()
    })  # fmt: skip
    refused(folder, r"config.json says hidden_size 12, weight .* has shape \[600, 1024\]")
    change_json(folder / "text_encoder" / "config.json", hidden_size=1024)
    refused(folder, r"takes prompt embeddings 12 wide, the text encoder .* makes 1024 \(Stable Diffusion 2\)")


def test_parts_of_stable_diffusion_xl(folder):
    """Whole models of it: test_base_model_families.py."""
    change_json(folder / "unet" / "config.json", addition_embed_type="text_time")
    refused(folder, r"unet: this U-Net is of Stable Diffusion XL, whose second text encoder .* is missing")
    (folder / "text_encoder_2").mkdir()
    refused(folder, "it has text_encoder_2, as Stable Diffusion XL; its tokenizer_2 is missing")


def test_other_classes(folder):
    for name, entries, message in (
        ("vae", {"_class_name": "AutoencoderTiny"}, "autoencoder must be one of .* got 'AutoencoderTiny'"),
        ("unet", {"_class_name": "UNet3DConditionModel"}, "unet must be one of UNet2DConditionModel"),
        ("text_encoder", {"architectures": ["T5EncoderModel"]}, "text_encoder must be one of CLIPTextModel"),
    ):
        content = (folder / name / "config.json").read_text()
        change_json(folder / name / "config.json", **entries)
        refused(folder, message)
        (folder / name / "config.json").write_text(content)


def test_tokenizers(folder):
    tokenizer = folder / "tokenizer"
    assert (tokenizer / "vocab.json").is_file()
    change_json(tokenizer / "vocab.json", surplus=600)
    refused(folder, "token ids reach 600, the text encoder of .* has 600 embeddings")
    (tokenizer / "merges.txt").unlink()
    refused(folder, r"tokenizer: no tokenizer; expected vocab.json and merges.txt, or tokenizer.json")
    (tokenizer / "tokenizer.json").write_text(json.dumps({"model": {"vocab": {"a": 7}}, "added_tokens": [{"id": 600}]}))
    refused(folder, "token ids reach 600")
    (tokenizer / "tokenizer.json").write_text(json.dumps({"model": 3, "added_tokens": "x"}))
    refused(folder, "token ids reach -1")


def test_a_dry_run_reports_it(home, folder):
    inputs = [ManifestRef(key="0" * 32, path=folder)] * 2
    choice = GeneratorChoice(name="stable_diffusion", options={"base_model": str(folder)})
    with planning() as rows:
        finetune(*inputs, generator=choice, seed=0)
    assert [row.stage for row in rows] == ["finetune"]
    path = weights_of(folder / "unet")
    path.write_bytes(path.read_bytes()[:-1])
    with planning(), pytest.raises(DataError, match="truncated"):
        finetune(*inputs, generator=choice, seed=0)


def refused_controlnet(folder, message):
    control = folder.with_name("sd-controlnet")
    check_base_model_folder(folder)
    with pytest.raises(DataError, match=message):
        controlnet.base_model_folders(controlnet.Options(base_model=folder, controlnet=control))


def test_controlnets_that_do_not_fit(folder):
    control = folder.with_name("sd-controlnet")
    config, weights = (control / "config.json").read_text(), weights_of(control).read_bytes()
    refused_cases = [
        (lambda tensors: {**tensors, "conv_in.bias": torch.zeros(320)}, {}, r"conv_in.bias is \[320\].* \[8\]"),
        (lambda tensors: tensors, {"_class_name": "T2IAdapter"}, "must be one of ControlNetModel, got 'T2IAdapter'"),
        (
            lambda tensors: tensors,
            {"controlnet_conditioning_channel_order": "grb"},
            "must be 'rgb' or 'bgr', got 'grb'",
        ),
        (
            lambda tensors: tensors,
            {"conditioning_embedding_out_channels": [4, 4, 8]},
            "reduces condition images 4 times, the autoencoder of .* reduces images 8 times",
        ),
        (
            lambda tensors: {name: value for name, value in tensors.items() if "down_blocks.3.resnets.1" not in name},
            {},
            "or a part of it is missing: 10 weights are only in one of them",
        ),
    ]
    for change, entries, message in refused_cases:
        change_weights(control, change)
        change_json(control / "config.json", **entries)
        refused_controlnet(folder, message)
        (control / "config.json").write_text(config)
        weights_of(control).write_bytes(weights)
    base_model = load_base_model(folder, controlnet=control)
    assert base_model.controlnet is not None
    with pytest.raises(DataError, match="no subfolder 'controlnet', and no separate ControlNet folder or file"):
        base_model_places(folder, needs_controlnet=True)


def test_a_controlnet_that_is_not_wanted_is_not_looked_at(folder):
    shutil.copytree(folder.with_name("sd-controlnet"), folder / "controlnet")
    weights_of(folder / "controlnet").write_bytes(b"")
    assert load_base_model(folder, with_controlnet=False).controlnet is None
    assert stable_diffusion.base_model_folders(stable_diffusion.Options(base_model=folder)) == [folder]
    with pytest.raises(DataError, match=r"controlnet/.*no safetensors file: 0 bytes"):
        load_base_model(folder)


# Prompts and images


def test_prompts_that_are_too_long_are_cut_and_named(written, caplog):
    base_model = load_base_model(written)
    short, fits = "a cup", "a cup " * 7  # start, fourteen words, end: all sixteen
    with caplog.at_level(logging.WARNING):
        encode_prompts(base_model, [short, fits.strip(), ""])
    assert not caplog.records
    long = "a cup " * 7 + "and a ball"
    with caplog.at_level(logging.WARNING):
        embeddings = encode_prompts(base_model, [short, long])
    (record,) = caplog.records
    assert "is cut to 16" in record.getMessage() and repr(long) in record.getMessage()
    assert embeddings.shape == (2, 16, 12)
    # Cut means cut: what lies beyond the limit changes nothing.
    assert torch.equal(embeddings[1:], encode_prompts(base_model, ["a cup " * 7 + "and nothing else"]))


class Overflowing(PatchAutoencoder):
    """In half precision the second half of all decoded images is NaN, as some autoencoders' are."""

    def decode(self, z, return_dict=True, generator=None):
        decoded = super().decode(z, return_dict, generator)
        if self.dtype != torch.float32:
            decoded.sample[len(z) // 2 :] = float("nan")
        return decoded


def half_base_model(vae):
    return PretrainedModel(None, None, vae.half(), None, None, {}, (8, 8))


def test_images_that_overflow_in_half_precision_are_decoded_again(caplog):
    latents = torch.randn((4, 48, 2, 2), generator=torch.Generator().manual_seed(0))
    expected = PatchAutoencoder().decode(latents).sample
    vae = Overflowing()
    with caplog.at_level(logging.WARNING):
        images = decode_latents(half_base_model(vae), latents)
    assert "2 of 4 images were not finite in float16" in caplog.text
    assert images.dtype == torch.float32 and vae.dtype == torch.float16
    assert torch.allclose(images, expected, atol=0.02)  # halves: 11 bits of values up to about 5
    plain = decode_latents(half_base_model(PatchAutoencoder()), latents)
    assert torch.equal(images[:2], plain[:2])  # those that were finite stay as they were
    again = decode_latents(half_base_model(Overflowing()), torch.cat([latents[3:], latents[3:]]))
    assert torch.equal(again[1], images[3])  # alone or in another batch


def test_images_that_are_never_finite_are_an_error():
    latents = torch.zeros(2, 48, 2, 2)
    latents[1, 0] = float("nan")
    for vae in (PatchAutoencoder().half(), PatchAutoencoder()):
        with pytest.raises(DataError, match="the latents of 1 of 2 samples hold values that are not finite"):
            decode_latents(PretrainedModel(None, None, vae, None, None, {}, (8, 8)), latents)


def test_saved_folder_keeps_scale_and_channel_order(folder, tmp_path):
    change_json(folder.with_name("sd-controlnet") / "config.json", controlnet_conditioning_channel_order="bgr")
    save_base_model(load_base_model(folder, controlnet=folder.with_name("sd-controlnet")), tmp_path / "out")
    again = load_base_model(tmp_path / "out")
    assert again.reversed_condition and again.scaling_factor == 0.25
    assert {path.suffix for path in (tmp_path / "out").rglob("*") if path.is_file()} <= {
        ".json",
        ".safetensors",
        ".txt",
    }
