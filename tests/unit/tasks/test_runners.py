"""Shards and stages on threads, processes, Dask and Ray: the same results, whoever computes."""

import errno
import gc
import importlib.util
import json
import os
import pickle
import shutil
import socket
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from data_contracts import tables
from data_contracts.errors import DataError
from tasks import runners
from tasks.runners import (
    ALIKE,
    ProcessesClosedError,
    WorkerError,
    asked_runner,
    environment_there,
    is_elsewhere,
    num_jobs,
    reply_to,
)
from tasks.stage import planning, stage
from tasks.store import Store
from tasks.workers import MAX_GROUP, Workers, _groups, current_workers, is_spread, map_shards, together

KINDS = [
    kind
    if kind in ("threads", "processes")
    else pytest.param(
        kind,
        marks=[
            pytest.mark.skipif(importlib.util.find_spec(package) is None, reason=f"{package} is not installed"),
            pytest.mark.filterwarnings("default"),  # theirs
        ],
    )
    for kind, package in (("threads", ""), ("processes", ""), ("dask", "distributed"), ("ray", "ray"))
]


@pytest.fixture(autouse=True)
def two_processes_that_know_this_file(monkeypatch):
    monkeypatch.setenv("CTLEV_WORKERS", "2")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    yield
    for cluster in list(runners._running.values()):
        cluster.close()


def draw(shard):
    """A shard's own random numbers: they tell if one was left out, done twice or misplaced."""
    return np.random.default_rng(shard).normal(size=3)


@stage(version=1, schema=tables.TRAINING)
def spread_losses(out, *, count):
    """Losses and an array that come from shards."""
    drawn = np.array(list(map_shards(draw, range(count))))
    out.write_array("frames", drawn)
    columns = [pa.array(["training"] * count), pa.array(range(count), pa.int64()), pa.array(drawn.sum(1))]
    return pa.table(columns, names=["curve", "step", "loss"])


@stage(version=1, schema=tables.TRAINING)
def losses_of_one_process(out, *, seed):
    """Without shards of its own."""
    return pa.table({"curve": ["training"], "step": pa.array([seed], pa.int64()), "loss": draw(seed)[:1]})


@stage(version=int(os.environ.get("VERSION_OF_TEST_STAGE", "1")), schema=tables.TRAINING)
def losses_of_a_version(out, *, seed):
    """Of a stage whose code differs from machine to machine."""
    return pa.table({"curve": ["training"], "step": pa.array([seed], pa.int64()), "loss": draw(seed)[:1]})


def digests(home):
    """Of every artefact; all of its files were checked against it."""
    found = {}
    for record in sorted(home.glob("artefacts/*/*/run.json")):
        Store(home).check(record.parent)
        found[record.parent.name] = json.loads(record.read_text())["digest"]
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_artefacts_do_not_depend_on_who_computes_them(kind, tmp_path, monkeypatch):
    def make(home):
        monkeypatch.setenv("CTLEV_HOME", str(home))
        arguments = {"count": 37}
        spread_losses.run(spread_losses.key(arguments, Store()), arguments)
        together([partial(run_stage, seed) for seed in range(4)])
        return digests(home)

    monkeypatch.setenv("CTLEV_RUNNER", kind)
    found = make(tmp_path / kind)
    monkeypatch.setenv("CTLEV_WORKERS", "1")
    monkeypatch.delenv("CTLEV_RUNNER")
    assert found == make(tmp_path / "alone") and len(found) == 5


@pytest.mark.parametrize("kind", ["processes", *KINDS[2:3]])
def test_a_machine_with_another_version_of_a_stage_makes_nothing_under_our_key(kind, home, monkeypatch):
    def run(seed):
        return losses_of_a_version.run(losses_of_a_version.key({"seed": seed}, Store()), {"seed": seed})

    monkeypatch.setenv("CTLEV_RUNNER", kind)
    assert [cached for _, cached in together([partial(run, 0), partial(run, 1)])] == [False, False]
    for cluster in list(runners._running.values()):
        cluster.close()
    monkeypatch.setenv("VERSION_OF_TEST_STAGE", "2")
    with pytest.raises(
        DataError, match=r"losses_of_a_version: .* has another version of ctlev.*'version': 1.*'version': 2"
    ):
        together([partial(run, 2), partial(run, 3)])
    assert len(list(home.glob("artefacts/losses_of_a_version/*"))) == 2


def run_stage(seed):
    return losses_of_one_process.run(losses_of_one_process.key({"seed": seed}, Store()), {"seed": seed})


@pytest.mark.parametrize("kind", KINDS)
def test_shards_keep_their_order_and_errors_their_type(kind, monkeypatch):
    monkeypatch.setenv("CTLEV_RUNNER", kind)
    assert [shard for shard, _ in map_shards(number_and_process, range(50))] == list(range(50))
    processes = {process for _, process in map_shards(number_and_process, range(50))}
    assert (processes == {os.getpid()}) == (kind == "threads")
    with pytest.raises(DataError, match="shard 7 is wrong"):
        list(map_shards(refuse_seven, range(20)))
    # What computes for us starts no processes of its own, and serves on after an error.
    if kind != "threads":
        assert list(map_shards(environment, ["CTLEV_WORKERS", "CTLEV_RUNNER"])) == ["1", "threads"]


@pytest.mark.parametrize("kind", KINDS[1:])
def test_a_process_that_dies_is_an_error_that_says_so(kind, monkeypatch):
    monkeypatch.setenv("CTLEV_RUNNER", kind)
    with pytest.raises(WorkerError):
        list(map_shards(die, range(2)))


@pytest.mark.parametrize("kind", KINDS[1:])
def test_of_calls_side_by_side_the_one_that_died_is_told(kind, tmp_path, monkeypatch):
    monkeypatch.setenv("CTLEV_RUNNER", kind)
    monkeypatch.setenv("CTLEV_WORKERS", "3")
    # Those that are ended for it would be told as often as not: whichever thread is awake first.
    calls = [partial(call_there, sleep_a_minute, tmp_path / str(number)) for number in range(2)]
    with pytest.raises(WorkerError) as found:
        together([*calls, partial(call_there, die, 0)])
    assert not isinstance(found.value, ProcessesClosedError)


def call_there(function, *arguments):
    return current_workers().call(function, *arguments)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("threads", "processes")])
def test_a_call_after_the_end_of_a_cluster_is_an_error_and_starts_no_other(kind, monkeypatch):
    monkeypatch.setenv("CTLEV_RUNNER", kind)
    for _ in range(2):
        cluster = runners.asked_cluster(2)
        assert cluster.call(abs, -3) == 3
        cluster.close()
        with pytest.raises(WorkerError, match=f"{kind}: a call was lost"):
            cluster.call(abs, -3)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_calls_that_wait_end_when_the_runner_is_closed(kind, tmp_path, monkeypatch):
    monkeypatch.setenv("CTLEV_RUNNER", kind)
    runner = runners.asked_cluster(2) or Workers(2)
    started = [tmp_path / "0", tmp_path / "1"]
    with ThreadPoolExecutor(2) as threads:
        waiting = [threads.submit(runner.call, sleep_a_minute, path) for path in started]
        while not all(path.exists() for path in started):
            time.sleep(0.05)
        since = time.monotonic()
        runner.close()
        for call in waiting:
            with pytest.raises(WorkerError):
                call.result()
    assert time.monotonic() - since < 30


def sleep_a_minute(started):
    started.touch()
    time.sleep(60)


def number_and_process(shard):
    return shard, os.getpid()


def refuse_seven(shard):
    if shard == 7:
        raise DataError("shard 7 is wrong")
    return shard


def environment(name):
    return os.environ[name]


def die(shard):
    os._exit(3)


@pytest.mark.parametrize(
    ("asked", "package"),
    [
        ("dask:node", "distributed"),
        ("dask:foo://node:1", "distributed"),
        ("ray:node", "ray"),
        ("ray:node:70000", "ray"),
    ],
)
def test_an_address_that_is_none_is_refused_with_the_variable(asked, package, monkeypatch):
    pytest.importorskip(package)
    monkeypatch.setenv("CTLEV_RUNNER", asked)
    with pytest.raises(DataError, match=f"CTLEV_RUNNER={asked}: there is no such cluster"):
        runners.asked_cluster(2)


def test_ray_is_not_waited_for_in_silence_where_nobody_answers(monkeypatch):
    monkeypatch.setattr("tasks.runners.CONNECT_TIMEOUT_S", 0.1)
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        asked = f"127.0.0.1:{taken.getsockname()[1]}"
        for address in (asked, f"ray://{asked}"):
            with pytest.raises(ConnectionRefusedError):
                runners.Ray(address, 1)


@pytest.mark.parametrize("address", ["foo://node:1", "node"])
def test_no_client_of_dask_is_left_half_made_to_be_collected_while_the_next_one_starts(address):
    distributed = pytest.importorskip("distributed")
    before = {id(found) for found in gc.get_objects() if type(found) is distributed.Client}
    with pytest.raises(ValueError):
        runners.Dask(address, 1)
    clients = [found for found in gc.get_objects() if type(found) is distributed.Client and id(found) not in before]
    assert not [client for client in clients if client.status != "closed"]


def test_the_rest_is_not_computed_where_nobody_wants_it():
    done = []
    results = map_shards(done.append, range(1000))
    next(results)
    results.close()
    assert len(done) < 1000


@pytest.mark.parametrize("max_group", [1, 4, MAX_GROUP])
@pytest.mark.parametrize(("num_shards", "count"), [(1, 2), (5, 2), (100, 3), (10_000, 16)])
def test_groups_cover_all_shards_once_and_end_small(num_shards, count, max_group):
    groups = list(_groups(range(num_shards), count, max_group))
    assert [shard for group in groups for shard in group] == list(range(num_shards))
    sizes = [len(group) for group in groups]
    assert sizes == sorted(sizes, reverse=True) and sizes[0] <= max_group and sizes[-1] == 1


def test_an_error_that_cannot_travel_still_says_whether_it_passes_and_where_it_was():
    class OwnError(OSError):
        """Nobody else knows it."""

    def fail():
        raise OwnError(errno.EIO, "at nfs")

    done, error = pickle.loads(reply_to(fail, ()))
    assert not done and str(error) == "OwnError: [Errno 5] at nfs" and error.passes
    assert "in fail" in error.__notes__[-1]


def test_what_decides_digits_and_limits_is_there_as_it_is_here(monkeypatch):
    for name in ALIKE:
        monkeypatch.delenv(name, raising=False)
    assert not set(ALIKE) & environment_there().keys()
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setenv("CTLEV_STAGE_TIMEOUT_S", "60")
    there = environment_there()
    assert (there["OMP_NUM_THREADS"], there["CTLEV_STAGE_TIMEOUT_S"], there["CTLEV_WORKERS"]) == ("2", "60", "1")


def test_shards_are_spread_where_there_are_several_of_both(monkeypatch):
    assert is_spread(2) and not is_spread(1)
    monkeypatch.setenv("CTLEV_WORKERS", "1")
    assert not is_spread(2)


def test_one_worker_computes_here(monkeypatch):
    monkeypatch.setenv("CTLEV_WORKERS", "1")
    monkeypatch.setenv("CTLEV_RUNNER", "processes")
    assert {process for _, process in map_shards(number_and_process, range(3))} == {os.getpid()}
    assert current_workers() is None


@pytest.mark.parametrize("asked", ["pbs", "threads:2", "processes:tcp://host:1"])
def test_an_unknown_runner_is_refused_before_anything_runs(asked, monkeypatch):
    monkeypatch.setenv("CTLEV_RUNNER", asked)
    with pytest.raises(DataError, match=f"threads, processes, dask, ray, .* got '{asked}'"), planning():
        pass


@pytest.mark.parametrize(("kind", "package"), [("dask", "distributed"), ("ray", "ray"), ("slurm", "dask_jobqueue")])
def test_a_missing_package_is_named_with_what_to_install(kind, package, monkeypatch):
    monkeypatch.setenv("CTLEV_RUNNER", f"{kind}:host:1")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else sys)
    with pytest.raises(DataError, match=rf"needs the package '{package}': pip install -e '.\[{kind}\]'"), planning():
        pass


def test_kind_and_address(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: sys)
    for asked, expected in {
        "": ("threads", ""),
        "dask": ("dask", ""),
        "dask:tcp://host:8786": ("dask", "tcp://host:8786"),
        "ray:auto": ("ray", "auto"),
        "slurm": ("slurm", ""),
        "slurm:0-8": ("slurm", "0-8"),
    }.items():
        monkeypatch.setenv("CTLEV_RUNNER", asked)
        monkeypatch.setattr(shutil, "which", lambda name: name)
        assert asked_runner() == expected
        assert is_elsewhere() == (asked in ("dask:tcp://host:8786", "ray:auto", "slurm", "slurm:0-8"))


def test_numbers_of_jobs():
    assert [num_jobs(asked) for asked in ("", "4", "0-8", "3-3")] == [(1, 1), (4, 4), (0, 8), (3, 3)]


@pytest.mark.parametrize("jobs", ["0", "0-0", "5-2", "-3", "3-", "x", "1.5", "two", "1-2-3"])
def test_wrong_numbers_of_jobs_are_refused_before_anything_runs(jobs, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: sys)
    monkeypatch.setenv("CTLEV_RUNNER", f"slurm:{jobs}")
    with pytest.raises(DataError, match=f"expects a number of jobs, as slurm:4 or slurm:0-8, got '{jobs}'"), planning():
        pass


def test_a_machine_without_the_programs_of_slurm_says_so(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: sys)
    monkeypatch.setattr(shutil, "which", lambda name: None if name == "squeue" else name)
    monkeypatch.setenv("CTLEV_RUNNER", "slurm")
    with pytest.raises(DataError, match=r"needs SLURM's programs; not on PATH: squeue$"), planning():
        pass
