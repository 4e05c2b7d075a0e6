"""Every system call of a stage and its store that can fail fails once: the next run ends as if nothing had happened."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[3]
HELPERS = REPOSITORY / "tests" / "helpers"
COMPILER = shutil.which("cc") or shutil.which("gcc")


@pytest.mark.release
@pytest.mark.timeout(1800)
@pytest.mark.skipif(COMPILER is None or not sys.platform.startswith("linux"), reason="needs Linux and a C compiler")
def test_a_call_that_fails_once_loses_nothing_and_leaves_nothing(tmp_path):
    library = tmp_path / "failing_calls.so"
    source = HELPERS / "failing_calls.c"
    subprocess.run([str(COMPILER), "-O1", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    environment = os.environ | {"LD_PRELOAD": str(library), "PYTHONPATH": str(REPOSITORY)}
    finished = subprocess.run(
        [sys.executable, HELPERS / "faulty_pipeline.py", library, tmp_path],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr[-3000:]
    found = json.loads(finished.stdout)
    assert not found["faults"], "\n\n".join(found["faults"][:5])
    # Else the library was not in the way of the calls.
    assert all(found["places"][name] for name in ("open", "write", "read", "fsync", "flock", "rename", "mkdir", "stat"))
    assert found["tried"] == sum(found["places"].values()) and found["told"] > found["tried"] / 2
