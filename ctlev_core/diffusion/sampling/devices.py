"""One process a device, each with the networks in memory and a share of the work."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import torch

from ctlev_core.diffusion.pretrained.adapters import is_adapter, read_adapter
from ctlev_core.diffusion.pretrained.loading import choose_device
from ctlev_core.processes import CORES, SMALL_BYTES, few_threads, num_cores

END_TIMEOUT_S = 10.0
"""After being asked to end, a process has so long."""


def device_names(asked: str) -> list[str]:
    """The devices that `SamplingOptions.device` asks for.

    Args:
        asked: a device or several, divided by commas; `all` is every CUDA device, or the CPU where there is none.
    Raises:
        ValueError: a CUDA device that this machine does not have.
    """
    available = torch.cuda.device_count()
    if asked == "all":
        return [f"cuda:{number}" for number in range(available)] or ["cpu"]
    names = asked.split(",")
    for name in names:
        kind, _, number = name.partition(":")
        if kind == "cuda" and int(number or 0) >= available:
            raise ValueError(f"device {name!r} was asked for, but this machine has {available} CUDA devices")
    return names


def spread_over_cores(device: str, checkpoint: Path, most: int) -> list[str]:
    """The device as often as processes are to share it.

    A small network gains little from a second thread of a CPU, and as much as there is to gain from a second process.

    Args:
        device: a name.
        checkpoint: folder or file of the weights.
        most: processes there is work for.
    """
    if is_adapter(checkpoint):
        checkpoint = read_adapter(checkpoint).base_model
    files = [checkpoint] if checkpoint.is_file() else checkpoint.glob("*/*.safetensors")
    if choose_device(device).type != "cpu" or sum(file.stat().st_size for file in files) > SMALL_BYTES:
        return [device]
    return [device] * max(min(num_cores(), most), 1)


def run_on_devices(
    function: Callable[[str, Any, Callable[[int], None]], None],
    devices: Sequence[str],
    shares: Sequence[Any],
    report: Callable[[int], None],
) -> None:
    """Call `function(device, share, report)` in a process for each device, side by side.

    The first that fails ends the others; what they have finished and stored stays. Processes end with this one.

    Args:
        function: of a module, so that it can be named in another process; its `report` takes the number of rows done.
        devices: names.
        shares: what each device has to do.
        report: is called here with the numbers reported there.
    Raises:
        RuntimeError: a process was ended from outside, for example because memory ran out.
        Exception: what a call raised, with the traceback of its process as a note.
    """
    # A forked process could not use CUDA once this one has.
    context = multiprocessing.get_context("spawn")
    running: dict[Any, tuple[str, Any]] = {}
    processes = []
    try:
        for device, share in zip(devices, shares, strict=True):
            ours, theirs = context.Pipe(duplex=False)
            arguments = (function, device, share, max(num_cores() // len(devices), 1), theirs)
            process = context.Process(target=_serve, args=arguments, name=f"sampling on {device}", daemon=True)
            process.start()
            theirs.close()  # so that its end is seen here when the process is gone
            running[ours] = device, process
            processes.append(process)
        while running:
            for connection in wait(list(running)):
                _receive(connection, running, report)
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.join(END_TIMEOUT_S)
            if process.is_alive():
                process.kill()
                process.join()


def _receive(connection: Any, running: dict[Any, tuple[str, Any]], report: Callable[[int], None]) -> None:
    """Take one message of a process, or its end."""
    try:
        message = connection.recv()
    except EOFError:
        device, process = running.pop(connection)
        process.join(END_TIMEOUT_S)
        if process.exitcode != 0:
            raise RuntimeError(
                f"the process that sampled on {device} ended with exit code {process.exitcode}; "
                "finished shards are kept, and a new run goes on from them"
            ) from None
        return
    if isinstance(message, BaseException):
        raise message
    report(message)


def _serve(
    function: Callable[[str, Any, Callable[[int], None]], None],
    device: str,
    share: Any,
    cores: int,
    connection: Connection,
) -> None:
    """What a process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one decides
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.environ[CORES] = str(cores)
    try:
        with few_threads():
            function(device, share, connection.send)
    except Exception as error:
        connection.send(_that_travels(error))


def _end_with_parent() -> None:
    """A process that lost the one which started it would hold its device for nobody."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _that_travels(error: Exception) -> Exception:
    """The error with its traceback as a note, or one that says the same where it cannot be pickled."""
    error.add_note("".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
