"""From a base model on disk to a fine-tuned checkpoint on disk, in this process or in several that train together.

Several processes are started here, by torchrun, and not by wrapping a flow in a launcher: one flow, one lock in the
store and one cache key, however many GPUs compute. Where `accelerate launch` or `torchrun` started the process all the
same, as many are started as the launcher was asked for; its other processes have nothing to do.

Arrays and options reach them as files in the work folder, and results come back the same way.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from ctlev_core.diffusion.pretrained.loading import choose_device, load_base_model, save_base_model
from ctlev_core.diffusion.sampling.value_table import write_value_table
from ctlev_core.diffusion.training.checks import check_packages, check_together
from ctlev_core.diffusion.training.distributed import SINGLE_PROCESS, DistributedContext
from ctlev_core.diffusion.training.finetuning import Tune, digest_of_start, fine_tune, forget_weights
from ctlev_core.diffusion.training.fsdp import gather_networks, shard_networks
from ctlev_core.diffusion.training.latent_files import Latents
from ctlev_core.diffusion.training.launch import run_rank, train_in_processes
from ctlev_core.diffusion.training.lora import save_lora
from ctlev_core.diffusion.training.options import FineTuningOptions
from ctlev_core.diffusion.training.trainer import TrainingHistory
from data_contracts.config import ConditionChoice
from data_contracts.image_rows import Images, as_image_rows, load_image_rows
from data_contracts.labels import Conditions


def train_checkpoint(
    frames: Images,
    conditions: Conditions,
    options: FineTuningOptions,
    *,
    tune: Tune,
    controlnet: Path | None = None,
    with_controlnet: bool,
    seed: int,
    out: Path,
    work: Path,
    class_names: Sequence[str] | None = None,
    latents: Latents | None = None,
) -> TrainingHistory:
    """Load the base model, fine-tune it and write it to `out` as a diffusers folder: `train` of both generators.

    Args:
        frames: [N, H, W, 3] uint8, of the base model's image size.
        conditions: N prompts, and N condition images for a ControlNet.
        options: see `FineTuningOptions`; `num_processes` changes nothing but the order of sums.
        tune: which networks learn.
        controlnet: the ControlNet to start from, see `load_base_model`.
        with_controlnet: load one at all.
        seed: of order and noise.
        out: the checkpoint folder to write.
        work: resumable state.
        class_names: N; see `cache_latents`.
        latents: likewise.
    Raises:
        ValueError: options or data do not fit.
        TrainingError: the loss stayed not finite, or one of several processes failed.
    """
    job: dict[str, Any] = {
        "tune": tune,
        "controlnet": None if controlnet is None else str(controlnet),
        "with_controlnet": with_controlnet,
        "seed": seed,
        "out": str(out),
        "work": str(work),
        "class_names": None if class_names is None else list(class_names),
        "made_by": None if conditions.made_by is None else conditions.made_by.model_dump(),
    }
    count = options.num_processes or int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    launched_so = os.environ.get("ACCELERATE_USE_FSDP", "false").lower() == "true"
    job["fsdp"] = (count > 1 and launched_so) if options.fsdp is None else options.fsdp
    check_together(options.model_copy(update={"num_processes": count, "fsdp": job["fsdp"]}))
    check_packages(options)
    if job["fsdp"]:
        options = options.model_copy(update={"compile_networks": False})
    if count == 1:
        return _train(frames, conditions, options, job, SINGLE_PROCESS, choose_device(options.device), latents)
    return _train_in_processes(count, frames, conditions, options, job, latents)


def _train(
    frames: Images,
    conditions: Conditions,
    options: FineTuningOptions,
    job: Mapping[str, Any],
    distributed: DistributedContext,
    device: torch.device,
    latents: Latents | None,
) -> TrainingHistory:
    controlnet = None if job["controlnet"] is None else Path(job["controlnet"])
    base_model = load_base_model(
        options.base_model, controlnet=controlnet, with_controlnet=job["with_controlnet"], device=device
    )
    if options.random_init:
        base_model = forget_weights(base_model, job["seed"])
    start = digest_of_start(base_model)
    if job["fsdp"]:
        shard_networks(base_model)
        distributed = replace(distributed, sharded=True)
    history = fine_tune(
        base_model,
        frames,
        conditions,
        options,
        tune=job["tune"],
        seed=job["seed"],
        work=Path(job["work"]),
        class_names=job["class_names"],
        latents=latents,
        distributed=distributed,
        start=start,
    )
    written = gather_networks(base_model, keep=distributed.rank == 0) if distributed.sharded else base_model
    if distributed.rank == 0 and written is not None:
        if options.lora_rank is None:
            save_base_model(written, Path(job["out"]))
        else:
            save_lora(written, options, controlnet, Path(job["out"]))
        if history.value_table is not None:
            write_value_table(Path(job["out"]), history.value_table)
            history.value_table = None  # it is in the checkpoint; histories travel as text
    return history


def _train_in_processes(
    count: int,
    frames: Images,
    conditions: Conditions,
    options: FineTuningOptions,
    job: dict[str, Any],
    latents: Latents | None,
) -> TrainingHistory:
    folder = Path(job["work"]) / "job"
    folder.mkdir(parents=True, exist_ok=True)
    as_image_rows(frames).save(folder / "frames")
    if conditions.images is not None:
        as_image_rows(conditions.images).save(folder / "conditions")
    kinds = {} if latents is None else {"mean": latents.mean, "std": latents.std}
    for kind, values in kinds.items():
        if values is not None:
            as_image_rows(values).save(folder / f"latents_{kind}")
    plain = options.model_dump(mode="json", include=set(FineTuningOptions.model_fields))
    written = {
        **job,
        "device": options.device,
        "options": plain,
        "prompts": conditions.prompts,
        "with_images": conditions.images is not None,
        "latents": [kind for kind, values in kinds.items() if values is not None],
    }
    return train_in_processes(count, __name__, folder, written)


def _train_rank(
    job: dict[str, Any], folder: Path, distributed: DistributedContext, device: torch.device
) -> TrainingHistory:
    images = load_image_rows(folder / "conditions") if job["with_images"] else None
    frames = load_image_rows(folder / "frames")
    made_by = None if job["made_by"] is None else ConditionChoice(**job["made_by"])
    conditions = Conditions(tuple(job["prompts"]), images, made_by=made_by)
    stored = {kind: load_image_rows(folder / f"latents_{kind}") for kind in job["latents"]}
    latents = Latents(stored["mean"], stored.get("std")) if stored else None
    return _train(frames, conditions, FineTuningOptions(**job["options"]), job, distributed, device, latents)


if __name__ == "__main__":
    run_rank(_train_rank)
