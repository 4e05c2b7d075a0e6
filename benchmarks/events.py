"""How fast event files are decoded and event histograms counted, in millions of events a second.

Histograms are compared with np.bincount and np.add.at, which must give the same counts; every number is the best of
`--repeats` runs on one thread with the file in the page cache.

    python benchmarks/events.py
    python benchmarks/events.py --recording my_recording.raw
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ctlev_core import event_files, plugins
from ctlev_core.encodings import event_histogram
from ctlev_core.windows import cut
from data_contracts.config import Windows
from data_contracts.events import Events, SensorSize


def main() -> None:
    """Run all measurements and print two tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=Path, help="event file to measure on; synthetic events where not given")
    parser.add_argument("--num-events", type=int, default=2_000_000, help="synthetic events")
    parser.add_argument("--sensor-size", type=int, nargs=2, default=(346, 260), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    if arguments.recording:
        events = event_files.read_events_file(arguments.recording)
    else:
        events = synthetic_events(arguments.num_events, tuple(arguments.sensor_size))
    width, height = events.sensor_size
    print(f"{len(events):,} events, sensor {width} x {height} px, best of {arguments.repeats}\n")
    print_decoding(events, arguments.repeats)
    print_histograms(events, arguments.repeats)


def synthetic_events(num_events: int, sensor_size: SensorSize) -> Events:
    """A spot that wanders over the sensor, with noise everywhere, at one event a microsecond."""
    rng = np.random.default_rng(0)
    phase = np.linspace(0, 6 * np.pi, num_events)
    columns = []
    for size, wave in zip(sensor_size, (np.cos(phase), np.sin(1.3 * phase)), strict=True):
        spot = rng.normal(size * (0.5 + 0.3 * wave), size / 20)
        is_noise = rng.random(num_events) < 0.2
        columns.append(np.where(is_noise, rng.uniform(0, size, num_events), spot).clip(0, size - 1).astype(np.uint16))
    t = np.sort(rng.integers(0, num_events, num_events))
    return Events(t, columns[0], columns[1], rng.integers(0, 2, num_events).astype(np.uint8), sensor_size)


def best_time(run: Callable[[], object], repeats: int) -> float:
    """Seconds of the fastest of `repeats` runs, after one that compiles and warms the caches."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def print_decoding(events: Events, repeats: int) -> None:
    """Reading, with every check, of the same events in each format the project writes."""
    # EVT3 spells out every overflow of its clock: start at 0, as a camera does.
    shifted = Events(events.t - events.t[0], events.x, events.y, events.p, events.sensor_size)
    print(f"{'format':10} {'bytes/event':>12} {'Mev/s':>8}")
    with tempfile.TemporaryDirectory() as folder:
        for name in ("evt2", "evt3", "parquet"):
            module = plugins.load("formats", name)
            path = Path(folder) / name
            module.write(path, shifted)
            seconds = best_time(lambda read=module.read, path=path: read(path), repeats)
            print(f"{name:10} {path.stat().st_size / len(events):12.2f} {len(events) / seconds / 1e6:8.1f}")
    print()


def print_histograms(events: Events, repeats: int) -> None:
    """Counting, for windows of the same number of events."""
    options = event_histogram.Options()
    methods = {"ctlev": event_histogram.encode, "np.bincount": bincount_encode, "np.add.at": add_at_encode}
    print(f"{'events/window':14} {'windows':>8}" + "".join(f" {name + ' Mev/s':>18}" for name in methods))
    for num_events in (7500, 30_000, len(events)):
        ranges = cut(events, Windows.model_validate({"num_events": num_events, "max_windows": 64}))
        total = int((ranges[:, 1] - ranges[:, 0]).sum())
        expected = event_histogram.encode(events, ranges, options)
        line = f"{num_events:14,} {len(ranges):8}"
        for name, encode in methods.items():
            if not (encode(events, ranges, options) == expected).all():
                raise RuntimeError(f"{name} counts differently for windows of {num_events} events")
            seconds = best_time(lambda encode=encode, ranges=ranges: encode(events, ranges, options), repeats)
            line += f" {total / seconds / 1e6:18.1f}"
        print(line)


def bincount_encode(events: Events, windows: np.ndarray, options: event_histogram.Options) -> np.ndarray:
    """Peer: one bincount of flat cell numbers a window."""
    width, height = events.sensor_size
    result = np.empty((len(windows), 2, height, width), np.uint16)
    for row, (start, stop) in enumerate(windows):
        part = events.slice(start, stop)
        cells = ((1 - part.p.astype(np.int64)) * height + part.y) * width + part.x
        counts = np.bincount(cells, minlength=2 * height * width)
        result[row] = np.minimum(counts, 65535).reshape(2, height, width)
    return result


def add_at_encode(events: Events, windows: np.ndarray, options: event_histogram.Options) -> np.ndarray:
    """Peer: the plain NumPy loop."""
    width, height = events.sensor_size
    result = np.zeros((len(windows), 2, height, width), np.int64)
    for row, (start, stop) in enumerate(windows):
        part = events.slice(start, stop)
        np.add.at(result[row], (1 - part.p.astype(np.int64), part.y, part.x), 1)
    return np.minimum(result, 65535).astype(np.uint16)


if __name__ == "__main__":
    main()
