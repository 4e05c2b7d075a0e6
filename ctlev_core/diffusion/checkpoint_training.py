"""From a prior on disk to a fine-tuned checkpoint on disk, in this process or in several that train together.

Several processes are started here, by torchrun, and not by wrapping a flow in a launcher: one flow, one lock in the
store and one cache key, however many GPUs compute. Where `accelerate launch` or `torchrun` started the process all the
same, as many are started as the launcher was asked for; its other processes have nothing to do.

Arrays and options reach them as files in the work folder, and results come back the same way.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ctlev_core.diffusion.finetuning import Tune, fine_tune, forget_weights
from ctlev_core.diffusion.prior import choose_device, load_prior, save_prior
from ctlev_core.diffusion.ranks import ALONE, Ranks, start_ranks, stop_ranks
from ctlev_core.diffusion.trainer import TrainingHistory
from ctlev_core.diffusion.training_options import FineTuningOptions
from ctlev_core.processes import die_with_parent, num_cores
from data_contracts.config import ConditionChoice
from data_contracts.errors import TrainingError
from data_contracts.labels import Conditions

JOB_FILE, HISTORY_FILE = "job.json", "history.json"
LAUNCHER_VARIABLES = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
LAUNCHER_PREFIXES = ("TORCHELASTIC_", "GROUP_", "ROLE_")


def train_checkpoint(
    frames: np.ndarray,
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
) -> TrainingHistory:
    """Load the prior, fine-tune it and write it to `out` as a diffusers folder: `train` of both generators.

    Args:
        frames: [N, H, W, 3] uint8, of the prior's image size.
        conditions: N prompts, and N condition images for a ControlNet.
        options: see `FineTuningOptions`; `num_processes` changes nothing but the order of sums.
        tune: which networks learn.
        controlnet: the ControlNet to start from, see `load_prior`.
        with_controlnet: load one at all.
        seed: of order and noise.
        out: the checkpoint folder to write.
        work: resumable state.
        class_names: N; see `cache_latents`.
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
    if count == 1:
        return _train(frames, conditions, options, job, ALONE, choose_device(options.device))
    Ranks(0, count).batches(options.gradient_accumulation)  # raises before processes are started
    if options.device not in ("auto", "cuda", "cpu"):
        raise ValueError(
            f"device must be auto, cuda or cpu with {count} processes, each takes a GPU of its own, got "
            f"{options.device!r}; choose among GPUs by CUDA_VISIBLE_DEVICES"
        )
    return _train_in_processes(count, frames, conditions, options, job)


def _train(
    frames: np.ndarray,
    conditions: Conditions,
    options: FineTuningOptions,
    job: Mapping[str, Any],
    ranks: Ranks,
    device: torch.device,
) -> TrainingHistory:
    controlnet = None if job["controlnet"] is None else Path(job["controlnet"])
    prior = load_prior(options.prior, controlnet=controlnet, with_controlnet=job["with_controlnet"], device=device)
    if options.random_init:
        prior = forget_weights(prior, job["seed"])
    history = fine_tune(
        prior,
        frames,
        conditions,
        options,
        tune=job["tune"],
        seed=job["seed"],
        work=Path(job["work"]),
        class_names=job["class_names"],
        ranks=ranks,
    )
    if ranks.rank == 0:
        save_prior(prior, Path(job["out"]))
    return history


def _train_in_processes(
    count: int, frames: np.ndarray, conditions: Conditions, options: FineTuningOptions, job: dict[str, Any]
) -> TrainingHistory:
    folder = Path(job["work"]) / "job"
    folder.mkdir(parents=True, exist_ok=True)
    for left in (HISTORY_FILE, *(f"error_{rank}.txt" for rank in range(count))):
        (folder / left).unlink(missing_ok=True)
    np.save(folder / "frames.npy", frames, allow_pickle=False)
    if conditions.images is not None:
        np.save(folder / "conditions.npy", conditions.images, allow_pickle=False)
    plain = options.model_dump(mode="json", include=set(FineTuningOptions.model_fields))
    written = {**job, "options": plain, "prompts": conditions.prompts, "with_images": conditions.images is not None}
    (folder / JOB_FILE).write_text(json.dumps(written))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}"]
    environment = child_environment(os.environ, count)
    child = subprocess.Popen([*command, "-m", __name__, str(folder)], env=environment, preexec_fn=die_with_parent)
    try:
        code = child.wait()
    finally:
        child.terminate()
    if code != 0 or not (folder / HISTORY_FILE).is_file():
        errors = {rank: folder / f"error_{rank}.txt" for rank in range(count)}
        said = [f"process {rank}: {path.read_text()}" for rank, path in errors.items() if path.is_file()]
        raise TrainingError(f"training in {count} processes failed: {'; '.join(said) or f'torchrun ended with {code}'}")
    return TrainingHistory(**json.loads((folder / HISTORY_FILE).read_text()))


def child_environment(environment: Mapping[str, str], count: int) -> dict[str, str]:
    """Ours, without what an outer launcher says of its own processes, and with the cores shared out."""
    kept = {
        name: value
        for name, value in environment.items()
        if name not in LAUNCHER_VARIABLES and not name.startswith(LAUNCHER_PREFIXES)
    }
    root = str(Path(__file__).resolve().parents[2])
    kept["PYTHONPATH"] = os.pathsep.join([root, *filter(None, [kept.get("PYTHONPATH")])])
    kept.setdefault("OMP_NUM_THREADS", str(max(1, num_cores() // count)))
    return kept


def run_rank(folder: Path) -> None:
    """What each of the processes does; `folder` is where the job was written."""
    die_with_parent()
    job = json.loads((folder / JOB_FILE).read_text())
    rank = int(os.environ["RANK"])
    try:
        options = FineTuningOptions(**job["options"])
        ranks, device = start_ranks(options.device)
        images = np.load(folder / "conditions.npy", mmap_mode="r") if job["with_images"] else None
        frames = np.load(folder / "frames.npy", mmap_mode="r")
        made_by = None if job["made_by"] is None else ConditionChoice(**job["made_by"])
        conditions = Conditions(tuple(job["prompts"]), images, made_by=made_by)
        history = _train(frames, conditions, options, job, ranks, device)
    except Exception as error:
        (folder / f"error_{rank}.txt").write_text(str(error))
        raise
    if rank == 0:
        (folder / HISTORY_FILE).write_text(json.dumps(dataclasses.asdict(history)))
    stop_ranks()


if __name__ == "__main__":
    run_rank(Path(sys.argv[1]))
