"""Features of a local transformers folder: DINOv2, CLIP or a ResNet.

Nothing is trained: the folder is kept with its checksums. DINOv2 gives its class token after the last normalisation, as
in FD-DINOv2 (Stein et al., NeurIPS 2023), CLIP its image embedding, as in CMMD (Jayasumana et al., CVPR 2024), not
scaled to length 1, and a ResNet its pooled features. Images are squeezed to the network's square, not cropped: what
happens at the border of an event image counts.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from ctlev_core.networks import feature_extractors
from data_contracts.config import RUN_SETTING, Frozen
from data_contracts.errors import DataError
from data_contracts.image_rows import Images

VERSION = 1
NAME = "transformers_features"
PREDICTS = ()
# model_type -> class of transformers, and the output that holds the features.
_MODELS = {
    "dinov2": ("Dinov2Model", "pooler_output"),
    "dinov2_with_registers": ("Dinov2WithRegistersModel", "pooler_output"),
    "clip": ("CLIPVisionModelWithProjection", "image_embeds"),
    "clip_vision_model": ("CLIPVisionModelWithProjection", "image_embeds"),
    "resnet": ("ResNetModel", "pooler_output"),
}
_CONFIG, _PREPROCESSOR = "config.json", "preprocessor_config.json"


class Options(Frozen):
    """Which folder."""

    folder: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="local folder of DINOv2, CLIP or a ResNet (config.json, preprocessor_config.json, safetensors); "
        "needed",
    )
    device: str = Field(
        default="auto", description="torch device; auto = CUDA where present", json_schema_extra=RUN_SETTING
    )


def input_files(options: Options) -> list[Path]:
    """The files of the folder that are read: configs and weights.

    Raises:
        DataError: none is named, a file is missing, or the network is none of the known ones.
    """
    folder = options.folder
    if folder is None or not folder.is_dir():
        raise DataError(f"transformers_features: expected option `folder` to be a folder, got {folder}")
    for name in (_CONFIG, _PREPROCESSOR):
        if not (folder / name).is_file():
            raise DataError(f"{folder}: expected {name} of a transformers model, found none")
    weights = sorted(folder.glob("model*.safetensors"))
    if not weights:
        raise DataError(f"{folder}: expected weights as model*.safetensors, found none")
    _read_kind(folder)
    _read_preprocessing(folder)
    return [folder / _CONFIG, folder / _PREPROCESSOR, *sorted(folder.glob("model*.index.json")), *weights]


def features(model: Path, frames: Images, device: str = "auto") -> np.ndarray:
    """Features [N, D] float32 of frames [N, H, W, 3] uint8.

    Raises:
        DataError: the folder is of another model, or its weights are damaged or lack a tensor.
    """
    import torch

    from ctlev_core.supervised.models import resolve_device

    feature_extractors.read_extractor(model, NAME)
    folder = model / feature_extractors.FILES_FOLDER
    network, output = _load(folder)
    network.to(resolve_device(device))
    size, mean, std = _read_preprocessing(folder)

    def run(images: torch.Tensor) -> torch.Tensor:
        # Bicubic overshoots; pixels do not.
        images = feature_extractors.resize_images(images, size).clamp(0, 255)
        return network(pixel_values=feature_extractors.normalise(images, mean, std))[output]

    return feature_extractors.compute_features(frames, run, resolve_device(device), f"features of {model}")


def _find_network(options: Options) -> tuple[str, dict[str, Path]]:
    files = {path.name: path for path in input_files(options)}
    return _read_kind(files[_CONFIG].parent).replace("_", ""), files


def _read_kind(folder: Path) -> str:
    kind = _read_json(folder / _CONFIG).get("model_type")
    if kind not in _MODELS:
        raise DataError(f"{folder / _CONFIG}: expected model_type {', '.join(_MODELS)}, got {kind!r}")
    return kind


def _read_preprocessing(folder: Path) -> tuple[int, tuple[float, ...], tuple[float, ...]]:
    """Side in px, mean and standard deviation of the network's input."""
    path = folder / _PREPROCESSOR
    values = _read_json(path)
    size = values.get("crop_size") or values.get("size") or {}
    if isinstance(size, dict):
        size = size.get("height") or size.get("shortest_edge")
    mean, std = (tuple(values.get(name) or ()) for name in ("image_mean", "image_std"))
    numbers = all(isinstance(value, int | float) for value in (*mean, *std))
    if not isinstance(size, int) or size < 1 or (len(mean), len(std)) != (3, 3) or not numbers or min(std) <= 0:
        raise DataError(
            f"{path}: expected crop_size or size, and three numbers each of image_mean and image_std, got "
            f"size {size}, mean {list(mean)}, std {list(std)}"
        )
    return size, mean, std


def _read_json(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DataError(f"{path}: is no JSON: {error}") from error
    if not isinstance(values, dict):
        raise DataError(f"{path}: expected a JSON object, got {type(values).__name__}")
    return values


def _load(folder: Path) -> tuple[Any, str]:
    import transformers

    name, output = _MODELS[_read_kind(folder)]
    try:
        network, found = getattr(transformers, name).from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except Exception as error:
        raise DataError(f"{folder}: cannot be loaded as {name}: {error}") from error
    # transformers draws what is missing at random, and says so in a warning.
    lost = sorted([*found["missing_keys"], *(key for key, *_ in found["mismatched_keys"])])
    if lost:
        raise DataError(f"{folder}: the weights lack {len(lost)} tensors of {name}, the first {lost[0]}")
    return network.float().eval(), output


name_score = feature_extractors.naming_of(NAME)
predict = feature_extractors.prediction_of(features)
train = feature_extractors.training_of(NAME, VERSION, _find_network, features)
