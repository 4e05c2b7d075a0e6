"""What running costs beside the work: Prefect's start-up, cached runs, stages, many shards.

    python benchmarks/operations.py
    python benchmarks/operations.py --part cached --preset demo --home HOME     # where the preset is finished
    python benchmarks/operations.py --part shards --shards 10000 --workers 16

`cached`: a preset whose every stage is in the store, as a script, in turns with a script of one empty flow, which is
Prefect's own start-up: server, client, imports. What the first takes beyond the second is what we add. `stages`: a
stage that does nothing, with Prefect and without. `smoke`: the preset in one process, so that no two stages overlap;
what is spent outside of stages is overhead, start-up apart. `shards`: shards that sleep, so that they need no
processor, in a hundred task runs; all that processors do is scheduling, the start of our processes included.

`runners`: shards within one stage, in threads, processes, Dask and Ray where they are installed: sleeping ones, a fifth
as many, and how much sooner two workers have counted events, rendered bodies and simulated a sensor than one has; that
needs two idle cores, and many shards, for a worker that starts later than the other counts. Before them what the
machine has to give: two processes that know nothing of each other, beside one alone. Where two cores are two threads of
one core's hardware, that is less than two, and no runner can do better.

By the clock, and in processor seconds of all processes. Targets are judged by the latter, but for `cached` and what a
second worker gains: on a busy machine the clock shows what others do. Each part ends in its targets, met or missed,
with what was measured over what is wanted.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
CACHED_S_WANTED, SMOKE_S_WANTED, OVERHEAD_WANTED = 3.0, 40.0, 0.05
TASK_RUNS = 100
PARTS = ("cached", "stages", "smoke", "shards", "runners")
RUNNERS = {"threads": "tasks", "processes": "tasks", "dask": "distributed", "ray": "ray"}
"""And the package that each needs."""
SPEED_UP_WANTED = 1.7
WORKS = ("encode", "render", "simulate")


@dataclass
class Script:
    """A command, and what each of its runs took: seconds of the clock, and of processors, its children's included."""

    command: list[str]
    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)

    def run(self, **environment: str) -> str:
        """Run it once and return what it printed."""
        before, start = _children_cpu_s(), time.perf_counter()
        finished = subprocess.run(self.command, env=os.environ | environment, capture_output=True, text=True)
        if finished.returncode:
            raise RuntimeError(f"{' '.join(self.command)}: exit status {finished.returncode}\n{finished.stderr}")
        self.wall_s.append(time.perf_counter() - start)
        self.cpu_s.append(_children_cpu_s() - before)
        return finished.stdout


def main() -> None:
    """Print one table a part, then what was reached."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=("all", *PARTS), default="all")
    parser.add_argument("--preset", default="smoke", help="of `cached`")
    parser.add_argument("--home", type=Path, help="of `cached`; without, a new one, where the preset runs first")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--stages", type=int, default=50)
    parser.add_argument("--shards", type=int, default=10_000)
    parser.add_argument("--seconds", type=float, default=0.1, help="of a shard")
    parser.add_argument("--workers", type=int, default=8, help="processes of `shards`; they sleep")
    parser.add_argument("--work-shards", type=int, default=128, help="of each kind of work in `runners`")
    parser.add_argument("--in-process", nargs=2, help=argparse.SUPPRESS)  # a function of operations_flows, arguments
    chosen = parser.parse_args()
    if chosen.in_process:
        run_in_process(chosen.in_process[0], json.loads(chosen.in_process[1]), chosen.home)
        return
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    missed: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        new_home, wanted = Path(folder), PARTS if chosen.part == "all" else (chosen.part,)
        if "cached" in wanted:
            missed += cached(chosen.preset, chosen.home, new_home, chosen.rounds)
        if "stages" in wanted:
            stages(new_home, chosen.stages)
        if "smoke" in wanted:
            missed += smoke(new_home)
        if "shards" in wanted:
            missed += shards(new_home, chosen.shards, chosen.seconds, chosen.workers)
        if "runners" in wanted:
            missed += runners(new_home, chosen.shards // 5, chosen.seconds, chosen.workers, chosen.work_shards)
    print("\nTargets missed: " + ("; ".join(missed) or "none"))


def run_in_process(name: str, arguments: dict[str, Any], home: Path) -> None:
    """Call a function of `operations_flows` and print what it returns as JSON."""
    import operations_flows

    print(json.dumps(getattr(operations_flows, name)(home, **arguments)))


def in_process(name: str, home: Path, **arguments: Any) -> Script:
    """A script that calls a function of `operations_flows`."""
    home.mkdir(parents=True, exist_ok=True)
    given = ["--in-process", name, json.dumps(arguments), "--home", str(home)]
    return Script([sys.executable, str(Path(__file__).resolve()), *given])


def experiment(preset: str, home: Path) -> Script:
    """The whole experiment as a script."""
    home.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, str(ROOT / "flows" / "full_experiment.py"), "--preset", preset, "--home", str(home)]
    return Script(command)


def cached(preset: str, home: Path | None, new_home: Path, rounds: int) -> list[str]:
    """A finished preset again, beside an empty flow."""
    again, empty = experiment(preset, home or new_home / "cached"), in_process("run_nothing", new_home / "empty")
    if home is None:
        again.run()
    empty.run()  # makes the server's database
    again.wall_s.clear()
    again.cpu_s.clear()
    empty.wall_s.clear()
    empty.cpu_s.clear()
    for _ in range(rounds):
        lines = again.run().splitlines()
        empty.run()
    print(f"\ncached: {preset}, {lines[-1]}\n{'':24} {'clock s':>8} {'CPU s':>8}  range of the clock")
    for name, script in ((f"{preset}, all cached", again), ("an empty flow", empty)):
        wall_s, cpu_s = statistics.median(script.wall_s), statistics.median(script.cpu_s)
        print(f"{name:24} {wall_s:8.1f} {cpu_s:8.1f}  {min(script.wall_s):.1f} .. {max(script.wall_s):.1f}")
    beyond_s = statistics.median(a - b for a, b in zip(again.wall_s, empty.wall_s, strict=True))
    cpu_s = statistics.median(a - b for a, b in zip(again.cpu_s, empty.cpu_s, strict=True))
    ratio = statistics.median(a / b for a, b in zip(again.wall_s, empty.wall_s, strict=True))
    print(f"{'beyond start-up':24} {beyond_s:8.1f} {cpu_s:8.1f}  ratio {ratio:.2f}")
    return judge(f"cached {preset}, beyond start-up", beyond_s, CACHED_S_WANTED, "s")


def judge(what: str, measured: float, wanted: float, unit: str, *, at_least: bool = False) -> list[str]:
    """Print whether a target was met; returns it where it was not."""
    met = measured >= wanted if at_least else measured < wanted
    line = f"{what}: {measured:.2f} {unit}, wanted {'at least' if at_least else 'less than'} {wanted:g} {unit}"
    print(f"target: {line}; {measured / wanted:.2f} of it: {'met' if met else 'missed'}")
    return [] if met else [line]


def stages(new_home: Path, count: int) -> None:
    """Milliseconds a stage that does nothing."""
    found = json.loads(in_process("time_stages", new_home / "stages", count=count).run())
    print(f"\nstages: {count} that do nothing, one after the other{'':6} {'ms a stage':>10}")
    for name, milliseconds in found.items():
        print(f"{name:56} {milliseconds:10.1f}")


def smoke(new_home: Path) -> list[str]:
    """The share of a run that is spent outside of stages, start-up apart, and the whole as users run it."""
    home = new_home / "smoke"
    whole = experiment("smoke", home)
    # In a home as new as its own: most of a start-up there is the server making its database.
    empty = in_process("run_nothing", new_home / "smoke_empty")
    empty.run()
    whole.run(CTLEV_WORKERS="1")
    records = [json.loads(path.read_text()) for path in home.glob("artefacts/*/*/run.json")]
    print(f"\nsmoke, {len(records)} stages {'whole':>22} {'start-up':>9} {'in stages':>10} {'the rest':>9}")
    shares = {}
    for name, of_whole, of_empty, field_name in (
        ("seconds by the clock", whole.wall_s[0], empty.wall_s[0], "wall_seconds"),
        ("processor seconds", whole.cpu_s[0], empty.cpu_s[0], "cpu_seconds"),
    ):
        work = sum(record[field_name] for record in records)
        shares[name] = share = (of_whole - of_empty - work) / of_whole
        print(f"{name:30} {of_whole:9.1f} {of_empty:9.1f} {work:10.1f} {100 * share:7.1f} %")
    side_by_side = experiment("smoke", new_home / "smoke_side_by_side")
    side_by_side.run()
    return [
        *judge("smoke, outside of stages", 100 * shares["processor seconds"], 100 * OVERHEAD_WANTED, "%"),
        *judge("smoke, the whole in a new home, one process a core", side_by_side.wall_s[0], SMOKE_S_WANTED, "s"),
    ]


def shards(new_home: Path, count: int, seconds: float, workers: int) -> list[str]:
    """What spreading many shards takes beside the shards, which themselves need no processor."""
    groups = workers * max(TASK_RUNS // workers, 1)  # so that none waits for a last one
    empty = in_process("run_nothing", new_home / "empty")
    empty.run()
    empty.run()
    given = {"shards": count, "seconds": seconds, "groups": groups, "workers": workers}
    spread = in_process("time_task_runs", new_home / "shards", **given)
    found, work_s = json.loads(spread.run()), count * seconds
    clock_s, cpu_s = found["seconds"] - found["start_s"], spread.cpu_s[0] - empty.cpu_s[-1]
    share = cpu_s / work_s
    print(f"\nshards: {count} of {1000 * seconds:g} ms in {groups} task runs, {workers} processes")
    print(f"clock: {found['start_s']:.1f} s until the first has begun, then {clock_s:.1f} s,", end=" ")
    print(f"{100 * (clock_s * workers / work_s - 1):.1f} % more than {work_s / workers:.1f} s of sleep")
    print(f"processors: {cpu_s:.1f} s, {100 * share:.1f} % of {work_s:.0f} s of work")
    return [
        *judge("shards, scheduling", 100 * share, 100 * OVERHEAD_WANTED, "%"),
        *judge("shards, task runs", groups, TASK_RUNS + 1, "runs"),
    ]


def runners(new_home: Path, count: int, seconds: float, workers: int, work_shards: int) -> list[str]:
    """Shards of one stage on each runner: what waiting costs, and what a second worker gains."""
    print(f"\nrunners: {count} of {1000 * seconds:g} ms on {workers} workers; {work_shards} with work, on 1 and 2")
    works = "".join(f"{work + ', 1 / 2':>17}" for work in WORKS)
    print(f"{'':10} {'start s':>8} {'beyond sleep':>13} {'processors':>11}{works}")
    apart = {work: apart_speed_up(new_home, work, work_shards) for work in WORKS}
    print(f"{'apart':10} {'':34}" + "".join(f"{apart[work]:17.2f}" for work in WORKS), flush=True)
    targets: list[tuple[str, float, float, str, bool]] = []
    for runner in [name for name, package in RUNNERS.items() if importlib.util.find_spec(package)]:
        given = {"work": "sleep", "shards": count, "seconds": seconds, "workers": workers, "runner": runner}
        script = in_process("time_map", new_home / "runners", **given)
        found, work_s = json.loads(script.run()), count * seconds
        beyond = (found["seconds"] - found["start_s"]) * workers / work_s - 1
        ratios = {}
        for work in WORKS:
            took = []
            for number in (1, 2):
                given = {"work": work, "shards": work_shards, "seconds": 0.0, "workers": number, "runner": runner}
                timed = json.loads(in_process("time_map", new_home / "runners", **given).run())
                # Seconds a shard, without the first of each worker, which compiles and makes what it works on.
                took.append((timed["seconds"] - timed["start_s"]) / (work_shards - number))
            ratios[work] = took[0] / took[1]
        print(
            f"{runner:10} {found['start_s']:8.1f} {100 * beyond:11.1f} % {100 * script.cpu_s[0] / work_s:9.1f} %"
            + "".join(f"{ratios[work]:17.2f}" for work in WORKS),
            flush=True,
        )
        for work, ratio in ratios.items():
            said = f"{work}, two workers of {runner} (two processes apart: {apart[work]:.2f})"
            targets.append((said, ratio, SPEED_UP_WANTED, "x", True))
        share = 100 * script.cpu_s[0] / work_s
        targets.append((f"shards in {runner}, scheduling", share, 100 * OVERHEAD_WANTED, "%", False))
    return [
        line
        for what, measured, wanted, unit, at_least in targets
        for line in judge(what, measured, wanted, unit, at_least=at_least)
    ]


def apart_speed_up(new_home: Path, work: str, shards: int) -> float:
    """Shards a second of two processes side by side, each with all of them, over those of one alone."""
    given = {"work": work, "shards": shards, "seconds": 0.0, "workers": 1, "runner": "threads"}

    def seconds(_: int) -> float:
        timed = json.loads(in_process("time_map", new_home / "runners", **given).run())
        return timed["seconds"] - timed["start_s"]

    alone = seconds(0)
    with ThreadPoolExecutor(2) as threads:
        return 2 * alone / statistics.mean(threads.map(seconds, range(2)))


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
