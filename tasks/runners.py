"""Which processes compute: the variable CTLEV_RUNNER, and the clusters of Dask, Ray and SLURM that it may ask for.

    CTLEV_RUNNER   shards of a stage    stages of branches
    threads        threads here         processes here        the default
    processes      processes here       processes here
    dask           a local cluster      the same; `dask:tcp://HOST:8786` = one that runs already
    ray            a local cluster      the same; `ray:HOST:6379`, `ray:auto` = one that runs already
    slurm          a job of SLURM       the same, and all other stages; `slurm:4` = four jobs, `slurm:0-8` = as needed

A runner calls a function elsewhere and waits for it; results never depend on which. Machines of a cluster need the same
version of ctlev and the home under the same path, on a disk whose `flock` works across them. A cluster that we started
serves until this process ends, for to start one takes seconds.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import errno
import importlib
import importlib.util
import logging
import os
import pickle
import re
import shutil
import socket
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from ctlev_core.processes import CORES, num_cores
from data_contracts.errors import DataError
from data_contracts.home_folder import bucket_url, home_folder

R = TypeVar("R")
KINDS = ("threads", "processes", "dask", "ray", "slurm")
ALONE = {"CTLEV_WORKERS": "1", "CTLEV_RUNNER": "threads"}
"""Environment of a process that does our work: it starts none of its own."""
ALIKE = ("OMP_NUM_THREADS", "CTLEV_STAGE_TIMEOUT_S", "CTLEV_STAGES_PER_GPU")
"""Environment that is there as it is here, for it decides digits and limits."""
CONNECT_TIMEOUT_S = 60
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""As mallopt names them."""
LOOK_UP_S = 0.5
"""A call to Ray that waits notices within so long that the cluster was closed."""


_PASSING = {
    errno.EAGAIN, errno.EBUSY, errno.ECONNABORTED, errno.ECONNREFUSED, errno.ECONNRESET, errno.EHOSTUNREACH,
    errno.EINTR, errno.EIO, errno.EMFILE, errno.ENETDOWN, errno.ENETRESET, errno.ENETUNREACH,
    errno.ENFILE, errno.ENOLCK, errno.EPIPE, errno.ESTALE, errno.ETIMEDOUT,
}  # fmt: skip
"""Failures of files and networks that another attempt may not meet; a full disk and a missing file stay."""


class WorkerError(RuntimeError):
    """A process that did our work is gone."""


class ProcessesClosedError(WorkerError):
    """Another call failed, or the run was interrupted; says nothing about what went wrong."""


class Runner(Protocol):
    """Something that computes for us; `count` calls at once."""

    count: int

    def call(self, function: Callable[..., R], *arguments: Any) -> R:
        """`function(*arguments)`; what it raises is raised here.

        Raises:
            WorkerError: the process that did it is gone.
        """
        ...

    def release(self) -> None:
        """Nothing more is to be done for now."""
        ...

    def close(self) -> None:
        """End what is being done; calls that wait raise `WorkerError`."""
        ...


def asked_runner() -> tuple[str, str]:
    """Kind and address, from CTLEV_RUNNER; of SLURM the number of jobs.

    Raises:
        DataError: no such kind, an address where none belongs, or a package or program that is not installed.
    """
    asked = os.environ.get("CTLEV_RUNNER", "") or KINDS[0]
    kind, _, address = asked.partition(":")
    if kind not in KINDS or (address and kind not in _PACKAGES):
        known = f"{', '.join(KINDS)}, dask:ADDRESS, ray:ADDRESS or slurm:JOBS"
        raise DataError(f"CTLEV_RUNNER must be one of {known}, got {asked!r}")
    if kind in _PACKAGES and importlib.util.find_spec(_PACKAGES[kind]) is None:
        raise DataError(f"CTLEV_RUNNER={asked} needs the package {_PACKAGES[kind]!r}: pip install -e '.[{kind}]'")
    if kind == "slurm":
        num_jobs(address)
        missing = [program for program in ("sbatch", "squeue", "scancel") if shutil.which(program) is None]
        if missing:
            raise DataError(f"CTLEV_RUNNER={asked} needs SLURM's programs; not on PATH: {', '.join(missing)}")
    return kind, address


def num_jobs(asked: str) -> tuple[int, int]:
    """The fewest and the most jobs of SLURM: `4` and `0-8`, by default one.

    Raises:
        DataError: it is neither.
    """
    found = re.fullmatch(r"(\d{1,6})(?:-(\d{1,6}))?", asked or "1", re.ASCII)
    least, most = (int(found[1]), int(found[2] or found[1])) if found else (0, 0)
    if most < max(least, 1):
        raise DataError(f"CTLEV_RUNNER=slurm:JOBS expects a number of jobs, as slurm:4 or slurm:0-8, got {asked!r}")
    return least, most


def is_elsewhere() -> bool:
    """Do other machines compute, of which this one knows neither memory nor cores?"""
    kind, address = asked_runner()
    return kind == "slurm" or bool(address)


def asked_cluster(count: int) -> Runner | None:
    """The cluster of Dask, Ray or SLURM that is asked for, if one is.

    Args:
        count: processes of a local one.

    Raises:
        DataError: it cannot be started or reached, or is of another kind than needed.
    """
    kind, address = asked_runner()
    if kind not in _PACKAGES:
        return None
    with _starting:
        cluster = _running.get((kind, address))
        if cluster is None:
            try:
                cluster = _running[kind, address] = _cluster_class(kind)(address, count)
            except DataError:
                raise
            except (ValueError, RuntimeError, OSError) as error:  # an address that is none, another version, nobody
                asked = f"{kind}:{address}" if address else kind
                raise DataError(
                    f"CTLEV_RUNNER={asked}: there is no such cluster, or it cannot be used: {error}"
                ) from error
            atexit.register(cluster.close)
        return cluster


def _cluster_class(kind: str) -> Callable[[str, int], Runner]:
    if kind == "slurm":
        from tasks.slurm import Slurm  # which needs this module

        return Slurm
    return {"dask": Dask, "ray": Ray}[kind]


def is_passing(error: BaseException | None) -> bool:
    """Is an error, or what it came from, one that another attempt may not meet?"""
    while error is not None:
        if getattr(error, "passes", False) or (isinstance(error, OSError) and error.errno in _PASSING):
            return True
        error = error.__cause__ or error.__context__
    return False


def reply_to(function: Callable[..., Any], arguments: tuple[Any, ...]) -> bytes:
    """Whether it succeeded, and what it returned or raised, with the traceback as a note."""
    try:
        return pickle.dumps((True, function(*arguments)))
    except Exception as error:
        return reply_with(error)


def reply_with(error: Exception) -> bytes:
    """A failure as a reply; errors that cannot travel become one that says what they said."""
    error.add_note("".join(traceback.format_exception(error)))
    error.passes = is_passing(error)  # pyright: ignore[reportAttributeAccessIssue]  # what it came from does not travel
    try:
        reply = pickle.dumps((False, error))
        pickle.loads(reply)
        return reply
    except Exception:
        told = RuntimeError(f"{type(error).__name__}: {error}")
        told.add_note(error.__notes__[-1])
        told.passes = error.passes  # pyright: ignore[reportAttributeAccessIssue]
        return pickle.dumps((False, told))


def compute_there(environment: dict[str, str], function: Callable[..., Any], arguments: tuple[Any, ...]) -> bytes:
    """In a process of a cluster, which may have started before we did."""
    os.environ.update(environment)
    return reply_to(function, arguments)


def environment_there() -> dict[str, str]:
    """What `compute_there` sets."""
    asked = ALONE | {name: os.environ[name] for name in ALIKE if os.environ.get(name)}
    if not os.environ.get("CTLEV_HOME"):
        return asked
    home = home_folder()
    return asked | {"CTLEV_HOME": bucket_url(home) or str(home)}


def use_memory_freely() -> None:
    """In a worker of Dask, which is set up for many small results rather than for networks.

    At 80 % of its memory it takes no further call until it holds less. What fills it is libraries and freed memory, so
    that it would wait for ever. And its nanny has freed memory given back at once, by MALLOC_TRIM_THRESHOLD_: sampling
    then takes twice as long. The thresholds are those that glibc reaches by itself (mallopt(3)).
    """
    importlib.import_module("distributed").get_worker().memory_manager.memory_pause_fraction = False
    with contextlib.suppress(AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, 32 << 20)
        mallopt(_M_TRIM_THRESHOLD, 64 << 20)


def _compute_in_worker(
    environment: dict[str, str], workers: dict[str, int], function: Callable[..., Any], arguments: tuple[Any, ...]
) -> bytes:
    """`compute_there`, in a worker of Dask, with its share of the machine's cores; `workers` are those of each host."""
    use_memory_freely()
    comm = importlib.import_module("distributed.comm")
    host = comm.get_address_host(importlib.import_module("distributed").get_worker().address)
    os.environ.setdefault(CORES, str(max(num_cores() // workers.get(host, 1), 1)))
    return compute_there(environment, function, arguments)


class _Cluster(ABC):
    """What Dask, Ray and SLURM share."""

    count = 1

    def __init__(self, address: str) -> None:
        self._name = type(self).__name__.lower() + (f":{address}" if address else "")
        self._closed = False

    def call(self, function: Callable[..., R], *arguments: Any) -> R:
        try:
            succeeded, result = pickle.loads(self._reply(function, arguments))
        except Exception as error:
            kind = ProcessesClosedError if self._closed else WorkerError
            raise kind(f"{self._name}: a call was lost: {type(error).__name__}: {error}") from error
        if not succeeded:
            raise result
        return result

    @abstractmethod
    def _reply(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> bytes:
        """What `reply_to` made of the call, in a process of the cluster."""

    def release(self) -> None:
        """Nothing: a cluster takes long to start, and stays for the next calls."""
        return

    def close(self) -> None:
        self._closed = True
        for key in [key for key, cluster in _running.items() if cluster is self]:
            del _running[key]
        atexit.unregister(self.close)


class Dask(_Cluster):
    """A cluster of Dask. Its workers have one thread each: two stages in a process would share random numbers."""

    def __init__(self, address: str, count: int) -> None:
        super().__init__(address)
        self._own_cores = {} if address else {CORES: str(max(num_cores() // count, 1))}
        self._workers: dict[str, int] = {}
        distributed = importlib.import_module("distributed")
        self._own = self._start(address, count)
        self._client = distributed.Client(self._own or address, timeout=CONNECT_TIMEOUT_S)
        self.count = self._count_workers()

    def _start(self, address: str, count: int) -> Any:
        """A cluster of our own, unless there is an address of one that runs elsewhere.

        Raises:
            ValueError: the address is none.
        """
        if address:
            # A client with an address that is none is left half made. Collected while the next one starts, in the same
            # thread, it waits for ever for a lock that the thread holds.
            comm = importlib.import_module("distributed.comm")
            scheme, place = comm.parse_address(address)
            comm.registry.get_backend(scheme)
            if scheme in ("tcp", "tls"):
                comm.parse_host_port(place)
            return None
        return importlib.import_module("distributed").LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address=None,
            silence_logs=logging.CRITICAL,
        )

    def _count_workers(self) -> int:
        self._client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
        threads = list(self._client.nthreads().values())
        host = importlib.import_module("distributed.comm").get_address_host
        self._workers = dict(Counter(host(address) for address in self._client.nthreads()))
        if set(threads) != {1}:
            self.close()
            raise DataError(
                f"{self._name}: workers must have one thread each, got {sorted(threads)}: "
                "dask worker --nworkers N --nthreads 1"
            )
        return len(threads)

    def _reply(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> bytes:
        call = (_compute_in_worker, environment_there() | self._own_cores, self._workers, function, arguments)
        return self._client.submit(*call, pure=False).result()

    def close(self) -> None:
        """End our own cluster, or take leave of one that runs elsewhere, which ends what we asked for."""
        super().close()
        for part in (self._client, self._own):
            if part is not None:
                with contextlib.suppress(Exception):  # it may be gone already
                    part.close()


class Ray(_Cluster):
    """A cluster of Ray; this process is its driver."""

    def __init__(self, address: str, count: int) -> None:
        super().__init__(address)
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        # Ray would hide the GPUs of a machine from calls that reserve none.
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        # A call that comes too late, from a thread that has not heard of the end, would start a cluster nobody ends.
        os.environ["RAY_ENABLE_AUTO_CONNECT"] = "0"
        _wait_for(address)
        ray = self._ray = importlib.import_module("ray")
        own = {} if address else {"num_cpus": count, "include_dashboard": False}
        ray.init(address=address or "local", logging_level=logging.ERROR, log_to_driver=False, **own)
        self._compute = ray.remote(num_cpus=1)(compute_there)
        self.count = max(int(ray.cluster_resources().get("CPU", 1)), 1)
        self._waiting = 0
        self._changed = threading.Condition()

    def _reply(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> bytes:
        with self._changed:
            if self._closed:
                raise WorkerError("the cluster is closed")
            self._waiting += 1
        try:
            # A `get` that waits while another thread shuts Ray down never returns: look up now and then.
            reply = self._compute.remote(environment_there(), function, arguments)
            while not self._ray.wait([reply], timeout=LOOK_UP_S)[0]:
                if self._closed:
                    raise WorkerError("the cluster was closed")
            return self._ray.get(reply)
        finally:
            with self._changed:
                self._waiting -= 1
                self._changed.notify_all()

    def close(self) -> None:
        """As Dask's, once the calls that wait have been told."""
        super().close()
        with self._changed:
            self._changed.wait_for(lambda: not self._waiting, timeout=CONNECT_TIMEOUT_S)
        self._ray.shutdown()


def _wait_for(address: str) -> None:
    """Until somebody answers at HOST:PORT, so long as Dask does; Ray would try for minutes, and say nothing.

    Raises:
        OSError: nobody did, or there is no such host.
        ValueError: there is no such port.
    """
    found = re.fullmatch(r"(?:ray://)?\[?(.+?)]?:(\d+)", address, re.ASCII)
    end = time.monotonic() + CONNECT_TIMEOUT_S
    while found:
        try:
            socket.create_connection((found[1], int(found[2])), timeout=CONNECT_TIMEOUT_S).close()
            return
        except OverflowError as error:
            raise ValueError(f"no port {found[2]}") from error
        except (ConnectionRefusedError, TimeoutError):  # not yet, perhaps
            if time.monotonic() > end:
                raise
            time.sleep(LOOK_UP_S)


_PACKAGES = {"dask": "distributed", "ray": "ray", "slurm": "dask_jobqueue"}
"""Of the clusters: what each needs."""
_running: dict[tuple[str, str], Runner] = {}
_starting = threading.Lock()
"""Branches that begin at the same time start one cluster."""
