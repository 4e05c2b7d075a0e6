"""Every format that is written, and Prophesee's ECF that is read: bytes an event, speed, and whether nothing is lost.

The recording of a person beside the project, taken by a DVXplorer, is repeated to a million events; without it
a made-up one of 346 x 260 px serves. Files lie in the page cache; medians of rounds, one process, all checks included.

    python benchmarks/formats.py --events 1000000 --rounds 5
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from decoding import tile

from ctlev_core import plugins
from ctlev_core.events import files as event_files
from data_contracts.events import Events

REPOSITORY = Path(__file__).resolve().parents[1]
PERSON = REPOSITORY.parent / "shared" / "real" / "events" / "person" / "tonic_sample.aedat4"
COLUMNS = ("t", "x", "y", "p")
ATIS_SIZE = (240, 180)
"""Coordinates of `atis` have 8 bits: events beyond a DAVIS240 are left out of its row."""
ECF_CHUNK = 16_384


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    events = tile(find_recording(), arguments.events)
    print(f"{len(events):,} events, {events.sensor_size[0]} x {events.sensor_size[1]} px")
    print(f"{'format':16} {'bytes an event':>14} {'written, Mev/s':>15} {'read, Mev/s':>12}  events read")
    with tempfile.TemporaryDirectory() as folder:
        for name in plugins.names("formats"):
            module = plugins.load("formats", name)
            given = within(events, ATIS_SIZE) if name == "atis" else events
            path = Path(folder) / f"recording{module.SUFFIXES[0]}"
            writing = seconds(partial(module.write, path, given), arguments.rounds)
            print_row(name, path, given, len(given) / writing / 1e6, arguments.rounds)
            path.unlink()
        path = Path(folder) / "recording.h5"
        write_ecf(path, events)
        print_row("hdf5, ECF", path, events, None, arguments.rounds)


def find_recording() -> Events:
    """The real one, or as many made-up events of a person's size."""
    if PERSON.is_file():
        return event_files.read_events_file(PERSON)
    random, count = np.random.default_rng(0), 100_000
    x = random.normal(173, 40, count).clip(0, 345).astype(np.uint16)
    y = random.normal(130, 50, count).clip(0, 259).astype(np.uint16)
    t = np.sort(random.integers(0, 500_000, count))
    return Events(t, x, y, random.integers(0, 2, count).astype(np.uint8), (346, 260))


def within(events: Events, size: tuple[int, int]) -> Events:
    """Those of the first columns and rows."""
    kept = (events.x < size[0]) & (events.y < size[1])
    return Events(*(getattr(events, name)[kept] for name in COLUMNS), size)


def write_ecf(path: Path, events: Events) -> None:
    """By the encoder of the tests, which follows the format's description bit by bit and is slow."""
    sys.path.insert(0, str(REPOSITORY / "tests" / "helpers"))
    import ecf_writer

    rows = list(zip(*(getattr(events, name).tolist() for name in ("t", "x", "y", "p")), strict=True))
    chunks = [ecf_writer.encode(rows[start : start + ECF_CHUNK], 0) for start in range(0, len(rows), ECF_CHUNK)]
    ecf_writer.write(path, chunks, len(rows), ECF_CHUNK)


def print_row(name: str, path: Path, events: Events, written: float | None, rounds: int) -> None:
    """Read the file, and compare."""
    got = event_files.read_events_file(path)
    same = len(got) == len(events) and all(np.array_equal(getattr(got, key), getattr(events, key)) for key in COLUMNS)
    reading = seconds(lambda: event_files.read_events_file(path), rounds)
    shown = "" if written is None else f"{written:.1f}"
    size = path.stat().st_size / len(events)
    print(
        f"{name:16} {size:14.2f} {shown:>15} {len(events) / reading / 1e6:12.1f}  {'equal' if same else 'NOT EQUAL'}",
        flush=True,
    )


def seconds(work: Callable[[], Any], rounds: int) -> float:
    """Median time of a call."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


if __name__ == "__main__":
    main()
