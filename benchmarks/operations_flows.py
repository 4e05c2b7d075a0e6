"""Flows that do nothing, or sleep, so that what is left is what running them costs; for `operations.py`.

Each function runs in a process of its own, for a private server serves one script, and returns what it measured.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from data_contracts import tables
from data_contracts.manifest import ManifestRef, read_manifest
from tasks.stage import Output, call_together, stage
from tasks.store import Store
from tasks.workers import map_shards


@stage(version=1, schema=tables.TRAINING)
def sleep_shards(out: Output, *, first: int, count: int, seconds: float) -> pa.Table:
    """Sleep once a shard; `loss` is the clock when the shard was done, which all processes of a machine share."""
    done = []
    for _ in range(count):
        time.sleep(seconds)
        done.append(time.monotonic())
    return _table(first, done)


def _table(first: int, done: list[float]) -> pa.Table:
    steps = pa.array(range(first, first + len(done)), pa.int64())
    columns = [pa.array(["training"] * len(done)), steps, pa.array(done, pa.float64())]
    return pa.table(columns, names=[column.name for column in tables.TRAINING.columns])


def run_nothing(home: Path) -> dict[str, float]:
    """One flow without a stage: what Prefect takes to start and to end."""
    _in_a_flow(home, lambda: None)
    return {}


def time_stages(home: Path, count: int) -> dict[str, float]:
    """Milliseconds for a stage that does nothing: computed, found in the store, and both without Prefect."""
    shards = [{"first": number, "count": 1, "seconds": 0.0} for number in range(2 * count)]
    with_prefect, without = shards[:count], shards[count:]

    def run_all() -> list[float]:
        return [_time_ms(lambda: [sleep_shards(**given) for given in with_prefect]) / count for _ in range(2)]

    computed, found = _in_a_flow(home, run_all)
    names = ("computed, without Prefect", "found, without Prefect")
    alone = {name: _time_ms(lambda: [_run_alone(given) for given in without]) / count for name in names}
    return {"computed": computed, "found": found, **alone}


def _run_alone(given: dict[str, Any]) -> None:
    sleep_shards.run(sleep_shards.key(given, Store()), given)


def time_task_runs(home: Path, shards: int, seconds: float, groups: int, workers: int) -> dict[str, float]:
    """Sleeping shards as `groups` task runs, in `workers` processes: the seconds it took, and those of starting up."""
    os.environ["CTLEV_WORKERS"] = str(workers)
    os.environ["PYTHONPATH"] = str(Path(__file__).parent)  # the processes must find this file
    edges = np.linspace(0, shards, groups + 1).astype(int).tolist()
    calls = [partial(sleep_shards, first=first, count=last - first, seconds=seconds) for first, last in pairwise(edges)]

    def run_all() -> tuple[float, list[ManifestRef]]:
        return time.monotonic(), call_together(*calls)

    started, made = _in_a_flow(home, run_all)
    done = np.concatenate([read_manifest(ref).table["loss"].to_numpy() for ref in made])
    if len(done) != shards:
        raise RuntimeError(f"expected {shards} shards, got {len(done)}")
    return {"seconds": float(done.max() - started), "start_s": float(done.min() - seconds - started)}


def time_map(home: Path, work: str, shards: int, seconds: float, workers: int, runner: str) -> dict[str, float]:
    """Seconds by the clock of shards within one stage, and how much of that was until each process had done something.

    Args:
        home: of the store; not used.
        work: `sleep`, `encode`, `render` or `simulate`.
        shards: how many.
        seconds: of sleep.
        workers: processes or threads.
        runner: as CTLEV_RUNNER.
    """
    os.environ |= {"CTLEV_WORKERS": str(workers), "CTLEV_RUNNER": runner, "PYTHONPATH": str(Path(__file__).parent)}
    shard = {"sleep": partial(_sleep, seconds), "encode": _encode, "render": _render, "simulate": _simulate}[work]
    start = time.monotonic()
    done = np.array(list(map_shards(shard, range(shards))))
    return {"seconds": float(done.max() - start), "start_s": float(done.min() - seconds - start)}


def _sleep(seconds: float, number: int) -> float:
    time.sleep(seconds)
    return time.monotonic()


def _encode(number: int) -> float:
    """Forty million events in windows of 7,500, some windows at a time as the stage `encode` does: about 100 ms."""
    from ctlev_core.encodings import event_histogram

    events, ranges = _events()
    for _ in range(10):
        for first in range(0, len(ranges), 16):
            event_histogram.encode(events, ranges[first : first + 16], event_histogram.Options())
    return time.monotonic()


@cache
def _events() -> tuple[Any, np.ndarray]:
    from data_contracts.events import Events

    rng, count = np.random.default_rng(0), 4_000_000
    x, y = (rng.integers(0, size, count, dtype=np.uint16) for size in (346, 260))
    p = rng.integers(0, 2, count, dtype=np.uint8)
    starts = np.arange(0, count - 7500, 7500)
    return Events(np.arange(count), x, y, p, (346, 260)), np.stack([starts, starts + 7500], axis=1)


def _render(number: int) -> float:
    """256 normal maps of 256 x 256 px: about 100 ms."""
    from ctlev_core.render.normals import render_normal_maps

    vertices, faces, intrinsics = _bodies()
    for _ in range(4):
        render_normal_maps(vertices, faces, intrinsics, (256, 256), "controlnet", workers=1)
    return time.monotonic()


def _simulate(number: int) -> float:
    """What a sensor of 346 x 260 px reports of 16 frames that move everywhere: about 100 ms."""
    from ctlev_core.sensor.dvs_pixel import PRESETS, Sensor

    frames = _moving_frames()
    Sensor((346, 260), PRESETS["dvs346"], sensor_seed=0, seed=number).push(frames, 4000 * np.arange(len(frames)))
    return time.monotonic()


@cache
def _moving_frames() -> np.ndarray:
    texture = np.random.default_rng(0).uniform(0.5, 1, (65, 99)).repeat(4, axis=0).repeat(4, axis=1)
    return np.stack([texture[:, 2 * step : 2 * step + 346] for step in range(16)])


@cache
def _bodies() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    from ctlev_core.body.layer import load_body, pose_vertices

    body = load_body(None)
    rotations = np.broadcast_to(np.eye(3), (64, 24, 3, 3))
    vertices, _ = pose_vertices(body, rotations, np.zeros((64, 10)), np.broadcast_to([0.0, 0.0, 3.0], (64, 3)))
    return vertices, body.faces, np.broadcast_to([256.0, 256.0, 128.0, 128.0], (64, 4))


def _in_a_flow(home: Path, run: Callable[[], Any]) -> Any:
    """What a script does around its flow."""
    from flows import local_server
    from flows.settings import configure, flow

    configure(home)
    local_server.start(home)
    with local_server.connected():
        return flow(name="benchmark")(run)()


def _time_ms(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return 1000 * (time.perf_counter() - start)
