"""Everything fine-tuning needs of frames, prompts and conditions, computed once, and checked before training starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ctlev_core import plugins
from ctlev_core.diffusion.denoising import Batch
from ctlev_core.diffusion.pretrained.loading import PretrainedModel, conditions_to_tensor, encode_posterior
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.training.distributed import SINGLE_PROCESS, DistributedContext
from ctlev_core.diffusion.training.latent_files import Latents, check_latents, latents_in_memory, latents_of_run
from ctlev_core.plugin_contracts import ConditionThatTurns
from data_contracts.config import ConditionChoice
from data_contracts.errors import DataError
from data_contracts.image_rows import Images
from data_contracts.labels import Conditions


@dataclass(frozen=True, eq=False)
class LatentCache:
    """Everything the loop needs of N frames in T quarter turns, computed once.

    Attributes:
        latents: of all frames and turns.
        scaling_factor: multiplies sampled latents.
        shift_factor: is taken from them before.
        embeddings: [P, L, D] of the distinct prompts; the last is the empty prompt.
        prompt_rows: for each of N frames the indices into `embeddings` of the prompts it may be shown with.
        conditions: [N, H, W, 3] uint8, or None.
        made_by: the plug-in of the conditions, where known.
    """

    latents: Latents
    scaling_factor: float
    embeddings: Tensor
    prompt_rows: tuple[Tensor, ...]
    conditions: Images | None
    made_by: ConditionChoice | None = None
    shift_factor: float = 0.0

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
        latents, std = torch.from_numpy(self.latents.mean[index]), self.latents.std
        if std is not None:
            latents = latents + torch.from_numpy(std[index]) * torch.randn(latents.shape, generator=generator)
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
        latents = (latents - self.shift_factor) * self.scaling_factor
        return Batch(latents.to(device), self.embeddings[prompts].to(device), conditions)


def cache_latents(
    base_model: PretrainedModel,
    frames: Images,
    conditions: Conditions,
    class_names: Sequence[str] | None = None,
    *,
    num_turns: int = 1,
    latents: Latents | None = None,
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
        latents: of all frames and turns, where they were encoded before; then the autoencoder is not run.
        folder: of a run's resumable state; None keeps latents in memory.
        distributed: which of several processes this is; more than one need a folder.
    """
    if latents is None:
        vae = base_model.vae
        latents = (
            latents_in_memory(vae, frames, num_turns)
            if folder is None
            else latents_of_run(vae, frames, num_turns, folder, distributed)
        )
    elif len(latents.mean) != num_turns * len(frames):
        raise ValueError(f"expected latents of {len(frames)} frames in {num_turns} turns, got {len(latents.mean)}")
    prompts = sorted(set(conditions.prompts))
    position = {prompt: row for row, prompt in enumerate(prompts)}
    return LatentCache(
        latents=latents,
        scaling_factor=base_model.scaling_factor,
        shift_factor=base_model.shift_factor,
        embeddings=encode_prompts(base_model, [*prompts, ""]).float().cpu(),
        prompt_rows=_prompt_rows([position[prompt] for prompt in conditions.prompts], class_names),
        conditions=conditions.images,
        made_by=conditions.made_by,
    )


@torch.no_grad()
def encode_images(base_model: PretrainedModel, images: np.ndarray, generator: torch.Generator) -> Tensor:
    """Scaled latents [B, C, h, w] float32 of images [B, H, W, 3] uint8, drawn from their posteriors."""
    latents, deviations = encode_posterior(base_model.vae, images)
    if deviations is not None:
        noise = torch.randn(latents.shape, generator=generator)
        latents = latents + deviations * noise.to(latents.device)
    return base_model.scale_latents(latents)


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


def check_cache(cache: LatentCache, conditions: Conditions, *, latents_are_checked: bool = False) -> None:
    """Raise `DataError` naming the first frame or prompt whose latents or embedding are not finite.

    Latents of an unusual size are logged (`check_latents`); those of a stage were checked there and are not read again.
    """
    wrong = ~torch.isfinite(cache.embeddings).flatten(1).all(dim=1)
    if bool(wrong.any()):
        row = int(wrong.nonzero()[0])
        prompt = [*sorted(set(conditions.prompts)), ""][row]
        raise DataError(f"prompt {prompt!r}: its embedding is not finite; check the base model's text encoder")
    if not latents_are_checked:
        check_latents(cache.latents, len(cache.prompt_rows), cache.scaling_factor)
