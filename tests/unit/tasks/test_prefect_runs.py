"""Further attempts after errors that pass, and stages that take too long."""

import errno
import os
import pickle
import signal
import subprocess
import sys
import time

import pyarrow as pa
import pytest

from data_contracts import tables
from data_contracts.errors import DataError
from tasks.prefect_runs import DEFAULT_RETRIES, RETRIES, num_retries
from tasks.runners import is_passing, reply_with
from tasks.stage import StageTimeoutError, planning, stage
from tasks.store import Store


def chained(cause):
    try:
        raise DataError("the file cannot be read") from cause
    except DataError as error:
        return error


@pytest.mark.parametrize(
    ("error", "passes"),
    [
        (OSError(errno.EIO, "disk"), True),
        (ConnectionResetError(errno.ECONNRESET, "network"), True),
        (OSError(errno.ENOSPC, "full"), False),
        (FileNotFoundError(errno.ENOENT, "gone"), False),
        (PermissionError(errno.EACCES, "no"), False),
        (DataError("wrong"), False),
        (chained(OSError(errno.ESTALE, "moved")), True),
        (chained(OSError(errno.ENOENT, "gone")), False),
        (None, False),
    ],
)
def test_which_errors_pass(error, passes):
    assert is_passing(error) == passes
    if error is not None:  # what it came from does not travel between processes, that it passes does
        succeeded, received = pickle.loads(reply_with(error))
        assert not succeeded and is_passing(received) == passes


def test_the_number_of_attempts_is_an_option(monkeypatch):
    assert num_retries() == DEFAULT_RETRIES
    monkeypatch.setenv(RETRIES, "0")
    assert num_retries() == 0
    for wrong in ("-1", "21", "two", "²"):
        monkeypatch.setenv(RETRIES, wrong)
        with pytest.raises(
            DataError, match=f"CTLEV_STAGE_RETRIES must be a number of further attempts, 0 to 20, got '{wrong}'"
        ):
            num_retries()


ATTEMPTS = """
import errno, os, sys
from pathlib import Path
from flows import local_server
from flows.settings import configure, flow
home = configure(Path(sys.argv[1]))
local_server.start(home)
with local_server.connected():
    from data_contracts.errors import DataError
    from data_contracts.manifest import ManifestRef
    from tasks import prefect_runs
    prefect_runs.BACKOFF_S = 0.01
    calls = []

    def work(name, error):
        calls.append(name)
        if calls.count(name) < 3:
            raise error
        return ManifestRef(key="k" * 32, path=home, digest="d", rows=5), False

    @flow(name="attempts")
    def attempts():
        passing = OSError(errno.ECONNRESET, "network")
        print(prefect_runs.run_as_task("some", "passes", lambda: work("passes", passing)).rows)
        for error in (DataError("wrong"), OSError(errno.ENOSPC, "full")):
            try:
                prefect_runs.run_as_task("some", "stays", lambda: work(str(error), error))
            except Exception as raised:
                print(type(raised).__name__, raised is error)
    attempts()
    print([calls.count(name) for name in dict.fromkeys(calls)])
"""


@pytest.mark.slow
def test_what_may_pass_is_tried_again_and_nothing_else(tmp_path):
    known = {name: value for name, value in os.environ.items() if not name.startswith(("PREFECT_", "CTLEV_"))}
    done = subprocess.run(
        [sys.executable, "-c", ATTEMPTS, str(tmp_path)], env=known, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["5", "DataError True", "OSError True", "[3, 1, 1]"]


@stage(version=1, schema=tables.TRAINING)
def slow(out, *, seconds):
    """Takes its time."""
    (out.work / "checkpoint").write_text("kept")
    time.sleep(seconds)
    return pa.table({"curve": ["training"], "step": pa.array([0], pa.int64()), "loss": [0.0]})


def test_a_stage_that_takes_too_long_is_ended_and_keeps_its_work(home, monkeypatch):
    arguments = {"seconds": 20.0}
    key = slow.key(arguments, Store())
    monkeypatch.setenv("CTLEV_STAGE_TIMEOUT_S", "0.2")
    started = time.monotonic()
    with pytest.raises(StageTimeoutError, match=r"slow took longer than 0.2 s \(CTLEV_STAGE_TIMEOUT_S\)"):
        slow.run(key, arguments)
    assert time.monotonic() - started < 5
    assert (Store().work_folder(key) / "checkpoint").read_text() == "kept"
    assert not Store().temporary_folder(key).exists()


@pytest.mark.parametrize(
    "name",
    [
        "CTLEV_RUNNER",
        "CTLEV_WORKERS",
        "CTLEV_CORES",
        "CTLEV_STAGE_RETRIES",
        "CTLEV_STAGE_TIMEOUT_S",
        "CTLEV_STAGES_PER_GPU",
    ],
)
def test_a_wrong_variable_is_refused_before_anything_is_planned(home, monkeypatch, name):
    monkeypatch.setenv(name, "some")
    with pytest.raises(DataError, match=f"{name} must be .*got 'some'"), planning():
        raise AssertionError


@stage(version=1, schema=tables.TRAINING)
def hides(out, *, how):
    """Takes the interruption for something else."""
    try:
        time.sleep(20)
    except Exception as error:
        if how == "renamed":
            raise DataError("the file is damaged") from error
    return pa.table({"curve": ["training"], "step": pa.array([0], pa.int64()), "loss": [0.0]})


@pytest.mark.parametrize("how", ["renamed", "passed over"])
def test_work_that_is_cut_short_is_never_taken_for_finished_or_for_damage(home, monkeypatch, how):
    monkeypatch.setenv("CTLEV_STAGE_TIMEOUT_S", "0.2")
    arguments = {"how": how}
    key = hides.key(arguments, Store())
    with pytest.raises(StageTimeoutError, match=r"hides took longer than 0.2 s"):
        hides.run(key, arguments)
    assert not Store().folder("hides", key).exists()
    monkeypatch.setenv("CTLEV_STAGE_TIMEOUT_S", "1e300")
    quick = {"seconds": 0.0}
    assert slow.run(slow.key(quick, Store()), quick)[0].rows == 1


def test_after_a_stage_its_alarm_is_off(home, monkeypatch):
    monkeypatch.setenv("CTLEV_STAGE_TIMEOUT_S", "60")
    before = signal.getsignal(signal.SIGALRM)
    quick = {"seconds": 0.0}
    assert slow.run(slow.key(quick, Store()), quick)[0].rows == 1
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0) and signal.getsignal(signal.SIGALRM) == before


@pytest.mark.parametrize("limit", ["0", "-1", "inf", "nan", "soon"])
def test_wrong_limits_are_refused(home, monkeypatch, limit):
    monkeypatch.setenv("CTLEV_STAGE_TIMEOUT_S", limit)
    arguments = {"seconds": 0.0}
    with pytest.raises(DataError, match=f"CTLEV_STAGE_TIMEOUT_S must be a number of seconds above 0, got '{limit}'"):
        slow.run(slow.key(arguments, Store()), arguments)
