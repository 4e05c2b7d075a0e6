"""A sweep of options as one study, stages side by side on this machine, on Dask and in jobs of SLURM.

    python benchmarks/sweeps.py                      # the preset smoke with two numbers of synthetic frames
    python benchmarks/sweeps.py --ways threads dask

Each way starts with a home of its own, and its results are compared by digests. SLURM is a cluster of this machine
alone, as the tests start it; without its programs, or the extras `dask` and `slurm`, that way is left out. Everything
shares the same cores: what differs is what starting workers and handing over stages costs.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests" / "helpers"), str(ROOT / "tests" / "flows"), str(ROOT)]

import slurm_cluster  # noqa: E402
from flow_scripts import digests  # noqa: E402

from ctlev_core.processes import num_cores  # noqa: E402

WAYS = {"threads": None, "dask": "dask", "slurm": "dask_jobqueue"}
"""What CTLEV_RUNNER is set to, and the package it needs."""
TIMED = ("report", "study_report")
"""Stages whose output holds times."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="smoke")
    parser.add_argument("--set", default="num_synthetic=8,6", help="a sweep")
    parser.add_argument("--ways", nargs="*", default=list(WAYS), choices=tuple(WAYS))
    arguments = parser.parse_args()
    print(f"{arguments.preset}, {arguments.set}; {num_cores()} cores")
    print(f"{'CTLEV_RUNNER':14} {'elapsed':>8} {'stages':>7}  results")
    expected: dict[str, str] | None = None
    for way in arguments.ways:
        if (package := WAYS[way]) is not None and importlib.util.find_spec(package) is None:
            print(f"{way:14} not run: {package} is not installed")
            continue
        if way == "slurm" and slurm_cluster.MISSING:
            print(f"{way:14} not run: not installed: {', '.join(slurm_cluster.MISSING)}")
            continue
        with tempfile.TemporaryDirectory() as folder, _environment(way, Path(folder)) as environment:
            home = Path(folder) / "home"
            started = time.perf_counter()
            command = [
                sys.executable,
                "-m",
                "flows.cli",
                "run",
                arguments.preset,
                "--home",
                str(home),
                "--set",
                arguments.set,
            ]
            subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True)
            elapsed = time.perf_counter() - started
            found = {name: digest for name, digest in digests(home).items() if name.partition("/")[0] not in TIMED}
        expected = expected or found
        print(f"{way:14} {elapsed:6.0f} s {len(found):7}  {'equal' if found == expected else 'NOT EQUAL'}", flush=True)


@contextlib.contextmanager
def _environment(way: str, folder: Path) -> Iterator[dict[str, str]]:
    """Variables of a run, while what it needs is there."""
    environment = {**os.environ, "CTLEV_RUNNER": way}
    if way != "slurm":
        yield environment
        return
    jobs = {
        "QUEUE": slurm_cluster.PARTITION, "ACCOUNT": slurm_cluster.ACCOUNT, "CORES": str(num_cores()), "MEMORY": "6GB",
        "WALLTIME": "00:30:00", "INTERFACE": "lo",
    }  # fmt: skip
    with (
        tempfile.TemporaryDirectory(dir="/tmp") as short,  # sockets have short paths
        slurm_cluster.slurm_cluster(Path(short)) as cluster,
    ):
        yield {**environment, **cluster, **{f"DASK_JOBQUEUE__SLURM__{name}": value for name, value in jobs.items()}}


if __name__ == "__main__":
    main()
