"""From counts to event streams: time stamps inside a window, drawn so that they look like those of recorded windows.

A histogram says how often a pixel fired, not when. What recorded windows say about that is fitted (`fit_times`):

    gaps          times between the events of a pixel, in windows: those of a real pixel with as many events
    starts        where in the window a pixel's events start, between the earliest and the latest possible: 0 .. 1. Of
                  pixels r px apart along an axis they have the rank correlation of a Gaussian field, whose correlation
                  is (1 - scatter) exp(-r^2 / (4 length^2)): an edge passes neighbours at like times, noise does not
    polarities    how much less often polarity changes within a pixel than if its events came in random order; counted
                  while a pixel has events of both polarities left, for then alone is there a choice
    durations     of windows with about as many events

The three ways to spread the events of a pixel, from the simplest: `uniform`, each on its own anywhere in the window;
`paced`, with recorded gaps from a start of its own; `field`, with recorded gaps from starts that a smooth field gives.
Which way an edge moves is not in an image: neighbours share a time, but which side of an edge was first is made up.

An image without polarity gives events that are all positive, as the event sets without polarity have them: the counts
say nothing else, and a drawn polarity would look like a measured one.

Source: rank correlation of a Gaussian pair, Pearson 1907: 6 / pi asin(rho / 2).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ctlev_core.events.windows import spread as spread_evenly
from data_contracts.errors import DataError
from data_contracts.events import Events

Spread = Literal["uniform", "paced", "field"]

LAGS_PX = (1, 2, 4, 8)
MAX_PIXELS = 1 << 16
"""Recorded pixels whose gaps are kept, evenly spread."""
LEAST_PIXELS = 16
"""Gaps are drawn from at least so many recorded pixels, also of other numbers of events where there are too few."""
NUM_LIKE = 16
"""A duration is that of one of so many windows with the most similar numbers of events."""
LONGEST_LENGTH_PX = 32.0


@dataclass(frozen=True, eq=False)
class TimeModel:
    """How R recorded windows spread their events; see the head of this file.

    Attributes:
        num_events: [R] int64, ascending.
        durations_us: [R] int64, of the same windows, from the first to the last event.
        gaps: [G] float64, in windows, of P recorded pixels with two events or more, by number of events.
        patterns: [P + 1] int64, where the gaps of each of them start.
        ranges: [M, 2] int64, which of them pixels with 2, 3, ... M + 1 or more events draw from.
        length_px: of the field of starts.
        scatter: share of the starts' variance that neighbours do not share, 0 .. 1.
        keep_polarity: 0 = random order, 1 = a pixel changes polarity at most once.
        least_gap_us: shortest time between two events of a pixel; 0 where no pixel fired twice.
    """

    num_events: np.ndarray
    durations_us: np.ndarray
    gaps: np.ndarray
    patterns: np.ndarray
    ranges: np.ndarray
    length_px: float
    scatter: float
    keep_polarity: float
    least_gap_us: int = 0


def fit_times(windows: Iterable[Events]) -> TimeModel:
    """Learn gaps, starts, polarities and durations from recorded windows.

    Args:
        windows: the events of one window each; those without two events at different times say nothing.
    Raises:
        DataError: no window has two events at different times.
    """
    found = [_measure(window) for window in windows if len(window) and window.t[-1] > window.t[0]]
    if not found:
        raise DataError("times cannot be learnt: no recorded window has two events at different times")
    gaps = _gaps_by_size([pixel for of in found for pixel in of.gaps])
    correlations = [_rank_correlation([of.neighbours[lag] for of in found]) for lag in range(len(LAGS_PX))]
    length_px, scatter = _fit_field(np.array(correlations))
    changes, expected = sum(of.changes for of in found), sum(of.expected_changes for of in found)
    keep_polarity = max(0.0, 1 - changes / expected) if expected else 0.0
    sizes = np.array([(of.num_events, of.duration_us) for of in found], np.int64)
    sizes = sizes[np.lexsort((sizes[:, 1], sizes[:, 0]))]
    shortest = [of.duration_us * pixel.min() for of in found for pixel in of.gaps]
    least_gap_us = round(min(shortest, default=0))
    return TimeModel(sizes[:, 0], sizes[:, 1], *gaps, length_px, scatter, keep_polarity, least_gap_us)


def sample_streams(
    counts: np.ndarray,
    model: TimeModel,
    *,
    seeds: Sequence[int],
    spread: Spread = "field",
    duration_us: int | None = None,
) -> Iterator[Events]:
    """One event stream for each histogram; counting its events gives the histogram again.

    Args:
        counts: [N, C, H, W] uint16; channels (positive, negative), or one without polarity.
        model: from `fit_times`.
        seeds: N seeds; a stream depends on its own counts and seed alone.
        spread: see the head of this file.
        duration_us: of every window; None = as long as recorded ones with as many events.
    Yields:
        Events on a sensor of W x H px, from 0 to the window's duration in us. Where all of a row's counts are 0, no
        events.
    Raises:
        ValueError: another shape or dtype, an image larger than 65,536 px a side, or another number of seeds.
    """
    if counts.ndim != 4 or counts.shape[1] not in (1, 2) or counts.dtype != np.uint16:
        raise ValueError(f"counts must be [N, 1 or 2, H, W] uint16, got {counts.shape} {counts.dtype}")
    if max(counts.shape[2:]) > 1 << 16:
        raise ValueError(f"images must have at most 65,536 px a side, got {counts.shape[3]} x {counts.shape[2]}")
    if len(seeds) != len(counts):
        raise ValueError(f"expected one seed a row, got {len(seeds)} seeds for {len(counts)} rows")
    return (
        _sample(np.ascontiguousarray(row), model, np.random.default_rng(seed), spread, duration_us)
        for row, seed in zip(counts, seeds, strict=True)
    )


def join_windows(windows: Sequence[Events], interval_us: int, least_gap_us: int) -> Events:
    """The streams of consecutive windows as one, the k-th from k times the interval on.

    Where a pixel fires at the end of a window and again at once in the next, the later event is put off until
    `least_gap_us` have passed, but not beyond its window, and events behind it likewise: each window keeps its events.

    Args:
        windows: of one sensor, from 0 us each, shorter than the interval.
        interval_us: from the start of one window to that of the next.
        least_gap_us: see `TimeModel`.
    """
    from ctlev_core.postprocessing import event_stream_kernels as kernels

    width = windows[0].sensor_size[0]
    numbers = np.repeat(np.arange(len(windows)), [len(window) for window in windows])
    t = np.concatenate([window.t for window in windows]) + numbers * interval_us
    x, y, p = (np.concatenate([getattr(window, name) for window in windows]) for name in "xyp")
    pixels = y.astype(np.int64) * width + x
    order = np.lexsort((t, pixels))
    moved = t[order]
    kernels.put_off(moved, pixels[order], numbers[order], interval_us, least_gap_us)
    t[order] = moved
    order = np.argsort(t, kind="stable")
    return Events(t[order], x[order], y[order], p[order], windows[0].sensor_size)


def sample_duration_us(num_events: int, model: TimeModel, rng: np.random.Generator) -> int:
    """The duration of one of the `NUM_LIKE` recorded windows whose numbers of events are closest, as ratios."""
    ratios = np.abs(np.log(model.num_events / max(num_events, 1)))
    closest = np.argsort(ratios, kind="stable")[:NUM_LIKE]
    # All that are as close as the last of them: windows of equal numbers of events are all alike.
    alike = np.flatnonzero(ratios <= ratios[closest[-1]])
    return int(model.durations_us[alike[rng.integers(len(alike))]])


def _sample(
    counts: np.ndarray, model: TimeModel, rng: np.random.Generator, spread: Spread, duration_us: int | None
) -> Events:
    from ctlev_core.postprocessing import event_stream_kernels as kernels

    height, width = counts.shape[1:]
    num_events = int(counts.sum(dtype=np.int64))
    if duration_us is None:
        duration_us = sample_duration_us(num_events, model, rng)
    is_active = np.asarray(counts.any(axis=0))
    places = _sample_places(is_active, model, rng) if spread == "field" else rng.random(np.count_nonzero(is_active))
    t, p = np.empty(num_events, np.int64), np.empty(num_events, np.uint8)
    x, y = np.empty(num_events, np.uint16), np.empty(num_events, np.uint16)
    real_gaps = model.gaps, model.patterns, model.ranges
    uniforms = rng.random((2, num_events))
    kernels.place_events(counts, places, uniforms, *real_gaps, model.keep_polarity, duration_us, t, x, y, p)
    if spread == "uniform":
        t = rng.integers(0, duration_us, num_events, endpoint=True)
    order = np.argsort(t, kind="stable")
    return Events(t[order], x[order], y[order], p[order], (width, height))


def _sample_places(is_active: np.ndarray, model: TimeModel, rng: np.random.Generator) -> np.ndarray:
    """Starts [A] float64 of the active pixels, each uniform in 0 .. 1, correlated as the model says."""
    import cv2
    from scipy.special import ndtr

    own = rng.standard_normal(np.count_nonzero(is_active))
    if model.scatter >= 1:
        return ndtr(own)
    radius = int(np.ceil(4 * model.length_px))
    kernel = cv2.getGaussianKernel(2 * radius + 1, model.length_px)
    height, width = is_active.shape
    # Drawn beyond the border too, so that the variance is the same everywhere.
    noise = rng.standard_normal((height + 2 * radius, width + 2 * radius), np.float32)
    smooth = cv2.sepFilter2D(noise, cv2.CV_32F, kernel, kernel)[radius : radius + height, radius : radius + width]
    shared = smooth[is_active].astype(np.float64) / float((kernel**2).sum())
    return ndtr(np.sqrt(1 - model.scatter) * shared + np.sqrt(model.scatter) * own)


@dataclass(frozen=True, eq=False)
class _Window:
    """What one window says.

    Attributes:
        num_events: in the window.
        duration_us: from the first to the last event.
        gaps: of each pixel with two events or more, in windows.
        neighbours: for each lag, starts [2, P] of pairs of pixels that both have events.
        changes: of polarity from an event of a pixel to its next, where events of both are left.
        expected_changes: if what is left came in random order.
    """

    num_events: int
    duration_us: int
    gaps: list[np.ndarray]
    neighbours: list[np.ndarray]
    changes: int
    expected_changes: float


def _measure(window: Events) -> _Window:
    width, height = window.sensor_size
    duration_us = int(window.t[-1] - window.t[0])
    pixels = window.y.astype(np.int64) * width + window.x
    order = np.argsort(pixels, kind="stable")  # of a pixel in order of time
    pixels, t = pixels[order], (window.t[order] - window.t[0]) / duration_us
    is_positive = window.p[order] > 0
    first = np.flatnonzero(np.concatenate([[True], pixels[1:] != pixels[:-1]]))
    sizes = np.diff(first, append=len(pixels))
    gaps = np.diff(t, prepend=0.0)
    room = 1 - (t[first + sizes - 1] - t[first])
    starts = np.full(height * width, np.nan)
    starts[pixels[first]] = np.divide(t[first], room, out=np.full(len(first), 0.5), where=room > 0)
    changes, expected_changes = _count_changes(is_positive, first, sizes)
    return _Window(
        num_events=len(window),
        duration_us=duration_us,
        gaps=[part[1:] for part in np.split(gaps, first[1:]) if len(part) > 1],
        neighbours=[_pairs(starts.reshape(height, width), lag) for lag in LAGS_PX],
        changes=changes,
        expected_changes=expected_changes,
    )


def _count_changes(is_positive: np.ndarray, first: np.ndarray, sizes: np.ndarray) -> tuple[int, float]:
    """`changes` and `expected_changes` of a window.

    Args:
        is_positive: [E] bool, pixel after pixel, in order of time.
        first: [A] where the events of each pixel start.
        sizes: [A] how many it has.
    """
    start = np.repeat(first, sizes)
    left = start + np.repeat(sizes, sizes) - np.arange(len(is_positive))
    passed = np.cumsum(is_positive) - is_positive
    left_positive = np.repeat(np.add.reduceat(is_positive.astype(np.int64), first), sizes) - (passed - passed[start])
    is_free = (np.arange(len(start)) > start) & (left_positive > 0) & (left_positive < left)
    was_positive = np.concatenate([[False], is_positive[:-1]])[is_free]
    left, left_positive = left[is_free], left_positive[is_free]
    others = np.where(was_positive, left - left_positive, left_positive)
    return int(np.count_nonzero(is_positive[is_free] != was_positive)), float((others / left).sum())


def _pairs(starts: np.ndarray, lag: int) -> np.ndarray:
    """Starts [2, P] of the pixels `lag` px apart along an axis that both have one."""
    pairs = [(starts[:, lag:], starts[:, :-lag]), (starts[lag:], starts[:-lag])]
    stacked = np.concatenate([np.stack([a.reshape(-1), b.reshape(-1)]) for a, b in pairs], axis=1)
    return stacked[:, np.isfinite(stacked).all(axis=0)]


def _gaps_by_size(pixels: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`gaps`, `patterns` and `ranges` of a model. Where no pixel fired twice, its gap would be that of random times."""
    if not pixels:
        pixels = [np.array([gap]) for gap in 1 - np.sqrt(1 - (np.arange(LEAST_PIXELS) + 0.5) / LEAST_PIXELS)]
    pixels = sorted(pixels, key=len)
    pixels = [pixels[number] for number in spread_evenly(len(pixels), MAX_PIXELS)]
    sizes = np.array([len(pixel) for pixel in pixels])
    wanted = np.arange(1, sizes[-1] + 1)
    low, high = np.searchsorted(sizes, wanted), np.searchsorted(sizes, wanted, "right")
    lacking = np.maximum(LEAST_PIXELS - (high - low), 0)
    low = np.clip(low - (lacking + 1) // 2, 0, max(len(sizes) - LEAST_PIXELS, 0))
    high = np.minimum(np.maximum(high, low + LEAST_PIXELS), len(sizes))
    return np.concatenate(pixels), np.concatenate([[0], np.cumsum(sizes)]), np.stack([low, high], axis=1)


def _rank_correlation(parts: list[np.ndarray]) -> float:
    """Of all pairs; 0 where there are too few, or all starts are equal."""
    from scipy.stats import rankdata

    pairs = np.concatenate(parts, axis=1)
    if pairs.shape[1] < 3 or (pairs == pairs[:, :1]).all(axis=1).any():
        return 0.0
    return float(np.corrcoef(rankdata(pairs, axis=1))[0, 1])


def _fit_field(correlations: np.ndarray) -> tuple[float, float]:
    """Length and scatter whose rank correlations at `LAGS_PX` come closest: least squares on a grid."""
    lengths, scatters = np.geomspace(0.4, LONGEST_LENGTH_PX, 89), np.linspace(0, 1, 101)
    decays = np.exp(-(np.array(LAGS_PX) ** 2) / (4 * lengths[:, None] ** 2))
    expected = 6 / np.pi * np.arcsin((1 - scatters)[:, None, None] * decays / 2)
    errors = ((expected - correlations) ** 2).sum(axis=2)
    scatter, length = np.unravel_index(np.argmin(errors), errors.shape)
    return float(lengths[length]), float(scatters[scatter])
