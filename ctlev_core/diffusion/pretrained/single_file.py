"""Checkpoints in one file, with the names that CompVis' and ControlNet's own code gives the weights.

Such a file holds U-Net, autoencoder and text encoder of Stable Diffusion v1, or a ControlNet, or both; it has no
configs and no tokenizer. The configs are bundled (`model_configs/stable_diffusion_v1.json`); `<name>.json` beside
`<name>.safetensors` changes entries of them, and a folder `tokenizer` beside it holds the tokenizer.
Imports nothing heavy: the plan calls it.

Sources of the names: CompVis/stable-diffusion, `openaimodel.py` (the U-Net's flat lists of blocks) and
`diffusionmodules/model.py` (the autoencoder); lllyasviel/ControlNet, `cldm.py`; diffusers for its own.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ctlev_core.diffusion.pretrained.components import ModelFiles, ModelPart, read_json
from ctlev_core.safe_files.tensor_files import StoredTensor, read_tensor_table
from data_contracts.errors import DataError

CONFIGS = Path(__file__).with_name("model_configs") / "stable_diffusion_v1.json"
ENDINGS = (".safetensors", ".ckpt", ".pth", ".pt", ".bin")
UNET, VAE, CONTROL = "model.diffusion_model.", "first_stage_model.", "control_model."
TEXT = "cond_stage_model.transformer."
_RESNET = {
    "in_layers.0": "norm1",
    "in_layers.2": "conv1",
    "emb_layers.1": "time_emb_proj",
    "out_layers.0": "norm2",
    "out_layers.3": "conv2",
    "skip_connection": "conv_shortcut",
}
_UNET_ENDS = {
    "time_embed.0": "time_embedding.linear_1",
    "time_embed.2": "time_embedding.linear_2",
    "input_blocks.0.0": "conv_in",
    "out.0": "conv_norm_out",
    "out.2": "conv_out",
}
_CONTROL_ENDS = {
    "input_hint_block.0": "controlnet_cond_embedding.conv_in",
    "middle_block_out.0": "controlnet_mid_block",
}
_MIDDLE = {"0": "mid_block.resnets.0", "1": "mid_block.attentions.0", "2": "mid_block.resnets.1"}
_VAE_ATTENTION = {"norm": "group_norm", "q": "to_q", "k": "to_k", "v": "to_v", "proj_out": "to_out.0"}
_FOREIGN = {
    "conditioner.embedders.": "Stable Diffusion XL",
    "cond_stage_model.model.": "Stable Diffusion 2, whose text encoder is OpenCLIP, 1024 wide",
    "model.diffusion_model.joint_blocks.": "Stable Diffusion 3",
    "model.diffusion_model.double_blocks.": "Flux",
    "double_blocks.": "Flux",
    "lora_": "a LoRA, which is no checkpoint of its own",
}


def translate_unet(name: str, layers_per_block: int) -> str | None:
    """The diffusers name of a weight of the U-Net, or of the encoder that a ControlNet copies; None = unknown.

    The original code keeps one flat list of blocks: the input convolution, then for each resolution `layers_per_block`
    blocks and one that halves the resolution; upwards `layers_per_block` + 1 blocks, the last of which doubles it.
    """
    module, _, kind = name.rpartition(".")
    if module in _UNET_ENDS:
        return f"{_UNET_ENDS[module]}.{kind}"
    if match := re.fullmatch(r"middle_block\.([012])\.(.+)", name):
        rest = match[2] if match[1] == "1" else _translate_resnet(match[2])
        return f"{_MIDDLE[match[1]]}.{rest}" if rest else None
    match = re.fullmatch(r"(input|output)_blocks\.(\d+)\.(\d)\.(.+)", name)
    if match is None:
        return None
    down, slot, rest = match[1] == "input", match[3], match[4]
    block, layer = divmod(int(match[2]) - down, layers_per_block + 1)
    place = f"{'down' if down else 'up'}_blocks.{block}"
    if rest in ("op.weight", "op.bias"):
        return f"{place}.downsamplers.0.conv.{kind}"
    if rest in ("conv.weight", "conv.bias"):
        return f"{place}.upsamplers.0.conv.{kind}"
    if slot == "1":
        return f"{place}.attentions.{layer}.{rest}"
    resnet = _translate_resnet(rest)
    return f"{place}.resnets.{layer}.{resnet}" if slot == "0" and resnet else None


def _translate_resnet(rest: str) -> str | None:
    module, _, kind = rest.rpartition(".")
    return f"{_RESNET[module]}.{kind}" if module in _RESNET else None


def translate_controlnet(name: str, layers_per_block: int, embedding_stages: int) -> str | None:
    """The diffusers name of a ControlNet's weight.

    Args:
        name: without the prefix `control_model.`.
        layers_per_block: of the config.
        embedding_stages: length of `conditioning_embedding_out_channels`; the condition goes through a convolution,
            two for each stage but the last, and a final one, with an activation between any two.
    """
    module, _, kind = name.rpartition(".")
    if module in _CONTROL_ENDS:
        return f"{_CONTROL_ENDS[module]}.{kind}"
    if match := re.fullmatch(r"zero_convs\.(\d+)\.0", module):
        return f"controlnet_down_blocks.{match[1]}.{kind}"
    if match := re.fullmatch(r"input_hint_block\.(\d+)", module):
        number = int(match[1]) // 2 - 1
        final = number == 2 * (embedding_stages - 1)
        return f"controlnet_cond_embedding.{'conv_out' if final else f'blocks.{number}'}.{kind}"
    return translate_unet(name, layers_per_block)


def translate_vae(name: str, levels: int) -> str | None:
    """The diffusers name of an autoencoder's weight; the original counts the decoder's levels from the image."""
    module, _, kind = name.rpartition(".")
    if re.fullmatch(r"(encoder|decoder)\.conv_(in|out)|(post_)?quant_conv", module):
        return name
    if match := re.fullmatch(r"(encoder|decoder)\.norm_out", module):
        return f"{match[1]}.conv_norm_out.{kind}"
    if match := re.fullmatch(r"(encoder|decoder)\.mid\.block_([12])\.(\w+)", module):
        return f"{match[1]}.mid_block.resnets.{int(match[2]) - 1}.{_shortcut(match[3])}.{kind}"
    if match := re.fullmatch(r"(encoder|decoder)\.mid\.attn_1\.(\w+)", module):
        part = _VAE_ATTENTION.get(match[2])
        return f"{match[1]}.mid_block.attentions.0.{part}.{kind}" if part else None
    match = re.fullmatch(r"(encoder\.down|decoder\.up)\.(\d+)\.(?:block\.(\d+)\.(\w+)|(down|up)sample\.conv)", module)
    if match is None:
        return None
    level = int(match[2]) if match[1] == "encoder.down" else levels - 1 - int(match[2])
    if match[5]:
        return f"{match[1]}_blocks.{level}.{match[5]}samplers.0.conv.{kind}"
    return f"{match[1]}_blocks.{level}.resnets.{match[3]}.{_shortcut(match[4])}.{kind}"


def _shortcut(part: str) -> str:
    return "conv_shortcut" if part == "nin_shortcut" else part


def translate_text(name: str) -> str | None:
    """The text encoder's names are those of transformers; what its model does not use is left out."""
    return None if name.endswith(".position_ids") or name.startswith(("logit_scale", "text_projection")) else name


def is_single_file(path: Path) -> bool:
    """Is it a file rather than a diffusers folder, or would it be one if it were there?"""
    return path.is_file() or (path.suffix in ENDINGS and not path.is_dir())


def files_beside(path: Path) -> list[Path]:
    """What belongs to a checkpoint file besides itself: the changes of its config, and the tokenizer's folder."""
    return [place for place in (path.with_suffix(".json"), path.with_name("tokenizer")) if place.exists()]


def read_single_base_model(path: Path) -> ModelFiles:
    """Stable Diffusion v1 in one file.

    Raises:
        DataError: no such file, damaged, another architecture, or without its tokenizer beside it.
    """
    tensors = read_tensor_table(path)
    _refuse_foreign(path, tensors)
    if f"{UNET}input_blocks.0.0.weight" not in tensors:
        raise DataError(
            f"{path}: expected a Stable Diffusion v1 checkpoint with the original names ({UNET}input_blocks.0.0.weight "
            f"...), {_what_it_is(tensors)}"
        )
    for prefix, part in ((VAE, "autoencoder"), (TEXT, "text encoder")):
        if not any(name.startswith(prefix) for name in tensors):
            raise DataError(
                f"{path}: the {part} is missing: expected tensors named {prefix}...; take the whole checkpoint"
            )
    tokenizer = path.with_name("tokenizer")
    if not tokenizer.is_dir():
        raise DataError(
            f"{tokenizer}: no such folder; a checkpoint in one file has no tokenizer: put a folder 'tokenizer' with "
            "CLIP's vocab.json and merges.txt beside it, the one of any Stable Diffusion v1 diffusers folder"
        )
    configs = _read_configs(path)
    parts = {
        "text_encoder": _part(path, "text_encoder", configs, tensors, TEXT, translate_text),
        "vae": _vae_part(path, configs, tensors),
        "unet": _unet_part(path, configs, tensors),
    }
    if f"{CONTROL}input_hint_block.0.weight" in tensors:
        parts["controlnet"] = _controlnet_part(path, configs, tensors, CONTROL)
    return ModelFiles(path, parts, tokenizer, configs["scheduler"])


def read_single_controlnet(path: Path) -> ModelPart:
    """A ControlNet for Stable Diffusion v1 in one file, with or without Stable Diffusion beside it.

    Raises:
        DataError: no such file, damaged, or something else.
    """
    tensors = read_tensor_table(path)
    _refuse_foreign(path, tensors)
    if "difference" in tensors:
        raise DataError(f"{path}: holds the difference of a ControlNet to a base model; expected the ControlNet itself")
    for prefix in (CONTROL, ""):
        if f"{prefix}input_hint_block.0.weight" in tensors:
            return _controlnet_part(path, _read_configs(path), tensors, prefix)
    raise DataError(
        f"{path}: expected a ControlNet with the original names ({CONTROL}input_hint_block.0.weight ...), "
        f"{_what_it_is(tensors)}"
    )


def _unet_part(path: Path, configs: dict[str, Any], tensors: dict[str, StoredTensor]) -> ModelPart:
    layers = configs["unet"]["layers_per_block"]
    return _part(path, "unet", configs, tensors, UNET, lambda name: translate_unet(name, layers))


def _vae_part(path: Path, configs: dict[str, Any], tensors: dict[str, StoredTensor]) -> ModelPart:
    levels = len(configs["vae"]["block_out_channels"])
    part = _part(path, "vae", configs, tensors, VAE, lambda name: translate_vae(name, levels))
    # Attention was written as convolutions of one pixel; diffusers has the same weights as matrices.
    matrices = {
        name: dataclasses.replace(tensor, shape=tensor.shape[:2], strides=tensor.strides[:2])
        for name, tensor in part.tensors.items()
        if ".attentions." in name and len(tensor.shape) > 2 and set(tensor.shape[2:]) == {1}
    }
    return dataclasses.replace(part, tensors={**part.tensors, **matrices})


def _controlnet_part(path: Path, configs: dict[str, Any], tensors: dict[str, StoredTensor], prefix: str) -> ModelPart:
    config = configs["controlnet"]
    layers, stages = config["layers_per_block"], len(config["conditioning_embedding_out_channels"])
    return _part(path, "controlnet", configs, tensors, prefix, lambda name: translate_controlnet(name, layers, stages))


def _part(
    path: Path,
    part: str,
    configs: dict[str, Any],
    tensors: dict[str, StoredTensor],
    prefix: str,
    translate: Callable[[str], str | None],
) -> ModelPart:
    """The tensors under a prefix by their diffusers names; those of unknown names keep them, and are refused later."""
    found = {}
    for name, tensor in tensors.items():
        if name.startswith(prefix):
            new = translate(name.removeprefix(prefix))
            if new is not None or part != "text_encoder":
                found[new or name] = tensor
    return ModelPart(part, path, configs[part], found)


def _read_configs(path: Path) -> dict[str, Any]:
    """The bundled configs with the changes of `<name>.json` beside the checkpoint."""
    configs = read_json(CONFIGS)
    changes_file = path.with_suffix(".json")
    if not changes_file.is_file():
        return configs
    for part, changes in read_json(changes_file).items():
        known = ", ".join(configs)
        if part not in configs or not isinstance(changes, dict):
            raise DataError(f"{changes_file}: expected an object of entries for any of {known}, got {part!r}")
        for entry, value in changes.items():
            if entry not in configs[part] or entry.startswith("_"):
                raise DataError(
                    f"{changes_file}: {part} has no entry {entry!r}; known: "
                    f"{', '.join(name for name in configs[part] if not name.startswith('_'))}"
                )
            configs[part][entry] = value
    return configs


def _refuse_foreign(path: Path, names: Iterable[str]) -> None:
    for name in names:
        for prefix, what in _FOREIGN.items():
            if name.startswith(prefix):
                raise DataError(f"{path}: expected Stable Diffusion v1, got {what} (it holds {name})")


def _what_it_is(tensors: Iterable[str]) -> str:
    names = set(tensors)
    if any(name.startswith(("down_blocks.", "controlnet_cond_embedding.")) for name in names):
        return "got the weights file of a diffusers folder; give the folder, which has the config.json"
    if any("input_hint_block." in name for name in names):
        return "got a ControlNet; give it as the option controlnet"
    if any(name.startswith(UNET) for name in names):
        return "got Stable Diffusion without a ControlNet"
    return f"got {len(names)} tensors such as {', '.join(sorted(names)[:3])}"
