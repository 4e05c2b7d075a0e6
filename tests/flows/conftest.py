"""A finished smoke run for the tests of the flows."""

from __future__ import annotations

from pathlib import Path

import pytest
from flow_scripts import run_script


@pytest.fixture(scope="session")
def smoke_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The home of one finished smoke run, shared by the tests that look at it or add to it."""
    home = tmp_path_factory.mktemp("smoke")
    finished = run_script("full_experiment", "--preset", "smoke", home=home)
    assert finished.status == 0, finished.errors
    (home / "first_run.txt").write_text(finished.output)
    return home
