"""Fit a simulation of recorded pictures to real recordings: thresholds, noise, silence, place and sign of the picture.

What is fitted, and from what:

    noise          events of pixels that the picture never reaches: one polarity in excess is leak, the rest shot noise.
                   A recording starts with pixels anywhere between two thresholds, and in the first 1 / rate a leak
                   sends half of its events: in a shorter one it is twice what is counted
    hot pixels     pixels with far more events than all their neighbours, and their rates
    flipped        a leak sends ON events, so p = 0 is ON where more noise is 0
    refractory     the interval between two events of a pixel that one in a hundred is below
    negative       ON events are ahead of OFF events in a bright picture's motion, and behind in a dark one's
    centre, size   middle and spread of the events of real recordings and of simulated ones
    thresholds     the number of events without noise of either polarity: contrast and threshold enter as their quotient
                   alone, so this is the threshold at the contrast that the options give

Each recording is compared with a picture of its class, not with the very picture it was recorded from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize

Simulate = Callable[[np.ndarray, SensorSize, dict[str, Any]], Iterator[Events]]
"""From numbers of pictures, sensor size and options to the events of each."""
NUM_BINS = 12
MAX_SIMULATED = 40
QUIET_MARGIN_PX = 3
MIN_QUIET_PX = 16
HOT_FACTOR, HOT_EVENTS = 3.0, 20
INTERVAL_SHARE = 0.01
MIN_INTERVALS = 200
ROUNDS, TRIES, TOLERANCE = 3, 5, 0.005
SIZE_POWER = 1.2
"""Spread grows less than size, for the path has its share of it."""
MIN_THRESHOLD, MAX_THRESHOLD = 0.02, 3.0
LEAK_SIGMAS = NOISE_SIGMAS = 3.0
"""What is taken for leak, and for events of a picture, must be this many standard deviations above chance."""


@dataclass(eq=False)
class Sums:
    """What is kept of recordings: all of it sums.

    Attributes:
        counts: [2, H, W], events of p = 0 and 1.
        of_bins: [2, B, 3]: number, sum of x and of y of the events of each polarity and time.
        seconds: length of all recordings.
        num: recordings.
        intervals_us: of each recording with enough, the quantile `INTERVAL_SHARE` of the intervals of a pixel.
    """

    counts: np.ndarray
    of_bins: np.ndarray
    seconds: float
    num: int
    intervals_us: list[float]


def fit(
    recordings: Iterable[Events],
    class_names: Sequence[str],
    picture_names: Sequence[str],
    simulate: Simulate,
    start: dict[str, Any],
    given: set[str],
    duration_us: int,
) -> tuple[dict[str, Any], dict[str, float]]:
    """The options that make simulated recordings like real ones.

    Args:
        recordings: N real ones.
        class_names: N.
        picture_names: classes of the pictures that there are.
        simulate: records some of them.
        start: first values of the options `centre_px`, `picture_share`, `negative`, `flipped`, `threshold`,
            `threshold_off`, `refractory_us`, `leak_rate_hz`, `shot_noise_rate_hz` and `hot_pixels`.
        given: those of them that stay as they are.
        duration_us: of a simulated recording.
    Returns:
        All those options, and what was measured.
    Raises:
        DataError: no recording has events, or all of them are noise.
    """
    real, size = _sum_up(recordings, duration_us)
    rows = _pictures_for(class_names, picture_names)
    found = dict(start)

    def set_open(**values: Any) -> None:
        found.update({name: value for name, value in values.items() if name not in given})

    def simulated(**changes: Any) -> Sums:
        return _sum_up(simulate(rows, size, found | changes), duration_us)[0]

    silent = {"leak_rate_hz": 0.0, "shot_noise_rate_hz": 0.0, "hot_pixels": ()}
    if real.intervals_us:
        set_open(refractory_us=round(float(np.median(real.intervals_us))))
    set_open(hot_pixels=_take_hot(real))
    set_open(centre_px=_moved(found["centre_px"], real.counts.sum(axis=0), simulated(**silent)))
    quiet = _quiet(simulated(**silent).counts.sum(axis=0))
    num_quiet = int(np.count_nonzero(quiet))
    noise_hz = np.zeros(2)
    if num_quiet >= MIN_QUIET_PX:
        noise_hz = real.counts[:, quiet].mean(axis=1) / real.seconds
        error_hz = np.sqrt(noise_hz.sum() / (num_quiet * real.seconds))
        excess_hz = abs(noise_hz[1] - noise_hz[0])
        set_open(flipped=bool(noise_hz[0] > noise_hz[1] and excess_hz > LEAK_SIGMAS * error_hz))
        early = excess_hz * real.seconds / real.num < 0.5
        set_open(leak_rate_hz=float(excess_hz * (2 if early else 1)), shot_noise_rate_hz=float(2 * noise_hz.min()))
    # Where there is noise alone, the sums of what is left of it would blur place and size.
    signal = np.where(quiet, 0.0, real.counts - (noise_hz * real.seconds)[:, None, None])
    set_open(negative=bool(found["negative"]) ^ (_agreement(real, simulated(**silent)) < 0))
    wanted = signal.sum(axis=(1, 2)) / real.num
    if wanted.sum() * real.num <= NOISE_SIGMAS * np.sqrt(real.counts.sum()):
        raise DataError("calibration: expected recordings of pictures, got none with more events than their noise")
    if found["flipped"]:
        wanted = wanted[::-1]  # from here on by light
    for _ in range(ROUNDS):
        _fit_thresholds(wanted, found, given, lambda: simulated(**silent))
        made = simulated(**silent)
        larger = _spread(signal.sum(axis=0)) / max(_spread(made.counts.sum(axis=0)), 1e-9)
        set_open(centre_px=_moved(found["centre_px"], signal.sum(axis=0), made))
        set_open(picture_share=float(found["picture_share"] * np.clip(larger**SIZE_POWER, 0.8, 1.25)))
    _fit_thresholds(wanted, found, given, lambda: simulated(**silent))
    made = simulated()
    return found, {
        "recordings": float(real.num),
        "quiet_pixels": float(num_quiet),
        "hot_pixels": float(len(found["hot_pixels"])),
        "noise_p0_hz": float(noise_hz[0]),
        "noise_p1_hz": float(noise_hz[1]),
        "events_per_recording": float(real.counts.sum() / real.num),
        "simulated_events_per_recording": float(made.counts.sum() / made.num),
        "p1_share": float(real.counts[1].sum() / real.counts.sum()),
        "simulated_p1_share": float(made.counts[1].sum() / max(made.counts.sum(), 1)),
        "agreement_of_motion": _agreement(real, made),
    }


def _sum_up(recordings: Iterable[Events], duration_us: int) -> tuple[Sums, SensorSize]:
    sums: Sums | None = None
    size: SensorSize = (0, 0)
    for events in recordings:
        if sums is None:
            size = events.sensor_size
            sums = Sums(np.zeros((2, size[1], size[0])), np.zeros((2, NUM_BINS, 3)), 0.0, 0, [])
        if events.sensor_size != size:
            raise DataError(f"calibration: sensors differ in size, {events.sensor_size} px after {size} px")
        _add(sums, events, duration_us)
    if sums is None or not sums.counts.any():
        raise DataError("calibration: no recording has events")
    return sums, size


def _add(sums: Sums, events: Events, duration_us: int) -> None:
    sums.num += 1
    if len(events) == 0:
        sums.seconds += 1e-6 * duration_us
        return
    # Recordings start with their path, but some clocks do not start with the recording.
    t = events.t if events.t[-1] <= 1.5 * duration_us else events.t - events.t[0]
    sums.seconds += 1e-6 * max(float(t[-1]), float(duration_us))
    np.add.at(sums.counts, (events.p, events.y, events.x), 1)
    bins = np.minimum(t * NUM_BINS // duration_us, NUM_BINS - 1)
    cells = events.p.astype(np.int64) * NUM_BINS + bins
    for column, weights in enumerate((None, events.x, events.y)):
        sums.of_bins[..., column] += np.bincount(cells, weights, 2 * NUM_BINS).reshape(2, NUM_BINS)
    pixel = events.y.astype(np.int64) * events.sensor_size[0] + events.x
    order = np.argsort(pixel, kind="stable")
    intervals_us = np.diff(events.t[order])[np.diff(pixel[order]) == 0]
    if len(intervals_us) >= MIN_INTERVALS:
        sums.intervals_us.append(float(np.quantile(intervals_us, INTERVAL_SHARE)))


def _pictures_for(class_names: Sequence[str], picture_names: Sequence[str]) -> np.ndarray:
    """Numbers of pictures of the recordings' classes, in turn: of a class without pictures any."""
    rows_of: dict[str, list[int]] = {}
    for row, name in enumerate(picture_names):
        rows_of.setdefault(name, []).append(row)
    every = list(range(len(picture_names)))
    repeats = -(-MAX_SIMULATED // max(len(class_names), 1))
    taken: dict[str, int] = {}
    rows = []
    for name in list(class_names) * repeats:
        own = rows_of.get(name, every)
        rows.append(own[taken.get(name, 0) % len(own)])
        taken[name] = taken.get(name, 0) + 1
    # Evenly spread, so that every class is there.
    return np.array(rows)[np.arange(MAX_SIMULATED) * len(rows) // MAX_SIMULATED]


def _quiet(counts: np.ndarray) -> np.ndarray:
    """Pixels [H, W] bool, `QUIET_MARGIN_PX` or more away from any that sent events."""
    active = np.pad(counts > 0, QUIET_MARGIN_PX)
    height, width = counts.shape
    reach = range(2 * QUIET_MARGIN_PX + 1)
    return ~np.any([active[y : y + height, x : x + width] for y in reach for x in reach], axis=0)


def _take_hot(real: Sums) -> tuple[tuple[int, int, float], ...]:
    """Pixels that outdo all their neighbours, (x, y, Hz); their events are taken off the sums of pixels."""
    total = real.counts.sum(axis=0)
    padded = np.pad(total, 1)
    height, width = total.shape
    around = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3) if (x, y) != (1, 1)]
    highest = np.max(around, axis=0)
    found = []
    for y, x in np.argwhere((total > HOT_FACTOR * highest) & (total >= HOT_EVENTS)).tolist():
        real.counts[:, y, x] *= highest[y, x] / total[y, x]
        found.append((x, y, float((total[y, x] - highest[y, x]) / real.seconds)))
    return tuple(found)


def _agreement(real: Sums, made: Sums) -> float:
    """Cosine of where p = 1 is against p = 0, over the time of real and of simulated recordings."""
    first, second = (_dipoles(sums) for sums in (real, made))
    return float((first * second).sum() / max(np.linalg.norm(first) * np.linalg.norm(second), 1e-12))


def _dipoles(sums: Sums) -> np.ndarray:
    """[B, 2]: middle of the events of p = 1 less that of p = 0, px, times the number of events."""
    number = sums.of_bins[..., :1]
    middle = sums.of_bins[..., 1:] / np.maximum(number, 1)
    return (middle[1] - middle[0]) * number.min(axis=0)


def _moved(centre_px: tuple[float, float], signal: np.ndarray, made: Sums) -> tuple[float, float]:
    """The centre by which simulated events move to where those of `signal` [H, W] are."""
    shift = _middle(signal) - _middle(made.counts.sum(axis=0))
    return float(centre_px[0] + shift[0]), float(centre_px[1] + shift[1])


def _middle(counts: np.ndarray) -> np.ndarray:
    """(x, y) px."""
    y, x = np.indices(counts.shape)
    return np.array([(counts * x).sum(), (counts * y).sum()]) / max(float(counts.sum()), 1e-9)


def _spread(counts: np.ndarray) -> float:
    """Standard deviation of events from their middle, px."""
    y, x = np.indices(counts.shape)
    middle = _middle(counts)
    squares = (x - middle[0]) ** 2 + (y - middle[1]) ** 2
    return float(np.sqrt((counts * squares).sum() / max(float(counts.sum()), 1e-9)))


def _fit_thresholds(wanted: np.ndarray, found: dict[str, Any], given: set[str], run: Callable[[], Sums]) -> None:
    """Change `found` until events a recording of falling and rising light are `wanted` [2]."""
    names = ("threshold_off", "threshold")
    free = np.array([name not in given for name in names])
    if not free.any():
        return
    for _ in range(TRIES):
        made = run()
        counts = made.counts.sum(axis=(1, 2)) / made.num
        if found["flipped"]:
            counts = counts[::-1]
        ratio = np.maximum(counts, 1.0) / np.maximum(wanted, 1.0)
        if (np.abs(np.log(ratio[free])) < TOLERANCE).all():
            return
        # Both thresholds follow the number of all events, which falls about as 1 / threshold; their ratio follows the
        # ratio of the polarities, for light that comes back lets n_on threshold_on be n_off threshold_off.
        mean = np.log(counts.sum() / wanted.sum())
        steps = np.array([mean, mean]) + 0.5 * np.array([1, -1]) * (np.log(ratio[0] / ratio[1]))
        if not free.all():
            steps = np.log(ratio)
        for name, step in zip(names, steps, strict=True):
            if name not in given:
                scaled = found[name] * float(np.exp(np.clip(step, -1.0, 1.0)))
                found[name] = min(max(scaled, MIN_THRESHOLD), MAX_THRESHOLD)
