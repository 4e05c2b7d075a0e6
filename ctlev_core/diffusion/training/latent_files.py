"""Latents of frames, encoded once: in memory, in the work folder of one training, or in the files of a stage.

Batches hold the same frames whichever way they are taken, so that latents are the same to the last bit.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ctlev_core.diffusion.pretrained.loading import ENCODE_PIXELS, encode_posterior
from ctlev_core.diffusion.sampling.out_of_memory import ShrinkingBatches
from ctlev_core.diffusion.training.distributed import DistributedContext
from ctlev_core.progress import ProgressBar
from data_contracts.arrays import ArrayWriter
from data_contracts.errors import DataError
from data_contracts.image_rows import ImageRows, Images, as_image_rows, image_chunks
from data_contracts.manifest import Manifest

logger = logging.getLogger(__name__)

USUAL_SIZE = (0.4, 4.0)
"""Root mean square of scaled latents, about 1: .7 to 2.5 of the bundled base models' images, black to white; .9 to 1.8
of photographs and event images in Stable Diffusion's space, where they are 5 to 10 if not scaled, .2 to .3 if twice."""
ENCODE_BATCH = 32
"""Images that are encoded at once, fewer where they have more than `ENCODE_PIXELS` together or memory runs out."""
FILE_FRAMES = 1024
"""Frames of a file of the stage, whole batches: what a killed run loses at most. 128 MB for 512 px and no turns."""
CHECK_BYTES = 8 << 20
"""Latents that are looked at together; in float64 they take twice as much."""
MEAN, STD = "mean", "std"


@dataclass(frozen=True, eq=False)
class Latents:
    """Posteriors of N frames in T quarter turns, not scaled.

    Attributes:
        mean: [T * N, C, h, w] float32: all frames as they are, then all turned once, and so on; in memory or on disk.
        std: [T * N, C, h, w] float32 standard deviations; None for a code without noise.
    """

    mean: Images
    std: Images | None


def latents_in_memory(vae: Any, frames: Images, num_turns: int) -> Latents:
    """Of frames [N, H, W, 3] uint8, as they are and in `num_turns` - 1 quarter turns."""
    means, deviations = zip(*_encode(vae, frames, range(len(frames)), num_turns), strict=True)
    return Latents(np.concatenate(means), None if deviations[0] is None else np.concatenate(deviations))


def latents_of_run(vae: Any, frames: Images, num_turns: int, folder: Path, distributed: DistributedContext) -> Latents:
    """The same on disk, in the folder of a run, of which each process writes those of a share of the frames."""
    folder.mkdir(parents=True, exist_ok=True)
    # Whole batches: however many processes there are, latents are the same to the last bit.
    size = _batch_size(frames)
    batches = -(-len(frames) // size)
    cuts = np.linspace(0, batches, min(distributed.count, batches) + 1).round().astype(int) * size
    shares = _between(np.minimum(cuts, len(frames)).tolist())
    paths = _paths(vae, frames, num_turns, folder, len(shares))
    if distributed.rank < len(shares) and not paths[distributed.rank][MEAN].is_file():
        _write(_encode(vae, frames, shares[distributed.rank], num_turns), paths[distributed.rank])
    distributed.wait()
    return _open(paths, shares, num_turns)


def write_latent_files(vae: Any, frames: Images, num_turns: int, folder: Path) -> list[tuple[range, dict[str, Path]]]:
    """Write latents in files of `FILE_FRAMES` frames each, one after another; those that are there already stay.

    Returns:
        Of each file its frames, and by `mean` and perhaps `std` its paths. In each lie all its frames as they are, then
        all turned once, and so on.
    Raises:
        DataError: latents that are not finite.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shares = _between([*range(0, len(frames), FILE_FRAMES), len(frames)])
    paths = _paths(vae, frames, num_turns, folder, len(shares))
    with ProgressBar(total=len(frames), desc="latents", unit="frame") as progress:
        for rows, files in zip(shares, paths, strict=True):
            if not files[MEAN].is_file():
                _write(_encode(vae, frames, rows, num_turns), files)
            progress.update(len(rows))
    check_latents(_open(paths, shares, num_turns), len(frames), float(vae.config.scaling_factor))
    return [
        (rows, {kind: path for kind, path in files.items() if path.is_file()})
        for rows, files in zip(shares, paths, strict=True)
    ]


def stored_latents(manifest: Manifest, sample_ids: Sequence[str], num_turns: int) -> Latents:
    """The latents of N frames, from the files of the stage.

    Args:
        manifest: of the table `latents`.
        sample_ids: N, of the frames.
        num_turns: T.
    Raises:
        DataError: a frame has none there.
    """
    names, turns = manifest.column("sample_id"), manifest.column("quarter_turns")
    place = {pair: row for row, pair in enumerate(zip(names, turns, strict=True))}
    try:
        rows = np.array([place[name, turn] for turn in range(num_turns) for name in sample_ids], np.int64)
    except KeyError as error:
        raise DataError(f"{manifest.ref.path}: expected latents of every frame and turn, got none of {error}") from None
    found = []
    for kind in (MEAN, STD):
        files = sorted(name.removesuffix(".npy") for name in manifest.files if name.startswith(f"{kind}_"))
        arrays = [manifest.array(name) for name in files]
        every = ImageRows.of([(array, np.arange(len(array))) for array in arrays]) if arrays else None
        found.append(None if every is None else every.take(rows))
    return Latents(*found)


def check_latents(latents: Latents, count: int, scaling_factor: float) -> None:
    """Raise `DataError` naming the first of `count` frames whose latents are not finite.

    Latents of an unusual size are logged: the scaling factor is a number in the base model's config that nothing else
    vouches for, and networks given latents of another size than they were trained on learn and draw badly, in silence.
    """
    squares = []
    for name, values in (("mean", latents.mean), ("standard deviation", latents.std)):
        start = 0
        for chunk in () if values is None else image_chunks(values, CHECK_BYTES):
            wrong = np.flatnonzero(~np.isfinite(chunk.reshape(len(chunk), -1)).all(axis=1))
            if len(wrong):
                raise DataError(
                    f"frame {(start + int(wrong[0])) % count} of {count}: the {name} of its latents must be finite, "
                    "which the base model's autoencoder did not make it; check that frame and the autoencoder"
                )
            start += len(chunk)
            if name == "mean":
                squares.append(float(np.square(chunk, dtype=np.float64).mean()) * len(chunk))
    size = (sum(squares) / len(latents.mean)) ** 0.5 * scaling_factor
    if not USUAL_SIZE[0] <= size <= USUAL_SIZE[1]:
        logger.warning(
            "latents of the frames have a root mean square of %.2g after scaling by %g, expected about 1; "
            "check scaling_factor in the config of the base model's autoencoder (Stable Diffusion v1: 0.18215)",
            size, scaling_factor,
        )  # fmt: skip


@torch.no_grad()
def _encode(vae: Any, frames: Images, rows: range, num_turns: int) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
    """Means and deviations of consecutive batches: the given rows as they are, then all turned once, and so on."""

    def encode(part: slice, turn: int) -> tuple[Tensor, Tensor | None]:
        chosen = rows[part]
        turned = np.rot90(frames[chosen.start : chosen.stop], turn, axes=(1, 2))
        return encode_posterior(vae, np.ascontiguousarray(turned))

    batches = ShrinkingBatches(_batch_size(frames))
    for turn in range(num_turns):
        for _, (mean, deviation) in batches.map(functools.partial(encode, turn=turn), len(rows)):
            yield mean.cpu().numpy(), None if deviation is None else deviation.cpu().numpy()


def _batch_size(frames: Images) -> int:
    return max(1, min(ENCODE_BATCH, ENCODE_PIXELS // (frames.shape[1] * frames.shape[2])))


def _open(paths: Sequence[Mapping[str, Path]], shares: Sequence[range], num_turns: int) -> Latents:
    """Frame i, turned t times, is row t * (frames of its share) + (i - first of its share) of its share's file."""
    share = np.concatenate([np.full(len(rows), number) for number, rows in enumerate(shares)])
    row = np.concatenate(
        [np.concatenate([turn * len(rows) + np.arange(len(rows)) for rows in shares]) for turn in range(num_turns)]
    )
    found = []
    for kind in (MEAN, STD):
        is_there = kind == MEAN or paths[0][STD].is_file()
        opened = [np.load(each[kind], mmap_mode="r", allow_pickle=False) for each in paths if is_there]
        found.append(ImageRows(opened, np.tile(share, num_turns), row) if is_there else None)
    return Latents(*found)


def _between(cuts: Sequence[int]) -> list[range]:
    return [range(start, stop) for start, stop in itertools.pairwise(cuts)]


def _write(encoded: Iterator[tuple[np.ndarray, np.ndarray | None]], paths: Mapping[str, Path]) -> None:
    """Under other names first: a file that has its name is whole. That of the means comes last."""
    unfinished = {kind: path.with_name(f"unfinished_{path.name}") for kind, path in paths.items()}
    with ArrayWriter(unfinished[MEAN]) as means, ArrayWriter(unfinished[STD]) as deviations:
        for mean, deviation in encoded:
            means.append(mean)
            if deviation is not None:
                deviations.append(deviation)
    for kind in (STD, MEAN):
        if unfinished[kind].is_file():
            unfinished[kind].replace(paths[kind])


def _paths(vae: Any, frames: Images, num_turns: int, folder: Path, num_shares: int) -> list[dict[str, Path]]:
    """The files of each share, named by all that decides latents."""
    total = hashlib.sha256(f"{as_image_rows(frames).digest()} {num_turns} {num_shares}".encode())
    for name, weight in vae.state_dict().items():
        total.update(name.encode())
        total.update(np.ascontiguousarray(weight.detach().float().cpu().numpy()).data)
    name = f"latents_{total.hexdigest()[:16]}"
    return [{kind: folder / f"{name}_{kind}_{share}.npy" for kind in (MEAN, STD)} for share in range(num_shares)]
