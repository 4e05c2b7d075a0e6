"""Child processes that never outlive us, how many cores there are for them, and how much memory they took."""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import resource
import signal
import sys
from collections.abc import Mapping
from pathlib import Path

CPU_LIMIT = Path("/sys/fs/cgroup/cpu.max")
"""Of a Linux container: microseconds of processor time it gets, in so many by the clock; or `max`."""

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
    """Cores that this process may use, at least 1: those it may run on, or fewer where its container gets less time.

    More threads than that are worse than few: oneDNN's wait for each other by spinning, and one that is not scheduled
    holds up all (a training of two threads on one core was seven times slower than one of one).
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = limit.read_text().split()
        return max(1, min(cores, int(quota) // int(period)))
    except (OSError, ValueError):  # no such container, or no limit
        return cores


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
