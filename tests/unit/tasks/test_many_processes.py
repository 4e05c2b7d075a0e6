"""Processes of one machine, and of what looks like two, that want the same artefacts: each is made once."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[3]
SCRIPT = REPOSITORY / "tests" / "helpers" / "counted_pipeline.py"
APART = ["unshare", "--net", "--pid", "--fork"]


def namespaces_are_allowed() -> bool:
    """A process with a network and process numbers of its own: another machine, but for the disk."""
    return shutil.which("unshare") is not None and subprocess.run([*APART, "true"], check=False).returncode == 0


def start(home, notes, seed, before=()):
    environment = os.environ | {"CTLEV_HOME": str(home), "PYTHONPATH": str(REPOSITORY)}
    command = [*before, sys.executable, str(SCRIPT), str(notes), str(seed)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def check(processes, notes):
    outputs = [process.communicate(timeout=120) for process in processes]
    assert all(process.returncode == 0 for process in processes), outputs
    # Every process found or made all twelve, the same ones; none was made twice.
    found = [sorted(line.split()[:2] for line in output.splitlines()) for output, _ in outputs]
    assert all(len(rows) == 12 and rows == found[0] for rows in found)
    assert sorted(int(line) for line in notes.read_text().split()) == list(range(12))
    return {line.split()[2] for output, _ in outputs for line in output.splitlines()}


@pytest.mark.parametrize("count", [2, 8])
def test_processes_that_run_the_same_make_each_artefact_once(tmp_path, count):
    notes = tmp_path / "notes"
    check([start(tmp_path / "home", notes, seed) for seed in range(count)], notes)


@pytest.mark.skipif(not namespaces_are_allowed(), reason="no namespaces of one's own are allowed here")
def test_machines_that_share_a_disk_make_each_artefact_once(tmp_path):
    notes = tmp_path / "notes"
    machines = [start(tmp_path / "home", notes, seed, APART if seed % 2 else []) for seed in range(4)]
    assert len(check(machines, notes)) >= 2  # process numbers were not shared
