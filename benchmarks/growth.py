"""What each stage takes as its amounts grow: time and memory, one chart.

    python benchmarks/growth.py                                 # an hour on two idle cores
    python benchmarks/growth.py --largest 2000 --axes rows      # minutes
    python benchmarks/growth.py --figure growth.png             # needs the extra `bench`

Whole experiments with class names (preset `n_imagenet` on small recordings, one evaluation a frame, few training
steps) and single stages of skeletons and bodies. What a stage took is read from its record.

    rows       recordings and frames generated, tens to tens of thousands, of ten classes
    classes    of 500 recordings
    workers    processes, of 500 recordings: the whole experiment, and stages whose rows they share

Times are those of the processor, which other programs hardly change, along `workers` those of the clock. A slope is
that of a line in the chart, between its last two points: 0 = the same time for any amount, 1 = in proportion.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from many_recordings import write_recordings
from many_samples import POSES, run_stage

from data_contracts.config import ConditionChoice, DatasetChoice, EncodingChoice, SamplingChoice, Windows
from tasks.condition import condition_samples
from tasks.encode import encode
from tasks.ingest import ingest
from tasks.sample import simulate

ROOT = Path(__file__).resolve().parents[1]
EVENTS = 200
"""Of a recording."""
AMOUNTS: Mapping[str, Sequence[int]] = {
    "rows": (20, 200, 2_000, 20_000),
    "classes": (2, 10, 50, 250),
    "workers": (1, 2, 4),
}
IN_PROCESS = ("condition_samples", "simulate")
"""Stages that an experiment with class names does not have, run apart."""
SHARED = ("ingest", "encode", "sample")
"""Stages whose rows workers share; the others run beside one another."""
MOST_SIMULATED = 2_000
"""Bodies; more take minutes."""
QUICK_S = 0.5
"""A stage that takes less is all start."""


@dataclass(frozen=True)
class Point:
    """A stage at one amount: what its record says, of all runs of the stage together; memory of the largest."""

    axis: str
    amount: int
    stage: str
    seconds: float
    cpu_seconds: float
    peak_mib: float

    @property
    def time(self) -> float:
        """Seconds of the clock where workers share the work, else of the processor."""
        return self.seconds if self.axis == "workers" else self.cpu_seconds


def main() -> None:
    """Print a table for each axis."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axes", nargs="+", choices=AMOUNTS, default=list(AMOUNTS))
    parser.add_argument("--largest", type=int, help="number of rows")
    parser.add_argument("--figure", type=Path, help="write the chart here")
    parser.add_argument(
        "--found", type=Path, help="keep what was found here; what is there already is not measured again"
    )
    parser.add_argument("--poses", type=int, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.poses:
        make_poses(chosen.poses)
        return
    found: Path | None = chosen.found
    points = []
    if found is not None and found.is_file():
        points = [Point(**one) for one in json.loads(found.read_text())]
    for axis in chosen.axes:
        for amount in AMOUNTS[axis]:
            is_known = any((point.axis, point.amount) == (axis, amount) for point in points)
            if is_known or (axis == "rows" and amount > (chosen.largest or math.inf)):
                continue
            points += measure(axis, amount)
            if found is not None:
                found.write_text(json.dumps([asdict(point) for point in points]))
    for axis in dict.fromkeys(point.axis for point in points):
        print_axis([point for point in points if point.axis == axis])
    if chosen.figure:
        draw(points, chosen.figure)


def measure(axis: str, amount: int) -> list[Point]:
    """The points of an amount."""
    numbers = {"rows": 500, "classes": 10}
    if axis != "workers":
        numbers[axis] = amount
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if axis == "rows":
            run_poses(folder / "poses", amount)
        started = time.perf_counter()
        run_classes(folder, axis, **numbers, workers=amount)
        whole = time.perf_counter() - started
        found = [*read_records(folder / "home", axis, amount), *read_records(folder / "poses", axis, amount)]
    seconds = sum(point.seconds for point in found)
    print(f"{axis} {amount:,}: {seconds:.0f} s in stages", file=sys.stderr, flush=True)
    if axis == "workers":
        largest = max(point.peak_mib for point in found)
        found = [point for point in found if point.stage in SHARED]
        found.append(Point(axis, amount, "the whole experiment", whole, 0.0, largest))
    return found


def run_classes(folder: Path, axis: str, *, rows: int, classes: int, workers: int) -> None:
    """An experiment with class names, in a home of its own."""
    write_recordings(folder / "raw", rows, EVENTS, 200, classes)
    changed = {
        "name": "growth",
        "dataset.options.root": folder / "raw",
        "dataset.options.images_per_class": "null",
        "generator.options.num_steps": 4,
        "generator.options.batch_size": 4,
        "sampling.num_inference_steps": 1,
        "num_synthetic": rows,
        "downstream.options": "{num_steps: 8, batch_size: 16}",
        "feature_extractor.options": "{num_steps: 8, batch_size: 16}",
    }
    options = [word for name, value in changed.items() for word in ("--set", f"{name}={value}")]
    workers = workers if axis == "workers" else 1
    call("flows/full_experiment.py", "--preset", "n_imagenet", *options, home=folder / "home", workers=workers)


def run_poses(home: Path, rows: int) -> None:
    """`make_poses` in a process of its own."""
    call("benchmarks/growth.py", "--poses", str(rows), home=home, workers=1)


def make_poses(rows: int) -> None:
    """So many skeletons and normal maps, and bodies through the simulator, of the home that is set."""
    numbers = {"num_train_recordings": 4, "num_test_recordings": 1, "num_condition_recordings": POSES}
    encoding = EncodingChoice(name="event_histogram", options={"polarity": False})
    windows = Windows(num_events=700, max_windows=3)
    recordings = run_stage(ingest, dataset=DatasetChoice(name="studio", options=numbers))
    frames = run_stage(encode, recordings=recordings, encoding=encoding, windows=windows)
    given = {"recordings": recordings, "frames": frames, "encoding": encoding, "windows": windows}
    drawn = {"count": rows, "order": "random", "views": "labelled", "seed": 2}
    for name in ("skeleton", "normals", "body_motion"):
        made = run_stage(condition_samples, poses=recordings, **given, condition=ConditionChoice(name=name), **drawn)
    if rows <= MOST_SIMULATED:
        run_stage(simulate, **given, conditions=made, sampling=SamplingChoice(name="smpl_esim"), seed=3)


def call(*command: str, home: Path, workers: int) -> None:
    """Run a script of the project; what it prints is shown where it fails."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "CTLEV_HOME": str(home), "CTLEV_WORKERS": str(workers)}
    done = subprocess.run([sys.executable, *command], cwd=ROOT, env=environment, capture_output=True, text=True)
    if done.returncode:
        said = done.stdout[-2000:] + done.stderr[-2000:]
        raise SystemExit(f"{' '.join(command)}: exit status {done.returncode}\n{said}")


def read_records(home: Path, axis: str, amount: int) -> list[Point]:
    """A point for each stage that ran in a home."""
    records: dict[str, list[dict[str, Any]]] = {}
    for path in sorted(home.glob("artefacts/*/*/run.json")):
        record = json.loads(path.read_text())
        if home.name == "home":
            records.setdefault(record["stage"], []).append(record)
        elif record["stage"] in IN_PROCESS:
            records.setdefault(f"{record['stage']}, {plugin_of(record['arguments'])}", []).append(record)
    return [
        Point(
            axis,
            amount,
            name,
            sum(one["wall_seconds"] for one in group),
            sum(one["cpu_seconds"] for one in group),
            max(one["process_peak_memory_mib"] for one in group),
        )
        for name, group in records.items()
    ]


def plugin_of(arguments: Mapping[str, Any]) -> str:
    """Of a stage that was run apart."""
    plugin = next(arguments[name]["plugin"] for name in ("condition", "sampling") if name in arguments)
    return str(plugin).split("/")[-1]


def print_axis(points: Sequence[Point]) -> None:
    """Seconds at each amount, the slope, and memory at the first and the last."""
    amounts = sorted({point.amount for point in points})
    print(f"\n{points[0].axis}")
    print(f"{'stage':36}" + "".join(f"{amount:>10,}" for amount in amounts) + f"{'slope':>8}{'MiB':>8}{'MiB':>8}")
    by_stage: dict[str, dict[int, Point]] = {}
    for point in points:
        by_stage.setdefault(point.stage, {})[point.amount] = point
    for stage, found in sorted(by_stage.items()):
        seconds = "".join(f"{found[amount].time:10.2f}" if amount in found else " " * 10 for amount in amounts)
        first, last = found[min(found)], found[max(found)]
        print(f"{stage:36}{seconds}{slope(found):>8}{first.peak_mib:8.0f}{last.peak_mib:8.0f}")


def slope(found: Mapping[int, Point]) -> str:
    """Of the last two points in a chart of logarithms; nothing where a stage is too quick to tell."""
    *_, before, last = [None, *(found[amount] for amount in sorted(found))]
    if before is None or last is None or last.time < QUICK_S:
        return ""
    return f"{math.log(last.time / before.time) / math.log(last.amount / before.amount):.2f}"


def draw(points: Sequence[Point], path: Path) -> None:
    """Time above, memory below, an axis a column."""
    import matplotlib.pyplot as plt

    axes = [axis for axis in AMOUNTS if any(point.axis == axis for point in points)]
    stages = sorted({point.stage for point in points})
    colours = {stage: plt.get_cmap("tab20")(number % 20) for number, stage in enumerate(stages)}
    figure, panels = plt.subplots(2, len(axes), figsize=(3.6 * len(axes), 7), squeeze=False, sharex="col")
    for column, axis in enumerate(axes):
        for stage in stages:
            own = sorted((one for one in points if (one.axis, one.stage) == (axis, stage)), key=lambda one: one.amount)
            amounts, colour = [one.amount for one in own], colours[stage]
            panels[0, column].loglog(amounts, [one.time for one in own], "o-", ms=3, color=colour, label=stage)
            panels[1, column].semilogx(amounts, [one.peak_mib for one in own], "o-", ms=3, color=colour)
        panels[0, column].set_title(axis)
        panels[1, column].set_ylim(bottom=0)
        panels[0, column].set_ylabel("s by the clock" if axis == "workers" else "processor seconds")
        amounts = sorted({point.amount for point in points if point.axis == axis})
        panels[1, column].set_xticks(amounts, [f"{amount:,}" for amount in amounts])
        panels[1, column].minorticks_off()
    panels[1, 0].set_ylabel("peak memory of the process, MiB")
    shown = {
        label: handle for panel in panels[0] for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    figure.legend(shown.values(), shown.keys(), loc="lower center", ncols=5, fontsize=7)
    figure.tight_layout(rect=(0, 0.12, 1, 1))
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
