"""Environment of every flow: which folder holds all state, and what libraries are told. Importing it changes nothing.

Entry points call `configure` before anything imports Prefect, which reads its settings when it is imported; flows are
therefore made by the decorator here, which imports Prefect when the first one is called.

All state lies under one folder: `--home`, else the variable CTLEV_HOME, else `.ctlev` in the working directory. Where
that is the URL of a bucket, the folder is its cache on this machine.
Nothing here reaches out: telemetry and update checks are off, and model hubs are never asked.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Generic, ParamSpec, TypeVar

from data_contracts.home_folder import home_folder
from flows import local_server

if TYPE_CHECKING:
    from prefect import Flow

P = ParamSpec("P")
R = TypeVar("R")
_run_path: ContextVar[tuple[str, ...]] = ContextVar("ctlev_run_path", default=())
_ENVIRONMENT = {
    # Idle OpenMP threads that spin cost a busy machine most of its speed: 30 training steps of the pose network with
    # two threads took 44 s spinning and 11 s sleeping while another process had one of the two cores.
    "OMP_WAIT_POLICY": "PASSIVE",
    # Weights depend on the number of threads: see `ctlev_core.processes.few_threads`.
    "OMP_NUM_THREADS": "1",
    "HF_HUB_OFFLINE": "1",
    "HF_HUB_DISABLE_TELEMETRY": "1",
    "HF_HUB_DISABLE_PROGRESS_BARS": "1",
    "TRANSFORMERS_VERBOSITY": "error",
    "DIFFUSERS_VERBOSITY": "error",
    "TOKENIZERS_PARALLELISM": "false",
}


def configure(home: str | Path | None = None, *, verbose: bool = False) -> Path:
    """Set the environment of this process and those it starts; must be called before Prefect is imported.

    Args:
        home: folder of all state, or the URL of a bucket; None = CTLEV_HOME, else `.ctlev` in the working directory.
        verbose: show Prefect's log.

    Returns:
        The home folder, absolute; of a bucket its cache. It is made where it is not there and can be.
    """
    folder = home_folder(home)
    os.environ["CTLEV_HOME"] = str(folder)
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    local_server.configure(folder, verbose=verbose)
    return folder


class ScriptFlow(Generic[P, R]):
    """A function that is run as a flow of Prefect; made by the decorator `flow`.

    Attributes:
        fn: the function alone.
        name: of the flow.
    """

    def __init__(self, function: Callable[P, R], name: str) -> None:
        self.fn, self.name = function, name
        self.__doc__ = function.__doc__

    @functools.cached_property
    def of_prefect(self) -> Flow[P, R]:
        """The same as Prefect knows it."""
        from prefect import flow as prefect_flow

        return prefect_flow(name=self.name)(self.fn)

    def __call__(self, *arguments: P.args, **settings: P.kwargs) -> R:
        """A run of the flow; what it returns or raises is that of the function."""
        options = [*arguments, *settings.values()]
        with run_named(self.name, getattr(options[0], "name", "") if options else "") as name:
            # Braces would be parameters to Prefect.
            return self.of_prefect.with_options(flow_run_name=lambda: name)(*arguments, **settings)


@contextlib.contextmanager
def run_named(flow_name: str, asked: str) -> Iterator[str]:
    """The name of a run, such as `demo / pose / synthesize`, which is that of the runs within this block before theirs.

    Args:
        flow_name: what is done.
        asked: name of the experiment or study it is done for; empty = none.
    """
    above = _run_path.get()
    if flow_name == "full-experiment":
        # The parts of a study `demo` may be called `demo_pose`.
        own = asked.removeprefix(f"{above[-1]}_") if above else asked
    else:
        own = flow_name
    path = (*(above or ((asked,) if own != asked and asked else ())), own or flow_name)
    token = _run_path.set(path)
    try:
        yield " / ".join(path)
    finally:
        _run_path.reset(token)


def flow(name: str) -> Callable[[Callable[P, R]], ScriptFlow[P, R]]:
    """Make a function a flow of this name."""
    return lambda function: ScriptFlow(function, name)


def leave_script_folder() -> None:
    """Take the folder of the flow scripts off the path, where `python flows/evaluate.py` puts it.

    There `evaluate.py` would hide a package of that name.
    """
    folder = Path(__file__).resolve().parent
    sys.path[:] = [entry for entry in sys.path if not entry or Path(entry).resolve() != folder]
