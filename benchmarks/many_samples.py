"""So many frames sampled by the machines of a cluster: overhead beside one machine, killed workers, cost as it grows.

    python benchmarks/many_samples.py 2500 10000
    python benchmarks/many_samples.py 2500 10000 --steps 20 --workers 4

The bundled base model, fine-tuned for a step, makes frames of 64 px from skeletons. A cluster of Dask with `--workers`
processes of this machine stands for one of several: the stage `sample` deals its files out as it does there
(CTLEV_RUNNER=dask:ADDRESS). For each number of frames, in processes of their own:

    alone     this machine as it is by default: a process a core
    cluster   the files dealt out
    killed    the same, while a worker is killed for every tenth file of frames

Digests of all are compared. The last number of frames is foretold from the others, on a line through their times; so is
a million. Needs the extra `dask`.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from ctlev_core.diffusion.sampling.shards import SHARD  # noqa: E402
from ctlev_core.processes import begin_memory_peak, memory_peak_mib, num_cores  # noqa: E402
from data_contracts.config import (  # noqa: E402
    ConditionChoice,
    DatasetChoice,
    EncodingChoice,
    GeneratorChoice,
    SamplingChoice,
    Windows,
)
from data_contracts.manifest import ManifestRef, read_manifest  # noqa: E402
from tasks.condition import condition_frames, condition_samples  # noqa: E402
from tasks.encode import encode  # noqa: E402
from tasks.finetune import finetune  # noqa: E402
from tasks.ingest import ingest  # noqa: E402
from tasks.sample import sample  # noqa: E402
from tasks.stage import Stage  # noqa: E402
from tasks.store import Store  # noqa: E402

WAYS = ("alone", "cluster", "killed")
POSES = 60
"""Recordings whose poses are asked for; each gives some twenty."""
KILLED_SHARE = 0.1
"""Workers that are killed, of the number of files."""
MILLION = 1_000_000


def main() -> None:
    """Print a line for each number and way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("frames", type=int, nargs="+")
    parser.add_argument("--steps", type=int, default=5, help="evaluations a frame")
    parser.add_argument("--workers", type=int, default=num_cores())
    parser.add_argument("--json", action="store_true", help="all that was found, as the last line")
    parser.add_argument("--home", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.home:
        print(json.dumps(sample_once(chosen.home, chosen.frames[0], chosen.steps)))
        return
    print(f"{num_cores()} cores, {chosen.workers} workers, {chosen.steps} evaluations a frame")
    print(f"{'frames':>9} {'way':8}{'seconds':>9}{'frames/s':>10}{'of alone':>10}{'peak MiB':>10}{'killed':>8}  digest")
    found: dict[str, list[dict[str, Any]]] = {way: [] for way in WAYS}
    for count in chosen.frames:
        for way in WAYS:
            with tempfile.TemporaryDirectory() as folder:
                one = run(way, Path(folder), count, chosen.steps, chosen.workers)
            found[way].append(one)
            share = one["seconds"] / found["alone"][-1]["seconds"]
            print(
                f"{count:9,} {way:8}{one['seconds']:9.1f}{count / one['seconds']:10.1f}{share:10.3f}"
                f"{one['peak_mib']:10.0f}{one['killed']:8}  {one['digest'][:12]}",
                flush=True,
            )
        if len({found[way][-1]["digest"] for way in WAYS}) > 1:
            raise SystemExit(f"{count} frames: the digests differ")
    foretell(chosen.frames, [one["seconds"] for one in found["cluster"]])
    if chosen.json:
        print(json.dumps(found))


def foretell(frames: list[int], seconds: list[float]) -> None:
    """The last of several numbers from the others, and a million from all."""
    if len(frames) < 2:
        return
    base = seconds[0] / frames[0] if len(frames) == 2 else slope(frames[:-1], seconds[:-1])
    last = seconds[-2] + base * (frames[-1] - frames[-2])
    print(f"{frames[-1]:,} frames: foretold {last:.0f} s, measured {seconds[-1]:.0f} s")
    hours = (seconds[-1] + slope(frames, seconds) * (MILLION - frames[-1])) / 3600
    print(f"{MILLION:,} frames: {hours:.1f} h of this machine")


def slope(frames: list[int], seconds: list[float]) -> float:
    """Seconds a frame between the first and the last."""
    return (seconds[-1] - seconds[0]) / (frames[-1] - frames[0])


def run(way: str, folder: Path, count: int, steps: int, workers: int) -> dict[str, Any]:
    """What a process that samples says of itself."""
    home = folder / "home"
    command = [sys.executable, str(Path(__file__).resolve()), str(count), "--steps", str(steps), "--home", str(home)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "CTLEV_HOME": str(home)}
    with cluster(folder, 0 if way == "alone" else workers, environment) as address:
        environment["CTLEV_RUNNER"] = f"dask:{address}" if address else "threads"
        process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        killed = Killing(home, count) if way == "killed" else None
        printed, _ = process.communicate()
        if process.returncode:
            raise SystemExit(f"{' '.join(command)}: exit status {process.returncode}")
        return json.loads(printed.splitlines()[-1]) | {"killed": killed.end() if killed else 0}


@contextmanager
def cluster(folder: Path, workers: int, environment: dict[str, str]) -> Iterator[str]:
    """The address of a scheduler with workers that are started again when they are killed; empty without workers."""
    if not workers:
        yield ""
        return
    told = folder / "scheduler.json"
    quiet: Any = {"env": environment, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    dask = [sys.executable, "-m", "dask"]
    place = ["--scheduler-file", str(told)]
    processes = [
        subprocess.Popen([*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", *place], **quiet)
    ]
    try:
        while not told.is_file():
            time.sleep(0.2)
        options = ["--nworkers", str(workers), "--nthreads", "1", "--no-dashboard", "--memory-limit", "0"]
        local = ["--local-directory", str(folder / "dask")]
        processes.append(subprocess.Popen([*dask, "worker", *options, *local, *place], **quiet))
        yield json.loads(told.read_text())["address"]
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait()


class Killing:
    """Kills a worker for every tenth file, spread over the frames that are written.

    Args:
        home: in which files of unfinished frames are counted.
        count: frames in all.
    """

    def __init__(self, home: Path, count: int) -> None:
        self._home, self._files = home, -(-count // SHARD)
        self._ended, self._killed = threading.Event(), 0
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()

    def _watch(self) -> None:
        import psutil

        wanted = max(round(KILLED_SHARE * self._files), 1)
        while self._killed < wanted and not self._ended.wait(0.1):
            written = len(list(self._home.glob("work/*/shard_*")))
            if written < (self._killed + 0.5) * self._files / wanted:
                continue
            workers = [
                one for one in psutil.process_iter(["cmdline"]) if "spawn_main" in " ".join(one.info["cmdline"] or ())
            ]
            workers = [one for one in workers if any("dask" in part for part in (one.parent() or one).cmdline())]
            if workers:
                random.Random(self._killed).choice(workers).kill()
                self._killed += 1

    def end(self) -> int:
        """How many were killed."""
        self._ended.set()
        self._thread.join()
        return self._killed


def sample_once(home: Path, count: int, steps: int) -> dict[str, Any]:
    """Make what is needed, then sample: time of the latter."""
    runner = os.environ.pop("CTLEV_RUNNER")
    given, inputs = prepare(count)
    os.environ["CTLEV_RUNNER"] = runner
    sampling = SamplingChoice(
        name="controlnet", options={"num_inference_steps": steps, "palette": "grey", "device": "cpu"}
    )
    begin_memory_peak()
    started = time.perf_counter()
    made = run_stage(sample, **inputs, **given, sampling=sampling, max_attempts=1, seed=3)
    seconds = time.perf_counter() - started
    return {"seconds": seconds, "peak_mib": memory_peak_mib(), "digest": made.digest}


def prepare(count: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Recorded frames, a checkpoint and `count` conditions."""
    numbers = {"num_train_recordings": 4, "num_test_recordings": 1, "num_condition_recordings": POSES}
    encoding = EncodingChoice(name="event_histogram", options={"polarity": False})
    windows = Windows(num_events=700, max_windows=3)
    recordings = run_stage(ingest, dataset=DatasetChoice(name="studio", options=numbers))
    frames = run_stage(encode, recordings=recordings, encoding=encoding, windows=windows)
    skeleton: dict[str, Any] = {"recordings": recordings, "condition": ConditionChoice(name="skeleton")}
    skeleton |= {"encoding": encoding, "frames": frames}
    learnt = run_stage(condition_frames, **skeleton, seed=1)
    chosen = {"windows": windows, "count": count, "order": "random", "views": "labelled", "seed": 2}
    conditions = run_stage(condition_samples, poses=recordings, **skeleton, **chosen)
    generator = GeneratorChoice(name="controlnet", options={"num_steps": 1, "batch_size": 4, "device": "cpu"})
    checkpoint = run_stage(finetune, frames=frames, conditions=learnt, generator=generator, seed=0)
    return {"frames": frames}, {"checkpoint": checkpoint, "conditions": conditions}


def run_stage(stage: Stage, **arguments: Any) -> ManifestRef:
    """What a Prefect task does, without Prefect."""
    bound = stage.signature.bind(None, **arguments)
    bound.apply_defaults()
    arguments = dict(list(bound.arguments.items())[1:])
    made = stage.run(stage.key(arguments, Store()), arguments)[0]
    return read_manifest(made).ref


if __name__ == "__main__":
    main()
