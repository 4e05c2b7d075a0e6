"""A stage is a cached task: a plain function that turns manifests into one new manifest.

    @stage(version=1, schema=tables.FRAMES)
    def encode(out: Output, recordings: Manifest, *, encoding: EncodingChoice) -> pa.Table: ...

    frames = encode(recordings_ref, encoding=experiment.encoding)      # a ManifestRef

Calling a stage computes its key from everything that can change its result: its name and version, the plug-ins it uses
with their versions and options, seeds, the keys of its inputs and the digests of its raw files. Keys need no data, so
the whole plan of an experiment, with every key, is known before anything runs. An artefact made from inputs whose
content has since changed (a training run that was repeated on another machine, say) is recognised by the digests in its
provenance record and made anew. Paths, devices and worker counts never enter a key.

This is the only file that knows about caching.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib
import importlib.metadata
import inspect
import json
import math
import os
import platform
import resource
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any, ParamSpec, Protocol, TypeVar

import numpy as np
import pyarrow as pa
from pydantic import BaseModel

from ctlev_core import plugins
from ctlev_core.cpu_precision import computed_in
from ctlev_core.plugin_contracts import PluginWithFiles
from ctlev_core.processes import asked_threads, begin_memory_peak, few_threads, memory_peak_mib, num_cores
from ctlev_core.progress import Progress, current_report, reporting_to
from ctlev_core.provenance.raw_file_digests import digest_raw_files
from data_contracts.arrays import save_compressed
from data_contracts.compressed_arrays import SUFFIX, CompressedArrayWriter
from data_contracts.config import Choice, cache_material
from data_contracts.errors import DataError, shortened
from data_contracts.file_lists import files_of
from data_contracts.manifest import ManifestRef, read_manifest, write_manifest
from data_contracts.table_writer import TableWriter
from data_contracts.tables import TableSchema
from tasks.gpus import GpuNeed, gpu_need, gpus_held, stages_per_gpu
from tasks.prefect_runs import num_retries, run_as_task
from tasks.runners import Runner, asked_runner
from tasks.store import Store
from tasks.workers import current_workers, num_workers, stage_workers, together

P = ParamSpec("P")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)
UPSTREAM_FILE = "upstream.json"
"""In the work folder of a stage: the digests of its inputs, by their keys."""
TIMEOUT = "CTLEV_STAGE_TIMEOUT_S"
"""Environment: seconds that the work of one stage may take; none = any."""
RawFiles = Callable[[dict[str, Any]], Sequence[tuple[str, Path]]]
"""From the stage's arguments to (name, path) of the raw files it will read; the names enter the key too."""
Spreads = Callable[[dict[str, Any]], bool]
"""From the stage's arguments to whether this process deals its work out."""


@dataclasses.dataclass
class PlannedStage:
    """One line of a plan."""

    stage: str
    label: str
    key: str
    cached: bool
    arguments: dict[str, Any] = dataclasses.field(default_factory=dict, repr=False)
    """As in the record of the artefact."""
    given: dict[str, Any] = dataclasses.field(default_factory=dict, repr=False)
    """As the stage gets them."""


class Watcher(Protocol):
    """Is told of stages while they run, from several threads."""

    def progressed(self, key: str, progress: Progress) -> None:
        """A stage has begun, or is so far."""
        ...

    def ended(self, key: str, rows: int, *, cached: bool) -> None:
        """A stage has made its table of so many rows, or found it."""
        ...


@dataclasses.dataclass
class _Plan:
    rows: list[PlannedStage] = dataclasses.field(default_factory=list)
    digests: dict[str, str] = dataclasses.field(default_factory=dict)
    """By key, of what is there."""
    changed: set[str] = dataclasses.field(default_factory=set)
    """Keys of what is there, but was made from inputs of other content."""


_plan: ContextVar[_Plan | None] = ContextVar("ctlev_plan", default=None)
_watcher: ContextVar[Watcher | None] = ContextVar("ctlev_watcher", default=None)
_in_one_run: ContextVar[bool] = ContextVar("ctlev_in_one_run", default=False)
_being_made: dict[str, threading.Lock] = {}
"""By key. Locks of this process, before those of the store, which hold against all."""


@contextlib.contextmanager
def planning() -> Iterator[list[PlannedStage]]:
    """Inside this block stages and flows only note what they would do; nothing is computed or written.

    Raises:
        DataError: a variable of the environment that stages read is wrong, so that nothing could be run either.
    """
    for read in (asked_runner, num_cores, num_workers, num_retries, time_limit_s, stages_per_gpu):
        read()
    plan = _Plan()
    token = _plan.set(plan)
    try:
        yield plan.rows
    finally:
        _plan.reset(token)


def is_planning() -> bool:
    """Are stages and flows only noting what they would do?"""
    return _plan.get() is not None


@contextlib.contextmanager
def in_one_run() -> Iterator[None]:
    """Inside this block a flow's stages belong to the run it is called from, one after the other.

    For runs that find everything cached: there, runs of their own for inner flows, and of tasks for stages, take longer
    than what is in them. The plan that such a run publishes lists its stages; one that is gone by now is a task.
    """
    token = _in_one_run.set(True)
    try:
        yield
    finally:
        _in_one_run.reset(token)


@contextlib.contextmanager
def watched_by(watcher: Watcher) -> Iterator[None]:
    """Inside this block a watcher is told of every stage that runs."""
    token = _watcher.set(watcher)
    try:
        yield
    finally:
        _watcher.reset(token)


class AnyFlow(Protocol[P, R_co]):
    """A flow: called, it is a run of its own; `fn` is the function alone."""

    @property
    def fn(self) -> Callable[P, R_co]:
        """What the flow does."""
        ...

    def __call__(self, *arguments: P.args, **settings: P.kwargs) -> R_co:
        """Run it."""
        ...


def call_flow(flow: AnyFlow[P, R], *arguments: P.args, **settings: P.kwargs) -> R:
    """Call a Prefect flow, or only its wiring while planning and `in_one_run`."""
    return (flow.fn if _plan.get() is not None or _in_one_run.get() else flow)(*arguments, **settings)


def call_together(*calls: Callable[[], Any]) -> list[Any]:
    """The results of all calls, side by side where there are cores; in order while planning and `in_one_run`."""
    return [call() for call in calls] if _plan.get() is not None or _in_one_run.get() else together(calls)


class Output:
    """Where a stage writes. Files in `folder` become the artefact; files in `work` survive a killed run."""

    def __init__(self, folder: Path, work: Path) -> None:
        self.folder = folder
        self.work = work

    def write_array(self, name: str, array: np.ndarray) -> None:
        """Attach an array, compressed; row i belongs to row i of the manifest."""
        save_compressed(self.folder / f"{name}{SUFFIX}", array)

    def open_array(self, name: str) -> CompressedArrayWriter:
        """The same, to be written row by row within a `with` block."""
        return CompressedArrayWriter(self.folder / f"{name}{SUFFIX}")

    def write_table(self, table: pa.Table, schema: TableSchema) -> None:
        """Attach a second table beside the manifest."""
        with self.open_table(schema) as written:
            written.append(table)

    def open_table(self, schema: TableSchema) -> TableWriter:
        """The same, to be written as rows come within a `with` block."""
        return TableWriter(self.folder, schema)

    def share(self, finished: Path, name: str) -> None:
        """Attach a file of the work folder, which stays there: a run that is killed finds it again."""
        target = self.folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(finished, target)
        except OSError:  # not every file system has links
            shutil.copyfile(finished, target)


class Stage:
    """See the module's docstring. Made by the decorator `stage`."""

    def __init__(
        self,
        function: Callable[..., pa.Table],
        version: int,
        schema: TableSchema,
        raw_files: RawFiles | None,
        readers: Sequence[str] = (),
        optional: Sequence[str] = (),
        aside: Sequence[str] = (),
        spreads: bool | Spreads = False,
    ) -> None:
        self.function = function
        self.name = function.__name__
        self.version = version
        self.schema = schema
        self.raw_files = raw_files
        self.readers = readers
        self.optional = optional
        self.aside = aside
        self.spreads = spreads
        self.signature = inspect.signature(function)
        self.__doc__ = function.__doc__

    def __call__(self, *inputs: Any, label: str = "", **settings: Any) -> ManifestRef:
        """Plan or run the stage.

        Args:
            inputs: manifest references, or lists or dataclasses of them, in the order of the function's parameters
                after `out`.
            label: shown in the plan and in Prefect; changes nothing.
            settings: the function's keyword parameters.
        """
        bound = self.signature.bind(None, *inputs, **settings)
        bound.apply_defaults()
        arguments = dict(list(bound.arguments.items())[1:])
        self.check(arguments)
        store = Store()
        materials = self._materials(arguments)
        key = self._key(arguments, materials, store)
        label = f"{self.name}: {label}" if label else self.name
        plan = _plan.get()
        if plan is not None:
            cached = self._is_cached(plan, store, key, arguments)
            plan.rows.append(PlannedStage(self.name, label, key, cached, materials, arguments))
            return ManifestRef(key=key, path=store.folder(self.name, key))
        found = self.find(key, arguments) if _in_one_run.get() else None
        return found or run_as_task(self.name, label, functools.partial(self.run, key, arguments))

    def is_made(self, *inputs: Any, **settings: Any) -> bool:
        """Is the artefact there already, which a call with these arguments would make?"""
        bound = self.signature.bind(None, *inputs, **settings)
        bound.apply_defaults()
        arguments = dict(list(bound.arguments.items())[1:])
        store = Store()
        key, plan = self.key(arguments, store), _plan.get()
        if plan is not None:
            return self._is_cached(plan, store, key, arguments)
        return store.find(self.name, key, self._upstream(arguments)) is not None

    def check(self, arguments: dict[str, Any]) -> None:
        """Raise `DataError` where the settings do not go together: where a stage is planned, and where it is run."""

    def _is_cached(self, plan: _Plan, store: Store, key: str, arguments: dict[str, Any]) -> bool:
        """Will a run find the artefact?

        Digests of inputs that are to be made are not known; that they will be what they were is taken for granted,
        unless those were made from changed inputs themselves.
        """
        upstream = {name: plan.digests.get(name, digest) for name, digest in self._upstream(arguments).items()}
        known = upstream if all(upstream.values()) else None
        digest = store.held_digest(self.name, key, known)
        if digest is not None and plan.changed.isdisjoint(upstream):
            plan.digests[key] = digest
            return True
        if digest is not None or (known is not None and store.held_digest(self.name, key) is not None):
            plan.changed.add(key)
        return False

    def key(self, arguments: dict[str, Any], store: Store) -> str:
        """The cache key: 32 hexadecimal digits of a SHA-256."""
        return self._key(arguments, self._materials(arguments), store)

    def _materials(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """What of each argument decides the result; of an optional one that is not given nothing."""
        given = {name: value for name, value in arguments.items() if value is not None or name not in self.optional}
        return {name: _material(value) for name, value in given.items() if name not in self.aside}

    def _upstream(self, arguments: dict[str, Any]) -> dict[str, str]:
        """Digests of the inputs, by their keys."""
        values = [value for name, value in arguments.items() if name not in self.aside]
        return {ref.key: ref.digest for value in values for ref in _references(value)}

    def _key(self, arguments: dict[str, Any], materials: dict[str, Any], store: Store) -> str:
        material = self._versions_of(materials)
        if self.raw_files is not None:
            material["raw_files"] = digest_raw_files(self.raw_files(arguments), store.home)
            if material["raw_files"]:
                material |= {kind: plugins.versions(kind) for kind in self.readers}
        return hashlib.sha256(json.dumps(material, sort_keys=True).encode()).hexdigest()[:32]

    def _versions_of(self, materials: dict[str, Any]) -> dict[str, Any]:
        """What of the code and the arguments decides the result, beside raw files and what reads them."""
        return {"stage": self.name, "version": self.version, "table": self.schema.version, "arguments": materials}

    def check_versions(self, arguments: dict[str, Any], asked: dict[str, Any]) -> None:
        """Raise `DataError` where what `_versions_of` says here is not what was asked for by another machine."""
        found = self._versions_of(self._materials(arguments))
        for name in (name for name, value in found.items() if value != asked.get(name)):
            raise DataError(
                f"{self.name}: {socket.gethostname()} has another version of ctlev: expected "
                f"{shortened(repr({name: asked.get(name)}), 300)}, got {shortened(repr({name: found[name]}), 300)}"
            )

    def run(self, key: str, arguments: dict[str, Any]) -> tuple[ManifestRef, bool]:
        """Return the artefact and whether it was already there."""
        watcher = _watcher.get()
        if watcher is None:
            return self._run(key, arguments)
        with reporting_to(functools.partial(watcher.progressed, key)):
            ref, cached = self._run(key, arguments)
        watcher.ended(key, ref.rows, cached=cached)
        return ref, cached

    def _run(self, key: str, arguments: dict[str, Any]) -> tuple[ManifestRef, bool]:
        found = self.find(key, arguments)
        if found is not None:
            return found, True
        workers = self._workers(arguments)
        if workers is not None:
            # Whoever else wants this artefact waits here, and leaves the processes to those who have work for them.
            with _being_made.setdefault(key, threading.Lock()):
                found = self.find(key, arguments)
                if found is not None:
                    return found, True
                asked = self._versions_of(self._materials(arguments))
                ref, cached = workers.call(_run_stage, self.function.__module__, self.name, key, arguments, asked)
                return Store().here(ref), cached
        store, upstream = Store(), self._upstream(arguments)
        with store.lock(key, f"artefact {self.name}/{key}"):
            # Another process may have just finished it.
            found = store.find(self.name, key, upstream, make_room=True)
            if found is not None:
                return found, True
            return self._compute(store, key, arguments, upstream), False

    def _workers(self, arguments: dict[str, Any]) -> Runner | None:
        """Who runs it as a whole; None = this process."""
        if self._deals_out(arguments):
            return None
        return current_workers() if self.spreads is True else stage_workers()

    def _deals_out(self, arguments: dict[str, Any]) -> bool:
        return callable(self.spreads) and self.spreads(arguments)

    def find(self, key: str, arguments: dict[str, Any]) -> ManifestRef | None:
        """The artefact, if it is there and was made from inputs of the same content."""
        return Store().find(self.name, key, self._upstream(arguments))

    def _compute(self, store: Store, key: str, arguments: dict[str, Any], upstream: dict[str, str]) -> ManifestRef:
        if (report := current_report()) is not None:
            report(Progress())  # until now it waited for its inputs, a free process, or another run
        folder, work = store.temporary_folder(key), store.work_folder(key)
        # We hold the lock of this key: whatever lies here was left by a process that died.
        shutil.rmtree(folder, ignore_errors=True)
        begin_memory_peak()
        started, wall, cpu = time.time(), time.perf_counter(), _cpu_seconds()
        try:
            folder.mkdir(parents=True)
            _prepare_work(work, upstream)
            opened = {name: _opened(value, store) for name, value in arguments.items()}
            # What is spread holds GPUs where it is computed.
            need = GpuNeed() if self._deals_out(arguments) else gpu_need(arguments)
            with few_threads(), gpus_held(need, self.name), _time_limit(self.name):
                table = self.function(Output(folder, work), **opened)
            self._check_unchanged(key, arguments, store)
            write_manifest(folder, table, self.schema)
            record = {
                "stage": self.name,
                "stage_version": self.version,
                "key": key,
                "arguments": self._materials(arguments),
                "upstream": upstream,
                "rows": table.num_rows,
                "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(started)),
                "wall_seconds": round(time.perf_counter() - wall, 3),
                "cpu_seconds": round(_cpu_seconds() - cpu, 3),
                # While the stage ran, which is what decides whether a machine is large enough.
                "process_peak_memory_mib": round(memory_peak_mib(), 1),
                "versions": _versions(),
            }
            return store.publish(self.name, key, folder, record)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def _check_unchanged(self, key: str, arguments: dict[str, Any], store: Store) -> None:
        """Raise where raw files have changed since the key was made of them: what was read is of two kinds."""
        if self.raw_files is not None and self.key(arguments, store) != key:
            shutil.rmtree(store.work_folder(key), ignore_errors=True)
            raise DataError(f"{self.name}: raw files have changed while they were read; run again to read them anew")


def _prepare_work(work: Path, upstream: dict[str, str]) -> None:
    """Make the folder of resumable state; what a killed run left there of inputs of other content is deleted."""
    note, content = work / UPSTREAM_FILE, json.dumps(upstream, sort_keys=True).encode()
    if note.exists():
        if note.read_bytes() == content:
            return  # written again on a full disk it would be lost, and with it what it vouches for
        shutil.rmtree(work)
    work.mkdir(parents=True, exist_ok=True)
    note.write_bytes(content)


class StageTimeoutError(RuntimeError):
    """A stage took longer than CTLEV_STAGE_TIMEOUT_S allows."""


@contextlib.contextmanager
def _time_limit(name: str) -> Iterator[None]:
    """Raise `StageTimeoutError` inside this block when its time is up; in the main thread of a process alone.

    Stages of branches run in processes of their own, and those of scripts in the script's main thread.
    """
    seconds = time_limit_s()
    if seconds is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    told = f"{name} took longer than {seconds:g} s ({TIMEOUT}); its checkpoints are kept"
    expired: list[float] = []

    def expire(number: int, frame: object) -> None:
        expired.append(seconds)
        raise StageTimeoutError(told)

    before = signal.signal(signal.SIGALRM, expire)
    signal.setitimer(signal.ITIMER_REAL, min(seconds, threading.TIMEOUT_MAX))
    try:
        yield
    except Exception as error:
        if not expired or isinstance(error, StageTimeoutError):
            raise
        raise StageTimeoutError(told) from error  # what was interrupted may say that a file is damaged
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    if expired:  # and may have taken it for an error that it can do without
        raise StageTimeoutError(told)


def time_limit_s() -> float | None:
    """The variable CTLEV_STAGE_TIMEOUT_S; None where it is not set.

    Raises:
        DataError: it is no number of seconds above 0.
    """
    asked = os.environ.get(TIMEOUT, "")
    if not asked:
        return None
    try:
        seconds = float(asked)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < math.inf:
        raise DataError(f"{TIMEOUT} must be a number of seconds above 0, got {asked!r}")
    return seconds


def numbered(label: str, number: int) -> str:
    """The label of one of several alike; the first has none."""
    return f"{label}, {number + 1}" if number else label


def input_files_of(argument: str) -> RawFiles:
    """For `raw_files`: the files from outside the store that the plug-in chosen by an argument reads, if any.

    Of a folder that is every file in it, named by its path inside.
    """

    def find(arguments: dict[str, Any]) -> list[tuple[str, Path]]:
        plugin = plugins.load_options(arguments[argument])
        files = plugin.module.input_files(plugin.options) if isinstance(plugin.module, PluginWithFiles) else []
        return [pair for path in files for pair in (files_of([path]) if path.is_dir() else [(path.name, path)])]

    return find


def stage(
    *,
    version: int,
    schema: TableSchema,
    raw_files: RawFiles | None = None,
    readers: Sequence[str] = (),
    optional: Sequence[str] = (),
    aside: Sequence[str] = (),
    spreads: bool | Spreads = False,
) -> Callable[[Callable[..., pa.Table]], Stage]:
    """Make a function a stage.

    Args:
        version: raise it when the function's output changes for the same inputs.
        schema: of the table the function returns.
        raw_files: names the files from outside the store that the stage reads.
        readers: kinds of plug-ins that read them, found by what is in the files: one that is mended reads all anew.
        optional: parameters that leave the key as it is where they are None: what is stored without them stays valid.
        aside: parameters that spare work and change no result: they are in neither key nor record.
        spreads: most of its work is in shards (`map_shards`), which go to a cluster one by one. A function of the
            arguments: whether it is for them; it then is this process that deals them out, whoever runs other stages.
    """
    return lambda function: Stage(function, version, schema, raw_files, readers, optional, aside, spreads)


def _run_stage(
    module: str, name: str, key: str, arguments: dict[str, Any], asked: dict[str, Any]
) -> tuple[ManifestRef, bool]:
    """`Stage.run` in another process, perhaps of a machine whose code would make something else of that key."""
    found: Stage = getattr(importlib.import_module(module), name)
    found.check_versions(arguments, asked)
    return found.run(key, arguments)


def _references(value: Any) -> list[ManifestRef]:
    if isinstance(value, ManifestRef):
        return [value]
    if isinstance(value, list | tuple):
        return [ref for item in value for ref in _references(item)]
    if dataclasses.is_dataclass(value):
        return [ref for field in dataclasses.fields(value) for ref in _references(getattr(value, field.name))]
    return []


def _opened(value: Any, store: Store) -> Any:
    if isinstance(value, ManifestRef):
        return read_manifest(store.here(value))
    if isinstance(value, list | tuple):
        return [_opened(item, store) for item in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        opened = {field.name: _opened(getattr(value, field.name), store) for field in dataclasses.fields(value)}
        return dataclasses.replace(value, **opened)
    return value


def _material(value: Any) -> Any:
    """What of an argument decides the result, ready for JSON."""
    if isinstance(value, ManifestRef):
        return {"manifest": value.key}
    if isinstance(value, Choice):
        plugin = plugins.load_options(value)
        return {
            "plugin": f"{plugin.kind}/{plugin.name}",
            "version": plugin.version,
            "options": cache_material(plugin.options, _material),
        }
    if isinstance(value, BaseModel):
        return cache_material(value, _material)
    if isinstance(value, list | tuple):
        return [_material(item) for item in value]
    if dataclasses.is_dataclass(value):
        return {field.name: _material(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if value is None or isinstance(value, str | int | float | bool):
        return value
    raise DataError(
        f"a stage argument must be a manifest, options, a plain value or a record of these, got {type(value).__name__}"
    )


def _cpu_seconds() -> float:
    """Processor seconds of this process, and of those it started that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(of.ru_utime + of.ru_stime for of in used)


@functools.cache
def _versions() -> dict[str, str]:
    packages = ("ctlev", "torch", "numpy", "diffusers", "transformers", "numba", "pyarrow", "prefect")
    found = {"python": platform.python_version(), "platform": platform.platform()}
    found |= {"cores": str(os.cpu_count()), "threads": str(asked_threads())}
    found["bfloat16"] = computed_in("bfloat16", "cpu")
    for package in packages:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    commit = _commit()
    return found | ({"commit": commit} if commit else {})


def _commit() -> str:
    """Of the checkout that the code runs from, with `-dirty` where it was changed; empty where it is installed."""
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return ""
    command = ["git", "--no-optional-locks", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        told = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):  # no git here, or a checkout of another user
        return ""
    return told.stdout.strip()
