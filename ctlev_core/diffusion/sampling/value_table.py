"""How real pixel values scatter about what the network expects, and frames drawn so.

Far from the data a denoiser gives the mean of what it cannot know, so that sampled event images are smooth where real
ones have counts that scatter from pixel to pixel, and black where those have isolated events. What is missing can be
measured: training frames are noised to a time step, the network says what it expects, and a table counts which values
real frames have where it expects a value. A sampled frame's values are then drawn from the table, each pixel and
channel by itself: the same mean, the scatter and the isolated events of real frames, and only values that they have.

The table is a histogram [256, 256] of (expected, real), smoothed over the expected value: neighbours have much the same
scatter, and training frames are few.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ctlev_core.diffusion.denoising import Denoiser, NoiseSchedule, generator_for, noise_schedule
from ctlev_core.diffusion.flow_matching import FlowSchedule
from ctlev_core.diffusion.pretrained.loading import PretrainedModel, decode_latents
from ctlev_core.diffusion.sampling.out_of_memory import ShrinkingBatches
from data_contracts.errors import DataError

TABLE_FOLDER, TABLE_NAME = "value_table", "probability.npy"
SMOOTHING = 4.0
"""Grey levels; standard deviation of the smoothing over expected values."""
MIN_PIXELS = 100_000
"""Pixels of training frames that the table is made of at least; few frames are noised several times."""
MAX_PIXELS = 20_000_000
_BATCH = 32


def max_table_frames(shape: Sequence[int]) -> int:
    """How many frames of a shape [H, W, 3] a table is made of at most."""
    return max(MAX_PIXELS // int(np.prod(shape)), 1)


def fit_value_table(
    base_model: PretrainedModel, frames: np.ndarray, latents: Tensor, embeddings: Tensor, *, timestep: int, seed: int
) -> np.ndarray:
    """Probability of each real value, given the value expected.

    Args:
        base_model: the trained network, and its autoencoder.
        frames: [N, H, W, 3] uint8, N > 0 training frames.
        latents: [N, C, h, w] their scaled latents.
        embeddings: [N, L, D] of their prompts.
        timestep: of the noise, 0 .. T - 1.
        seed: of the noise.
    Returns:
        [256, 256] float32, rows (expected values) sum to 1. A value that was never expected has the row of the nearest
        that was.
    """
    if not len(frames):
        raise DataError("a table of values needs at least one training frame, got none")
    per_frame = int(np.prod(frames.shape[1:]))
    count = min(len(frames), max_table_frames(frames.shape[1:]))
    repeats = max(-(-MIN_PIXELS // (per_frame * count)), 1)
    counts, batches = np.zeros((256, 256)), ShrinkingBatches(_BATCH)
    schedule = noise_schedule(base_model.scheduler_config)
    for repeat in range(repeats):

        def expect(rows: slice, repeat: int = repeat) -> np.ndarray:
            entropy = seed, repeat, rows.start
            return _expected(base_model, schedule, latents[rows], embeddings[rows], timestep, entropy)

        for rows, expected in batches.map(expect, count):
            np.add.at(counts, (expected.ravel(), frames[rows].ravel()), 1)
    return _probabilities(counts)


def draw_values(expected: np.ndarray, table: np.ndarray, seeds: Sequence[tuple[int, ...]]) -> np.ndarray:
    """Values drawn from the table's rows.

    Args:
        expected: [N, H, W, C] float, 0 .. 255.
        table: [256, 256] as `fit_value_table` returns it.
        seeds: N of one or more integers each; image i depends on its own alone.
    Returns:
        [N, H, W, C] uint8.
    """
    cumulated = np.cumsum(table.astype(np.float64), axis=1)
    cumulated /= cumulated[:, -1:]
    # One search in a single ascending row for all expected values: row v reaches from v to v + 1.
    line = (cumulated + np.arange(256)[:, None]).ravel()
    rounded = np.clip(np.rint(expected), 0, 255).astype(np.int64)
    drawn = np.empty(expected.shape, np.uint8)
    for image, rows, seed in zip(drawn, rounded, seeds, strict=True):
        places = np.searchsorted(line, rows + np.random.default_rng(seed).random(rows.shape), side="right")
        image[...] = np.minimum(places - 256 * rows, 255)
    return drawn


def nearest_values(table: np.ndarray) -> np.ndarray:
    """A table [256, 256] of the same values in which each expected value has the nearest one, the lower of two.

    For networks that draw the scatter themselves, whose samples are real values but for small errors.
    """
    seen = np.flatnonzero(table.any(axis=0))
    nearest = seen[np.abs(np.arange(256)[:, None] - seen).argmin(axis=1)]
    return np.eye(256, dtype=np.float32)[nearest]


def write_value_table(checkpoint: Path, table: np.ndarray) -> None:
    """Into the folder of a checkpoint; diffusers leaves what it does not know alone."""
    folder = checkpoint / TABLE_FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / TABLE_NAME, table, allow_pickle=False)


def read_value_table(checkpoint: Path) -> np.ndarray:
    """The table of a checkpoint.

    Raises:
        DataError: it has none, or one that is no table of probabilities.
    """
    path = checkpoint / TABLE_FOLDER / TABLE_NAME
    if not path.is_file():
        raise DataError(
            f"{checkpoint}: sampling.values=drawn or nearest needs a checkpoint that learnt its values; train it with "
            "generator.options.values_at above 0"
        )
    try:
        table = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    is_table = table.shape == (256, 256) and table.dtype == np.float32 and bool(np.isfinite(table).all())
    if not is_table or (table < 0).any() or np.abs(table.sum(axis=1) - 1).max() > 1e-3:
        raise DataError(f"{path}: expected [256, 256] float32 probabilities, got {list(table.shape)} {table.dtype}")
    return table


@torch.no_grad()
def _expected(
    base_model: PretrainedModel,
    schedule: NoiseSchedule | FlowSchedule,
    latents: Tensor,
    embeddings: Tensor,
    timestep: int,
    entropy: tuple[int, ...],
) -> np.ndarray:
    """What the network makes of noised latents in one step: [B, H, W, 3] int64, 0 .. 255."""
    device = base_model.unet.device
    timesteps = torch.full((len(latents),), timestep)
    noise = torch.randn(latents.shape, generator=generator_for(*entropy))
    noisy, _ = schedule.noised(latents, noise, timesteps)
    denoiser = Denoiser(base_model.unet)
    times = schedule.times(timesteps.to(device))
    predicted = denoiser.predict(noisy.to(device), times, embeddings.to(device), None).float()
    clean = schedule.clean_of(predicted, noisy.to(device), timesteps.to(device))
    values = (decode_latents(base_model, clean) + 1) * 127.5
    return values.clamp(0, 255).round().long().permute(0, 2, 3, 1).cpu().numpy()


def _probabilities(counts: np.ndarray) -> np.ndarray:
    from scipy.ndimage import gaussian_filter1d

    smooth = gaussian_filter1d(counts, SMOOTHING, axis=0, mode="nearest", truncate=4.0)
    seen = np.flatnonzero(smooth.sum(axis=1) > 0)
    nearest = seen[np.abs(np.arange(256)[:, None] - seen).argmin(axis=1)]
    smooth = smooth[nearest]
    return (smooth / smooth.sum(axis=1, keepdims=True)).astype(np.float32)
