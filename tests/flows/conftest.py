"""What the tests of the flows share: a Prefect server and a finished smoke run."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import flow_scripts
import pytest
from flow_scripts import run_script

FOLDER = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put a file whose tests need the finished smoke run first in this folder, and the other such files last.

    A process of tests that needs the run while another makes it does nothing but wait.
    """
    positions = [position for position, item in enumerate(items) if FOLDER in item.path.parents]
    own = [items[position] for position in positions]
    needing = list(dict.fromkeys(item.path for item in own if "smoke_home" in getattr(item, "fixturenames", ())))
    own.sort(key=lambda item: (item.path in needing) - 2 * (item.path in needing[:1]))
    for position, item in zip(positions, own, strict=True):
        items[position] = item


@contextlib.contextmanager
def server(home: Path) -> Iterator[dict[str, str]]:
    """The variables that lead to a Prefect server as scripts start it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PREFECT_HOME", str(home / "prefect"))
        patch.setenv("PREFECT_LOGGING_LEVEL", "CRITICAL")
        patch.delenv("PREFECT_API_URL", raising=False)
        from flows import local_server

        local_server.start(home)
        with local_server.connected():
            pass
    try:
        yield local_server.environment()
    finally:
        local_server.stop()


@pytest.fixture(scope="session", autouse=True)
def shared_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A server for all scripts, from the first one on."""
    with contextlib.ExitStack() as stack, pytest.MonkeyPatch.context() as patch:

        def start() -> dict[str, str]:
            return stack.enter_context(server(tmp_path_factory.mktemp("server")))

        patch.setattr(flow_scripts, "shared_server", functools.cache(start))
        yield


@pytest.fixture(scope="session")
def smoke_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The home of one finished smoke run, shared by the tests that look at it or add to it.

    Processes of tests run it once between them, and each has a copy to itself.
    """
    own = tmp_path_factory.mktemp("smoke") / "home"
    root = tmp_path_factory.getbasetemp()
    run = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "finished_smoke_run"
    with (run.parent / "finished_smoke_run.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not run.exists():
            finished = run_script("full_experiment", "--preset", "smoke", home=own, own_server=True)
            assert finished.status == 0, finished.errors
            (own / "first_run.txt").write_text(finished.output)
            (own / "first_run_errors.txt").write_text(finished.errors)
            shutil.copytree(own, run.with_name("unfinished_copy"), symlinks=True)
            run.with_name("unfinished_copy").rename(run)
            return own
    return Path(shutil.copytree(run, own, symlinks=True))
