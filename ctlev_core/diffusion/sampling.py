"""Draw frames from a checkpoint: fast solvers, one random stream an image, resumable shards.

Image i depends on (condition i, seed i) alone: its noise comes from a stream of its own, and no layer mixes the rows of
a batch. Convolution libraries may still sum in another order for another batch size, which moves a pixel by rounding,
one grey level at most; run with the same batch size for bit-identical frames.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from ctlev_core.diffusion.denoising import Denoiser
from ctlev_core.diffusion.prior import Prior, choose_device, conditions_to_tensor, encode_prompts, load_prior
from ctlev_core.diffusion.sampling_options import SamplingOptions
from data_contracts.config import cache_material
from data_contracts.labels import Conditions

SHARD = 128
UNIPC_ORDER = 3


def make_scheduler(name: str, config: dict[str, Any], num_inference_steps: int) -> Any:
    """A diffusers scheduler for the noise schedule of a checkpoint, its time steps set.

    Karras sigmas and a last sigma of zero: with evenly spaced steps the last jump starts at sigma 0.2 and more, and
    blurs exactly what event images consist of, narrow peaks on a black background.

    Args:
        name: `unipc`, `dpm++`, `ddim` or `ddpm`.
        config: the checkpoint's scheduler config; never a class's defaults, which clip latents.
        num_inference_steps: evaluations of the network.
    Raises:
        ValueError: unknown name, or more steps than the schedule has.
    """
    from diffusers.schedulers.scheduling_ddim import DDIMScheduler
    from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
    from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler
    from diffusers.schedulers.scheduling_unipc_multistep import UniPCMultistepScheduler

    karras = {"use_karras_sigmas": True, "final_sigmas_type": "zero"}
    known: dict[str, tuple[Any, dict[str, Any]]] = {
        "unipc": (UniPCMultistepScheduler, {"solver_order": UNIPC_ORDER, **karras}),
        "dpm++": (DPMSolverMultistepScheduler, {"algorithm_type": "dpmsolver++", **karras}),
        "ddim": (DDIMScheduler, {"clip_sample": False}),
        "ddpm": (DDPMScheduler, {"clip_sample": False}),
    }
    if name not in known:
        raise ValueError(f"unknown scheduler {name!r}; known: {', '.join(known)}")
    scheduler_class, overrides = known[name]
    if num_inference_steps >= config.get("num_train_timesteps", 1000):
        # Stable Diffusion's offset of 1 would ask for time step 1000 of 0 .. 999.
        overrides = {**overrides, "steps_offset": 0}
    scheduler: Any = scheduler_class.from_config(config, **overrides)
    scheduler.set_timesteps(num_inference_steps)
    return scheduler


class _CachedEmbedding(torch.nn.Module):
    """Stands in for a ControlNet's condition embedding, whose output does not depend on the time step."""

    def __init__(self, value: Tensor) -> None:
        super().__init__()
        self.value = value

    def forward(self, conditioning: Tensor) -> Tensor:
        return self.value


@contextmanager
def cached_condition_embedding(controlnet: Any | None, conditions: Tensor | None) -> Iterator[None]:
    """Within the context the condition embedding is computed once; exact, and most of a tiny ControlNet's time."""
    if controlnet is None or conditions is None:
        yield
        return
    original = controlnet.controlnet_cond_embedding
    controlnet.controlnet_cond_embedding = _CachedEmbedding(original(conditions))
    try:
        yield
    finally:
        controlnet.controlnet_cond_embedding = original


@torch.no_grad()
def sample_latents(
    prior: Prior,
    embeddings: Tensor,
    empty_embedding: Tensor,
    conditions: Tensor | None,
    seeds: Sequence[int],
    options: SamplingOptions,
) -> Tensor:
    """Clean latents [B, C, h, w] float32, still multiplied by the scaling factor.

    Args:
        prior: networks in any precision; the solver's state is float32 whatever theirs.
        embeddings: [B, L, D] of the prompts.
        empty_embedding: [1, L, D], for guidance.
        conditions: [B, 3, H, W] in [0, 1], or None.
        seeds: B non-negative integers.
        options: solver, number of steps, guidance.
    """
    device, dtype = prior.unet.device, prior.unet.dtype
    scheduler = make_scheduler(options.scheduler, prior.scheduler_config, options.num_inference_steps)
    streams = [torch.Generator().manual_seed(int(seed)) for seed in seeds]
    side = prior.unet.config.sample_size
    shape = (prior.unet.config.in_channels, side, side)
    state = torch.stack([torch.randn(shape, generator=stream) for stream in streams]).to(device)
    state = state * scheduler.init_noise_sigma
    guided = options.guidance_scale > 1
    if guided:
        embeddings = torch.cat([empty_embedding.expand_as(embeddings), embeddings])
        conditions = None if conditions is None else torch.cat([conditions, conditions])
    embeddings = embeddings.to(device, dtype)
    conditions = None if conditions is None else conditions.to(device, dtype)
    # Only the ancestral solver draws further noise, from each image's own stream.
    further = {"generator": streams} if options.scheduler == "ddpm" else {}
    denoiser = Denoiser(prior.unet, prior.controlnet)
    with cached_condition_embedding(prior.controlnet, conditions):
        for timestep in scheduler.timesteps:
            noisy = scheduler.scale_model_input(state, timestep).to(dtype)
            noisy = torch.cat([noisy, noisy]) if guided else noisy
            timesteps = timestep.expand(len(noisy)).to(device)
            predicted = denoiser.predict(noisy, timesteps, embeddings, conditions).float()
            if guided:
                plain, prompted = predicted.chunk(2)
                predicted = plain + options.guidance_scale * (prompted - plain)
            state = scheduler.step(predicted, timestep, state, **further).prev_sample
    return state


@torch.no_grad()
def decode_frames(prior: Prior, latents: Tensor, options: SamplingOptions) -> np.ndarray:
    """Frames [B, H, W, 3] uint8 of scaled latents; dark values become exactly 0."""
    images = prior.vae.decode((latents / prior.scaling_factor).to(prior.vae.dtype)).sample.float()
    values = ((images + 1) * 127.5).clamp(0, 255)
    if options.palette == "grey":
        values = values.mean(dim=1, keepdim=True).expand_as(values)
    elif options.palette == "red_blue":
        values = values * torch.tensor([1.0, 0.0, 1.0], device=values.device)[:, None, None]
    values = torch.where(values < options.dark_level, 0.0, values)
    return values.round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()


def sample_frames(
    prior: Prior,
    conditions: Conditions,
    options: SamplingOptions,
    *,
    seeds: Sequence[int],
    work: Path,
    identity: str = "",
) -> np.ndarray:
    """Sample one frame a condition; finished shards in `work` are reused when a killed run is started again.

    Args:
        prior: a loaded checkpoint.
        conditions: N prompts, with N condition images where the checkpoint has a ControlNet.
        options: solver, steps, guidance, output levels.
        seeds: N non-negative integers.
        work: folder of the finished shards.
        identity: names the checkpoint, so that shards of another one are not reused.
    Returns:
        [N, H, W, 3] uint8.
    Raises:
        ValueError: numbers or sizes do not match.
    """
    _check_conditions(prior, conditions, seeds)
    width, height = prior.image_size
    frames = np.zeros((len(conditions), height, width, 3), np.uint8)
    prompts = sorted(set(conditions.prompts))
    table = encode_prompts(prior, [*prompts, ""]).cpu()
    embeddings = table[[prompts.index(prompt) for prompt in conditions.prompts]]
    work.mkdir(parents=True, exist_ok=True)
    settings = json.dumps([identity, cache_material(options)])
    with tqdm(total=len(frames), desc="sampling", unit="image", leave=False, disable=None) as bar:
        for start in range(0, len(frames), SHARD):
            rows = range(start, min(start + SHARD, len(frames)))
            path = work / f"shard_{_shard_digest(settings, conditions, seeds, rows)}.npy"
            if path.is_file():
                frames[rows.start : rows.stop] = np.load(path, allow_pickle=False)
                bar.update(len(rows))
                continue
            for first in range(rows.start, rows.stop, options.batch_size):
                part = slice(first, min(first + options.batch_size, rows.stop))
                images = None
                if conditions.images is not None:
                    images = conditions_to_tensor(conditions.images[part], prior.reversed_condition)
                latents = sample_latents(prior, embeddings[part], table[-1:], images, seeds[part], options)
                frames[part] = decode_frames(prior, latents, options)
                bar.update(part.stop - part.start)
            temporary = path.with_suffix(".tmp")
            with temporary.open("wb") as file:
                np.save(file, frames[rows.start : rows.stop])
            os.replace(temporary, path)
    return frames


def sample_checkpoint(
    checkpoint: Path,
    conditions: Conditions,
    options: SamplingOptions,
    *,
    with_controlnet: bool,
    seeds: Sequence[int],
    work: Path,
) -> np.ndarray:
    """Load a checkpoint folder and sample from it: `sample` of both generators."""
    dtype = torch.bfloat16 if options.precision == "bfloat16" else torch.float32
    device = choose_device(options.device)
    prior = load_prior(checkpoint, with_controlnet=with_controlnet, dtype=dtype, device=device)
    return sample_frames(prior, conditions, options, seeds=seeds, work=work, identity=_weights_digest(checkpoint))


def _weights_digest(checkpoint: Path) -> str:
    """Digest of the networks' weights: what makes two checkpoints different."""
    digest = hashlib.sha256()
    for path in sorted(checkpoint.glob("*/*.safetensors")):
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _check_conditions(prior: Prior, conditions: Conditions, seeds: Sequence[int]) -> None:
    if len(seeds) != len(conditions):
        raise ValueError(f"one seed a condition is needed, got {len(seeds)} seeds for {len(conditions)} conditions")
    if (prior.controlnet is None) != (conditions.images is None):
        needs = "no condition images" if prior.controlnet is None else "condition images"
        got = "none" if conditions.images is None else f"images of shape {list(conditions.images.shape)}"
        raise ValueError(f"this checkpoint takes {needs}, got {got}")
    width, height = prior.image_size
    images = conditions.images
    if images is not None and (images.shape != (len(conditions), height, width, 3) or images.dtype != np.uint8):
        raise ValueError(
            f"condition images must be [{len(conditions)}, {height}, {width}, 3] uint8, "
            f"got {list(images.shape)} {images.dtype}"
        )


def _shard_digest(settings: str, conditions: Conditions, seeds: Sequence[int], rows: range) -> str:
    """Names a shard by everything its frames depend on."""
    part = slice(rows.start, rows.stop)
    digest = hashlib.sha256(settings.encode())
    digest.update(json.dumps([list(conditions.prompts[part]), [int(seed) for seed in seeds[part]]]).encode())
    if conditions.images is not None:
        digest.update(np.ascontiguousarray(conditions.images[part]).data)
    return digest.hexdigest()[:24]
