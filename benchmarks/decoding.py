"""How fast event files are decoded beside other packages, whether those give the true events, and in how much memory.

Peers are timed where they are installed (expelliarmus, faery, evlib, aestream). Each round reads the file once with
every package in turn, from the page cache; medians over the rounds are printed, in millions of events a second of wall
and of CPU time, with the ratio of CPU speeds. Our time includes every check of `check_events`; the last column says
what a peer's columns have of the truth.

    python benchmarks/decoding.py --recording my.raw
    python benchmarks/decoding.py --memory      # chunked reads of 2 GB files, written to the temporary folder
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core import plugins
from ctlev_core.events import files as event_files
from ctlev_core.events.decoding import prophesee
from data_contracts.events import Events

REAL = Path(__file__).resolve().parents[1].parent / "shared" / "real" / "events"
SPOT, STREET = REAL / "spot" / "expelliarmus_evt2.raw", REAL / "street" / "expelliarmus_evt3.raw"
SUFFIXES = {"evt2": ".raw", "evt3": ".raw", "dat": ".dat"}
COLUMNS = ("t", "x", "y", "p")


def main() -> None:
    """Run and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=int, default=8_000_000, help="repeat the recording up to this many events")
    parser.add_argument("--recording", type=Path, help="event file; the real ones beside the project, else synthetic")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--memory", action="store_true", help="measure the memory of chunked reads instead")
    parser.add_argument("--gigabytes", type=float, default=2.0, help="file size for --memory")
    arguments = parser.parse_args()
    recordings = find_recordings(arguments.recording)
    with tempfile.TemporaryDirectory() as folder:
        if arguments.memory:
            for name in (*SUFFIXES, "parquet"):
                print_memory(name, tile(next(iter(recordings.values())), 4_000_000), arguments.gigabytes, Path(folder))
            return
        for label, recording in recordings.items():
            events = tile(recording, arguments.events)
            for name in ("evt2", "evt3", "dat") if label != "street" else ("evt3",):
                print_speed(f"{name}, {label}", name, events, arguments.rounds, Path(folder))


def find_recordings(path: Path | None) -> dict[str, Events]:
    """What is measured on, by name."""
    if path:
        return {path.stem: event_files.read_events_file(path)}
    if SPOT.is_file() and STREET.is_file():
        return {"spot": event_files.read_events_file(SPOT), "street": event_files.read_events_file(STREET)}
    random = np.random.default_rng(0)
    n = 500_000
    x, y = (random.normal(size / 2, size / 8, n).clip(0, size - 1).astype(np.uint16) for size in (640, 480))
    t = np.sort(random.integers(0, 50_000, n))
    return {"synthetic": Events(t, x, y, random.integers(0, 2, n).astype(np.uint8), (640, 480))}


def tile(events: Events, num_events: int) -> Events:
    """The recording again and again, each time later, from time 0."""
    copies = max(1, round(num_events / len(events)))
    period = events.duration_us + 1
    t = np.concatenate([events.t - events.t[0] + copy * period for copy in range(copies)])
    x, y, p = (np.tile(getattr(events, name), copies) for name in "xyp")
    return Events(t, x, y, p, events.sensor_size)


# Speed -------------------------------------------------------------------------------------------------------------


def readers(name: str, path: Path, events: Events) -> dict[str, tuple[Callable[[], Any], Callable[[Any], list]]]:
    """For every package that is installed: read the file, and the columns t, x, y, p of what was read."""
    found: dict[str, tuple[Callable[[], Any], Callable[[Any], list]]] = {
        "ctlev": (lambda: event_files.read_events_file(path), lambda got: [getattr(got, key) for key in COLUMNS])
    }
    if importlib.util.find_spec("expelliarmus"):
        from expelliarmus import Wizard  # pyright: ignore[reportMissingImports]

        def read_expelliarmus() -> Any:
            wizard = Wizard(encoding=name)
            wizard.set_file(path)
            return wizard.read()

        found["expelliarmus"] = (read_expelliarmus, lambda got: [got[key] for key in COLUMNS])
    if importlib.util.find_spec("faery"):
        import faery  # pyright: ignore[reportMissingImports]

        found["faery"] = (
            lambda: faery.events_stream_from_file(path).to_array(),
            lambda got: [got["t"], got["x"], got["y"], got["on"]],
        )
    if importlib.util.find_spec("evlib"):
        import evlib  # pyright: ignore[reportMissingImports]

        found["evlib"] = (
            lambda: evlib.load_events(str(path)).collect(),
            lambda got: [
                got["t"].to_physical().to_numpy(),
                got["x"].to_numpy(),
                got["y"].to_numpy(),
                got["polarity"].to_numpy() > 0,
            ],
        )
    if importlib.util.find_spec("aestream"):
        import aestream  # pyright: ignore[reportMissingImports]

        def read_aestream() -> Any:
            with aestream.FileInput(str(path), events.sensor_size) as file:
                return file.load()

        found["aestream"] = (
            read_aestream,
            lambda got: [got[key] for key in ("timestamp", "x", "y", "polarity")],
        )
    return found


def print_speed(title: str, name: str, events: Events, rounds: int, folder: Path) -> None:
    """One format, every package."""
    path = folder / f"recording_{name}{SUFFIXES[name]}"
    plugins.load("formats", name).write(path, events)
    print(f"\n{title}: {len(events):,} events, {path.stat().st_size / len(events):.2f} bytes an event")
    print(f"{'package':14} {'Mev/s wall':>11} {'Mev/s CPU':>10} {'ctlev is':>9}  events")
    packages = readers(name, path, events)
    verdicts: dict[str, str] = {}
    for package, (read, columns) in packages.items():
        try:
            verdicts[package] = compare(columns(read()), events)
        except Exception as error:
            verdicts[package] = f"error: {str(error).splitlines()[0][:70] if str(error) else type(error).__name__}"
    times: dict[str, list[tuple[float, float]]] = {package: [] for package in packages}
    for _ in range(rounds):
        for package, (read, _) in packages.items():
            if verdicts[package].startswith("error"):
                continue
            wall, cpu = time.perf_counter(), time.process_time()
            try:
                got = read()
            except Exception as error:  # some fail now and then
                verdicts[package] += f"; a later round: {type(error).__name__}: {error}"
                continue
            times[package].append((time.perf_counter() - wall, time.process_time() - cpu))
            del got
    speeds = {
        package: [len(events) / statistics.median(column) / 1e6 for column in zip(*values, strict=True)]
        for package, values in times.items()
    }
    for package, speed in speeds.items():
        numbers = f"{speed[0]:11.1f} {speed[1]:10.1f} {speeds['ctlev'][1] / speed[1]:8.2f}x" if speed else " " * 32
        print(f"{package:14} {numbers}  {verdicts[package]}")


def compare(columns: list[np.ndarray], events: Events) -> str:
    """What differs from the true events."""
    if len(columns[0]) != len(events):
        return f"{len(columns[0]):,} events instead of {len(events):,}"
    problems = []
    for name, column in zip(COLUMNS, columns, strict=True):
        error = np.abs(np.asarray(column).astype(np.int64) - getattr(events, name).astype(np.int64))
        if error.any():
            problems.append(f"{name} differs in {np.count_nonzero(error) / len(events):.1%}, by up to {error.max():,}")
    return "; ".join(problems) or "exact"


# Memory ------------------------------------------------------------------------------------------------------------


def print_memory(name: str, events: Events, gigabytes: float, folder: Path) -> None:
    """Peak memory of a chunked read of a large file, in a process of its own."""
    path = folder / f"large{SUFFIXES.get(name, '')}"
    size = write_large(name, path, events, int(gigabytes * 1e9))
    code = (
        "import re, sys, time\n"
        "from pathlib import Path\n"
        "from ctlev_core import event_files, plugins\n"
        "import numba, pyarrow\n"
        # Not ru_maxrss, which a new process takes over from the one that started it.
        "peak = lambda: int(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1]) / 1024\n"
        "before, start = peak(), time.perf_counter()\n"
        "total = sum(len(chunk) for chunk in event_files.read_event_chunks(Path(sys.argv[1])))\n"
        "seconds = time.perf_counter() - start\n"
        "print(f'{total:,} events in {seconds:.1f} s ({total / seconds / 1e6:.0f} Mev/s),', end=' ')\n"
        "print(f'peak {peak() - before:.0f} MB above import ({before:.0f} MB)')\n"
    )
    result = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    print(f"{name}: {size / 1e9:.2f} GB, {result.stdout.strip()}", flush=True)
    path.unlink()


def write_large(name: str, path: Path, events: Events, num_bytes: int) -> int:
    """Write the recording again and again until the file has `num_bytes`; returns its size."""
    if name == "parquet":
        period = events.duration_us + 1
        copies = max(1, num_bytes // (4 * len(events)))  # about 4 bytes an event
        event_files.write_event_chunks_parquet(
            path,
            (Events(events.t + copy * period, events.x, events.y, events.p, events.sensor_size)
             for copy in range(copies)),
        )  # fmt: skip
        return path.stat().st_size
    part = path.with_suffix(".part")
    with path.open("wb") as file:
        for content in parts(name, part, events):
            file.write(content)
            if file.tell() >= num_bytes:
                break
    part.unlink()
    return path.stat().st_size


def parts(name: str, part: Path, events: Events) -> Iterator[bytes]:
    """The file's first part with the header, then further ones without; never ends."""
    module = plugins.load("formats", name)
    period = events.duration_us + 1
    clock = {"evt2": 1 << 34, "evt3": 1 << 24, "dat": 1 << 32}[name]
    for copy in range(1 << 30):
        offset = copy * period % clock
        module.write(part, Events(events.t + offset, events.x, events.y, events.p, events.sensor_size))
        content = part.read_bytes()
        header = prophesee.read_header(part).size + (2 if name == "dat" else 0)
        # The writer starts every part with TIME_HIGH 0, an overflow to a reader unless the clock is there.
        if name == "evt3" and offset >> 12:
            header += 2
        yield content if copy == 0 else content[header:]


if __name__ == "__main__":
    main()
