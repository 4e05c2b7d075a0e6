"""Checkpoint folders of Event-GAN, and event images sampled from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from ctlev_core.event_gan.event_images import NUM_CHANNELS, Palette, pairs_to_tensor, volumes_to_frames
from ctlev_core.event_gan.networks import EventVolumeUNet
from ctlev_core.event_gan.options import SamplingOptions
from ctlev_core.supervised import models
from data_contracts.errors import DataError
from data_contracts.image_rows import Images

NAME = "event_gan"


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A trained generator, ready to sample from.

    Attributes:
        network: pairs to volumes, in evaluation mode, its spectral norms folded into the weights.
        palette: of the event images it learned.
        one_event: value of one event in them, in (0, 1].
        image_size: (width, height) px of the images it learned.
    """

    network: nn.Module
    palette: Palette
    one_event: float
    image_size: tuple[int, int]


def write_checkpoint(folder: Path, checkpoint: Checkpoint, arguments: dict[str, Any], record: dict[str, Any]) -> None:
    """Write `model.safetensors` and `config.json`.

    Args:
        folder: made where missing.
        checkpoint: what to write.
        arguments: `EventVolumeUNet` was built with them.
        record: options and versions, for the reader's information.
    """
    config = {
        "model": NAME,
        "generator": {**arguments, "spectral_norm": False},
        "palette": checkpoint.palette,
        "one_event": checkpoint.one_event,
        "image_size": list(checkpoint.image_size),
        **record,
    }
    models.write_model(folder, checkpoint.network, config)


def load_checkpoint(folder: Path, device: str) -> Checkpoint:
    """Load what `write_checkpoint` wrote.

    Raises:
        DataError: there is no Event-GAN in the folder, or a damaged one.
    """
    try:
        config = models.read_config(folder, NAME)
        network = EventVolumeUNet(NUM_CHANNELS[config["palette"]], **config["generator"])
        models.read_weights(folder, network)
        width, height = config["image_size"]
        checkpoint = Checkpoint(network, config["palette"], float(config["one_event"]), (int(width), int(height)))
    except DataError:
        raise
    except Exception as error:
        raise DataError(f"{folder}: the {NAME} model cannot be loaded: {error}") from error
    network.eval().to(models.resolve_device(device))
    return checkpoint


def check_sampling(checkpoint: Checkpoint, pairs: Images, seeds: Sequence[int]) -> None:
    """Raise `ValueError` unless there is a seed a pair, and `DataError` unless pairs have the size of training."""
    if len(seeds) != len(pairs):
        raise ValueError(f"one seed a pair is needed, got {len(seeds)} seeds for {len(pairs)} pairs")
    size = pairs.shape[2], pairs.shape[1]
    if size != checkpoint.image_size:
        raise DataError(
            f"this Event-GAN learned images of {' x '.join(map(str, checkpoint.image_size))} px, "
            f"got pairs of {' x '.join(map(str, size))} px"
        )


@torch.no_grad()
def sample_frames(
    network: nn.Module,
    pairs: Images,
    palette: Palette,
    one_event: float,
    options: SamplingOptions,
    *,
    seeds: Sequence[int],
) -> np.ndarray:
    """Event images [N, H, W, 3] uint8 of pairs [N, H, W, 3] uint8.

    One pair at a time: convolutions round differently at other batch sizes, and no row may depend on another.
    """
    device = next(network.parameters()).device
    frames = np.empty(pairs.shape, np.uint8)
    for row, seed in enumerate(seeds):
        volume = network(pairs_to_tensor(pairs[row : row + 1]).to(device)).cpu().numpy()
        frames[row] = volumes_to_frames(volume, palette, one_event, options, [seed])[0]
    return frames
