"""A training in several processes, started here by torchrun: each runs a module as its main program on one folder.

Options and arrays reach them as files in that folder, and the history comes back there.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from ctlev_core.diffusion.training.distributed import DistributedContext, start_distributed, stop_distributed
from ctlev_core.diffusion.training.trainer import TrainingHistory
from ctlev_core.processes import CORES, THREADS, die_with_parent, module_environment, num_cores
from data_contracts.errors import TrainingError

JOB_FILE, HISTORY_FILE = "job.json", "history.json"
LAUNCHER_VARIABLES = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
LAUNCHER_PREFIXES = ("TORCHELASTIC_", "GROUP_", "ROLE_")


def train_in_processes(count: int, module: str, folder: Path, job: Mapping[str, Any]) -> TrainingHistory:
    """Run `python -m module folder` in `count` processes that know one another; the module calls `run_rank`.

    Args:
        count: of the processes.
        module: name of the module.
        folder: of the job, made where it is not there; arrays that the processes need are the caller's to write.
        job: JSON values that `run_rank` hands on; `device` is as for `start_distributed`.
    Raises:
        TrainingError: a process failed; with what each of them said.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / JOB_FILE).write_text(json.dumps(job))
    for left in (HISTORY_FILE, *(f"error_{rank}.txt" for rank in range(count))):
        (folder / left).unlink(missing_ok=True)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}"]
    environment = child_environment(os.environ, count)
    child = subprocess.Popen([*command, "-m", module, str(folder)], env=environment, preexec_fn=die_with_parent)
    try:
        code = child.wait()
    finally:
        child.terminate()
    if code != 0 or not (folder / HISTORY_FILE).is_file():
        errors = {rank: folder / f"error_{rank}.txt" for rank in range(count)}
        said = [f"process {rank}: {path.read_text()}" for rank, path in errors.items() if path.is_file()]
        raise TrainingError(f"training in {count} processes failed: {'; '.join(said) or f'torchrun ended with {code}'}")
    return TrainingHistory(**json.loads((folder / HISTORY_FILE).read_text()))


def run_rank(train: Callable[[dict[str, Any], Path, DistributedContext, torch.device], TrainingHistory]) -> None:
    """The main program of each of the processes: train, and leave the history, or why there is none, in the folder.

    Args:
        train: given the job, its folder, which process this is, and its device.
    """
    die_with_parent()
    folder = Path(sys.argv[1])
    rank = int(os.environ["RANK"])
    try:
        job = json.loads((folder / JOB_FILE).read_text())
        distributed, device = start_distributed(job["device"])
        history = train(job, folder, distributed, device)
    except Exception as error:
        (folder / f"error_{rank}.txt").write_text(str(error))
        raise
    if rank == 0:
        (folder / HISTORY_FILE).write_text(json.dumps(dataclasses.asdict(history)))
    stop_distributed()


def child_environment(environment: Mapping[str, str], count: int) -> dict[str, str]:
    """Ours, without what an outer launcher says of its own processes, and with the cores shared out."""
    kept = {
        name: value
        for name, value in environment.items()
        if name not in LAUNCHER_VARIABLES and not name.startswith(LAUNCHER_PREFIXES)
    }
    kept = module_environment(kept)
    kept.setdefault(THREADS, "1")
    kept[CORES] = str(max(1, num_cores() // count))
    return kept
