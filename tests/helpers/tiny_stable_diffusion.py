"""Stable Diffusion v1 in small, with random weights, as a diffusers folder and under the names of the original code.

The original names are read off the constructors of CompVis' and ControlNet's networks: loops that append to flat lists
of blocks. The project goes the other way, from a name to its place, by arithmetic.
"""

import json
from functools import cache

import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from diffusers.models.controlnets.controlnet import ControlNetModel
from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
from safetensors.torch import save_file
from tiny_base_model import CORPUS
from transformers import CLIPTextConfig, CLIPTextModel

from ctlev_core.diffusion.pretrained.components import read_json
from ctlev_core.diffusion.pretrained.single_file import CONFIGS
from ctlev_core.diffusion.pretraining.architecture import train_tokenizer

SIDE = 32
CHANGES = {
    "unet": {
        "sample_size": SIDE // 8,
        "block_out_channels": [8, 16, 16, 24],
        "norm_num_groups": 4,
        "cross_attention_dim": 12,
        "attention_head_dim": 2,
    },
    "controlnet": {
        "block_out_channels": [8, 16, 16, 24],
        "norm_num_groups": 4,
        "cross_attention_dim": 12,
        "attention_head_dim": 2,
        "conditioning_embedding_out_channels": [4, 4, 8, 8],
    },
    "vae": {"sample_size": SIDE, "block_out_channels": [4, 8, 8, 12], "norm_num_groups": 2, "scaling_factor": 0.25},
    "text_encoder": {
        "hidden_size": 12,
        "intermediate_size": 24,
        "projection_dim": 12,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "max_position_embeddings": 16,
    },
}
SCHEDULER = {
    "_class_name": "PNDMScheduler",
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "beta_start": 0.00085,
    "num_train_timesteps": 1000,
    "set_alpha_to_one": False,
    "skip_prk_steps": True,
    "steps_offset": 1,
}
"""As Stable Diffusion v1.4 was first published: without prediction_type and clip_sample."""


def make_models(changes=CHANGES, seed=0):
    """U-Net, ControlNet, autoencoder and text encoder of the bundled configs with the given changes."""
    configs = {part: {**config, **changes.get(part, {})} for part, config in read_json(CONFIGS).items()}
    torch.manual_seed(seed)
    models = {
        "unet": UNet2DConditionModel.from_config(configs["unet"]),
        "controlnet": ControlNetModel.from_config(configs["controlnet"]),
        "vae": AutoencoderKL.from_config(configs["vae"]),
        "text_encoder": CLIPTextModel(CLIPTextConfig.from_dict(configs["text_encoder"])),
    }
    for model in models.values():
        model.eval().requires_grad_(False)
    for name, parameter in models["controlnet"].named_parameters():
        if name.startswith(("controlnet_down", "controlnet_mid", "controlnet_cond_embedding.conv_out")):
            torch.nn.init.normal_(parameter, std=0.1)  # zero at first, which would hide a mistake
    return models


def write_folder(models, folder):
    """An ordinary diffusers folder, written by the libraries; the ControlNet in a folder of its own beside it."""
    vocabulary = train_tokenizer(CORPUS, folder / "tokenizer").get_vocab()
    assert len(vocabulary) <= models["text_encoder"].config.vocab_size
    for name in ("unet", "vae", "text_encoder"):
        models[name].save_pretrained(folder / name)
    models["controlnet"].save_pretrained(folder.with_name(f"{folder.name}-controlnet"))
    (folder / "scheduler").mkdir()
    (folder / "scheduler" / "scheduler_config.json").write_text(json.dumps(SCHEDULER))
    return folder


@cache
def tiny_changes():
    return {**CHANGES, "text_encoder": {**CHANGES["text_encoder"], "vocab_size": 600}}


def write_single(tensors, path, changes=None):
    """A safetensors file, and beside it what makes the bundled configs small."""
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path)
    path.with_suffix(".json").write_text(json.dumps(tiny_changes() if changes is None else changes))
    return path


def _resnet(original, new, *, timed):
    parts = [("norm1", "in_layers.0"), ("conv1", "in_layers.2"), ("norm2", "out_layers.0"), ("conv2", "out_layers.3")]
    parts += [("time_emb_proj", "emb_layers.1"), ("conv_shortcut", "skip_connection")]
    if not timed:
        parts = [(part, part) for part in ("norm1", "conv1", "norm2", "conv2")] + [("conv_shortcut", "nin_shortcut")]
    return [(f"{new}.{ours}", f"{original}.{theirs}") for ours, theirs in parts]


def unet_encoder_modules(config):
    """(diffusers name, original name) of the modules from the input to the middle; the length of the flat list."""
    kinds, layers = config["down_block_types"], config["layers_per_block"]
    pairs = [("time_embedding.linear_1", "time_embed.0"), ("time_embedding.linear_2", "time_embed.2")]
    pairs, count = [*pairs, ("conv_in", "input_blocks.0.0")], 1
    for level, kind in enumerate(kinds):
        for layer in range(layers):
            pairs += _resnet(f"input_blocks.{count}.0", f"down_blocks.{level}.resnets.{layer}", timed=True)
            if kind.startswith("CrossAttn"):
                pairs.append((f"down_blocks.{level}.attentions.{layer}", f"input_blocks.{count}.1"))
            count += 1
        if level < len(kinds) - 1:
            pairs.append((f"down_blocks.{level}.downsamplers.0.conv", f"input_blocks.{count}.0.op"))
            count += 1
    pairs += _resnet("middle_block.0", "mid_block.resnets.0", timed=True)
    pairs.append(("mid_block.attentions.0", "middle_block.1"))
    return pairs + _resnet("middle_block.2", "mid_block.resnets.1", timed=True), count


def unet_modules(config):
    pairs, _ = unet_encoder_modules(config)
    kinds, count = config["up_block_types"], 0
    for level, kind in enumerate(kinds):
        for layer in range(config["layers_per_block"] + 1):
            pairs += _resnet(f"output_blocks.{count}.0", f"up_blocks.{level}.resnets.{layer}", timed=True)
            slot = 1
            if kind.startswith("CrossAttn"):
                pairs.append((f"up_blocks.{level}.attentions.{layer}", f"output_blocks.{count}.1"))
                slot = 2
            if layer == config["layers_per_block"] and level < len(kinds) - 1:
                pairs.append((f"up_blocks.{level}.upsamplers.0.conv", f"output_blocks.{count}.{slot}.conv"))
            count += 1
    return [*pairs, ("conv_norm_out", "out.0"), ("conv_out", "out.2")]


def controlnet_modules(config):
    pairs, count = unet_encoder_modules(config)
    pairs += [(f"controlnet_down_blocks.{number}", f"zero_convs.{number}.0") for number in range(count)]
    pairs.append(("controlnet_mid_block", "middle_block_out.0"))
    names = ["conv_in", *(f"blocks.{n}" for n in range(2 * len(config["conditioning_embedding_out_channels"]) - 2))]
    for number, name in enumerate([*names, "conv_out"]):  # convolutions and activations in turns
        pairs.append((f"controlnet_cond_embedding.{name}", f"input_hint_block.{2 * number}"))
    return pairs


def vae_modules(config):
    levels, layers = len(config["block_out_channels"]), config["layers_per_block"]
    pairs = [(name, name) for name in ("quant_conv", "post_quant_conv")]
    for half, extra in (("encoder", 0), ("decoder", 1)):
        pairs += [(f"{half}.{name}", f"{half}.{name}") for name in ("conv_in", "conv_out")]
        pairs.append((f"{half}.conv_norm_out", f"{half}.norm_out"))
        for number in (0, 1):
            pairs += _resnet(f"{half}.mid.block_{number + 1}", f"{half}.mid_block.resnets.{number}", timed=False)
        for ours, theirs in (
            ("group_norm", "norm"),
            ("to_q", "q"),
            ("to_k", "k"),
            ("to_v", "v"),
            ("to_out.0", "proj_out"),
        ):
            pairs.append((f"{half}.mid_block.attentions.0.{ours}", f"{half}.mid.attn_1.{theirs}"))
        direction = "up" if extra else "down"
        for level in range(levels):
            original = f"{half}.{direction}.{levels - 1 - level if extra else level}"
            for layer in range(layers + extra):
                new = f"{half}.{direction}_blocks.{level}.resnets.{layer}"
                pairs += _resnet(f"{original}.block.{layer}", new, timed=False)
            pairs.append(
                (f"{half}.{direction}_blocks.{level}.{direction}samplers.0.conv", f"{original}.{direction}sample.conv")
            )
    return pairs


def rename(state, pairs, prefix):
    """The tensors under their original names; every one must belong to a module."""
    modules, renamed = dict(pairs), {}
    for name, tensor in state.items():
        module, rest = name, ""
        while module not in modules:
            module, _, last = module.rpartition(".")
            rest = f".{last}{rest}"
        renamed[f"{prefix}{modules[module]}{rest}"] = tensor
    assert len(renamed) == len(state)
    return renamed


def original_controlnet(models, prefix="control_model."):
    return rename(models["controlnet"].state_dict(), controlnet_modules(models["controlnet"].config), prefix)


def original_checkpoint(models):
    """U-Net, autoencoder and text encoder as Stable Diffusion v1's own code saves them."""
    unet = rename(models["unet"].state_dict(), unet_modules(models["unet"].config), "model.diffusion_model.")
    vae = rename(models["vae"].state_dict(), vae_modules(models["vae"].config), "first_stage_model.")
    for name, tensor in vae.items():
        if ".attn_1." in name and tensor.ndim == 2:
            vae[name] = tensor[:, :, None, None]
    prefix = "cond_stage_model.transformer.text_model."
    text = {
        prefix + name.removeprefix("text_model."): value for name, value in models["text_encoder"].state_dict().items()
    }
    text[f"{prefix}embeddings.position_ids"] = torch.arange(models["text_encoder"].config.max_position_embeddings)[None]
    schedule = {"betas": torch.linspace(0.1, 0.2, 10), "alphas_cumprod": torch.linspace(0.9, 0.1, 10)}
    return {**schedule, **unet, **vae, **text, "model_ema.decay": torch.tensor(0.9999)}
