"""One fuzz target a reader; CTLEV_FUZZ_SECONDS sets how long each runs, 60 s unless given."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import fuzz_other_readers
import pytest

from ctlev_core import plugins

SECONDS = int(os.environ.get("CTLEV_FUZZ_SECONDS", "60"))
SCRIPT = Path(__file__).parent / "fuzz_reader.py"


@pytest.mark.slow
@pytest.mark.parametrize("name", plugins.names("formats"))
def test_any_bytes_give_events_or_a_data_error(name, tmp_path):
    result = subprocess.run(
        [sys.executable, str(SCRIPT), name, "--seconds", str(SECONDS)],
        capture_output=True,
        text=True,
        errors="replace",
        timeout=SECONDS + 300,
        env={**os.environ, "TMPDIR": str(tmp_path)},  # atheris ends the process without tidying up
    )
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-4000:]


@pytest.mark.slow
@pytest.mark.timeout(SECONDS + 300)
@pytest.mark.parametrize("name", fuzz_other_readers.TARGETS)
def test_any_bytes_give_a_result_or_an_error_that_names_the_file(name, tmp_path):
    # In a process of its own: a reader that crashes or never ends is a failure of this test, not the end of all.
    script = SCRIPT.with_name("fuzz_other_readers.py")
    result = subprocess.run(
        [sys.executable, str(script), name, "--seconds", str(SECONDS)],
        capture_output=True,
        text=True,
        errors="replace",
        timeout=SECONDS + 200,
        env={**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": str(SCRIPT.parents[2])},
    )
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-4000:]
