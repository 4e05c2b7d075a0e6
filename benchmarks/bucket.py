"""What a home in a bucket costs beside a home folder: single artefacts, and a preset whose stages are all finished.

    python benchmarks/bucket.py
    python benchmarks/bucket.py --part flow --preset demo

The bucket is an S3 server on loopback (moto), in Python and with its objects in memory: what is measured is what ctlev
and its packages take, with an answer after some milliseconds. A network adds its own times; `requests` says how often.

`artefacts`: made and published, then fetched into an empty cache and found in it again; one file, and many small ones.
`flow`: a preset that is finished, with a home folder and with a bucket, in turns; then from an empty cache.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import fsspec
import numpy as np
import pyarrow as pa

from data_contracts import tables
from data_contracts.home_folder import home_folder
from data_contracts.manifest import write_manifest
from tasks.store import Store

ROOT = Path(__file__).resolve().parents[1]
TABLE = pa.table({"curve": ["training"], "step": pa.array([0], pa.int64()), "loss": pa.array([1.0], pa.float64())})
SIZES = {"1 file of 100 MB": (1, 100_000_000), "400 files of 40 kB": (400, 40_000), "3 files of 1 kB": (3, 1000)}


def main() -> None:
    """Print a table a part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=("all", "artefacts", "flow"), default="all")
    parser.add_argument("--preset", default="smoke", help="of `flow`")
    parser.add_argument("--rounds", type=int, default=3)
    chosen = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as folder, _server(Path(folder)) as log:
        os.environ["CTLEV_CACHE"] = str(Path(folder) / "caches")
        if chosen.part != "flow":
            artefacts(Path(folder), chosen.rounds)
        if chosen.part != "artefacts":
            flow(Path(folder), log, chosen.preset, chosen.rounds)


def artefacts(folder: Path, rounds: int) -> None:
    """Publish, fetch and find artefacts of several sizes."""
    print(f"\nmedian of {rounds}, s         publish: folder    bucket     fetch      find: folder    bucket")
    for what, (count, num_bytes) in SIZES.items():
        took: dict[str, list[float]] = {}
        for number in range(rounds):
            key = f"{number:031x}{count % 16:x}"
            stores = {"folder": Store(folder / "home"), "bucket": _bucket_store("a"), "other": _bucket_store("b")}
            for name in ("folder", "bucket"):
                temporary = _put_together(stores[name], key, count, num_bytes)
                _time(took, f"publish {name}", lambda: stores[name].publish("encode", key, temporary, _record(key)))  # noqa: B023
                _time(took, f"find {name}", lambda: stores[name].find("encode", key))  # noqa: B023
            _time(took, "fetch", lambda: stores["other"].find("encode", key))  # noqa: B023
        names = ("publish folder", "publish bucket", "fetch", "find folder", "find bucket")
        middle = [statistics.median(took[name]) for name in names]
        print(f"{what:20} {middle[0]:19.3f} {middle[1]:9.3f} {middle[2]:9.3f} {middle[3]:17.4f} {middle[4]:9.4f}")


def flow(folder: Path, log: Path, preset: str, rounds: int) -> None:
    """Run a preset until it is finished in a folder; then with the bucket, and from empty caches."""
    home, url = folder / "home_of_flow", "s3://benchmark/flow"
    _run(preset, str(home))
    shutil.copytree(home / "artefacts", home_folder(url) / "artefacts")
    cases = {"finished, home folder": str(home), "finished, bucket": url, "finished, bucket, empty cache": url}
    first_s = _run(preset, url)[0]
    print(f"\n{preset}, everything sent: {first_s:.1f} s")
    took: dict[str, list[tuple[float, float, int]]] = {case: [] for case in cases}
    for number in range(rounds):
        for case, place in cases.items():
            os.environ["CTLEV_CACHE"] = str(folder / (f"empty_{number}" if "empty" in case else "caches"))
            before = len(log.read_text().splitlines())
            wall_s, cpu_s = _run(preset, place)
            took[case].append((wall_s, cpu_s, len(log.read_text().splitlines()) - before))
    print(f"median of {rounds}                     s   processor s   requests")
    for case, found in took.items():
        wall_s, cpu_s, requests = (statistics.median(values) for values in zip(*found, strict=True))
        print(f"{case:30} {wall_s:6.1f} {cpu_s:13.1f} {requests:10.0f}")


def _run(preset: str, home: str) -> tuple[float, float]:
    """Seconds of the clock and of processors."""
    command = [sys.executable, str(ROOT / "flows" / "full_experiment.py"), "--preset", preset, "--home", home]
    before, start = os.times(), time.perf_counter()
    finished = subprocess.run(command, capture_output=True, text=True)
    if finished.returncode:
        raise RuntimeError(f"{' '.join(command)}: exit status {finished.returncode}\n{finished.stderr}")
    after = os.times()
    cpu_s = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - start, cpu_s


def _bucket_store(machine: str) -> Store:
    os.environ["CTLEV_CACHE"] = str(Path(os.environ["CTLEV_CACHE"]).parent / machine)
    return Store(home_folder("s3://benchmark/artefacts"))


def _put_together(store: Store, key: str, count: int, num_bytes: int) -> Path:
    temporary = store.temporary_folder(key)
    temporary.mkdir(parents=True)
    random = np.random.default_rng(int(key, 16))
    for number in range(count):
        (temporary / f"{number:04}.bin").write_bytes(random.bytes(num_bytes))
    write_manifest(temporary, TABLE, tables.TRAINING)
    return temporary


def _record(key: str) -> dict:
    return {
        "stage": "encode", "stage_version": 1, "key": key, "arguments": {}, "versions": {}, "upstream": {},
        "started": "2026-01-01T00:00:00Z", "wall_seconds": 0.0, "cpu_seconds": 0.0, "process_peak_memory_mib": 0.0,
    }  # fmt: skip


def _time(took: dict[str, list[float]], what: str, call: Callable[[], object]) -> None:
    start = time.perf_counter()
    call()
    took.setdefault(what, []).append(time.perf_counter() - start)


@contextlib.contextmanager
def _server(folder: Path) -> Iterator[Path]:
    """The log of an S3 server, with a line a request, that the environment names; it has a bucket `benchmark`."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    log = folder / "server.log"
    with (
        log.open("w") as file,
        subprocess.Popen(
            [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)], stdout=file, stderr=file
        ) as server,
    ):
        os.environ |= {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
            "AWS_ACCESS_KEY_ID": "key",
            "AWS_SECRET_ACCESS_KEY": "secret",
            "AWS_DEFAULT_REGION": "us-east-1",
        }
        try:
            _wait(os.environ["AWS_ENDPOINT_URL"])
            fsspec.filesystem("s3").mkdir("benchmark")
            yield log
        finally:
            server.terminate()


def _wait(url: str) -> None:
    for _ in range(300):
        with contextlib.suppress(urllib.error.URLError):
            urllib.request.urlopen(f"{url}/moto-api/", timeout=5).close()
            return
        time.sleep(0.1)
    raise RuntimeError(f"{url}: the server did not start")


if __name__ == "__main__":
    main()
