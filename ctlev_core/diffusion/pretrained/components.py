"""The files of a diffusers folder: configs, and which tensors lie where. Imports nothing heavy: the plan calls it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctlev_core.safe_files.tensor_files import StoredTensor, read_tensor_table
from data_contracts.errors import DataError

ZERO_EMPTY_PROMPT = "force_zeros_for_empty_prompt"
"""Entry of `model_index.json` of Stable Diffusion XL."""
_STEMS = ("diffusion_pytorch_model", "model", "pytorch_model")
_OLD_ATTENTION = {".query.": ".to_q.", ".key.": ".to_k.", ".value.": ".to_v.", ".proj_attn.": ".to_out.0."}


@dataclass(frozen=True, eq=False)
class ModelPart:
    """One network of a base model.

    Attributes:
        name: `unet` (also a transformer), `vae`, `text_encoder`, `text_encoder_2`, `text_encoder_3` or `controlnet`.
        place: the folder or file it comes from.
        config: as in diffusers' or transformers' `config.json`.
        tensors: where its weights are, by their names in diffusers or transformers.
    """

    name: str
    place: Path
    config: dict[str, Any]
    tensors: Mapping[str, StoredTensor]


@dataclass(frozen=True, eq=False)
class ModelFiles:
    """A whole base model on disk.

    Attributes:
        place: the folder or file that was asked for.
        parts: `text_encoder`, `vae`, `unet`, and where they are there `text_encoder_2`, `text_encoder_3`, `controlnet`.
        tokenizer: folder of the tokenizer.
        scheduler_config: the noise schedule the base model was trained with.
        tokenizer_2: folder of the tokenizer of `text_encoder_2`.
        zero_empty_prompt: what `model_index.json` calls `force_zeros_for_empty_prompt`.
        tokenizer_3: folder of the tokenizer of `text_encoder_3`.
    """

    place: Path
    parts: dict[str, ModelPart]
    tokenizer: Path
    scheduler_config: dict[str, Any]
    tokenizer_2: Path | None = None
    zero_empty_prompt: bool = False
    tokenizer_3: Path | None = None


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object of a file.

    Raises:
        DataError: no such file, or something else in it.
    """
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read as JSON: {error}") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected a JSON object, got {type(content).__name__}")
    return content


def read_part(name: str, folder: Path) -> ModelPart:
    """The network of a subfolder.

    Raises:
        DataError: config or weights are missing or damaged.
    """
    if not (folder / "config.json").is_file():
        raise DataError(f"{folder}: config.json is missing")
    config = read_json(folder / "config.json")
    tensors: dict[str, StoredTensor] = {}
    for file in weights_files(folder):
        tensors |= read_tensor_table(file)
    return ModelPart(name, folder, config, {_new_name(name, old): tensor for old, tensor in tensors.items()})


def weights_files(folder: Path) -> list[Path]:
    """The weights files of a subfolder: several where they are split into shards.

    Safetensors come before torch's .bin files, full precision before variants such as `fp16`.

    Raises:
        DataError: there are none, a shard is missing, or the choice is not clear.
    """
    for ending in (".safetensors", ".bin"):
        whole = [folder / f"{stem}{ending}" for stem in _STEMS]
        indices = [folder / f"{stem}{ending}.index.json" for stem in _STEMS]
        variants = [
            path for stem in _STEMS for path in sorted(folder.glob(f"{stem}.*{ending}")) if "-of-" not in path.name
        ]
        split = [path for stem in _STEMS for path in sorted(folder.glob(f"{stem}*{ending}.index.*json"))]
        for found in (
            [path for path in whole if path.is_file()],
            [path for path in indices if path.is_file()],
            variants,
            split,
        ):
            if len(found) > 1:
                found = [path for path in found if ".fp16." in path.name] or found
            if len(found) > 1:
                raise DataError(f"{folder}: which of {', '.join(path.name for path in found)}? Keep one of them")
            if found:
                return _shards(found[0]) if found[0].suffix == ".json" else found
    present = ", ".join(sorted(path.name for path in folder.iterdir())) or "nothing"
    raise DataError(f"{folder}: no weights; expected {_STEMS[0]}.safetensors (or model.safetensors), found {present}")


def _shards(index: Path) -> list[Path]:
    weight_map = read_json(index).get("weight_map")
    if not isinstance(weight_map, dict) or not weight_map:
        raise DataError(f"{index}: expected an object 'weight_map' of tensor and file names")
    names = sorted({str(name) for name in weight_map.values()})
    outside = [name for name in names if Path(name).name != name]
    if outside:
        raise DataError(f"{index}: shards lie in the same folder, got {outside[0]!r}")
    missing = [name for name in names if not (index.parent / name).is_file()]
    if missing:
        raise DataError(f"{index.parent}: missing {', '.join(missing)} of the {len(names)} shards in {index.name}")
    return [index.parent / name for name in names]


def _new_name(part: str, name: str) -> str:
    """Autoencoders written by diffusers before 0.17 name the weights of their attention differently."""
    if part == "vae" and ".attentions." in name:
        for old, new in _OLD_ATTENTION.items():
            name = name.replace(old, new)
    return name
