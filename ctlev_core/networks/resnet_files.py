"""Folders of published residual networks in the layout of transformers. Imports nothing heavy.

A folder as `microsoft/resnet-34` is published has `config.json` and `model.safetensors`. Pickled weights are not read.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from data_contracts.errors import DataError

# Name -> blocks per stage, channels per stage, channels of the first convolution; blocks are basic (two convolutions)
# unless they say otherwise.
ARCHITECTURES: dict[str, dict[str, Any]] = {
    "resnet10-quarter": {"depths": [1, 1, 1, 1], "hidden_sizes": [16, 32, 64, 128], "embedding_size": 16},
    "resnet10-half": {"depths": [1, 1, 1, 1], "hidden_sizes": [32, 64, 128, 256], "embedding_size": 32},
    "resnet18": {"depths": [2, 2, 2, 2], "hidden_sizes": [64, 128, 256, 512], "embedding_size": 64},
    "resnet34": {"depths": [3, 4, 6, 3], "hidden_sizes": [64, 128, 256, 512], "embedding_size": 64},
    "resnet50": {
        "depths": [3, 4, 6, 3],
        "hidden_sizes": [256, 512, 1024, 2048],
        "embedding_size": 64,
        "layer_type": "bottleneck",
    },
}
SMALL_CNN = "small-cnn"
"""No ResNet, and without published weights; see `ctlev_core.networks.small_cnn`."""
ARCHITECTURES[SMALL_CNN] = {"widths": [16, 32, 64, 64], "dropout": 0.3}
CONFIG_NAME, WEIGHTS_NAME = "config.json", "model.safetensors"
STRIDE = 32
"""Image px a pixel of the last feature map."""
# What a config leaves out has these values in transformers.
_OTHERS: dict[str, Any] = {
    "layer_type": "bottleneck",
    "hidden_act": "relu",
    "num_channels": 3,
    "downsample_in_first_stage": False,
}
_WANTED = {"layer_type": "basic", "hidden_act": "relu", "num_channels": 3, "downsample_in_first_stage": False}


def check_batch(batch_size: int, height: int, width: int, where: str) -> None:
    """Raise `DataError` where a ResNet would have one value a channel and batch to normalise, of which none is left."""
    if batch_size == 1 and max(height, width) <= STRIDE:
        raise DataError(
            f"{where}: one image of {width} x {height} px has one value a channel in the last feature map, which batch "
            "normalisation cannot spread; expected a batch_size of 2 or more"
        )


def check_resnet_folder(folder: Path, architecture: str) -> list[Path]:
    """The files of a published ResNet, with its config compared to the wanted one.

    Args:
        folder: in the layout of transformers.
        architecture: a key of `ARCHITECTURES`.
    Raises:
        DataError: a file is missing or cannot be read, or the folder holds another network.
    """
    files = [folder / CONFIG_NAME, folder / WEIGHTS_NAME]
    for path in files:
        if not path.is_file():
            raise DataError(f"weights {folder}: expected {CONFIG_NAME} and {WEIGHTS_NAME}, found no {path.name}")
    try:
        config = json.loads(files[0].read_text(encoding="utf-8"))
        kind = config["model_type"]
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{files[0]}: expected the JSON config of a model of transformers: {error!r}") from error
    if kind != "resnet":
        raise DataError(f"{files[0]}: expected model_type 'resnet', got {kind!r}")
    for name, wanted in {**_WANTED, **ARCHITECTURES[architecture]}.items():
        got = config.get(name, _OTHERS.get(name))
        if got != wanted:
            raise DataError(f"{files[0]}: expected {name} {wanted} of {architecture}, got {got}")
    return files
