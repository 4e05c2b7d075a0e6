"""Training pairs, the part held back, and batches: each a function of (seed, number) alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ctlev_core.event_gan.event_images import Palette, frames_to_volumes, pairs_to_tensor
from ctlev_core.event_gan.options import TrainingOptions
from ctlev_core.supervised.batches import batch_rows
from data_contracts.image_rows import Images, as_image_rows

# Entropy that keeps random streams apart.
_SPLIT_STREAM, _BATCH_STREAM = 20, 21
MAX_VALIDATION = 128


@dataclass(frozen=True, eq=False)
class Pairs:
    """Intensity pairs and the event images between them.

    Attributes:
        conditions: [N, H, W, 3] uint8 as in `check_pairs`.
        frames: [N, H, W, 3] uint8 event images.
        palette: of the event images.
        one_event: value of one event, in (0, 1].
    """

    conditions: Images
    frames: Images
    palette: Palette
    one_event: float

    def take(self, rows: np.ndarray) -> Pairs:
        """The given rows."""
        conditions, frames = (as_image_rows(images).take(rows) for images in (self.conditions, self.frames))
        return Pairs(conditions, frames, self.palette, self.one_event)


@dataclass(frozen=True, eq=False)
class Batch:
    """Tensors of one update; `seen` is the pair as the generator sees it, its brightness changed."""

    seen: Tensor
    pairs: Tensor
    volumes: Tensor
    random: np.random.Generator


def split_rows(count: int, validation_fraction: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows to train on and rows held back, ascending; of the latter one to 128 if the fraction is positive."""
    num_validation = min(math.ceil(count * validation_fraction), count - 1, MAX_VALIDATION)
    order = np.random.default_rng([seed, _SPLIT_STREAM]).permutation(count)
    return np.sort(order[num_validation:]), np.sort(order[:num_validation])


def change_appearance(pairs: Tensor, gain: Tensor, gamma: Tensor) -> Tensor:
    """Gain x intensity^gamma of pairs in [-1, 1], clipped; the same for both frames of a pair, so that motion stays."""
    return (2 * gain * ((1 + pairs) / 2) ** gamma - 1).clamp(-1, 1)


def make_batch(data: Pairs, options: TrainingOptions, seed: int, number: int, device: torch.device) -> Batch:
    """Batch `number` of a run: its rows, mirrored at random, and the pair brightened at random.

    Args:
        data: what to train on.
        options: size of the batch, shares and ranges of the augmentation.
        seed: of the run.
        number: counts the batches of both networks together.
        device: of the tensors.
    """
    rows = batch_rows(len(data.frames), options.batch_size, seed, number)
    random = np.random.default_rng([seed, _BATCH_STREAM, number])
    pairs = pairs_to_tensor(data.conditions[rows])
    volumes = frames_to_volumes(data.frames[rows], data.palette)
    for axis in (-1, -2):
        is_mirrored = torch.from_numpy(random.random(len(rows)) < options.flip)[:, None, None, None]
        pairs = torch.where(is_mirrored, pairs.flip(axis), pairs)
        volumes = torch.where(is_mirrored, volumes.flip(axis), volumes)
    gain, gamma = random.uniform(1 - options.appearance, 1 + options.appearance, (2, len(rows), 1, 1, 1))
    seen = change_appearance(pairs, torch.from_numpy(gain).float(), torch.from_numpy(gamma).float())
    return Batch(seen.to(device), pairs.to(device), volumes.to(device), random)
