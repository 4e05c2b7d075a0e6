"""One fuzz target a reader; CTLEV_FUZZ_SECONDS sets how long each runs, 60 s unless given."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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
