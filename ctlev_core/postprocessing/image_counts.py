"""From event images back to counts: the inverse of the event histogram's rendering, as far as there is one.

An image holds v = min(255, floor(255 count / full scale)). Two things are lost: the full scale, and the counts of
saturated pixels. Both are found again from what recorded windows say (`fit_counts`):

* Full scale. The values of a recorded image lie on the levels floor(255 k / scale), k = 0, 1, 2, ..., which few scales
  explain. Of those the one is taken under which the counts are most probable, given how often recorded windows of such
  a scale have each count. The values of a generated image scatter around levels: of a grid of scales, each blurred by
  decoders of several widths, the one is taken under which the values and the number of events are most probable, and
  for each value the most probable count. So faint values become events only where levels lie that close.
* Saturated pixels. Their counts are drawn from the recorded ones, as multiples of the full scale. With `three_sigma`
  the full scale follows from all counts, so they are then changed, event by event, until it does.

Rendered again, the counts give a recorded image exactly. For a generated image there are in general no counts that do;
`CountEstimate` says how far it moved. Exactness ends where full scales are above 255: with `three_sigma` isolated
events are then black.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ctlev_core import plugins
from ctlev_core.events.windows import spread
from data_contracts.errors import DataError

if TYPE_CHECKING:
    from ctlev_core.encodings.event_histogram import Options

MAX_WINDOWS = 256
"""Recorded windows learnt from, evenly spread."""
MAX_SCALES = 256
BLURS = (0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 11.0, 16.0)
"""Standard deviations of the decoders tried, grey levels."""
FAINT = 26
"""Values below do not decide about the scale: what a decoder makes of the many black pixels would outweigh the rest."""
NUM_QUANTILES = 257
LEAST_DEVIATION = 0.1
"""Of the logarithm of the number of events: where recorded windows have equally many, images may have others."""
BANDWIDTH = 0.1
"""Of the smoothing over full scales, natural logarithm: recorded windows within 10 % lend one another their counts."""
_FLOOR = 1e-9
"""Probability of a count, or value, that no recorded window has, so that one such pixel does not decide alone."""
_CHANCE = 0.05
"""Levels that random values would fit with more probability than this say nothing."""
_MAX_RANGES = 1 << 14
_TRIED_RANGES = 8
_NUM_DRAWS = 1 << 10


@dataclass(frozen=True, eq=False)
class CountModel:
    """What recorded windows say about the counts behind an image.

    Attributes:
        options: of the event histogram.
        full_scales: [R] float64, of R recorded windows: the count that became 255; 1 where it was less.
        count_shares: [R, 256] float64, cells with each count over all cells of the window; larger ones in the last.
        grid: [G] float64, ascending: full scales that generated images may have.
        log_probabilities: [G, B, 256] float64, of each value at each of these scales, after each of B blurs, among the
            values that are not faint; 0 for those that are.
        counts: [G, B, 256] float32, the most probable count of each value there, that of saturated cells on average.
        log_num_events: mean and standard deviation of the logarithm of the number of events of recorded windows.
        excess: [Q] float64, ascending: quantiles of count / full scale of saturated cells, at least 1.
    """

    options: Options
    full_scales: np.ndarray
    count_shares: np.ndarray
    grid: np.ndarray
    log_probabilities: np.ndarray
    counts: np.ndarray
    log_num_events: tuple[float, float]
    excess: np.ndarray


@dataclass(frozen=True, eq=False)
class CountEstimate:
    """Counts of N images.

    Attributes:
        counts: [N, C, H, W] uint16, channels as the event histogram has them.
        frames: [N, H, W, 3] uint8, the images that these counts are rendered to.
        is_exact: [N] bool, equal to the images given?
        error_levels: [N] float64, mean absolute difference of both images over the values that are not 0 in both; 0
            where all are.
    """

    counts: np.ndarray
    frames: np.ndarray
    is_exact: np.ndarray
    error_levels: np.ndarray


def fit_counts(histograms: np.ndarray, options: Options) -> CountModel:
    """Learn full scales, counts and saturated counts from recorded windows.

    Args:
        histograms: [N, C, H, W] uint16, counts of recorded windows as the event histogram encodes them.
        options: of the event histogram.
    Raises:
        DataError: no window has an event.
        ValueError: the shape or dtype is not that of counts encoded with these options.
    """
    chosen = spread(len(histograms), MAX_WINDOWS)
    counts = np.ascontiguousarray(histograms[chosen]) if len(chosen) else histograms
    encoding = plugins.load("encodings", "event_histogram")
    values = encoding.render_image(counts, options)[..., 0]  # checks shape and dtype
    counts = counts[counts.any(axis=(1, 2, 3))]
    if len(counts) == 0:
        raise DataError(f"counts cannot be learnt: none of {len(values)} recorded windows has an event")
    scales = np.maximum(encoding.full_scales(counts, options), 1.0)
    shares = np.stack([np.bincount(np.minimum(row, 255).reshape(-1), minlength=256) for row in counts])
    shares = shares / counts[0].size
    relative = [row[row >= scale] / scale for row, scale in zip(counts, scales, strict=True)]
    saturated = np.concatenate(relative)
    excess = np.quantile(saturated, np.linspace(0, 1, NUM_QUANTILES)) if len(saturated) else np.ones(1)
    grid = _grid(scales, options)
    levels = np.stack([_level_shares(_shares_at(scale, scales, shares), scale) for scale in grid])
    blurred = np.stack([levels @ _blur(width) for width in BLURS], axis=1)
    blurred = blurred[:, :, FAINT:] + _FLOOR
    log_probabilities = np.zeros((*blurred.shape[:2], 256))
    log_probabilities[:, :, FAINT:] = np.log(blurred / blurred.sum(axis=2, keepdims=True))
    num_events = np.log(counts.sum(axis=(1, 2, 3), dtype=np.float64))
    log_num_events = float(num_events.mean()), max(float(num_events.std()), LEAST_DEVIATION)
    tables = np.empty(log_probabilities.shape, np.float32)
    for number, scale in enumerate(grid):
        of_scale = _shares_at(scale, scales, shares)
        for blur, width in enumerate(BLURS):
            table = _most_probable_counts(scale, of_scale, width)
            tables[number, blur] = np.where(table < 0, max(scale * excess.mean(), 1.0), table)
    return CountModel(options, scales, shares, grid, log_probabilities, tables, log_num_events, excess)


def estimate_counts(frames: np.ndarray, model: CountModel, *, seeds: Sequence[int]) -> CountEstimate:
    """Counts of event images; see the head of this file.

    Args:
        frames: [N, H, W, 3] uint8; with polarity red = positive and blue = negative (green is not looked at), without
            the mean of the channels counts.
        model: from `fit_counts`, of the encoding that the images resemble.
        seeds: N seeds, each of the saturated pixels of one image; a row depends on its own alone.
    Raises:
        ValueError: another shape or dtype, or another number of seeds.
    """
    from ctlev_core.postprocessing import image_count_kernels as kernels

    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8:
        raise ValueError(f"frames must be [N, H, W, 3] uint8, got {frames.shape} {frames.dtype}")
    if len(seeds) != len(frames):
        raise ValueError(f"expected one seed a frame, got {len(seeds)} seeds for {len(frames)} frames")
    num_channels = 2 if model.options.polarity else 1
    values = np.empty((num_channels, *frames.shape[1:3]), np.uint8)
    counts = np.empty((len(frames), *values.shape), np.uint16)
    for row, seed in enumerate(seeds):
        frequencies = np.zeros(256, np.int64)
        kernels.read_values(frames[row], values, frequencies)
        found = _estimate(values, frequencies, model, np.random.default_rng(seed))
        np.minimum(found, 65535, out=counts[row], casting="unsafe")
    rendered = plugins.load("encodings", "event_histogram").render_image(counts, model.options)
    errors = np.array([kernels.compare(*pair) for pair in zip(frames, rendered, strict=True)]).reshape(-1, 2)
    return CountEstimate(counts, rendered, errors[:, 0] == 0, errors[:, 0] / np.maximum(errors[:, 1], 1))


def _grid(scales: np.ndarray, options: Options) -> np.ndarray:
    if options.normalisation == "count":
        return scales[:1]
    grid = np.geomspace(max(scales.min() / 1.5, 1.0), scales.max() * 1.5, MAX_SCALES)
    return np.unique(np.rint(grid)) if options.normalisation == "max" else grid


def _shares_at(scale: float, scales: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Share of cells [256] with each count at a full scale: mean of the recorded windows, those of like scale most."""
    distances = np.log(scales / scale) ** 2 / (2 * BANDWIDTH**2)
    weights = np.exp(distances.min() - distances)
    return weights @ shares / weights.sum() + _FLOOR


def _levels(scale: float) -> np.ndarray:
    """The value of each count from 0 on, the last of them 255."""
    return np.minimum(np.floor(255.0 * np.arange(int(np.ceil(scale)) + 1) / scale), 255).astype(np.int64)


def _shares_of_levels(shares: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Probability of each level; that of the last one stands for all larger counts."""
    found = shares[np.minimum(np.arange(len(levels)), 255)]
    found[-1] = shares[min(len(levels) - 1, 255) :].sum()
    return found


def _level_shares(shares: np.ndarray, scale: float) -> np.ndarray:
    levels = _levels(scale)
    return np.bincount(levels, weights=_shares_of_levels(shares, levels), minlength=256)


@functools.cache
def _blur(width: float) -> np.ndarray:
    """[256, 256]: share of the values i that a decoder of this width turns into j; what lies outside is clipped."""
    from scipy.special import ndtr

    upper_ends = np.append(np.arange(255) + 0.5, np.inf)
    cumulated = ndtr((upper_ends - np.arange(256)[:, None]) / width)
    blur = np.diff(cumulated, axis=1, prepend=0.0)
    blur.setflags(write=False)
    return blur


@functools.cache
def _log_blur(width: float) -> np.ndarray:
    log_blur = np.log(_blur(width) + 1e-300)
    log_blur.setflags(write=False)
    return log_blur


def _estimate(values: np.ndarray, frequencies: np.ndarray, model: CountModel, rng: np.random.Generator) -> np.ndarray:
    """Counts [C, H, W] int64 of one image."""
    largest = int(np.flatnonzero(frequencies)[-1])
    if largest == 0:
        return np.zeros(values.shape, np.int64)
    stretch = np.arange(256)
    if model.options.normalisation == "max" and largest < 255:
        # The largest count becomes 255 when the counts are rendered; so it is here.
        stretch = np.minimum(np.rint(stretch * (255.0 / largest)), 255).astype(np.int64)
        frequencies = np.bincount(stretch, weights=frequencies, minlength=256).astype(np.int64)
    for low, high in _fitting_ranges(frequencies, model):
        scale = (low + high) / 2
        counts, fits = _counts_by_table(values, _nearest_counts(scale)[stretch], model, rng, (low, high))
        if fits:
            return counts
    mean, deviation = model.log_num_events
    num_events = np.log(np.maximum(model.counts @ frequencies.astype(np.float32), 1))
    best = np.argmax(model.log_probabilities @ frequencies - 0.5 * ((num_events - mean) / deviation) ** 2)
    number, blur = np.unravel_index(best, model.log_probabilities.shape[:2])
    scale = float(model.grid[number])
    shares = _shares_at(scale, model.full_scales, model.count_shares)
    table = _most_probable_counts(scale, shares, BLURS[blur])
    wanted = (scale, scale)
    if model.options.normalisation == "three_sigma":
        # One part in 500 of it moves no value by more than half a grey level; up to 1 all events come out white.
        wanted = (scale * 0.998, scale * 1.002) if scale > 1 else (0.0, 1.0)
    return _counts_by_table(values, table[stretch], model, rng, wanted)[0]


def _fitting_ranges(frequencies: np.ndarray, model: CountModel) -> list[tuple[float, float]]:
    """Ranges of full scales at which all values of an image are levels, the most probable ones first."""
    from ctlev_core.postprocessing import image_count_kernels as kernels

    values = np.flatnonzero(frequencies[:255])
    values = values[values > 0]
    if model.options.normalisation != "three_sigma":
        # From 255 on every value is a level.
        found = [(k, k) for k in _whole_scales(model) if k >= 255 or np.isin(values, _levels(k)).all()]
    elif len(values) == 0:
        found = [(0.0, 1.0)]
    else:
        low, high = model.grid[0] / 2, model.grid[-1] * 2
        buffer = np.empty((_MAX_RANGES, 2))
        used = kernels.find_scale_ranges(values, low, min(high, 255.0), buffer)
        found = [(float(first), float(last)) for first, last in buffer[: max(used, 0)]]
        found += [(255.0, high)] if high > 255 else []
    ranked = []
    for low, high in found:
        scale = max((low + high) / 2, 1.0)
        by_chance = min(1.0, high / 255) ** len(values)
        may_be_chance = len(values) > 0 and by_chance > _CHANCE and model.options.normalisation != "count"
        if may_be_chance and not model.grid[0] <= scale <= model.grid[-1]:
            continue
        shares = _shares_at(scale, model.full_scales, model.count_shares)
        of_levels = np.full(256, _FLOOR)
        levels = _levels(scale)
        of_levels[levels] = _shares_of_levels(shares, levels)
        ranked.append((float(frequencies @ np.log(of_levels)), low, high))
    return [(low, high) for _, low, high in sorted(ranked, reverse=True)[:_TRIED_RANGES]]


def _whole_scales(model: CountModel) -> list[float]:
    if model.options.normalisation == "count":
        return [float(model.options.full_scale_count)]
    return [float(scale) for scale in range(int(max(model.grid[0] / 2, 1)), int(model.grid[-1]) * 2 + 1)]


def _nearest_counts(scale: float) -> np.ndarray:
    """The count [256] whose level is nearest to each value; -1 = saturated."""
    values = np.arange(256)
    if scale >= 255:
        # Several counts share a level; the middle one.
        table = np.rint((values + 0.5) * scale / 255).astype(np.int64)
        table[0] = 0
    else:
        levels = _levels(scale)
        table = np.abs(values[:, None] - levels).argmin(axis=1)
        table[levels[table] == 255] = -1
    table[255] = -1
    return table


def _most_probable_counts(scale: float, shares: np.ndarray, width: float) -> np.ndarray:
    """The most probable count [256] of each value that a decoder of this width has blurred; -1 = saturated."""
    levels = _levels(scale)
    log_shares = np.log(_shares_of_levels(shares, levels))
    # Of the counts of one level the first most probable is enough: there may be tens of thousands.
    starts = np.flatnonzero(np.diff(levels, prepend=-1))
    most = np.maximum.reduceat(log_shares, starts)
    probable = np.flatnonzero(log_shares == np.repeat(most, np.diff(starts, append=len(levels))))
    counts = probable[np.searchsorted(probable, starts)]
    found = counts[np.argmax(most[:, None] + _log_blur(width)[levels[starts]], axis=0)]
    # A level so close to 255 cannot be told from it; that there are saturated pixels at all decides about the scale.
    found[levels[found] >= 255 - width] = -1
    return found


def _counts_by_table(
    values: np.ndarray,
    table: np.ndarray,
    model: CountModel,
    rng: np.random.Generator,
    wanted: tuple[float, float],
) -> tuple[np.ndarray, bool]:
    """Counts [C, H, W] int64 by a table of values, and whether they have a full scale in the range wanted."""
    from ctlev_core.postprocessing import image_count_kernels as kernels

    counts = np.empty(values.shape, np.int64)
    flat, saturated = counts.reshape(-1), np.empty(values.size, np.int64)
    saturated = saturated[: kernels.look_up(values.reshape(-1), table, flat, saturated)]
    scale = (wanted[0] + wanted[1]) / 2
    if model.options.normalisation == "max":
        flat[saturated] = int(scale)
        return counts, True
    if model.options.normalisation == "three_sigma" and wanted[1] <= 1:
        # Equal counts come out white, however many events there are; one is the simplest.
        flat[saturated] = 1
    elif len(saturated):
        places = rng.random(len(saturated)) * (len(model.excess) - 1)
        drawn = np.rint(np.interp(places, np.arange(len(model.excess)), model.excess) * scale).astype(np.int64)
        flat[saturated] = np.maximum(drawn, int(np.ceil(scale)))
    if model.options.normalisation == "count":
        return counts, True
    totals = counts[0] if len(counts) == 1 else counts[0] + counts[1]
    totals = totals.reshape(-1)
    active = np.flatnonzero(totals)
    row_of = np.searchsorted(active, saturated % len(totals))
    settled, draws = flat[saturated], np.zeros((0, 2), np.int64)
    if len(saturated):
        draws = rng.integers(0, len(saturated), (_NUM_DRAWS, 2))
    least = max(int(np.ceil(scale)), 1)
    fits = kernels.settle_saturated(totals[active], row_of, settled, least, *wanted, draws)
    flat[saturated] = settled
    return counts, fits
