"""Calls side by side, processes that do their work, one a core, and shards of one stage spread over a runner.

Small networks gain little from a second thread: two trainings with a core each are done almost twice as soon as one
after the other with both. They run in processes of their own, because in one process they would wait for each other's
Python, and draw from each other's random numbers. A process is started when there is work for it, serves until the
calls are done, and ends with the process that started it, whatever ends that. Clusters can take the place of these
processes, and do the shards of a stage (`map_shards`): see `tasks.runners`.
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
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from contextvars import ContextVar, copy_context
from typing import Any, BinaryIO, TypeVar

from ctlev_core.processes import CORES, module_environment, num_cores
from ctlev_core.progress import Progress, Report, current_report, reporting_to
from data_contracts.errors import DataError
from tasks.runners import (
    ALONE,
    ProcessesClosedError,
    Runner,
    WorkerError,
    asked_cluster,
    asked_runner,
    is_elsewhere,
    reply_to,
    reply_with,
)

R = TypeVar("R")
S = TypeVar("S")

WORKERS = "CTLEV_WORKERS"
END_TIMEOUT_S = 10.0
"""After being asked to end, a process has so long to clear away what it was writing."""
MAX_GROUP = 16
"""Shards that travel together; what they return is held until the first of them is wanted."""
WAITING = 2
"""Groups a process that may be ahead of the one that is wanted."""


class Worker:
    """One process that is handed calls.

    Args:
        cores: its share of them.
    """

    def __init__(self, cores: int) -> None:
        environment = {
            **module_environment(os.environ),
            **ALONE,
            CORES: str(cores),
        }
        command = [sys.executable, "-m", "tasks.workers"]
        # Ctrl-C is for us to handle, also while Python starts there.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

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
            while isinstance(received := pickle.load(self._process.stdout), Progress):
                if (report := current_report()) is not None:
                    report(received)
            succeeded, result = received
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

    def __init__(self, count: int) -> None:
        self.count = count
        self._cores = max(1, num_cores() // count)
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
                    raise ProcessesClosedError("the processes that run stages are closed")
                worker = self._workers[number] = self._workers[number] or Worker(self._cores)
            return worker.call(function, *arguments)
        except WorkerError as error:
            if self._closed:  # and the process was asked to end
                raise ProcessesClosedError("the processes that run stages are closed") from error
            raise
        finally:
            self._free.put(number)

    def release(self) -> None:
        """As `close`: to start processes anew takes little."""
        self.close()

    def close(self) -> None:
        """End all processes; calls that wait for one raise `WorkerError`."""
        with self._lock:
            self._closed = True
            workers = [worker for worker in self._workers if worker is not None]
            for worker in workers:
                worker.ask_to_end()
            for worker in workers:
                worker.close()


class Threads:
    """Threads of this process, for shards that leave Python's lock alone most of the time."""

    def __init__(self, count: int) -> None:
        self.count = count

    def call(self, function: Callable[..., R], *arguments: Any) -> R:
        """`function(*arguments)`, in the thread that asks."""
        return function(*arguments)

    def release(self) -> None:
        """There is nothing to release."""

    def close(self) -> None:
        """There is nothing to close: what has begun ends by itself."""


_current: ContextVar[Runner | None] = ContextVar("ctlev_workers", default=None)


def current_workers() -> Runner | None:
    """The processes of the innermost `together` that we are in."""
    return _current.get()


def stage_workers() -> Runner | None:
    """Who runs a stage that spreads no shards: `current_workers`, or SLURM's jobs, also for a stage alone.

    The machine that submits jobs is often one where nothing may be computed, and has no GPU.
    """
    return current_workers() or (asked_cluster(num_workers()) if asked_runner()[0] == "slurm" else None)


def num_workers() -> int:
    """The variable CTLEV_WORKERS, else one process for each core that we may use."""
    asked = os.environ.get(WORKERS, "")
    if asked and not (asked.isdecimal() and int(asked) >= 1):
        raise DataError(f"CTLEV_WORKERS must be a positive number, got {asked!r}")
    return int(asked) if asked else num_cores()


def together(calls: Sequence[Callable[[], R]]) -> list[R]:
    """The results of all calls, which run at the same time; stages within them run in processes of their own.

    Called within itself, it shares the processes that there are. With one core, or one call, everything runs here and
    in order. The first call that raises ends the processes; what they have stored is kept.
    """
    if len(calls) < 2 or (current_workers() is None and not _has_several()):
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
            # One that only missed its process says less than the one that made it miss it, which may take longer to
            # arrive: calls within calls hand it on.
            done, _ = wait(futures)
            errors = [error for future in done if (error := future.exception()) is not None]
            raise min(
                errors, key=lambda error: (isinstance(error, ProcessesClosedError), isinstance(error, WorkerError))
            )
        return [future.result() for future in futures]


def map_shards(
    function: Callable[[S], R], shards: Sequence[S], *, max_group: int = MAX_GROUP
) -> Generator[R, None, None]:
    """`function` of every shard, in their order, computed where CTLEV_RUNNER says.

    Args:
        function: one that can travel: of a module, or a `functools.partial` of such. It depends on the shard alone.
        shards: what to do, such as paths and row numbers; data is better read where it is needed.
        max_group: shards that travel together at most; fewer where each returns much.
    """
    if not is_spread(len(shards)):
        yield from map(function, shards)
        return
    runner = _shard_runner()
    with ThreadPoolExecutor(runner.count) as threads:
        pending: deque[Future[list[R]]] = deque()
        try:
            for group in _groups(shards, runner.count, max_group):
                pending.append(threads.submit(_call_each_on, runner, current_report(), function, group))
                if len(pending) > WAITING * runner.count:
                    yield from pending.popleft().result()
            while pending:
                yield from pending.popleft().result()
        except BaseException:  # also where nobody wants the rest
            for future in pending:
                future.cancel()
            runner.close()
            raise
    runner.release()


def is_spread(num_shards: int) -> bool:
    """Does `map_shards` have so many computed elsewhere or side by side, rather than here and one after the other?"""
    return num_shards > (0 if is_elsewhere() else 1) and _has_several()


def _groups(shards: Sequence[S], count: int, max_group: int = MAX_GROUP) -> Iterator[Sequence[S]]:
    """Consecutive shards, fewer and fewer towards the end, so that all processes end at about the same time."""
    start = 0
    while start < len(shards):
        size = min(max((len(shards) - start) // (2 * count), 1), max_group)
        yield shards[start : start + size]
        start += size


def _call_each_on(runner: Runner, report: Report | None, function: Callable[[S], R], shards: Sequence[S]) -> list[R]:
    """In a thread, which does not know by itself to whom it reports."""
    with reporting_to(report):
        return runner.call(_call_each, function, shards)


def _call_each(function: Callable[[S], R], shards: Sequence[S]) -> list[R]:
    return [function(shard) for shard in shards]


def num_processes() -> int:
    """That `map_shards` has; of a cluster, which is started if it must be, its workers."""
    return getattr(asked_cluster(num_workers()), "count", num_workers())


def _has_several() -> bool:
    """Is more than one process or thread to be had? Of a cluster that runs elsewhere we assume it."""
    return is_elsewhere() or num_workers() > 1


def _shard_runner() -> Runner:
    count = num_workers()
    cluster = asked_cluster(count)
    if cluster is not None:
        return cluster
    return Threads(count) if asked_runner()[0] == "threads" else Workers(count)


@contextlib.contextmanager
def _processes() -> Iterator[Runner]:
    """The processes there are, or new ones that end here, or those of a cluster."""
    shared = current_workers()
    if shared is not None:
        yield shared
        return
    count = num_workers()
    workers = asked_cluster(count) or Workers(count)
    token = _current.set(workers)
    try:
        yield workers
    finally:
        _current.reset(token)
        workers.release()


def _serve() -> None:
    """Do what comes in on standard input; results go out on what was standard output, prints to standard error."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    signal.signal(signal.SIGTERM, _give_up)
    sending = threading.Lock()

    def send(reply: bytes) -> None:
        with sending:
            replies.write(reply)
            replies.flush()

    calls: queue.SimpleQueue[tuple[Callable[..., Any], tuple[Any, ...]] | Exception] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(sys.stdin.buffer, calls), daemon=True).start()
    while True:
        try:
            received = calls.get()
            if isinstance(received, Exception):
                raise received
            with reporting_to(lambda progress: send(pickle.dumps(progress))):
                reply = reply_to(*received)
        except Exception as error:
            reply = reply_with(error)
        send(reply)


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


if __name__ == "__main__":
    try:
        _serve()
    finally:
        # Without waiting for the thread that listens, which reads until its source is gone.
        os._exit(0)
