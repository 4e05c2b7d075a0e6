"""What tests have computed in jobs of SLURM."""

from __future__ import annotations

import os
import time
from pathlib import Path


def number_and_job(shard: int) -> tuple[int, str]:
    """The shard and the job that computed it, after half a second."""
    time.sleep(0.5)
    return shard, os.environ["SLURM_JOB_ID"]


def variable(name: str) -> str | None:
    """Of the environment there."""
    return os.environ.get(name)


_held = bytearray()


def hold_memory(share: float) -> int:
    """Hold so large a share of the memory of a worker of Dask from now on; the process of the worker."""
    import distributed
    import psutil

    global _held
    process = psutil.Process()
    missing = int(share * distributed.get_worker().memory_manager.memory_limit) - process.memory_info().rss
    _held = bytearray(b"\1") * max(missing, 0)
    time.sleep(1)  # Dask looks each tenth of a second
    return process.pid


def page_faults(count: int) -> int:
    """When `count` arrays of 1,000 pages are made and freed, one after the other."""
    import resource

    import numpy as np

    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(count):
        np.ones(1000 * 4096, np.uint8)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def note_and_wait(folder: Path) -> int:
    """Note the job in `jobs` and wait for `go_on`; how often it was begun."""
    folder.mkdir(exist_ok=True)
    with (folder / "jobs").open("a") as file:
        file.write(os.environ["SLURM_JOB_ID"] + "\n")
    until = time.monotonic() + 120
    while not (folder / "go_on").exists() and time.monotonic() < until:
        time.sleep(0.1)
    return len((folder / "jobs").read_text().split())
