import math
import os
import subprocess
import sys

import pytest
import torch

from ctlev_core import processes
from ctlev_core.processes import asked_threads, few_threads, memory_mib, num_cores, use_cores_for

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


def test_a_process_with_a_share_has_that_many(monkeypatch, tmp_path):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    monkeypatch.setenv("CTLEV_CORES", "3")
    assert num_cores(tmp_path / "cpu.max") == 3
    monkeypatch.setenv("CTLEV_CORES", "30")
    assert num_cores(tmp_path / "cpu.max") == 8
    monkeypatch.setenv("CTLEV_CORES", "none")
    with pytest.raises(ValueError, match="CTLEV_CORES must be a positive number, got 'none'"):
        num_cores(tmp_path / "cpu.max")


@pytest.fixture
def four_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(4)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("four_threads")
@pytest.mark.parametrize(("asked", "threads"), [(None, 1), ("", 1), ("nonsense", 1), ("0", 1), ("3", 3), ("2,4", 2)])
def test_torch_has_few_threads_unless_more_are_asked_for(monkeypatch, asked, threads):
    if asked is None:
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    else:
        monkeypatch.setenv("OMP_NUM_THREADS", asked)
    with pytest.raises(KeyError), few_threads():
        assert torch.get_num_threads() == asked_threads() == threads
        assert "OMP_NUM_THREADS" in os.environ  # for processes that are started here
        raise KeyError
    assert torch.get_num_threads() == 4
    assert os.environ.get("OMP_NUM_THREADS") == asked


@pytest.mark.usefixtures("four_threads")
@pytest.mark.parametrize(("asked", "size", "threads"), [("1", 10**8, 1), ("1", 10**9, 6), ("2", 10**9, 2)])
def test_large_networks_have_all_cores_until_the_end(monkeypatch, asked, size, threads):
    monkeypatch.setenv("OMP_NUM_THREADS", asked)
    monkeypatch.setattr(processes, "num_cores", lambda: 6)
    with few_threads():
        use_cores_for(size)
        assert torch.get_num_threads() == threads
    assert torch.get_num_threads() == 4


def test_a_torch_that_is_imported_later_has_few_threads():
    code = """
from ctlev_core.processes import few_threads
with few_threads():
    import torch
    print(torch.get_num_threads())
print(torch.get_num_threads())
"""
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert run.stdout.split() == ["1", "1"]


TABLE = "MemTotal:       20971520 kB\nMemFree:         1048576 kB\nMemAvailable:   15728640 kB\n"


@pytest.mark.parametrize(
    ("limit", "expected"),
    [("max", (20480, 15360)), ("8589934592", (8192, 8192)), ("17179869184", (16384, 15360)), (None, (20480, 15360))],
)
def test_a_container_has_the_memory_that_it_gets(tmp_path, limit, expected):
    (tmp_path / "meminfo").write_text(TABLE)
    if limit is not None:
        (tmp_path / "memory.max").write_text(f"{limit}\n")
    assert memory_mib(tmp_path / "memory.max", tmp_path / "meminfo") == expected


def test_where_nothing_tells_memory_is_not_bounded(tmp_path):
    assert memory_mib(tmp_path / "none", tmp_path / "none") == (math.inf, math.inf)


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel forgets a peak on Linux alone")
def test_a_peak_of_memory_is_that_since_it_began():
    code = """
from ctlev_core.processes import begin_memory_peak, memory_peak_mib
import numpy as np
def take(mib):
    begin_memory_peak()
    np.ones(mib << 17)
    return memory_peak_mib()
before, large, small = take(1), take(400), take(50)
print(large - before, small - before)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    large, small = map(float, run.stdout.split())
    assert large == pytest.approx(399, abs=30) and small == pytest.approx(49, abs=30)
