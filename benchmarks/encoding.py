"""How fast events become event histograms, beside the peers and beside the speed at which memory can be read.

    python benchmarks/encoding.py
    python benchmarks/encoding.py --events 4000000 --rounds 5

One thread; millions of events a CPU second, the median of interleaved rounds. Each scene is counted whole, in windows
of 7,500 events and in windows of 8.333 ms at `--rate` events a second, on sensors of 346 x 260 and 640 x 480 px.
Scenes: `uniform`, random over the sensor, the worst case for caches; `spot`, four fifths of the events in a spot that
wanders.

Two ways to take the result. `kept`: one new array holds every window, as ctlev's tasks want it; new memory is most of
the cost then. `streamed`: one window after the other into memory that is used again (for peers: an array a window,
dropped at once; tonic, which has one way only, is compared with both). `limit` is one pass over the 5 bytes an event
in the columns x, y and p, in the same rounds; the events of `whole` do not fit the caches. `increments` is what is left
when cell numbers are known, nothing is checked and counts wrap: one increment an event in a byte a cell. `new memory`
is the making of the array of `kept` alone. Peers that are not installed are left out, and every result is checked
against ours first. Slow peers count the first `--slow-events` events where the window is the whole.
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit

from ctlev_core.encodings import event_histogram
from ctlev_core.events.windows import cut
from data_contracts.config import Windows
from data_contracts.events import Events, SensorSize

SENSORS: tuple[SensorSize, ...] = ((346, 260), (640, 480))
METHODS = {
    "whole": Windows.model_validate({"method": "whole"}),
    "7,500 events": Windows.model_validate({"method": "count", "num_events": 7500}),
    "8.333 ms": Windows.model_validate({"method": "duration", "duration_us": 8333}),
}
TONIC_WANTED, BINCOUNT_WANTED, LIMIT_WANTED = 40.0, 3.0, 2.0


@dataclass(frozen=True)
class Job:
    """Something to time, and how many events it counts."""

    name: str
    run: Callable[[], object]
    num_events: int


def main() -> None:
    """Print one table a sensor and scene, then what was reached."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", type=int, default=16_000_000, help="events of `whole`")
    parser.add_argument("--window-events", type=int, default=2_000_000, help="events cut into the shorter windows")
    parser.add_argument("--slow-events", type=int, default=1_000_000, help="events for the slow peers in `whole`")
    parser.add_argument("--rate", type=float, default=5e6, help="events a second")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    missed: list[str] = []
    for sensor_size in SENSORS:
        for scene in (uniform, spot):
            events = scene(arguments.events, sensor_size, arguments.rate)
            print(f"\n{scene.__name__}, {sensor_size[0]} x {sensor_size[1]} px: Mev per CPU second (ratio to ctlev)")
            for method, windows in METHODS.items():
                part = events if method == "whole" else events.slice(0, arguments.window_events)
                ranges = cut(part, windows)
                speeds = measure(jobs(part, ranges, method, arguments.slow_events), arguments.rounds)
                where = f"{scene.__name__} {sensor_size[0]} x {sensor_size[1]}, {method}"
                missed += print_speeds(f"{method} ({len(ranges)})", speeds, where)
    print("\nTargets missed:" if missed else "\nEvery target was met.")
    for line in missed:
        print(" ", line)


def uniform(num_events: int, sensor_size: SensorSize, rate: float) -> Events:
    """Every pixel as likely as any other."""
    rng = np.random.default_rng(0)
    x, y = (rng.integers(0, size, num_events, dtype=np.uint16) for size in sensor_size)
    return Events(_times(num_events, rate), x, y, rng.integers(0, 2, num_events, dtype=np.uint8), sensor_size)


def spot(num_events: int, sensor_size: SensorSize, rate: float) -> Events:
    """Four fifths in a Gaussian spot (sigma a twentieth of the sensor) that circles twice a second, rest uniform."""
    rng = np.random.default_rng(0)
    t = _times(num_events, rate)
    phase = (t * (4e-6 * np.pi)).astype(np.float32)
    is_noise = rng.random(num_events, dtype=np.float32) < 0.2
    columns = []
    for size, wave in zip(sensor_size, (np.cos(phase), np.sin(phase)), strict=True):
        column = rng.normal(size=num_events).astype(np.float32) * (size / 20) + size * (0.5 + 0.3 * wave)
        column[is_noise] = rng.random(int(is_noise.sum()), dtype=np.float32) * size
        columns.append(column.clip(0, size - 1).astype(np.uint16))
    return Events(t, columns[0], columns[1], rng.integers(0, 2, num_events, dtype=np.uint8), sensor_size)


def _times(num_events: int, rate: float) -> np.ndarray:
    return (np.arange(num_events) * (1e6 / rate)).astype(np.int64)


def jobs(events: Events, ranges: np.ndarray, method: str, slow_events: int) -> list[Job]:
    """Ours, the peers that are installed, and the reading of memory."""
    options = event_histogram.Options()
    counted = int((ranges[:, 1] - ranges[:, 0]).sum())
    width, height = events.sensor_size
    found = [
        Job("limit", lambda: read_columns(events), len(events)),
        *increments(events, ranges),
        Job("new memory", lambda: new_memory((len(ranges), 2, height, width)), counted),
        Job("ctlev", lambda: event_histogram.encode(events, ranges, options), counted),
        Job("ctlev streamed", lambda: drop(event_histogram.encode_each(events, ranges, options)), counted),
        Job("bincount", lambda: keep(bincount(events, ranges), ranges, events), counted),
        Job("bincount streamed", lambda: drop(bincount(events, ranges)), counted),
    ]
    if importlib.util.find_spec("torch"):
        found.append(Job("torch", lambda: keep(torch_index_add(events, ranges), ranges, events), counted))
        found.append(Job("torch streamed", lambda: drop(torch_index_add(events, ranges)), counted))
    few = events if method != "whole" else events.slice(0, slow_events)
    few_ranges = ranges if method != "whole" else np.array([[0, len(few)]])
    few_counted = int((few_ranges[:, 1] - few_ranges[:, 0]).sum())
    found.append(Job("add.at", lambda: keep(add_at(few, few_ranges), few_ranges, few), few_counted))
    check(keep(add_at(few, few_ranges), few_ranges, few), few, few_ranges, "np.add.at")
    if importlib.util.find_spec("tonic"):
        records, to_frame = tonic_to_frame(few, few_ranges, method)
        found.append(Job("tonic", lambda: to_frame(records), few_counted))
        # Its channels are (negative, positive), and it keeps an incomplete last window.
        check(to_frame(records)[: len(few_ranges), ::-1], few, few_ranges, "tonic")
    for job in found:
        result = job.run()
        if isinstance(result, np.ndarray) and job.name in ("bincount", "torch"):
            check(result, events, ranges, job.name)
    return found


def check(result: np.ndarray, events: Events, ranges: np.ndarray, name: str) -> None:
    """Raise unless a peer counted what we count."""
    expected = event_histogram.encode(events, ranges, event_histogram.Options())
    if not np.array_equal(result, expected):
        raise RuntimeError(f"{name} counts differently in {int((result != expected).sum())} cells")


def keep(windows: Iterator[np.ndarray], ranges: np.ndarray, events: Events) -> np.ndarray:
    """Collect the windows of a generator in one new array."""
    width, height = events.sensor_size
    kept = np.empty((len(ranges), 2, height, width), np.uint16)
    for row, counts in enumerate(windows):
        np.minimum(counts.reshape(2, height, width), 65535, out=kept[row], casting="unsafe")
    return kept


def drop(windows: Iterator[np.ndarray]) -> None:
    """Look at the windows of a generator, one after the other."""
    for _ in windows:
        pass


def _cells(events: Events, start: int, stop: int, dtype: type) -> np.ndarray:
    width, height = events.sensor_size
    part = events.slice(start, stop)
    return ((1 - part.p.astype(dtype)) * height + part.y) * width + part.x


def bincount(events: Events, ranges: np.ndarray) -> Iterator[np.ndarray]:
    """One np.bincount of flat cell numbers a window."""
    num_cells = 2 * events.sensor_size[0] * events.sensor_size[1]
    for start, stop in ranges.tolist():
        yield np.bincount(_cells(events, start, stop, np.int64), minlength=num_cells)


def torch_index_add(events: Events, ranges: np.ndarray) -> Iterator[np.ndarray]:
    """One torch index_add_ of ones a window."""
    import torch

    torch.set_num_threads(1)
    num_cells = 2 * events.sensor_size[0] * events.sensor_size[1]
    for start, stop in ranges.tolist():
        cells = torch.from_numpy(_cells(events, start, stop, np.int64))
        counts = torch.zeros(num_cells, dtype=torch.int32)
        yield counts.index_add_(0, cells, torch.ones(stop - start, dtype=torch.int32)).numpy()


def add_at(events: Events, ranges: np.ndarray) -> Iterator[np.ndarray]:
    """The plain NumPy loop."""
    width, height = events.sensor_size
    for start, stop in ranges.tolist():
        part = events.slice(start, stop)
        counts = np.zeros((2, height, width), np.int32)
        np.add.at(counts, (1 - part.p, part.y, part.x), 1)
        yield counts


def tonic_to_frame(
    events: Events, ranges: np.ndarray, method: str
) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """The transform of tonic and the array of records it takes; making that is not timed."""
    from tonic.transforms import ToFrame  # pyright: ignore[reportMissingImports]

    counted = events.slice(0, int(ranges[-1, 1])) if method == "7,500 events" else events
    records = np.zeros(len(counted), [("x", np.int16), ("y", np.int16), ("t", np.int64), ("p", np.int8)])
    for name in ("x", "y", "t", "p"):
        records[name] = getattr(counted, name)
    how = {"whole": {"n_event_bins": 1}, "7,500 events": {"event_count": 7500}, "8.333 ms": {"time_window": 8333}}
    return records, ToFrame(sensor_size=(*events.sensor_size, 2), **how[method])


def increments(events: Events, ranges: np.ndarray) -> list[Job]:
    """Increments alone, for the recording as a whole: a bound for every method that makes one an event."""
    if len(ranges) > 1:
        return []
    cells = _cells(events, 0, len(events), np.int64).astype(np.uint32)
    counts = np.zeros(2 * events.sensor_size[0] * events.sensor_size[1], np.uint8)
    return [Job("increments", lambda: _increment(cells, counts), len(events))]


@njit(nogil=True)
def _increment(cells: np.ndarray, counts: np.ndarray) -> None:
    for i in range(len(cells)):
        counts[np.uint64(cells[i])] += np.uint8(1)


def new_memory(shape: tuple[int, ...]) -> None:
    """Make the array of all windows and let the operating system clear every page of it: what `kept` cannot avoid."""
    np.zeros(shape, np.uint16).reshape(-1)[::2048] = 0


def read_columns(events: Events) -> None:
    """One pass over the columns the histogram needs."""
    for column in (events.x, events.y, events.p):
        usable = len(column) // 8 * 8
        _read(column[:usable].view(np.uint64))


@njit(nogil=True)
def _read(words: np.ndarray) -> np.uint64:
    total = np.uint64(0)
    for i in range(len(words)):
        total += words[i]
    return total


def measure(found: list[Job], rounds: int) -> dict[str, float]:
    """Median events per CPU second of each job; the rounds are interleaved, because a machine's speed drifts."""
    seconds: dict[str, list[float]] = {job.name: [] for job in found}
    for _ in range(rounds):
        for job in found:
            start = time.process_time()
            job.run()
            seconds[job.name].append(time.process_time() - start)
    return {job.name: job.num_events / statistics.median(seconds[job.name]) for job in found}


def print_speeds(head: str, speeds: dict[str, float], where: str) -> list[str]:
    """One line a job, and which targets were missed."""
    ours = {"kept": speeds["ctlev"], "streamed": speeds["ctlev streamed"]}
    print(f"  {head}")
    for name, speed in speeds.items():
        mine = ours["streamed" if name.endswith("streamed") else "kept"]
        print(f"    {name:18} {speed / 1e6:9.1f}   ({speed / mine:.3f})")
    missed = []
    wanted = [("bincount", BINCOUNT_WANTED, "kept"), ("bincount streamed", BINCOUNT_WANTED, "streamed")]
    wanted += [("tonic", TONIC_WANTED, way) for way in ours if "tonic" in speeds]
    for name, ratio, way in wanted:
        if ours[way] < ratio * speeds[name]:
            missed.append(f"{where}, {way}: {ours[way] / speeds[name]:.1f} x {name}, wanted {ratio:g}")
    if "whole" in where and speeds["ctlev"] * LIMIT_WANTED < speeds["limit"]:
        missed.append(
            f"{where}: {speeds['limit'] / speeds['ctlev']:.1f} x slower than reading, wanted {LIMIT_WANTED:g}"
        )
    return missed


if __name__ == "__main__":
    main()
