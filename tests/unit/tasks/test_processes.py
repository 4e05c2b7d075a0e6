import os
import subprocess
import sys

import pytest

from ctlev_core.processes import num_cores

COUNT = "from ctlev_core.processes import num_cores; print(num_cores())"


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes cannot be bound to cores here")
def test_a_process_that_is_bound_to_one_core_has_one():
    (one, *_) = os.sched_getaffinity(0)
    bound = subprocess.run(
        [sys.executable, "-c", COUNT],
        preexec_fn=lambda: os.sched_setaffinity(0, {one}),
        capture_output=True,
        text=True,
        check=True,
    )
    assert bound.stdout.strip() == "1"


@pytest.mark.parametrize(
    ("limit", "cores"),
    [("max 100000", 8), ("200000 100000", 2), ("150000 100000", 1), ("50000 100000", 1), ("9900000 100000", 8)],
)
def test_a_container_has_the_cores_whose_time_it_gets(monkeypatch, tmp_path, limit, cores):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    (tmp_path / "cpu.max").write_text(f"{limit}\n")
    assert num_cores(tmp_path / "cpu.max") == cores


def test_without_a_limit_all_cores_count(monkeypatch, tmp_path):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1, 2}, raising=False)
    assert num_cores(tmp_path / "cpu.max") == 3
