"""Two programs measured turn by turn, because a machine's speed drifts: the clock, the ratio and its spread."""

from __future__ import annotations

import importlib.metadata
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from diffusers.utils import logging as diffusers_logging

LIBRARIES = ("torch", "diffusers", "transformers", "accelerate")


def now_s(device: torch.device) -> float:
    """Seconds: of this process on a CPU, which others use as well; of the wall on a GPU, once it has caught up."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        return time.perf_counter()
    return time.process_time()


def measure(run: Callable[[], object], device: torch.device) -> float:
    """Seconds that one call takes."""
    start = now_s(device)
    run()
    return now_s(device) - start


@dataclass
class Comparison:
    """Seconds of the same work, ours and a peer's, round by round.

    Attributes:
        name: of the work.
        images: that each round makes or learns from.
        wanted: times the peer's speed; None = no target.
        ours: seconds a round.
        peer: seconds a round, as many.
    """

    name: str
    images: int
    wanted: float | None = None
    ours: list[float] = field(default_factory=list)
    peer: list[float] = field(default_factory=list)

    @property
    def ratio(self) -> float:
        """How many times as fast as the peer: the median over the rounds."""
        return statistics.median(self.ratios)

    @property
    def ratios(self) -> list[float]:
        """The same of each round."""
        return [slow / fast for fast, slow in zip(self.ours, self.peer, strict=True)]

    @property
    def is_met(self) -> bool:
        """Was the target reached? Without one it was."""
        return self.wanted is None or self.ratio >= self.wanted


def print_comparisons(head: str, peer: str, comparisons: list[Comparison]) -> None:
    """One line each: images a second, the ratio and its range over the rounds, and what was wanted."""
    width = max(len(head), *(len(comparison.name) for comparison in comparisons))
    print(f"\n{head:{width}} {'ctlev img/s':>12} {peer + ' img/s':>20} {'ratio':>7} {'range':>13}  wanted")
    for comparison in comparisons:
        ours, theirs = (
            comparison.images / statistics.median(seconds) for seconds in (comparison.ours, comparison.peer)
        )
        spread = f"{min(comparison.ratios):.2f} .. {max(comparison.ratios):.2f}"
        verdict = "" if comparison.wanted is None else f"{comparison.wanted:g}: " + say_met(comparison.is_met)
        print(
            f"{comparison.name:{width}} {ours:12.4g} {theirs:20.4g} {comparison.ratio:7.2f} {spread:>13}  {verdict}",
            flush=True,
        )


def print_targets(comparisons: list[Comparison]) -> None:
    """Which targets were missed, and by what."""
    missed = [
        f"{comparison.name}: {comparison.ratio:.2f} x, wanted {comparison.wanted:g} x"
        for comparison in comparisons
        if not comparison.is_met
    ]
    print("\nTargets missed: " + ("; ".join(missed) or "none"))


def say_met(is_met: bool) -> str:
    """`met` or `missed`."""
    return "met" if is_met else "missed"


def describe_machine(device: torch.device) -> str:
    """Processor or card, threads and the versions that decide about speed."""
    diffusers_logging.set_verbosity_error()  # casting networks on purpose would fill the tables with warnings
    if device.type == "cuda":
        card = torch.cuda.get_device_properties(device)
        where = f"{card.name}, {card.total_memory / 2**30:.0f} GiB, CUDA {torch.version.cuda}"
    else:
        where = f"{_processor_name()}, {torch.get_num_threads()} thread(s)"
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in LIBRARIES)
    return f"{where}; Python {platform.python_version()}, {versions}"


def _processor_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    flags = next((line for line in lines if line.startswith("flags")), "")
    wide = [name for name in ("avx2", "avx512f", "avx512_bf16", "amx_bf16") if f" {name} " in flags + " "]
    return f"{names[0] if names else platform.machine()} ({', '.join(wide)})"


def matmul_flops(device: torch.device, dtype: torch.dtype, side: int, rounds: int = 10) -> float:
    """Floating-point operations a second of a square matrix product, the best of some rounds."""
    left = torch.randn((side, side), device=device).to(dtype)
    right = torch.randn((side, side), device=device).to(dtype)
    left @ right
    return 2 * side**3 / min(measure(lambda: left @ right, device) for _ in range(rounds))
