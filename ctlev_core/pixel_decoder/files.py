"""A trained pixel decoder on disk: its weights as `decoder.safetensors`, classes and sizes as `decoder.json`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from ctlev_core.pixel_decoder.network import PixelNetwork
from ctlev_core.pixel_decoder.options import PixelDecoderOptions
from ctlev_core.pixel_decoder.training import build_network
from ctlev_core.pixel_decoder.value_classes import ValueClasses
from data_contracts.errors import DataError

WEIGHTS_FILE, CONFIG_FILE = "decoder.safetensors", "decoder.json"


def save_decoder(
    folder: Path,
    network: PixelNetwork,
    classes: ValueClasses,
    options: PixelDecoderOptions,
    *,
    conditioned: bool,
    whole_counts: bool,
    interval_us: int | None = None,
) -> None:
    """Write both files.

    Args:
        folder: is made.
        network: that was trained.
        classes: of its values.
        options: its sizes.
        conditioned: whether it takes condition images.
        whole_counts: whether the values are event counts, not grey levels.
        interval_us: from one frame to the next, of a network that sees the frame before; else None.
    """
    folder.mkdir(parents=True, exist_ok=True)
    save_file({name: value.cpu().contiguous() for name, value in network.state_dict().items()}, folder / WEIGHTS_FILE)
    config = {
        "num_planes": network.num_planes,
        "conditioned": conditioned,
        "whole_counts": whole_counts,
        **({} if interval_us is None else {"interval_us": interval_us}),
        "width": options.width,
        "depth": options.depth,
        "classes": {
            "starts": classes.starts.tolist(),
            "values": classes.values.tolist(),
            "shares": classes.shares.tolist(),
            "mean": classes.mean,
            "deviation": classes.deviation,
        },
    }
    (folder / CONFIG_FILE).write_text(json.dumps(config, indent=1) + "\n", encoding="utf-8")


class SavedDecoder(NamedTuple):
    """As it was given to `save_decoder`; the network on its device, for inference."""

    network: PixelNetwork
    classes: ValueClasses
    conditioned: bool
    whole_counts: bool
    interval_us: int | None


def load_decoder(folder: Path, device: torch.device) -> SavedDecoder:
    """What was saved.

    Raises:
        DataError: a file is missing or is not that of a pixel decoder.
    """
    try:
        config = json.loads((folder / CONFIG_FILE).read_text(encoding="utf-8"))
        found = config["classes"]
        classes = ValueClasses(
            np.array(found["starts"], np.int64),
            np.array(found["values"], np.int64),
            np.array(found["shares"], np.float64),
            float(found["mean"]),
            float(found["deviation"]),
        )
        interval_us = config.get("interval_us")
        if interval_us is not None and (type(interval_us) is not int or interval_us < 1):
            raise ValueError(f"interval_us must be a whole number from 1, got {interval_us!r}")
        network = build_network(
            classes,
            config["num_planes"],
            config["conditioned"],
            config["width"],
            config["depth"],
            sees_previous=interval_us is not None,
        )
        network.load_state_dict(load_file(folder / WEIGHTS_FILE))
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise DataError(f"{folder}: no pixel decoder can be read: {str(error)[:300]}") from error
    network = network.to(device).eval().requires_grad_(False)
    return SavedDecoder(network, classes, bool(config["conditioned"]), bool(config["whole_counts"]), interval_us)
