"""GPUs of this machine dealt out among stages, whatever processes, runs and homes they belong to.

    CTLEV_STAGES_PER_GPU   stages that share a GPU; 1. Small networks leave much of a large GPU idle: try 2 to 8

Without this, all branches of an experiment would start on the first GPU at once. A stage waits until as many GPUs as it
asks for are free together, in the order of asking, so that one that needs four is not passed by those that need one.
What it asks for is read from its options: `device` and `num_processes`. On a machine without a GPU nothing happens.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from pydantic import BaseModel

from ctlev_core import plugins
from data_contracts.config import Choice
from data_contracts.errors import DataError
from tasks.file_locks import locked

PER_GPU = "CTLEV_STAGES_PER_GPU"
VISIBLE = "CUDA_VISIBLE_DEVICES"
LOOK_EVERY_S = 0.2
_changing = threading.Lock()
_stages: list[tuple[int, ...]] = []
"""GPUs of the stages that run in this process."""
_own: dict[str, str] = {}
"""The variable as it was before them."""


@dataclass(frozen=True)
class GpuNeed:
    """How many GPUs a stage uses.

    Attributes:
        count: any so many; -1 = all there are.
        named: these, by number.
    """

    count: int = 0
    named: tuple[int, ...] = ()


def gpu_need(arguments: Mapping[str, Any]) -> GpuNeed:
    """What the options among a stage's arguments ask for; the most of several."""
    needs = [_need_of(value) for value in arguments.values() if isinstance(value, BaseModel)]
    named = tuple(sorted({number for need in needs for number in need.named}))
    counts = [need.count for need in needs]
    return GpuNeed(-1 if -1 in counts else max(counts, default=0), named)


def _need_of(value: BaseModel) -> GpuNeed:
    options = plugins.load_options(value).options if isinstance(value, Choice) else value
    device = getattr(options, "device", None)  # of a model or a sampler; labels and windows have none
    if not isinstance(device, str):
        return GpuNeed()
    if device == "all":
        return GpuNeed(-1)
    places = [place.partition(":") for place in device.split(",")]
    named = tuple(int(number) for kind, _, number in places if kind == "cuda" and number)
    if named:
        return GpuNeed(named=named)
    if places[0][0] not in ("auto", "cuda"):
        return GpuNeed()
    launched = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))  # by `accelerate launch`
    asked = getattr(options, "num_processes", 1)
    return GpuNeed(launched if asked is None else asked)


@contextlib.contextmanager
def gpus_held(need: GpuNeed, what: str) -> Iterator[tuple[int, ...]]:
    """Hold GPUs within this block; `cuda` is then the first of them, and processes started here see no other.

    Args:
        need: of the stage.
        what: for those who wait.
    Yields:
        Their numbers; none on a machine without.
    Raises:
        DataError: more or other GPUs are asked for than there are.
    """
    if need == GpuNeed():
        yield ()
        return
    import torch

    present = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if not present:
        yield ()
        return
    if max(need.named, default=0) >= present or need.count > present:
        asked = f"cuda:{max(need.named)}" if need.named else f"{need.count} GPUs, one a process"
        raise DataError(f"{what}: asks for {asked}; this machine shows {present}")
    places = _lock_files(present)
    wanted = list(need.named) or list(range(present))
    count = len(wanted) if need.named or need.count < 0 else need.count
    with contextlib.ExitStack() as stack:
        with locked(places[0][0].with_name("queue.lock"), f"a GPU for {what}"):
            held = _take(places, wanted, count, stack)
        torch.cuda.init()  # before the variable changes what it would find
        before = torch.cuda.current_device()
        torch.cuda.set_device(held[0])
        try:
            with _visible(held):
                yield held
        finally:
            torch.cuda.empty_cache()
            torch.cuda.set_device(before)


def stages_per_gpu() -> int:
    """The variable CTLEV_STAGES_PER_GPU.

    Raises:
        DataError: it is no number above 0.
    """
    asked = os.environ.get(PER_GPU, "")
    if asked and not (asked.isdecimal() and int(asked)):
        raise DataError(f"{PER_GPU} must be a number above 0, got {asked!r}")
    return int(asked) if asked else 1


def _lock_files(present: int) -> list[list[Path]]:
    """For each GPU a file for each stage that may use it; named by the GPU, which may have other numbers elsewhere."""
    import torch

    folder = Path(tempfile.gettempdir()) / f"ctlev-gpus-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise DataError(f"{folder}: belongs to another user, expected a folder of our own")
    shares = range(stages_per_gpu())
    names = [str(torch.cuda.get_device_properties(number).uuid) for number in range(present)]
    return [[folder / f"{name}.{share}.lock" for share in shares] for name in names]


def _take(
    places: Sequence[Sequence[Path]], wanted: Sequence[int], count: int, stack: contextlib.ExitStack
) -> tuple[int, ...]:
    """Wait until `count` of the wanted GPUs are free together; they are ours until the stack unwinds."""
    while True:
        with contextlib.ExitStack() as trial:
            held = []
            # The least used first, where several stages share one.
            for share in range(len(places[0])):
                for number in wanted:
                    if len(held) < count and number not in held and _try(places[number][share], trial):
                        held.append(number)
            if len(held) == count:
                stack.push(trial.pop_all())
                return tuple(sorted(held))
        time.sleep(LOOK_EVERY_S)


def _try(path: Path, stack: contextlib.ExitStack) -> bool:
    file: IO[bytes] = path.open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return False
    stack.enter_context(file)
    return True


@contextlib.contextmanager
def _visible(held: Sequence[int]) -> Iterator[None]:
    """CUDA_VISIBLE_DEVICES for the processes of a training; this one has looked already.

    Stages of one process follow one another, but for those of threads, which start no others.
    """
    with _changing:
        if not _stages:
            _own.clear()
            _own.update({VISIBLE: os.environ[VISIBLE]} if os.environ.get(VISIBLE) else {})
        _stages.append(tuple(held))
        _show_latest()
    try:
        yield
    finally:
        with _changing:
            _stages.remove(tuple(held))
            _show_latest()


def _show_latest() -> None:
    """The variable as the stage that began last needs it, or as it was."""
    if not _stages:
        os.environ.pop(VISIBLE, None)
        os.environ.update(_own)
        return
    names = _own[VISIBLE].split(",") if _own else None
    os.environ[VISIBLE] = ",".join(str(number) if names is None else names[number] for number in _stages[-1])
