"""A finished smoke run for the tests of the flows."""

from __future__ import annotations

import fcntl
import os
import shutil
from pathlib import Path

import pytest
from flow_scripts import run_script


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
            finished = run_script("full_experiment", "--preset", "smoke", home=own)
            assert finished.status == 0, finished.errors
            (own / "first_run.txt").write_text(finished.output)
            shutil.copytree(own, run.with_name("unfinished_copy"), symlinks=True)
            run.with_name("unfinished_copy").rename(run)
            return own
    return Path(shutil.copytree(run, own, symlinks=True))
