"""Everything fine-tuning needs of frames, prompts and conditions, computed once, and checked before training starts."""

from __future__ import annotations

import functools
import hashlib
import itertools
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ctlev_core import plugins
from ctlev_core.diffusion.denoising import Batch
from ctlev_core.diffusion.pretrained.loading import (
    PretrainedModel,
    conditions_to_tensor,
    encode_posterior,
    encode_prompts,
)
from ctlev_core.diffusion.sampling.out_of_memory import ShrinkingBatches
from ctlev_core.diffusion.training.distributed import SINGLE_PROCESS, DistributedContext
from ctlev_core.plugin_contracts import ConditionThatTurns
from data_contracts.arrays import ArrayWriter
from data_contracts.config import ConditionChoice
from data_contracts.errors import DataError
from data_contracts.image_rows import ImageRows, Images, as_image_rows, image_chunks
from data_contracts.labels import Conditions

logger = logging.getLogger(__name__)

USUAL_SIZE = (0.4, 4.0)
"""Root mean square of scaled latents, about 1: .7 to 2.5 of the bundled base models' images, black to white; .9 to 1.8
of photographs and event images in Stable Diffusion's space, where they are 5 to 10 if not scaled, .2 to .3 if twice."""
ENCODE_BATCH = 32
"""Images that are encoded at once, unless memory runs out: of 512 px each takes .7 GB in Stable Diffusion's."""


@dataclass(frozen=True, eq=False)
class LatentCache:
    """Everything the loop needs of N frames in T quarter turns, computed once.

    Attributes:
        mean: [T * N, C, h, w] float32 posterior means, not scaled: all frames as they are, then all turned once, and
            so on; in memory or on disk.
        std: [T * N, C, h, w] float32 posterior standard deviations; None for a code without noise.
        scaling_factor: multiplies sampled latents.
        embeddings: [P, L, D] of the distinct prompts; the last is the empty prompt.
        prompt_rows: for each of N frames the indices into `embeddings` of the prompts it may be shown with.
        conditions: [N, H, W, 3] uint8, or None.
        made_by: the plug-in of the conditions, where known.
    """

    mean: Images
    std: Images | None
    scaling_factor: float
    embeddings: Tensor
    prompt_rows: tuple[Tensor, ...]
    conditions: Images | None
    made_by: ConditionChoice | None = None

    def batch(
        self,
        rows: np.ndarray,
        generator: torch.Generator,
        prompt_dropout: float,
        device: torch.device,
        turns: np.ndarray | None = None,
    ) -> Batch:
        """The given rows; latents are drawn from their posteriors, and prompts from those of each frame.

        Args:
            rows: [B] of N frames.
            generator: of latents and prompts.
            prompt_dropout: share of empty prompts.
            device: of the batch.
            turns: [B] quarter turns, less than T, of frame and condition alike; None = none.
        """
        index = rows if turns is None else turns * len(self.prompt_rows) + rows
        latents = torch.from_numpy(self.mean[index])
        if self.std is not None:
            latents = latents + torch.from_numpy(self.std[index]) * torch.randn(latents.shape, generator=generator)
        dropped = torch.rand(len(rows), generator=generator) < prompt_dropout
        choices = [self.prompt_rows[row] for row in rows]
        drawn = torch.rand(len(rows), generator=generator).tolist()
        prompts = torch.stack([each[int(value * len(each))] for each, value in zip(choices, drawn, strict=True)])
        prompts = torch.where(dropped, len(self.embeddings) - 1, prompts)
        conditions = None
        if self.conditions is not None:
            images = self.conditions[rows]
            if turns is not None:
                images = turn_conditions(images, turns, self.made_by)
            conditions = conditions_to_tensor(images).to(device)
        latents = latents * self.scaling_factor
        return Batch(latents.to(device), self.embeddings[prompts].to(device), conditions)


def cache_latents(
    base_model: PretrainedModel,
    frames: Images,
    conditions: Conditions,
    class_names: Sequence[str] | None = None,
    *,
    num_turns: int = 1,
    folder: Path | None = None,
    distributed: DistributedContext = SINGLE_PROCESS,
) -> LatentCache:
    """Run the frozen autoencoder and text encoder, once per frame and turn and once per distinct prompt.

    With a folder latents are written there and stay on disk: memory does not grow with the number of frames, several
    processes encode a share each and read all, and a run that goes on finds them.

    Args:
        base_model: autoencoder and text encoder.
        frames: [N, H, W, 3] uint8.
        conditions: N prompts and perhaps condition images.
        class_names: N; frames of one class may be shown with the prompt of any of them. None = each with its own.
        num_turns: 4 also encodes square frames in their three quarter turns.
        folder: of a run's resumable state; None keeps latents in memory.
        distributed: which of several processes this is; more than one need a folder.
    """
    if folder is None:
        means, deviations = zip(*_encode(base_model, frames, range(len(frames)), num_turns), strict=True)
        mean = np.concatenate(means)
        std = None if deviations[0] is None else np.concatenate(deviations)
    else:
        mean, std = _latents_on_disk(base_model, frames, num_turns, folder, distributed)
    prompts = sorted(set(conditions.prompts))
    position = {prompt: row for row, prompt in enumerate(prompts)}
    return LatentCache(
        mean=mean,
        std=std,
        scaling_factor=base_model.scaling_factor,
        embeddings=encode_prompts(base_model, [*prompts, ""]).float().cpu(),
        prompt_rows=_prompt_rows([position[prompt] for prompt in conditions.prompts], class_names),
        conditions=conditions.images,
        made_by=conditions.made_by,
    )


@torch.no_grad()
def _encode(
    base_model: PretrainedModel, frames: Images, rows: range, num_turns: int
) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
    """Means and deviations of consecutive batches: the given rows as they are, then all turned once, and so on."""

    def encode(part: slice, turn: int) -> tuple[Tensor, Tensor | None]:
        chosen = rows[part]
        turned = np.rot90(frames[chosen.start : chosen.stop], turn, axes=(1, 2))
        return encode_posterior(base_model, np.ascontiguousarray(turned))

    batches = ShrinkingBatches(ENCODE_BATCH)
    for turn in range(num_turns):
        for _, (mean, deviation) in batches.map(functools.partial(encode, turn=turn), len(rows)):
            yield mean.cpu().numpy(), None if deviation is None else deviation.cpu().numpy()


def _latents_on_disk(
    base_model: PretrainedModel, frames: Images, num_turns: int, folder: Path, distributed: DistributedContext
) -> tuple[Images, Images | None]:
    """The latents of all frames and turns, of which each process writes those of a share of the frames."""
    folder.mkdir(parents=True, exist_ok=True)
    # Whole batches: however many processes there are, latents are the same to the last bit.
    batches = -(-len(frames) // ENCODE_BATCH)
    cuts = np.linspace(0, batches, min(distributed.count, batches) + 1).round().astype(int) * ENCODE_BATCH
    shares = [range(start, stop) for start, stop in itertools.pairwise(np.minimum(cuts, len(frames)).tolist())]
    name = f"latents_{_latents_digest(base_model, frames, num_turns, len(shares))}"
    paths = [{kind: folder / f"{name}_{kind}_{share}.npy" for kind in ("mean", "std")} for share in range(len(shares))]
    if distributed.rank < len(shares) and not paths[distributed.rank]["mean"].is_file():
        _write_latents(_encode(base_model, frames, shares[distributed.rank], num_turns), paths[distributed.rank])
    distributed.wait()
    # Frame i, turned t times, is row t * (frames of its share) + (i - first of its share) of its share's file.
    share = np.concatenate([np.full(len(rows), number) for number, rows in enumerate(shares)])
    row = np.concatenate(
        [np.concatenate([turn * len(rows) + np.arange(len(rows)) for rows in shares]) for turn in range(num_turns)]
    )
    found = []
    for kind in ("mean", "std"):
        is_there = kind == "mean" or paths[0]["std"].is_file()
        opened = [np.load(each[kind], mmap_mode="r", allow_pickle=False) for each in paths if is_there]
        found.append(ImageRows(opened, np.tile(share, num_turns), row) if is_there else None)
    return found[0], found[1]


def _write_latents(encoded: Iterator[tuple[np.ndarray, np.ndarray | None]], paths: Mapping[str, Path]) -> None:
    """Under other names first: a file that has its name is whole. That of the means comes last."""
    unfinished = {kind: path.with_name(f"unfinished_{path.name}") for kind, path in paths.items()}
    with ArrayWriter(unfinished["mean"]) as means, ArrayWriter(unfinished["std"]) as deviations:
        for mean, deviation in encoded:
            means.append(mean)
            if deviation is not None:
                deviations.append(deviation)
    for kind in ("std", "mean"):
        if unfinished[kind].is_file():
            unfinished[kind].replace(paths[kind])


def _latents_digest(base_model: PretrainedModel, frames: Images, num_turns: int, num_shares: int) -> str:
    """Names latents by all that decides them."""
    total = hashlib.sha256(f"{as_image_rows(frames).digest()} {num_turns} {num_shares}".encode())
    for name, weight in base_model.vae.state_dict().items():
        total.update(name.encode())
        total.update(np.ascontiguousarray(weight.detach().float().cpu().numpy()).data)
    return total.hexdigest()[:16]


@torch.no_grad()
def encode_images(base_model: PretrainedModel, images: np.ndarray, generator: torch.Generator) -> Tensor:
    """Scaled latents [B, C, h, w] float32 of images [B, H, W, 3] uint8, drawn from their posteriors."""
    latents, deviations = encode_posterior(base_model, images)
    if deviations is not None:
        noise = torch.randn(latents.shape, generator=generator)
        latents = latents + deviations * noise.to(latents.device)
    return latents * base_model.scaling_factor


def turn_conditions(images: np.ndarray, turns: np.ndarray, made_by: ConditionChoice | None) -> np.ndarray:
    """Square condition images [B, S, S, 3] in `turns` [B] quarter turns against the clock.

    A `ConditionThatTurns` knows what its colours mean; the others' images are pictures.
    """
    plugin = None if made_by is None else plugins.load_options(made_by)
    if plugin is not None and isinstance(plugin.module, ConditionThatTurns):
        return plugin.module.turn(images, turns, plugin.options)
    return np.stack([np.rot90(image, turn) for image, turn in zip(images, turns, strict=True)])


def _prompt_rows(own: Sequence[int], class_names: Sequence[str] | None) -> tuple[Tensor, ...]:
    if class_names is None:
        return tuple(torch.tensor([row]) for row in own)
    of_class: dict[str, set[int]] = {}
    for name, row in zip(class_names, own, strict=True):
        of_class.setdefault(name, set()).add(row)
    choices = {name: torch.tensor(sorted(rows)) for name, rows in of_class.items()}
    return tuple(choices[name] for name in class_names)


def check_training_data(frames: Images, conditions: Conditions, image_size: tuple[int, int]) -> None:
    """Raise `DataError` unless frames and conditions are images of the base model's size, one condition a frame."""
    width, height = image_size
    arrays = {"frames": frames} if conditions.images is None else {"frames": frames, "conditions": conditions.images}
    for name, array in arrays.items():
        if array.ndim != 4 or array.shape[1:] != (height, width, 3) or array.dtype != np.uint8:
            raise DataError(
                f"{name} must be [N, {height}, {width}, 3] uint8, the size this base model was trained on, "
                f"got {list(array.shape)} {array.dtype}; set the image size of the encoding"
            )
        if len(array) != len(conditions.prompts):
            raise DataError(f"{len(array)} {name} do not match {len(conditions.prompts)} prompts")
    if len(frames) == 0:
        raise DataError("fine-tuning needs at least one frame, got none")


def check_cache(cache: LatentCache, conditions: Conditions) -> None:
    """Raise `DataError` naming the first frame or prompt whose latents or embedding are not finite.

    Latents of an unusual size are logged: the scaling factor is a number in the base model's config that nothing else
    vouches for, and networks given latents of another size than they were trained on learn and draw badly, in silence.
    """
    squares, count = [], len(cache.prompt_rows)
    for name, values in (("mean", cache.mean), ("standard deviation", cache.std)):
        start = 0
        for chunk in () if values is None else image_chunks(values):
            wrong = np.flatnonzero(~np.isfinite(chunk.reshape(len(chunk), -1)).all(axis=1))
            if len(wrong):
                raise DataError(
                    f"frame {(start + int(wrong[0])) % count} of {count}: the {name} of its latents must be finite, "
                    "which the base model's autoencoder did not make it; check that frame and the autoencoder"
                )
            start += len(chunk)
            if name == "mean":
                squares.append(float(np.square(chunk, dtype=np.float64).mean()) * len(chunk))
    wrong = ~torch.isfinite(cache.embeddings).flatten(1).all(dim=1)
    if bool(wrong.any()):
        row = int(wrong.nonzero()[0])
        prompt = [*sorted(set(conditions.prompts)), ""][row]
        raise DataError(f"prompt {prompt!r}: its embedding is not finite; check the base model's text encoder")
    size = (sum(squares) / len(cache.mean)) ** 0.5 * cache.scaling_factor
    if not USUAL_SIZE[0] <= size <= USUAL_SIZE[1]:
        logger.warning(
            "latents of the frames have a root mean square of %.2g after scaling by %g, expected about 1; "
            "check scaling_factor in the config of the base model's autoencoder (Stable Diffusion v1: 0.18215)",
            size, cache.scaling_factor,
        )  # fmt: skip
