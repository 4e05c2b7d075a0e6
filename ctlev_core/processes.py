"""Child processes that never outlive us, how many cores there are for them, and how much memory they took."""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import resource
import signal
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from data_contracts.errors import DataError

CPU_LIMIT = Path("/sys/fs/cgroup/cpu.max")
"""Of a Linux container: microseconds of processor time it gets, in so many by the clock; or `max`."""

CORES = "CTLEV_CORES"
"""A process that has only a share of the cores is told so by this variable."""

THREADS = "OMP_NUM_THREADS"
"""The usual variable for the threads of numerical libraries."""

SMALL_BYTES = 100_000_000
"""Weights of more use several threads well, and fill the memory when several processes read them."""

MEMORY_LIMIT = Path("/sys/fs/cgroup/memory.max")
"""Of a Linux container: bytes that it gets, or `max`."""


def die_with_parent() -> None:
    """Ask the Linux kernel to end the calling process when its parent ends, even by SIGKILL; a no-op elsewhere."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG = 1


def module_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """An environment in which `python -m` runs a module of ours, though the working directory has one of that name.

    Else Python looks there first, and a `tasks.py` of the user's would run in its place.
    """
    root = str(Path(__file__).resolve().parents[1])
    path = os.pathsep.join(filter(None, [root, environment.get("PYTHONPATH", "")]))
    return {**environment, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}


def num_cores(limit: Path = CPU_LIMIT) -> int:
    """Cores that this process may use, at least 1: those it may run on, or fewer where its container gets less time, or
    where CTLEV_CORES says so.

    More threads than that are worse than few: oneDNN's wait for each other by spinning, and one that is not scheduled
    holds up all (a training of two threads on one core was seven times slower than one of one).
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    share = os.environ.get(CORES, "")
    if share:
        if not (share.isdecimal() and int(share) >= 1):
            raise DataError(f"{CORES} must be a positive number, got {share!r}")
        cores = min(cores, int(share))
    try:
        quota, period = limit.read_text().split()
        return max(1, min(cores, int(quota) // int(period)))
    except (OSError, ValueError):  # no such container, or no limit
        return cores


@contextlib.contextmanager
def few_threads() -> Iterator[None]:
    """Torch computes in this block with as many threads as OMP_NUM_THREADS says, else with one.

    Gradients are summed over threads, so that another number of them ends in other weights. One is the number that
    every machine has, and the small networks of this project lose little by it: on two cores a step of fine-tuning the
    bundled base model takes 0.33 s with one thread and 0.67 s with two, one of the pose network 0.14 and 0.11 s.
    """
    torch = sys.modules.get("torch")  # where it is not needed, it is not imported here
    before = torch.get_num_threads() if torch else None
    is_set = THREADS in os.environ
    os.environ.setdefault(THREADS, "1")  # for a torch that is imported in this block, and for processes
    if torch:
        torch.set_num_threads(asked_threads())
    try:
        yield
    finally:
        if not is_set:
            del os.environ[THREADS]
        if torch := sys.modules.get("torch"):
            torch.set_num_threads(before or asked_threads())


def asked_threads() -> int:
    """Threads of each computation: OMP_NUM_THREADS, else 1."""
    first = os.environ.get(THREADS, "").split(",")[0].strip()
    return int(first) if first.isdecimal() and int(first) else 1


def use_cores_for(num_bytes: int) -> None:
    """Torch on all cores where weights are so large, until the end of `few_threads`, unless OMP_NUM_THREADS says more
    than one.
    """
    if num_bytes > SMALL_BYTES and asked_threads() == 1:
        import torch

        torch.set_num_threads(num_cores())


def memory_mib(limit: Path = MEMORY_LIMIT, table: Path = Path("/proc/meminfo")) -> tuple[float, float]:
    """Memory that this process may use, and how much of it is free, MiB: the machine's, or less in a container."""
    try:
        lines = dict(line.split(":") for line in table.read_text().splitlines())
        whole, free = (int(lines[name].split()[0]) / 1024 for name in ("MemTotal", "MemAvailable"))
    except (OSError, ValueError, KeyError):
        return math.inf, math.inf
    try:
        allowed = int(limit.read_text()) / 2**20
    except (OSError, ValueError):  # no such container, or no limit
        return whole, free
    return min(whole, allowed), min(free, allowed)


def begin_memory_peak() -> None:
    """Forget how much memory this process has taken so far, on Linux; freed memory is given back before."""
    if sys.platform != "linux":
        return
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def memory_peak_mib() -> float:
    """The most memory of this process since `begin_memory_peak`, MiB; elsewhere than on Linux since its start."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM:")).split()[1]) / 1024
    except (OSError, StopIteration, ValueError, IndexError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
