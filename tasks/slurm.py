"""Jobs of a SLURM cluster as a runner: CTLEV_RUNNER=slurm.

`dask_jobqueue` submits the jobs; each runs workers of Dask, which connect to a scheduler in this process. What a job is
(partition, account, wall time, cores, memory, further `#SBATCH` lines) is said in its configuration, `jobqueue.slurm`.
A worker that is gone has its calls begun again by another, and a job that ended is submitted again while it is needed.
"""

from __future__ import annotations

import contextlib
import math
import os
import shlex
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import dask
import dask_jobqueue
import distributed

from ctlev_core.processes import CORES, module_environment
from data_contracts.errors import DataError
from tasks.runners import Dask, WorkerError, compute_there, environment_there, num_jobs, reply_with, use_memory_freely
from tasks.store import home_folder

NAME = "ctlev"
FOLDER = "slurm"
"""Of a home: logs of jobs, and keys of the connections while they last."""
LOOK_EVERY_S = 5.0
"""The queue is looked at so often."""
SAY_AFTER_S = 30.0
SAY_AGAIN_S = 300.0
MAX_FAILURES = 3
"""So often in a row may jobs end, or be refused, while no worker is connected."""
IDLE_S = 60
"""A job that is more than the fewest ends when it had nothing to do for so long; a new one would wait in the queue."""
TASK_S = 0.5
"""What Dask takes for the duration of a call that it does not know yet."""
ENDED = {
    "BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL", "OUT_OF_MEMORY", "PREEMPTED", "REVOKED",
    "TIMEOUT",
}  # fmt: skip
"""States of a job, as `squeue` names them, after which it does nothing more."""


class _Job(dask_jobqueue.slurm.SLURMJob):
    """A job that keeps what `sbatch` said where it was refused, and knows that it is closed.

    Without that the cluster fails as it closes, and leaves its threads.
    """

    refusal = ""

    async def _submit_job(self, script_filename: str) -> str:
        try:
            return await super()._submit_job(script_filename)
        except (RuntimeError, OSError) as error:
            self.refusal = " ".join(str(error).split())
            raise

    async def close(self) -> None:
        await super().close()
        self.status = distributed.Status.closed


class _Adaptive(distributed.Adaptive):
    """As many jobs as there is work for; Dask's own counts workers, and may end a job of which one worker is busy."""

    async def target(self) -> int:
        """Workers of whole jobs."""
        processes = len(self.cluster.new_spec.get("group", [""]))  # pyright: ignore[reportAttributeAccessIssue]
        return math.ceil(await super().target() / processes) * processes

    async def workers_to_close(self, target: int) -> list[str]:
        """Those of jobs that have nothing to do."""
        workers = self.cluster.scheduler.workers.values()  # pyright: ignore[reportAttributeAccessIssue]
        busy = {_job_of(worker) for worker in workers if worker.processing}
        idle = {worker.name for worker in workers if _job_of(worker) not in busy}
        return [name for name in await super().workers_to_close(target) if name in idle]


class Slurm(Dask):
    """Jobs with workers of Dask, one thread each."""

    def _start(self, address: str, count: int) -> Any:
        """A scheduler here, and the fewest jobs that are asked for.

        Args:
            address: number of jobs.
            count: not used: `processes` of the configuration counts.
        """
        self._jobs = num_jobs(address)
        self._ended = threading.Event()
        self._failure = ""
        self._homes: dict[Path, IO[bytes]] = {}
        self._guard = threading.Lock()
        given = {name: _configured(name) for name in ("cores", "processes", "memory", "job-cpu")}
        self._cores, self._processes = _cores_and_processes(given)
        folder = str(_folder(home_folder()))
        environment = module_environment({"PYTHONPATH": os.environ.get("PYTHONPATH", "")})
        try:
            cluster = dask_jobqueue.SLURMCluster(  # pyright: ignore[reportPrivateImportUsage]
                name=NAME,
                job_cls=_Job,  # pyright: ignore[reportArgumentType]
                cores=self._processes,  # of Dask: a thread each
                processes=self._processes,
                job_cpu=given["job-cpu"] or self._cores,
                log_directory=_configured("log-directory") or folder,
                # Workers run what they are told, and other users can reach them: TLS, with keys that only we can read.
                security=True,
                shared_temp_directory=_configured("shared-temp-directory") or folder,
                scheduler_options={
                    "dashboard_address": "127.0.0.1:0",
                    "dashboard": False,
                    **_configured("scheduler-options"),
                },
                job_script_prologue=[
                    *(f"export {name}={shlex.quote(value)}" for name, value in environment.items()),
                    *_configured("job-script-prologue"),
                ],
            )
        except (ValueError, TypeError, RuntimeError) as error:
            raise DataError(f"CTLEV_RUNNER=slurm, configuration jobqueue.slurm: {error}") from error
        cluster.adapt(
            _Adaptive,
            minimum_jobs=self._jobs[0],
            maximum_jobs=self._jobs[1],
            interval="1s",
            wait_count=IDLE_S,
            target_duration=TASK_S,  # a worker for each call that waits: calls take minutes, not milliseconds
            worker_key=_job_of,
        )
        return cluster

    def _count_workers(self) -> int:
        """As many as there may be: jobs can wait in the queue for hours, and calls with them."""
        threading.Thread(target=self._watch, daemon=True).start()
        return self._jobs[1] * self._processes

    def _reply(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> bytes:
        home = home_folder()
        environment = {CORES: str(self._cores // self._processes), **environment_there(), "CTLEV_HOME": str(home)}
        call = (_compute_if_seen, self._witness(home), environment, function, arguments)
        try:
            return self._client.submit(*call, pure=False).result()
        except Exception as error:
            raise WorkerError(self._failure) if self._failure else error from error

    def _witness(self, home: Path) -> str:
        """A file in the home with a name that is nowhere else."""
        with self._guard:
            if home not in self._homes:
                self._homes[home] = tempfile.NamedTemporaryFile(prefix="seen-", dir=_folder(home))  # noqa: SIM115
            return self._homes[home].name

    def _watch(self) -> None:
        """Have jobs that ended submitted again, say what is waited for, and give up where jobs only fail.

        Dask itself notices the end of a job only by the loss of its worker, and not if it has several, or none yet.
        """
        failures, say_at = 0, time.monotonic() + SAY_AFTER_S
        while not self._ended.wait(LOOK_EVERY_S):
            jobs = dict(self._own.workers)  # before the queue: one that is submitted in between is in neither
            queue = _queue()
            if queue is None:  # SLURM is busy, or starts anew; jobs go on
                continue
            ended = {name: job for name, job in jobs.items() if queue.get(job.job_id, ("COMPLETED", ""))[0] in ENDED}
            for name, job in ended.items():
                self._own.loop.add_callback(self._forget, name, job)
            if self._own.observed:
                failures, say_at = 0, time.monotonic() + SAY_AFTER_S
                continue
            failures += bool(ended)
            if failures == MAX_FAILURES:
                self._fail(list(ended.values())[-1], queue)
            if jobs and time.monotonic() > say_at:
                say_at = time.monotonic() + SAY_AGAIN_S
                waiting = [f"{job.job_id} {' '.join(queue.get(job.job_id, ()))}" for job in jobs.values()]
                print(f"{self._name}: waits for a job to start: {', '.join(waiting)}", file=sys.stderr)

    def _forget(self, name: str, job: Any) -> None:
        """In the thread of the cluster, which within a second submits what it misses."""
        if self._own.workers.get(name) is job:
            del self._own.workers[name]
            job.status = distributed.Status.closed

    def _fail(self, job: _Job, queue: dict[str, tuple[str, str]]) -> None:
        """End calls that wait, with the reason."""
        self._failure = f"{MAX_FAILURES} times jobs ended, or were refused, before a worker connected; the last: "
        if job.refusal:
            self._failure += job.refusal
        else:
            state = " ".join(queue.get(str(job.job_id), ("not in the queue",)))
            self._failure += f"job {job.job_id}, {state}; {_last_line(job)}"
        self.close()

    def close(self) -> None:
        """Cancel the jobs; calls that wait raise `WorkerError`."""
        self._ended.set()
        super().close()
        # dask_jobqueue removes its files of keys only when the cluster object is collected.
        keys = [vars(self._own).pop(f"_job_{name}", None) for name in ("ca_file", "cert", "key")]
        with self._guard:
            for file in [*self._homes.values(), *filter(None, keys)]:
                with contextlib.suppress(OSError):
                    file.close()
            self._homes.clear()


def _cores_and_processes(given: dict[str, Any]) -> tuple[int, int]:
    """Cores of a job, and how many workers share them, by default one a core."""
    cores = given["cores"]
    if cores is None or given["memory"] is None:
        raise DataError(
            "CTLEV_RUNNER=slurm needs the cores and the memory of a job: DASK_JOBQUEUE__SLURM__CORES=4 "
            "DASK_JOBQUEUE__SLURM__MEMORY=16GB, or jobqueue.slurm in ~/.config/dask/jobqueue.yaml"
        )
    processes = cores if given["processes"] is None else given["processes"]
    if not all(type(number) is int and number >= 1 for number in (cores, processes)) or processes > cores:
        raise DataError(
            "configuration jobqueue.slurm: expected whole numbers 1 <= processes <= cores, "
            f"got processes {processes!r}, cores {cores!r}"
        )
    return cores, processes


def _folder(home: Path) -> Path:
    folder = home / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _compute_if_seen(
    witness: str, environment: dict[str, str], function: Callable[..., Any], arguments: tuple[Any, ...]
) -> bytes:
    """In a job. One that sees another home would compute everything anew, into a folder that nobody reads."""
    use_memory_freely()
    if not os.path.exists(witness):
        home = Path(witness).parents[1]
        error = DataError(
            f"job {os.environ.get('SLURM_JOB_ID', '?')} on {socket.gethostname()} does not see the home {home}; "
            "CTLEV_HOME must be a folder that all nodes share, under the same path"
        )
        return reply_with(error)
    return compute_there(environment, function, arguments)


def _job_of(worker: Any) -> str:
    """Name of the job that a worker of Dask is in: `ctlev-3` of `ctlev-3-1`, or of `ctlev-3` where it is alone."""
    return "-".join(worker.name.split("-")[:2])


def _configured(name: str) -> Any:
    return dask.config.get(f"jobqueue.slurm.{name}")  # pyright: ignore[reportPrivateImportUsage]


def _queue() -> dict[str, tuple[str, str]] | None:
    """State and reason of each of our jobs, by its number; None where `squeue` does not answer."""
    command = ["squeue", "--me", "--noheader", "--states=all", "--format=%A %T %r"]
    try:
        finished = subprocess.run(command, capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return None
    if finished.returncode:
        return None
    rows = [line.split(maxsplit=2) for line in finished.stdout.splitlines()]
    return {row[0]: (row[1], f"({row[2]})") for row in rows if len(row) == 3}


def _last_line(job: _Job) -> str:
    """Of what a job wrote to standard error, with the file's path."""
    path = Path(job.log_directory, f"{job.job_name}-{job.job_id}.err")
    try:
        lines = path.read_text(errors="replace").split("\n")
    except OSError:
        return f"no {path.name}: do all nodes see {path.parent}, under the same path?"
    return f"{path}: " + next((line.strip() for line in reversed(lines) if line.strip()), "empty")
