"""Calls side by side, and the processes that do their work."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from ctlev_core.processes import num_cores
from data_contracts.errors import DataError
from tasks.workers import Worker, WorkerError, Workers, current_workers, together

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(autouse=True)
def two_processes_that_know_this_file(monkeypatch):
    monkeypatch.setenv("CTLEV_WORKERS", "2")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))


def elsewhere(function, *arguments):
    """A call that does its work in one of the processes."""
    pool = current_workers()
    assert pool is not None
    return pool.call(function, *arguments)


def test_results_come_in_the_order_of_the_calls_and_from_other_processes():
    found = together([lambda number=number: (number, elsewhere(os.getpid)) for number in range(6)])
    assert [number for number, _ in found] == list(range(6))
    processes = {process for _, process in found}
    assert 1 <= len(processes) <= 2 and os.getpid() not in processes
    assert current_workers() is None


def test_calls_within_calls_share_the_processes():
    def outer():
        return together([lambda: elsewhere(os.getpid), lambda: elsewhere(os.getpid), lambda: elsewhere(os.getpid)])

    found = together([outer, outer])
    assert len({process for inner in found for process in inner}) <= 2


def test_one_call_or_one_core_needs_no_process(monkeypatch):
    assert together([current_workers]) == [None]
    monkeypatch.setenv("CTLEV_WORKERS", "1")
    order = []
    together([lambda number=number: order.append((number, current_workers())) for number in range(3)])
    assert order == [(0, None), (1, None), (2, None)]
    monkeypatch.setenv("CTLEV_WORKERS", "none")
    with pytest.raises(ValueError, match="CTLEV_WORKERS must be a positive number, got 'none'"):
        together([lambda: None, lambda: None])


def test_an_error_keeps_its_type_and_its_message_and_says_where_it_was_raised():
    # int("x") raises there; the note is the traceback of that process.
    with pytest.raises(ValueError, match="invalid literal for int") as error:
        together([lambda: elsewhere(int, "x"), lambda: elsewhere(time.sleep, 30)])
    assert "in reply_to" in "".join(error.value.__notes__)


def test_the_first_error_ends_the_other_calls_at_once():
    started = time.monotonic()
    with pytest.raises(DataError, match="wrong"):
        together([lambda: elsewhere(time.sleep, 60), lambda: elsewhere(raise_data_error)])
    assert time.monotonic() - started < 50


@pytest.mark.parametrize(
    ("ends", "said"), [("raise_data_error", "wrong"), ("kill_self", "signal SIGKILL; if memory ran out")]
)
def test_the_error_is_told_that_ended_the_others_also_when_it_takes_longer_to_arrive(monkeypatch, ends, said):
    """As in a flow of flows: the branches beside it have lost their processes by then, and say so sooner."""

    monkeypatch.setenv("CTLEV_WORKERS", "4")

    def branch():
        try:
            return together([lambda: elsewhere(globals()[ends]), lambda: elsewhere(time.sleep, 60)])
        finally:
            time.sleep(3)

    with pytest.raises((DataError, WorkerError), match=said):
        together([branch, *[lambda: elsewhere(time.sleep, 60)] * 2])


def test_a_process_that_is_closed_clears_away_what_it_was_writing(tmp_path):
    pool = Workers(1)
    thread = threading.Thread(target=lambda: suppress_worker_error(pool, tmp_path), daemon=True)
    thread.start()
    deadline = time.monotonic() + 60
    while not (tmp_path / "half").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    pool.close()
    thread.join(30)
    assert not thread.is_alive() and not (tmp_path / "half").exists()


def suppress_worker_error(pool, folder):
    with pytest.raises(WorkerError):
        pool.call(write_slowly, folder)


def write_slowly(folder):
    (folder / "half").mkdir()
    try:
        time.sleep(600)
    finally:
        (folder / "half").rmdir()


def raise_data_error():
    time.sleep(1)
    raise DataError("wrong")


class Unpicklable(Exception):
    """Its arguments are not those it is made of."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


def raise_unpicklable():
    raise Unpicklable("this", "that")


def test_an_error_that_cannot_travel_says_what_it_said():
    pool = Workers(1)
    try:
        with pytest.raises(RuntimeError, match="Unpicklable: this and that"):
            pool.call(raise_unpicklable)
        assert pool.call(int, "7") == 7  # the process serves on
    finally:
        pool.close()


def test_a_process_that_is_killed_is_an_error_that_says_so():
    pool = Workers(1)
    try:
        with pytest.raises(WorkerError, match="ended with signal SIGKILL; if memory ran out, set CTLEV_WORKERS=1"):
            pool.call(kill_self)
    finally:
        pool.close()
    with pytest.raises(WorkerError, match="closed"):
        pool.call(os.getpid)


def test_ctrl_c_is_left_to_us_from_the_start_of_a_process(capfd):
    """Python's own start-up would end with a traceback."""
    worker = Worker(1)
    try:
        for _ in range(40):
            os.kill(worker._process.pid, signal.SIGINT)
            time.sleep(0.05)
        assert worker.call(os.getpid) == worker._process.pid
    finally:
        worker.close()
    assert "Traceback" not in capfd.readouterr().err


def test_what_cannot_travel_fails_here_and_the_process_serves_on():
    pool = Workers(1)
    try:
        with pytest.raises((AttributeError, TypeError), match=r"pickle|local object"):
            pool.call(lambda: None)
        assert pool.call(int, "7") == 7
    finally:
        pool.close()


def kill_self():
    os.kill(os.getpid(), signal.SIGKILL)


def test_prints_do_not_disturb_the_replies(capfd):
    pool = Workers(1)
    try:
        assert pool.call(print, "a line") is None
        assert pool.call(int, "7") == 7
    finally:
        pool.close()
    assert "a line" in capfd.readouterr().err


PARENT = """
import os, threading, time
from tasks.workers import Workers
pool = Workers(1)
print(pool.call(os.getpid), flush=True)
threading.Thread(target=pool.call, args=(time.sleep, 600), daemon=True).start()
time.sleep(600)
"""


def test_a_process_ends_with_the_one_that_started_it_even_by_sigkill():
    parent = subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        child = int(parent.stdout.readline())
        assert is_running(child)
    finally:
        parent.kill()
        parent.wait()
    deadline = time.monotonic() + 20
    while is_running(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not is_running(child)


def is_running(process):
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_cores_are_those_that_may_be_used():
    assert 1 <= num_cores() <= (os.cpu_count() or 1)
