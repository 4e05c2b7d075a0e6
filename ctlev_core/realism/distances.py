"""How far two sets of recordings are from one another in the numbers of `realism`, and how far a set is from itself.

A number of a set is the mean over those of its recordings that have it, a distribution the mean of the recordings' own:
each recording counts once, however many events it has. Distances:

    NAME                        magnitude of the difference of a number
    NAME_wasserstein_UNIT       Wasserstein-1 distance of a distribution: the area between the cumulative sums
    NAME_js_bits                Jensen-Shannon divergence of a distribution: 0 = equal, 1 = nothing in common; of
                                `value` over 11 bins of 21 grey levels, of `power_spectrum` over 12 bins of 0.06
                                cycles per px

Intervals (95 %) are those of replicates in which whole recordings are drawn, widened where they are few
(`statistics.small_samples`); with fewer than `MIN_RECORDINGS` there is none.
Resampling repeats recordings, which makes divergences a little larger: with few their interval may lie above the value.
The floor is the distance of a set from itself: over random splits of its recordings into halves. Halves hold half as
many recordings, so that it is a little too high: a set that lies below it cannot be told from this one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from ctlev_core.realism.summary import AXES, Summary
from ctlev_core.statistics.bootstrap import MIN_RECORDINGS
from ctlev_core.statistics.small_samples import percentile_levels
from data_contracts.tables import Column, TableSchema

DISTRIBUTIONS = TableSchema(
    "distributions",
    1,
    None,
    (
        Column("group", pa.string(), "events or frames"),
        Column("subject", pa.string(), "which set of recordings or frames"),
        Column("axis", pa.string(), "what is distributed (ctlev_core.realism.summary.AXES)"),
        Column("centre", pa.float64(), "middle of the bin, in the unit of the axis"),
        Column("share", pa.float64(), "share of the bin, mean over recordings", minimum=0, maximum=1.000001),
    ),
)
FRAME_DISTANCES = (
    "active_pixel_share",
    "positive_share",
    "speckle_share",
    "isolated_pixel_share",
    "value_mean",
    "hot_pixel_share",
    "rms_contrast",
    "neighbour_correlation",
    "value_wasserstein_grey_levels",
    "value_js_bits",
    "power_spectrum_wasserstein_cycles_per_px",
    "power_spectrum_js_bits",
)
"""Names of all distances between sets of event images; that of `positive_share` only of images with colour."""
_NUM_REPLICATES = 1000


@dataclass(frozen=True)
class Estimate:
    """A number and the ends of its 95 % interval; NaN where there are too few recordings to tell."""

    value: float
    low: float = float("nan")
    high: float = float("nan")


def mean_distributions(summaries: Sequence[Summary]) -> dict[str, np.ndarray]:
    """Mean of the recordings' distributions, [num_bins] by name of the axis, adding up to 1."""
    means = _means(summaries, np.ones((1, len(summaries))))
    return {name: values[0] for name, values in means.items() if name in AXES}


def estimate_numbers(summaries: Sequence[Summary], seed: int = 0) -> dict[str, Estimate]:
    """The numbers of a set."""

    def numbers(weights: np.ndarray) -> dict[str, np.ndarray]:
        means = _means(summaries, weights)
        return {name: values[:, 0] for name, values in means.items() if name not in AXES}

    found = numbers(np.ones((1, len(summaries))))
    count = len(summaries)
    replicates = numbers(_draws(count, seed)) if count >= MIN_RECORDINGS else {}
    having = _having(summaries)
    return {name: _estimate(float(value[0]), replicates.get(name), having[name]) for name, value in found.items()}


def estimate_distances(first: Sequence[Summary], second: Sequence[Summary], seed: int = 0) -> dict[str, Estimate]:
    """Distances of two sets, for all that both have; intervals under resampling of the recordings of both."""
    ones = np.ones((1, len(first))), np.ones((1, len(second)))
    found = _distances(_means(first, ones[0]), _means(second, ones[1]))
    replicates: dict[str, np.ndarray] = {}
    if min(len(first), len(second)) >= MIN_RECORDINGS:
        draws = _draws(len(first), seed), _draws(len(second), seed + 1)
        replicates = _distances(_means(first, draws[0]), _means(second, draws[1]))
    having = [_having(summaries) for summaries in (first, second)]
    estimates = {}
    for name, value in found.items():
        of = name if name in having[0] else next(axis for axis in AXES if name.startswith(f"{axis}_"))
        estimates[name] = _estimate(float(value[0]), replicates.get(name), min(each[of] for each in having))
    return estimates


def estimate_floor(summaries: Sequence[Summary], seed: int = 0) -> dict[str, Estimate]:
    """Distances of random halves of one set: median and central 95 %. Empty with fewer than two recordings."""
    count = len(summaries)
    if count < 2:
        return {}
    generator = np.random.default_rng(seed)
    ranks = generator.permuted(np.tile(np.arange(count), (_NUM_REPLICATES, 1)), axis=1)
    in_first = (ranks < count // 2).astype(np.float64)
    replicates = _distances(_means(summaries, in_first), _means(summaries, 1 - in_first))
    found = {}
    for name, values in replicates.items():
        values = values[np.isfinite(values)]
        if len(values):
            low, high = np.quantile(values, [0.025, 0.975]) if count >= MIN_RECORDINGS else (np.nan, np.nan)
            found[name] = Estimate(float(np.median(values)), float(low), float(high))
    return found


def wasserstein(first: np.ndarray, second: np.ndarray, width: float) -> np.ndarray:
    """Wasserstein-1 distance of distributions [..., bins]: the area between cumulative sums over bins of one width."""
    return np.abs(np.cumsum(first - second, axis=-1)).sum(axis=-1) * width


def jensen_shannon(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Jensen-Shannon divergence of distributions [..., bins], bits, 0 .. 1."""
    middle = (first + second) / 2
    total = np.zeros(first.shape[:-1])
    for part in (first, second):
        ratio = np.divide(part, middle, out=np.ones_like(part), where=part > 0)
        total = total + (part * np.log2(ratio)).sum(axis=-1) / 2
    # Rounding may leave -1e-17 where both are equal.
    return np.clip(total, 0.0, 1.0)


def _means(summaries: Sequence[Summary], weights: np.ndarray) -> dict[str, np.ndarray]:
    """Weighted means over recordings, one row a row of weights [R, N]; NaN where no recording with weight has it."""
    found = {}
    for part in ("numbers", "distributions"):
        for name in dict.fromkeys(name for summary in summaries for name in getattr(summary, part)):
            have = np.array([name in getattr(summary, part) for summary in summaries])
            values = np.array([np.atleast_1d(getattr(s, part)[name]) for s in summaries if name in getattr(s, part)])
            total = weights[:, have].sum(axis=1, keepdims=True)
            sums = weights[:, have] @ values
            found[name] = np.divide(sums, total, out=np.full_like(sums, np.nan), where=total > 0)
    return found


def _having(summaries: Sequence[Summary]) -> Counter[str]:
    """How many recordings have each number and distribution."""
    return Counter(name for summary in summaries for name in (*summary.numbers, *summary.distributions))


def _distances(first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Distances [R] of means [R, numbers or bins]."""
    found = {}
    for name, a in first.items():
        if name not in second:
            continue
        b = second[name]
        if name not in AXES:
            found[name] = np.abs(a - b)[:, 0]
            continue
        axis = AXES[name]
        found[f"{name}_wasserstein_{axis.unit.replace(' ', '_')}"] = wasserstein(a, b, axis.width)
        merged = (part.reshape(len(part), -1, axis.num_merged).sum(axis=-1) for part in (a, b))
        found[f"{name}_js_bits"] = jensen_shannon(*merged)
    return found


def _draws(count: int, seed: int) -> np.ndarray:
    """How often each recording is drawn in each replicate, [replicates, count]."""
    shares = np.full(count, 1 / count)
    return np.random.default_rng(seed).multinomial(count, shares, size=_NUM_REPLICATES).astype(np.float64)


def _estimate(value: float, replicates: np.ndarray | None, count: int) -> Estimate:
    """`count`: recordings that have the number, of the smaller set."""
    if replicates is None or count < MIN_RECORDINGS or not np.isfinite(replicates).any():
        return Estimate(value)
    low, high = np.quantile(replicates[np.isfinite(replicates)], percentile_levels(count))
    return Estimate(value, float(low), float(high))
