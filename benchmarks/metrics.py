"""How fast and how exact the scores are: Frechet distances beside other packages' algorithms, poses beside a loop.

    python benchmarks/metrics.py
    python benchmarks/metrics.py --quick
    python benchmarks/metrics.py --parts times --widths 64 768 --figure metrics.png

One thread (set OMP_NUM_THREADS=1), CPU seconds; all of it takes about four minutes, most of them SciPy's. Frechet
distances are timed from features to the number, with the covariances that an algorithm needs; errors are relative to
the distance itself, against multi-precision arithmetic on the same rounded features (mpmath, which torch brings along)
or, in many dimensions, a closed form. `neg` marks a negative result, `raises` an error. Pose scores are timed beside
the plainest loop over frames, which must give the same numbers. At the end stand the targets, with what was measured.

A machine that does other things moves each time by tens of per cent: read the ratios.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pose_loops
from frechet_algorithms import (
    OURS,
    PEERS,
    Distance,
    closed_form_case,
    exact_distance,
    hard_cases,
)

PARTS = ("errors", "times", "poses")
ROWS = (500, 2000, 10_000)
LARGEST = (2048, 10_000)
ERROR_WANTED, SQRTM_WANTED, FEW_ROWS_WANTED, POSES_WANTED = 1e-12, 4.0, 100.0, 20.0
LEAST_SECONDS = 0.1
CONSERVATIVE = ("ctlev", "exact route")
"""What is to keep the wanted error; a covariance alone does not hold enough digits for it."""


@dataclass(frozen=True)
class Target:
    """What is wanted and what was measured; `note` is what the others do there."""

    name: str
    wanted: float
    got: float
    is_met: bool
    note: str = ""

    def __str__(self) -> str:
        sign = "<=" if self.wanted < 1 else ">="
        text = (
            f"{'met   ' if self.is_met else 'MISSED'}  {self.name:52}{self.got:10.3g}  (wanted {sign} {self.wanted:g})"
        )
        return f"{text}  {self.note}".rstrip()


def main() -> None:
    """Print the tables, then what was reached."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="what to measure; all without it")
    parser.add_argument("--quick", action="store_true", help="seconds instead of minutes: small sizes, fewer targets")
    parser.add_argument("--error-width", type=int, help="features of the hard cases; 24, or 8 if quick")
    parser.add_argument("--widths", type=int, nargs="*", help="features of the timings; 64 768 2048, or 64 if quick")
    parser.add_argument("--frames", type=int, help="frames of the pose scores; 2,000, or 200 if quick")
    parser.add_argument("--rounds", type=int, default=3, help="timings of what takes less than a second")
    parser.add_argument("--figure", type=Path, help="file for a plot of time against error; needs both parts")
    arguments = parser.parse_args()
    if arguments.figure and not {"errors", "times"} <= set(arguments.parts):
        parser.error("--figure needs the parts errors and times")
    quick = arguments.quick
    targets: list[Target] = []
    errors, times = {}, {}
    if "errors" in arguments.parts:
        errors = print_errors(arguments.error_width or (8 if quick else 24), targets, in_many_dimensions=not quick)
    if "times" in arguments.parts:
        widths = arguments.widths or ([64] if quick else [64, 768, 2048])
        times = print_times(widths, arguments.rounds, targets)
    if "poses" in arguments.parts:
        print_poses(arguments.frames or (200 if quick else 2000), arguments.rounds, targets)
    print("\nTargets:")
    for target in targets:
        print(f"  {target}")
    print(f"  {sum(target.is_met for target in targets)} of {len(targets)} met")
    if arguments.figure:
        draw(arguments.figure, errors, times)


def print_errors(width: int, targets: list[Target], *, in_many_dimensions: bool) -> dict[str, float]:
    """Relative errors in the hard cases; returns the largest of each algorithm, but for nearly identical sets."""
    algorithms = PEERS | OURS
    print(f"\nRelative error of Frechet distances, d = {width}\n{'case':34}" + "".join(f"{n:>13}" for n in algorithms))
    worst = dict.fromkeys(algorithms, 0.0)
    cases: list[tuple[str, np.ndarray, np.ndarray, float | None]]
    cases = [(name, a, b, None) for name, (a, b) in hard_cases(width).items()]
    for count in (256, 4096) if in_many_dimensions else ():
        a, b, exact = closed_form_case(1024, count)
        cases.append((f"d = 1024, N = {count}, closed form", a, b, exact))
    for name, a, b, closed in cases:
        exact = exact_distance(a, b) if closed is None else closed
        found = {algorithm: relative_error(function, a, b, exact) for algorithm, function in algorithms.items()}
        print(f"{name:34}" + "".join(f"{text:>13}" for _, text in found.values()), flush=True)
        # Roots in float64 do not hold enough digits for sets that differ by a millionth.
        is_near = name.startswith("near-identical")
        got = max(found[algorithm][0] for algorithm in (("ctlev",) if is_near else CONSERVATIVE))
        peers = ", ".join(f"{algorithm} {found[algorithm][1]}" for algorithm in PEERS)
        targets.append(Target(f"relative error, {name}", ERROR_WANTED, got, got <= ERROR_WANTED, peers))
        if not is_near:
            worst = {algorithm: max(error, found[algorithm][0]) for algorithm, error in worst.items()}
    print(f"{'worst, without near-identical':34}" + "".join(f"{error:13.0e}" for error in worst.values()))
    return worst


def relative_error(function: Distance, a: np.ndarray, b: np.ndarray, exact) -> tuple[float, str]:
    """The error, and how to print it; of a distance of 0 the result itself, as a share of the squared features."""
    try:
        found = function(a, b)
    except (ValueError, np.linalg.LinAlgError):
        return float("inf"), "raises"
    size = exact if exact > 1e-30 else float(np.square(a - a.mean(axis=0)).sum())
    error = float(abs(found - exact) / size)
    if not np.isfinite(error):
        return float("inf"), "nan"
    return error, f"{error:.0e}{' neg' if found < 0 else ''}"


def print_times(widths: list[int], rounds: int, targets: list[Target]) -> dict[str, dict[str, float]]:
    """CPU seconds by size and algorithm."""
    algorithms = {name: f for name, f in (PEERS | OURS).items() if name != "eigh"}
    print(f"\nCPU seconds of a Frechet distance (times ctlev)\n{'d, N':16}" + "".join(f"{n:>18}" for n in algorithms))
    found: dict[str, dict[str, float]] = {}
    for width in widths:
        for count in ROWS:
            random = np.random.default_rng(0)
            a, b = random.normal(size=(count, width)), 1.2 * random.normal(size=(count, width)) + 0.1
            seconds = {name: measure(partial(function, a, b), rounds) for name, function in algorithms.items()}
            key = f"{width}, {count}"
            found[key] = seconds
            cells = [f"{s:.3f} ({s / seconds['ctlev']:.2g}x)" for s in seconds.values()]
            print(f"{key:16}" + "".join(f"{cell:>18}" for cell in cells), flush=True)
            wanted = FEW_ROWS_WANTED if count < width else SQRTM_WANTED
            if count < width or (width, count) == LARGEST:
                ratio = seconds["sqrtm"] / seconds["ctlev"]
                targets.append(Target(f"times faster than sqrtm, d, N = {key}", wanted, ratio, ratio >= wanted))
    return found


def print_poses(num_frames: int, rounds: int, targets: list[Target]) -> None:
    """CPU microseconds a frame, ours and a plain loop's."""
    print(f"\nPose scores of {num_frames} frames: CPU us a frame\n{'score':34}{'ctlev':>10}{'loop':>10}{'ratio':>8}")
    for name, ours, loop in pose_loops.jobs(num_frames):
        pose_loops.check(name, ours(), loop())
        fast, slow = measure(ours, rounds), measure(loop, rounds)
        us = 1e6 / num_frames
        print(f"{name:34}{us * fast:10.2f}{us * slow:10.1f}{slow / fast:8.0f}", flush=True)
        targets.append(
            Target(f"times faster than a loop, {name}", POSES_WANTED, slow / fast, slow / fast >= POSES_WANTED)
        )


def measure(run: Callable[[], object], rounds: int) -> float:
    """CPU seconds, the median of rounds: of one where that takes longer than a second, of more where it is short."""
    seconds: list[float] = []
    while sum(seconds) < 1 and (len(seconds) < rounds or sum(seconds) < LEAST_SECONDS):
        start = time.process_time()
        run()
        seconds.append(time.process_time() - start)
    return statistics.median(seconds)


def draw(file: Path, errors: dict[str, float], times: dict[str, dict[str, float]]) -> None:
    """Time at the largest size against the largest error, one point an algorithm."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    key, seconds = list(times.items())[-1]
    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    for name, second in seconds.items():
        error = min(max(errors[name], 1e-17), 10.0)
        axes.loglog(second, error, "o" if name in OURS else "s")
        note = name + (" (raises)" if not np.isfinite(errors[name]) else "")
        axes.annotate(note, (second, error), (7, 0), textcoords="offset points", va="center")
    axes.axhline(ERROR_WANTED, color="0.7", linestyle="--")
    axes.margins(x=0.45, y=0.2)
    axes.set(xlabel=f"CPU seconds, d, N = {key}", ylabel="largest relative error, hard cases", title="Frechet distance")
    figure.savefig(file, dpi=120)


if __name__ == "__main__":
    main()
