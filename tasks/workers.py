"""Calls side by side, and processes that do their work: one a core.

Small networks gain little from a second thread: two trainings with a core each are done almost twice as soon as one
after the other with both. They run in processes of their own, because in one process they would wait for each other's
Python, and draw from each other's random numbers. A process is started when there is work for it, serves until the
calls are done, and ends with the process that started it, whatever ends that.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextvars import ContextVar, copy_context
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

R = TypeVar("R")


END_TIMEOUT_S = 10.0
"""After being asked to end, a process has so long to clear away what it was writing."""


class WorkerError(RuntimeError):
    """A process that did our work is gone."""


class Worker:
    """One process that is handed calls.

    Args:
        position: of its progress bar, lines below the cursor.
        threads: for torch and others.
    """

    def __init__(self, position: int, threads: int) -> None:
        root = str(Path(__file__).resolve().parents[1])
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH", "")])),
            "OMP_NUM_THREADS": str(threads),
            "TQDM_POSITION": str(position),
        }
        command = [sys.executable, "-m", "tasks.workers"]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)

    def call(self, function: Callable[..., R], *arguments: Any) -> R:
        """`function(*arguments)`, there; what it raises is raised here, with the other process's traceback as a note.

        Raises:
            WorkerError: the process ended, for example because memory ran out.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        request = pickle.dumps((function, arguments))  # before anything is written: what cannot travel fails here
        try:
            self._process.stdin.write(request)
            self._process.stdin.flush()
            succeeded, result = pickle.load(self._process.stdout)
        except (EOFError, BrokenPipeError, pickle.UnpicklingError) as error:
            code = self._process.wait()
            ended = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"
            raise WorkerError(
                f"a process that ran stages ended with {ended}; if memory ran out, set CTLEV_WORKERS=1"
            ) from error
        if not succeeded:
            raise result
        return result

    def ask_to_end(self) -> None:
        """What it is doing is given up, and cleared away."""
        self._process.terminate()

    def close(self) -> None:
        """End the process, whatever it is doing, at once where it does not end when asked."""
        self.ask_to_end()
        try:
            self._process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()


class Workers:
    """A few processes; each is started by the first call that finds the others busy."""

    def __init__(self, count: int, threads: int) -> None:
        self._threads = threads
        self._workers: list[Worker | None] = [None] * count
        self._lock = threading.Lock()
        self._closed = False
        self._free: queue.LifoQueue[int] = queue.LifoQueue()
        for number in reversed(range(count)):
            self._free.put(number)

    def call(self, function: Callable[..., R], *arguments: Any) -> R:
        """As `Worker.call`, in the first process that is free."""
        number = self._free.get()
        try:
            with self._lock:
                if self._closed:
                    raise WorkerError("the processes that run stages are closed")
                worker = self._workers[number] = self._workers[number] or Worker(number, self._threads)
            return worker.call(function, *arguments)
        finally:
            self._free.put(number)

    def close(self) -> None:
        """End all processes; calls that wait for one raise `WorkerError`."""
        with self._lock:
            self._closed = True
            workers = [worker for worker in self._workers if worker is not None]
            for worker in workers:
                worker.ask_to_end()
            for worker in workers:
                worker.close()


_current: ContextVar[Workers | None] = ContextVar("ctlev_workers", default=None)


def current_workers() -> Workers | None:
    """The processes of the innermost `together` that we are in."""
    return _current.get()


def num_workers() -> int:
    """The variable CTLEV_WORKERS, else one process for each core that we may use."""
    asked = os.environ.get("CTLEV_WORKERS", "")
    if asked and not (asked.isdecimal() and int(asked) >= 1):
        raise ValueError(f"CTLEV_WORKERS must be a positive number, got {asked!r}")
    return int(asked) if asked else num_cores()


def num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def together(calls: Sequence[Callable[[], R]]) -> list[R]:
    """The results of all calls, which run at the same time; stages within them run in processes of their own.

    Called within itself, it shares the processes that there are. With one core, or one call, everything runs here and
    in order. The first call that raises ends the processes; what they have stored is kept.
    """
    count = min(num_workers(), len(calls)) if current_workers() is None else len(calls)
    if count < 2:
        return [call() for call in calls]
    with _processes() as workers, ThreadPoolExecutor(len(calls)) as threads:
        futures = [threads.submit(copy_context().run, call) for call in calls]
        try:
            done, _ = wait(futures, return_when=FIRST_EXCEPTION)
        except BaseException:
            workers.close()
            raise
        errors = [error for future in done if (error := future.exception()) is not None]
        if errors:
            workers.close()
            # One that only missed its process says less than the one that made it miss it.
            raise min(errors, key=lambda error: isinstance(error, WorkerError))
        return [future.result() for future in futures]


@contextlib.contextmanager
def _processes() -> Iterator[Workers]:
    """The processes there are, or new ones that end here."""
    shared = current_workers()
    if shared is not None:
        yield shared
        return
    count = num_workers()
    workers = Workers(count, max(1, num_cores() // count))
    token = _current.set(workers)
    try:
        yield workers
    finally:
        _current.reset(token)
        workers.close()


def _serve() -> None:
    """Do what comes in on standard input; results go out on what was standard output, prints to standard error."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started us decides
    signal.signal(signal.SIGTERM, _give_up)
    calls: queue.SimpleQueue[tuple[Callable[..., Any], tuple[Any, ...]] | Exception] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(sys.stdin.buffer, calls), daemon=True).start()
    while True:
        try:
            received = calls.get()
            if isinstance(received, Exception):
                raise received
            function, arguments = received
            reply = pickle.dumps((True, function(*arguments)))
        except Exception as error:
            reply = _as_pickle(error)
        replies.write(reply)
        replies.flush()


def _give_up(number: int, frame: object) -> None:
    """Raise where the work is done, so that what is half written is cleared away."""
    raise SystemExit(128 + number)


def _listen(requests: BinaryIO, calls: queue.SimpleQueue[Any]) -> None:
    """Pass requests on, and end the process at once where their source is gone."""
    while True:
        try:
            calls.put(pickle.load(requests))
        except EOFError:
            os._exit(0)
        except Exception as error:
            calls.put(error)


def _as_pickle(error: Exception) -> bytes:
    """A failure as a reply; errors that cannot travel become one that says what they said."""
    error.add_note("".join(traceback.format_exception(error)))
    try:
        reply = pickle.dumps((False, error))
        pickle.loads(reply)
        return reply
    except Exception:
        return pickle.dumps((False, RuntimeError(f"{type(error).__name__}: {error}")))


if __name__ == "__main__":
    try:
        _serve()
    finally:
        # Without waiting for the thread that listens, which reads until its source is gone.
        os._exit(0)
