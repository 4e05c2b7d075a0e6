"""Draw frames from a checkpoint: fast solvers, one random stream an image, resumable shards, one process a device.

Image i depends on (condition i, seed i) alone: its noise comes from a stream of its own, and no layer mixes the rows of
a batch. Convolution libraries may still sum in another order for another batch size, which moves a pixel by rounding,
one grey level at most; run with the same batch size for bit-identical frames.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import json
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ctlev_core.cpu_precision import computed_in
from ctlev_core.diffusion.compilation import SAMPLING_PASSES, compiler_works, pays
from ctlev_core.diffusion.denoising import Denoiser, generator_for, mix_noise
from ctlev_core.diffusion.motion_layers import load_motion_layers
from ctlev_core.diffusion.pretrained.adapters import ADAPTER_FILE, WEIGHTS_FILE
from ctlev_core.diffusion.pretrained.loading import (
    PretrainedModel,
    choose_device,
    conditions_to_tensor,
    control_input,
    decode_latents,
    load_base_model,
)
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.sampling.autoguidance import attention_blocks, without_blocks
from ctlev_core.diffusion.sampling.controlnet_reuse import EveryKthStep
from ctlev_core.diffusion.sampling.controlnet_reuse import cached_condition_embedding as cached_condition_embedding
from ctlev_core.diffusion.sampling.devices import device_names, run_on_devices, spread_over_cores
from ctlev_core.diffusion.sampling.options import STOCHASTIC, SamplingOptions, noise_seeds
from ctlev_core.diffusion.sampling.out_of_memory import ShrinkingBatches
from ctlev_core.diffusion.sampling.schedulers import make_scheduler as make_scheduler
from ctlev_core.diffusion.sampling.shards import SHARD, Shard, plan_shards, whole_stretches
from ctlev_core.diffusion.sampling.value_table import draw_values, nearest_values, read_value_table
from ctlev_core.progress import ProgressBar
from ctlev_core.supervised.frame_sequences import stretch_lengths
from data_contracts.config import cache_material
from data_contracts.errors import DataError
from data_contracts.labels import Conditions

logger = logging.getLogger(__name__)

VALUE_STREAM, SHARED_STREAM = 1, 2
"""Entropy that keeps the values drawn, and the noise of a stretch, apart from the noise of the same seed."""
SHARDS_A_PROCESS = 4
"""Fewer are sampled before another process has started, which takes some ten seconds of imports."""


@torch.no_grad()
def sample_latents(
    base_model: PretrainedModel,
    embeddings: Tensor,
    empty_embedding: Tensor,
    conditions: Tensor | None,
    seeds: Sequence[int],
    options: SamplingOptions,
    lengths: Sequence[int] | None = None,
) -> Tensor:
    """Clean latents [B, C, h, w] float32, still multiplied by the scaling factor.

    Args:
        base_model: networks in any precision; the solver's state is float32 whatever theirs.
        embeddings: [B, L, D] of the prompts.
        empty_embedding: [1, L, D], for guidance.
        conditions: [B, 3, H, W] in [0, 1], or None.
        seeds: B non-negative integers, of the images' noise streams; equal seeds give equal noise.
        options: solver, number of steps, guidance.
        lengths: of stretches that lie behind one another, whose frames are made from one another; None = none are.
    Raises:
        FloatingPointError: latents are not finite, because the networks' precision does not reach.
    """
    device, dtype = base_model.unet.device, base_model.unet.dtype
    scheduler = make_scheduler(
        options.scheduler, base_model.scheduler_config, options.num_inference_steps, options.timestep_spacing
    )
    streams = [torch.Generator().manual_seed(int(seed)) for seed in seeds]
    side = base_model.unet.config.sample_size
    shape = (base_model.unet.config.in_channels, side, side)
    state = torch.stack([torch.randn(shape, generator=stream) for stream in streams])
    if lengths is not None and base_model.motion is not None:
        state = mix_noise(state, _noise_of_stretches(shape, seeds, lengths), base_model.motion.settings.shared_noise)
    state = state.to(device) * scheduler.init_noise_sigma
    further = {"generator": streams} if options.scheduler in STOCHASTIC else {}
    motion = contextlib.nullcontext() if base_model.motion is None else base_model.motion.of(lengths)
    with guided_predictions(base_model, embeddings, empty_embedding, conditions, options) as predict, motion:
        for timestep in scheduler.timesteps:
            predicted = predict(scheduler.scale_model_input(state, timestep), timestep)
            state = scheduler.step(predicted, timestep, state, **further).prev_sample
    if not bool(torch.isfinite(state).all()):
        raise FloatingPointError(
            f"latents sampled with {options.scheduler} and networks in {dtype} are not finite; "
            "float16 overflows beyond 65504, bfloat16 and float32 do not"
        )
    return state


def _noise_of_stretches(shape: Sequence[int], seeds: Sequence[int], lengths: Sequence[int]) -> Tensor:
    """Noise [B, C, h, w] that is the same for all frames of a stretch, from the seed of its first."""
    firsts = np.cumsum([0, *lengths[:-1]]).tolist()
    noise = [torch.randn(tuple(shape), generator=generator_for(int(seeds[row]), SHARED_STREAM)) for row in firsts]
    return torch.stack(noise).repeat_interleave(torch.tensor(list(lengths)), 0)


@contextmanager
def guided_predictions(
    base_model: PretrainedModel,
    embeddings: Tensor,
    empty_embedding: Tensor,
    conditions: Tensor | None,
    options: SamplingOptions,
) -> Iterator[Callable[[Tensor, Tensor], Tensor]]:
    """Within the context a function of (noisy latents [B, C, h, w], time step) to the prediction, with guidance.

    It takes the latents in any precision and gives float32; the time step is one number for all rows.

    Args:
        base_model: networks in any precision.
        embeddings: [B, L, D] of the prompts.
        empty_embedding: [1, L, D], for guidance.
        conditions: [B, 3, H, W] in [0, 1], or None.
        options: guidance, and how often the ControlNet is evaluated.
    """
    device, dtype = base_model.unet.device, base_model.unet.dtype
    embeddings = embeddings.to(device, dtype)
    conditions = control_input(base_model, conditions)
    conditions = None if conditions is None else conditions.to(device, dtype)
    # What guided steps take: every row without its prompt, then with it.
    both, twice = embeddings, conditions
    if options.guidance_scale > 1:
        both = torch.cat([empty_embedding.to(embeddings).expand_as(embeddings), embeddings])
        twice = None if conditions is None else torch.cat([conditions, conditions])
    denoiser = _denoiser(base_model, options)
    num_timesteps = base_model.scheduler_config.get("num_train_timesteps", 1000)
    blocks = attention_blocks(base_model.unet, options.autoguidance_layers) if options.autoguidance_scale > 1 else []
    # With a count of its own of the ControlNet's calls.
    worse = _denoiser(base_model, options)

    def predict(noisy: Tensor, timestep: Tensor) -> Tensor:
        noisy = noisy.to(dtype)
        once = timestep.expand(len(noisy)).to(device)
        if not _is_guided(timestep, num_timesteps, options):
            return denoiser.predict(noisy, once, embeddings, conditions).float()
        if options.guidance_scale > 1:
            timesteps = timestep.expand(2 * len(noisy)).to(device)
            predicted = denoiser.predict(torch.cat([noisy, noisy]), timesteps, both, twice).float()
            plain, prompted = predicted.chunk(2)
            guided = plain + options.guidance_scale * (prompted - plain)
        else:
            guided = prompted = denoiser.predict(noisy, once, embeddings, conditions).float()
        if not blocks:
            return guided
        with without_blocks(blocks):
            bad = worse.predict(noisy, once, embeddings, conditions).float()
        return guided + (options.autoguidance_scale - 1) * (prompted - bad)

    with cached_condition_embedding(base_model.controlnet, conditions):
        yield predict


def _denoiser(base_model: PretrainedModel, options: SamplingOptions) -> Denoiser:
    """The networks, of which the ControlNet is evaluated as often as is asked for."""
    if base_model.controlnet is None:
        return Denoiser(base_model.unet)
    return Denoiser(base_model.unet, EveryKthStep(base_model.controlnet, options.controlnet_every))


def _is_guided(timestep: Tensor, num_timesteps: int, options: SamplingOptions) -> bool:
    low, high = options.guidance_interval
    share = min(float(timestep) / (num_timesteps - 1), 1.0)  # flow matching goes up to num_timesteps
    return options.passes_a_step > 1 and low <= share <= high


@torch.no_grad()
def decode_frames(
    base_model: PretrainedModel, latents: Tensor, options: SamplingOptions, seeds: Sequence[int] = ()
) -> np.ndarray:
    """Frames [B, H, W, 3] uint8 of scaled latents; dark values become exactly 0, or values are drawn from `seeds`."""
    values = ((decode_latents(base_model, latents) + 1) * 127.5).clamp(0, 255)
    if options.palette == "grey":
        values = values.mean(dim=1, keepdim=True).expand_as(values)
    elif options.palette == "red_blue":
        values = values * torch.tensor([1.0, 0.0, 1.0], device=values.device)[:, None, None]
    if base_model.value_table is not None:
        expected = values.permute(0, 2, 3, 1).float().cpu().numpy()
        streams = [(int(seed), VALUE_STREAM) for seed in seeds]
        if options.palette == "grey":
            return draw_values(expected[..., :1], base_model.value_table, streams).repeat(3, axis=3)
        drawn = draw_values(expected, base_model.value_table, streams)
        if options.palette == "red_blue":
            drawn[..., 1] = 0
        return drawn
    values = torch.where(values < options.black_threshold, 0.0, values)
    return values.round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()


def sample_frames(
    base_model: PretrainedModel,
    conditions: Conditions,
    options: SamplingOptions,
    *,
    seeds: Sequence[int],
    work: Path,
    identity: str = "",
) -> np.ndarray:
    """Sample one frame a condition; finished shards in `work` are reused when a killed run is started again.

    Args:
        base_model: a loaded checkpoint.
        conditions: N prompts, with N condition images where the checkpoint has a ControlNet.
        options: solver, steps, guidance, output levels; its device is that of the base model.
        seeds: N non-negative integers.
        work: folder of the finished shards.
        identity: names the checkpoint, so that shards of another one are not reused.
    Returns:
        [N, H, W, 3] uint8.
    Raises:
        ValueError: numbers or sizes do not match.
    """
    _check_conditions(base_model, conditions, seeds)
    if not len(conditions):
        width, height = base_model.image_size
        return np.zeros((0, height, width, 3), np.uint8)
    shards = plan_shards(conditions, _noise_seeds(conditions, seeds, options), _settings(identity, options), work)
    with _progress(shards) as (missing, report):
        sample_shards(base_model, _prompts(conditions), missing, options, report)
    return _read(shards)


def sample_shards(
    base_model: PretrainedModel,
    prompts: list[str],
    shards: list[Shard],
    options: SamplingOptions,
    report: Callable[[int], None],
    compiled_rows: int = 0,
) -> None:
    """Sample shards and write them.

    Args:
        base_model: a loaded checkpoint.
        prompts: all that any shard of the call has, also those of other processes: they are embedded together.
        shards: what is to be done.
        options: solver, steps, guidance, output levels.
        report: is called with the number of frames done since.
        compiled_rows: size of a whole batch, where the networks are compiled for it.
    """
    if not shards:
        return
    table = encode_prompts(base_model, [*prompts, ""]).cpu()
    # Apart: the decoder takes more memory than the networks, and what they computed must not be lost for it.
    batches, decoded = ShrinkingBatches(options.batch_size), ShrinkingBatches(options.batch_size)
    for shard in shards:
        embeddings = table[[prompts.index(prompt) for prompt in shard.conditions.prompts]]
        sample = functools.partial(_sample_rows, base_model, shard, embeddings, table[-1:], options)
        if compiled_rows:
            sample = functools.partial(_compiled_if_whole, sample, batches, compiled_rows)
        parts = []
        for rows, latents in _sampled(sample, batches, shard, whole=base_model.motion is not None):
            decode = functools.partial(_decode_rows, base_model, latents, options, shard.seeds[rows])
            parts += [frames for _, frames in decoded.map(decode, len(latents))]
            report(rows.stop - rows.start)
        shard.write(np.concatenate(parts))


def _sampled(
    sample: Callable[[slice], Tensor], batches: ShrinkingBatches, shard: Shard, *, whole: bool
) -> Iterator[tuple[slice, Tensor]]:
    """Batches of rows and their latents; `whole` for batches of whole stretches, where rows have stretches."""
    if shard.conditions.stretches is None or not whole:
        yield from batches.map(sample, len(shard))
        return
    for rows in whole_stretches(shard.conditions, batches.size):
        yield rows, sample(rows)


def _compiled_if_whole(
    sample: Callable[[slice], Tensor], batches: ShrinkingBatches, compiled_rows: int, rows: slice
) -> Tensor:
    """Batches of other sizes, such as the last one, run uncompiled: to compile for each takes minutes."""
    whole = rows.stop - rows.start == min(batches.size, compiled_rows)
    with torch.compiler.set_stance("default" if whole else "force_eager"):
        return sample(rows)


def _sample_rows(
    base_model: PretrainedModel,
    shard: Shard,
    embeddings: Tensor,
    empty_embedding: Tensor,
    options: SamplingOptions,
    rows: slice,
) -> Tensor:
    images = None
    if shard.conditions.images is not None:
        images = conditions_to_tensor(shard.conditions.images[rows])
    stretches = shard.conditions.stretches
    lengths = None if stretches is None else stretch_lengths(stretches[rows])
    return sample_latents(base_model, embeddings[rows], empty_embedding, images, shard.seeds[rows], options, lengths)


def _decode_rows(
    base_model: PretrainedModel, latents: Tensor, options: SamplingOptions, seeds: Sequence[int], rows: slice
) -> np.ndarray:
    return decode_frames(base_model, latents[rows], options, seeds[rows])


def sample_checkpoint(
    checkpoint: Path,
    conditions: Conditions,
    options: SamplingOptions,
    *,
    with_controlnet: bool,
    seeds: Sequence[int],
    work: Path,
) -> np.ndarray:
    """Load a checkpoint folder and sample from it: `sample` of both generators.

    With several devices, or several cores and a small network, the shards are dealt out to one process each, batches as
    with one: the frames are the same.
    """
    if not len(conditions):
        _check_scheduler(checkpoint, options)
        base_model = load_for_sampling(checkpoint, options, device_names(options.device)[0], with_controlnet)
        return sample_frames(base_model, conditions, options, seeds=seeds, work=work)
    return _read(make_shards(checkpoint, conditions, options, with_controlnet=with_controlnet, seeds=seeds, work=work))


def make_shards(
    checkpoint: Path,
    conditions: Conditions,
    options: SamplingOptions,
    *,
    with_controlnet: bool,
    seeds: Sequence[int],
    work: Path,
    only: slice = slice(None),
) -> list[Shard]:
    """Write the files that `sample_checkpoint` puts together, or only some of them; those that are there are kept.

    Args:
        checkpoint: folder.
        conditions: N > 0, all of the call, whatever `only` is: batches and prompts are planned for the whole.
        options: solver, steps, guidance, devices.
        with_controlnet: the route.
        seeds: N non-negative integers.
        work: folder of the files.
        only: these of the shards, by number.
    """
    _check_scheduler(checkpoint, options)
    devices, identity = device_names(options.device), _checkpoint_digest(checkpoint)
    _check_seeds(conditions, seeds)
    shards = plan_shards(conditions, _noise_seeds(conditions, seeds, options), _settings(identity, options), work)[only]
    with _progress(shards) as (missing, report):
        function = functools.partial(
            _sample_share, checkpoint, options, with_controlnet, _prompts(conditions), len(conditions)
        )
        if len(devices) == 1:
            devices = spread_over_cores(devices[0], checkpoint, _num_whole(missing) // SHARDS_A_PROCESS)
        shares = [missing[number :: len(devices)] for number in range(len(devices))]
        busy = [number for number, share in enumerate(shares) if share]
        if len(devices) == 1:
            function(devices[0], missing, report)
        else:
            run_on_devices(function, [devices[number] for number in busy], [shares[number] for number in busy], report)
    return shards


def _num_whole(shards: list[Shard]) -> int:
    """Shards, without one that is hardly worth a process."""
    sizes = [len(shard) for shard in shards]
    return sum(sizes) // max(sizes) if sizes else 0


def _sample_share(
    checkpoint: Path,
    options: SamplingOptions,
    with_controlnet: bool,
    prompts: list[str],
    num_rows: int,
    device: str,
    shards: list[Shard],
    report: Callable[[int], None],
) -> None:
    """What the process of one device does; `num_rows` are those of all shards, of other runs and processes too."""
    if not shards:
        return
    base_model = load_for_sampling(checkpoint, options, device, with_controlnet)
    for shard in shards:
        _check_conditions(base_model, shard.conditions, shard.seeds)
    place, whole = base_model.unet.device, min(options.batch_size, SHARD, num_rows)
    num_passes = math.ceil(num_rows / whole) * options.num_inference_steps
    compiled = pays(options.compile_networks, place, num_passes, SAMPLING_PASSES) and compiler_works(place)
    if compiled:
        compile_for_sampling(base_model)
    sample_shards(base_model, prompts, shards, options, report, whole if compiled else 0)


def compile_for_sampling(base_model: PretrainedModel) -> None:
    """Compile U-Net and ControlNet in place when they are first called; on a GPU with channels last.

    Convolutions of half precision are faster so, and compiled networks leave out the copies that it costs elsewhere.
    """
    for network in filter(None, (base_model.unet, base_model.controlnet)):
        if network.device.type == "cuda":
            network.to(memory_format=torch.channels_last)
        network.compile(dynamic=False)


def load_for_sampling(
    checkpoint: Path, options: SamplingOptions, device: str, with_controlnet: bool
) -> PretrainedModel:
    """The networks in the precision asked for. The patch code stays in float32, where it is exact and takes no time."""
    from ctlev_core.diffusion.patch_autoencoder import PatchAutoencoder

    place = choose_device(device)
    dtype = getattr(torch, computed_in(options.precision, place.type))
    base_model = load_base_model(checkpoint, with_controlnet=with_controlnet, dtype=dtype, device=place)
    base_model = dataclasses.replace(base_model, motion=load_motion_layers(checkpoint, base_model.unet))
    if options.values != "expected":
        table = read_value_table(checkpoint)
        base_model = dataclasses.replace(
            base_model, value_table=table if options.values == "drawn" else nearest_values(table)
        )
    if not isinstance(base_model.vae, PatchAutoencoder) or dtype == torch.float32:
        return base_model
    exact: Any = PatchAutoencoder.from_config(base_model.vae.config)
    return dataclasses.replace(base_model, vae=exact.to(place).eval().requires_grad_(False))


def _check_scheduler(checkpoint: Path, options: SamplingOptions) -> None:
    """Raise before anything is loaded where the checkpoint's noise schedule cannot be sampled with these options."""
    path = checkpoint / "scheduler" / "scheduler_config.json"
    try:
        config = json.loads(path.read_text())
    except (OSError, ValueError):
        return  # the checkpoint is broken, and loading it says in what way
    try:
        make_scheduler(options.scheduler, config, options.num_inference_steps, options.timestep_spacing)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def _settings(identity: str, options: SamplingOptions) -> str:
    return json.dumps([identity, cache_material(options)])


def _noise_seeds(conditions: Conditions, seeds: Sequence[int], options: SamplingOptions) -> list[int]:
    lengths = None if conditions.stretches is None else stretch_lengths(conditions.stretches)
    return noise_seeds(seeds, options, lengths)


def _prompts(conditions: Conditions) -> list[str]:
    return sorted(set(conditions.prompts))


@contextmanager
def _progress(shards: list[Shard]) -> Iterator[tuple[list[Shard], Callable[[int], Any]]]:
    """The shards that are still to be sampled, and what to call with the number of frames done."""
    missing = [shard for shard in shards if not shard.path.is_file()]
    total, left = sum(map(len, shards)), sum(map(len, missing))
    with ProgressBar(total=total, initial=total - left, desc="sampling", unit="image") as bar:
        yield missing, bar.update


def _read(shards: list[Shard]) -> np.ndarray:
    """The frames of all shards; only one shard is in memory twice."""
    first = shards[0].read()
    frames = np.empty((sum(map(len, shards)), *first.shape[1:]), np.uint8)
    start = 0
    for shard in shards:
        frames[start : start + len(shard)] = shard.read()
        start += len(shard)
    return frames


def _checkpoint_digest(checkpoint: Path) -> str:
    """Digest of the weights, and of the configs that say what they mean."""
    digest = hashlib.sha256()
    parts = [checkpoint]
    if checkpoint.is_dir():
        files = [*checkpoint.glob("*/*"), checkpoint / ADAPTER_FILE, checkpoint / WEIGHTS_FILE]
        parts = sorted(path for path in files if path.is_file())
    for path in parts:
        with path.open("rb") as file:
            digest.update(path.name.encode() + hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _check_seeds(conditions: Conditions, seeds: Sequence[int]) -> None:
    if len(seeds) != len(conditions):
        raise ValueError(f"one seed a condition is needed, got {len(seeds)} seeds for {len(conditions)} conditions")


def _check_conditions(base_model: PretrainedModel, conditions: Conditions, seeds: Sequence[int]) -> None:
    _check_seeds(conditions, seeds)
    if (base_model.controlnet is None) != (conditions.images is None):
        needs = "no condition images" if base_model.controlnet is None else "condition images"
        got = "none" if conditions.images is None else f"images of shape {list(conditions.images.shape)}"
        raise ValueError(f"this checkpoint takes {needs}, got {got}")
    width, height = base_model.image_size
    images = conditions.images
    if images is not None and (images.shape != (len(conditions), height, width, 3) or images.dtype != np.uint8):
        raise ValueError(
            f"condition images must be [{len(conditions)}, {height}, {width}, 3] uint8, "
            f"got {list(images.shape)} {images.dtype}"
        )
