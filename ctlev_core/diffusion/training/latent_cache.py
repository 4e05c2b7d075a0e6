"""Everything fine-tuning needs of frames, prompts and conditions, computed once, and checked before training starts."""

from __future__ import annotations

import functools
import logging
from collections.abc import Sequence
from dataclasses import dataclass

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
from data_contracts.config import ConditionChoice
from data_contracts.errors import DataError
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
        mean: [T * N, C, h, w] posterior means, not scaled: all frames as they are, then all turned once, and so on.
        std: [T * N, C, h, w] posterior standard deviations; None for a code without noise.
        scaling_factor: multiplies sampled latents.
        embeddings: [P, L, D] of the distinct prompts; the last is the empty prompt.
        prompt_rows: for each of N frames the indices into `embeddings` of the prompts it may be shown with.
        conditions: [N, H, W, 3] uint8, or None.
        made_by: the plug-in of the conditions, where known.
    """

    mean: Tensor
    std: Tensor | None
    scaling_factor: float
    embeddings: Tensor
    prompt_rows: tuple[Tensor, ...]
    conditions: np.ndarray | None
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
        index = torch.from_numpy(rows if turns is None else turns * len(self.prompt_rows) + rows)
        latents = self.mean[index]
        if self.std is not None:
            latents = latents + self.std[index] * torch.randn(latents.shape, generator=generator)
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
    frames: np.ndarray,
    conditions: Conditions,
    class_names: Sequence[str] | None = None,
    *,
    num_turns: int = 1,
) -> LatentCache:
    """Run the frozen autoencoder and text encoder, once per frame and turn and once per distinct prompt.

    Args:
        base_model: autoencoder and text encoder.
        frames: [N, H, W, 3] uint8.
        conditions: N prompts and perhaps condition images.
        class_names: N; frames of one class may be shown with the prompt of any of them. None = each with its own.
        num_turns: 4 also encodes square frames in their three quarter turns.
    """
    means, deviations = [], []

    def encode(rows: slice, turn: int) -> tuple[Tensor, Tensor | None]:
        turned = np.rot90(frames[rows], turn, axes=(1, 2))
        return encode_posterior(base_model, np.ascontiguousarray(turned))

    batches = ShrinkingBatches(ENCODE_BATCH)
    with torch.no_grad():
        for turn in range(num_turns):
            for _, (mean, deviation) in batches.map(functools.partial(encode, turn=turn), len(frames)):
                means.append(mean.cpu())
                if deviation is not None:
                    deviations.append(deviation.cpu())
    prompts = sorted(set(conditions.prompts))
    position = {prompt: row for row, prompt in enumerate(prompts)}
    return LatentCache(
        mean=torch.cat(means),
        std=torch.cat(deviations) if deviations else None,
        scaling_factor=base_model.scaling_factor,
        embeddings=encode_prompts(base_model, [*prompts, ""]).float().cpu(),
        prompt_rows=_prompt_rows([position[prompt] for prompt in conditions.prompts], class_names),
        conditions=conditions.images,
        made_by=conditions.made_by,
    )


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

    A plug-in with a function `turn` knows what its colours mean; the others' images are pictures.
    """
    plugin = None if made_by is None else plugins.load_options(made_by)
    if plugin is not None and hasattr(plugin.module, "turn"):
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


def check_training_data(frames: np.ndarray, conditions: Conditions, image_size: tuple[int, int]) -> None:
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
    for name, values in (("mean", cache.mean), ("standard deviation", cache.std)):
        wrong = None if values is None else ~torch.isfinite(values).flatten(1).all(dim=1)
        if wrong is not None and bool(wrong.any()):
            count = len(cache.prompt_rows)
            row = int(wrong.nonzero()[0]) % count
            raise DataError(
                f"frame {row} of {count}: the {name} of its latents must be finite, which the base model's "
                "autoencoder did not make it; check that frame and the autoencoder"
            )
    wrong = ~torch.isfinite(cache.embeddings).flatten(1).all(dim=1)
    if bool(wrong.any()):
        row = int(wrong.nonzero()[0])
        prompt = [*sorted(set(conditions.prompts)), ""][row]
        raise DataError(f"prompt {prompt!r}: its embedding is not finite; check the base model's text encoder")
    sizes = torch.linalg.vector_norm(cache.mean.flatten(1), dim=1).double() / cache.mean[0].numel() ** 0.5
    size = float(sizes.square().mean().sqrt()) * cache.scaling_factor
    if not USUAL_SIZE[0] <= size <= USUAL_SIZE[1]:
        logger.warning(
            "latents of the frames have a root mean square of %.2g after scaling by %g, expected about 1; "
            "check scaling_factor in the config of the base model's autoencoder (Stable Diffusion v1: 0.18215)",
            size, cache.scaling_factor,
        )  # fmt: skip
