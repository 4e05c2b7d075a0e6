"""How sure is a score? Bootstrap intervals over groups of samples, and the spread over seeds.

Frames of one recording resemble one another, so whole recordings are drawn, never single frames of them: a bootstrap
over frames would give intervals that are far too narrow. Of few recordings the ends are farther out than percentiles of
that level (`small_samples`). Replicates are moved by the difference of the score and their mean: a resampled set has
fewer different recordings, and some scores, such as a calibration error, are larger for that alone.
Source: Davison & Hinkley, Bootstrap Methods and their Application, 1997, section 3.8 (clusters).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Protocol, runtime_checkable

import numpy as np

from ctlev_core.statistics.small_samples import LEVEL, percentile_levels

MIN_RECORDINGS = 5
"""With fewer test recordings a bootstrap over them says too little: the tables then give no interval."""

_CHUNK_NUMBERS = 4_000_000


def score_text(value: float, low: float | None = None, high: float | None = None, *, signed: bool = False) -> str:
    """For a sentence or a cell: `6.541 [5.932, 7.217]`, `-25.3 [-38.1, -13.2]`, or the value alone.

    Args:
        value: a score or a difference of scores.
        low: lower end of its interval; None or NaN = unknown.
        high: its upper end.
        signed: with a sign above zero, too.
    Returns:
        Four significant digits of the largest of them, at most three decimals: more is not known of any score. Of what
        is below 0.01, as kernel distances often are, three significant digits.
    """
    known = low is not None and high is not None and not math.isnan(low)
    numbers = (value, low, high) if known else (value,)
    largest = max(abs(number) for number in numbers if number is not None)
    decimals = 3 if not math.isfinite(largest) else min(3, max(0, 4 - len(f"{largest:.0f}")))
    if 0 < largest < 0.01:
        decimals = min(6, 2 - math.floor(math.log10(largest)))
    shown = [f"{number:{'+' if signed else ''}z.{decimals}f}" for number in numbers]
    return f"{shown[0]} [{shown[1]}, {shown[2]}]" if known else shown[0]


def rows_of_groups(groups: Sequence[str] | np.ndarray) -> list[np.ndarray]:
    """The rows of each group, ascending, of the group [N] of each row."""
    _, index = np.unique(np.asarray(groups), return_inverse=True)
    order = np.argsort(index, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(index[order])) + 1)


def bootstrap_interval(
    values: np.ndarray,
    groups: Sequence[str] | np.ndarray | None = None,
    *,
    level: float = LEVEL,
    num_resamples: int = 2000,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile interval of the mean of `values` under resampling of whole groups.

    For the difference of two models on the same samples, pass the differences: the bootstrap is then paired.

    Args:
        values: [N] scores of samples; NaN = not scored.
        groups: [N] recording or sequence of each sample; None = every sample is its own group.
        level: probability the interval should cover.
        num_resamples: bootstrap replicates.
        seed: of the resampling.
    Returns:
        (low, high). Both NaN with fewer than two scored groups: nothing is known about the spread then.
    Raises:
        ValueError: shapes differ, no value is scored, or the level is outside (0, 1).
    """
    values = np.asarray(values, dtype=np.float64)
    names = np.arange(len(values)) if groups is None else np.asarray(groups)
    if values.ndim != 1 or names.shape != values.shape:
        raise ValueError(f"values and groups must both be [N], got {values.shape} and {names.shape}")
    if not 0 < level < 1:
        raise ValueError(f"level must be between 0 and 1, got {level}")
    scored = ~np.isnan(values)
    if not scored.any():
        raise ValueError(f"none of the {len(values)} values is scored")
    sums = {"mean": (values[scored], np.ones(np.count_nonzero(scored)))}
    low, high = ratio_bootstrap(sums, names[scored], level=level, num_resamples=num_resamples, seed=seed)
    return low.get("mean", float("nan")), high.get("mean", float("nan"))


@runtime_checkable
class ScoresOfDraws(Protocol):
    """Scores of any rows, which of many draws of whole groups can be had at once."""

    def __call__(self, rows: np.ndarray) -> dict[str, float]:
        """Named scores of the given rows; those drawn twice come twice."""
        ...

    def of_draws(self, groups: np.ndarray, draws: np.ndarray) -> dict[str, np.ndarray] | None:
        """The same, to the last digit, of every draw that has scores.

        Args:
            groups: [N] int64, the group of each row.
            draws: [R, G] how often each group is drawn.
        Returns:
            [R or fewer] of each score; None where they would be rounded otherwise.
        """
        ...


def cluster_bootstrap(
    compute: Callable[[np.ndarray], Mapping[str, float]],
    groups: Sequence[str] | np.ndarray,
    *,
    level: float = LEVEL,
    num_resamples: int = 500,
    seed: int = 0,
) -> tuple[dict[str, float], dict[str, float]]:
    """Intervals of any scores under resampling of whole groups.

    Args:
        compute: named scores of the given rows, in which rows of a group drawn twice come twice. It is called once a
            replicate, unless it is one of `ScoresOfDraws`.
        groups: [N] recording or sequence of each row.
        level: probability each interval should cover.
        num_resamples: bootstrap replicates.
        seed: of the resampling.
    Returns:
        The lower and the upper ends by name; both empty with fewer than two groups. A replicate on which `compute`
        raises ValueError (no visible joint, say) is left out.
    """
    names, index = np.unique(np.asarray(groups), return_inverse=True)
    if len(names) < 2:
        return {}, {}
    whole = compute(np.arange(len(index)))
    parts = []
    for draws in _draws(len(names), num_resamples, seed):
        at_once = compute.of_draws(index, draws) if isinstance(compute, ScoresOfDraws) else None
        parts.append(_one_by_one(compute, index, draws) if at_once is None else at_once)
    parts = [part for part in parts if part]
    if not parts:
        return {}, {}
    scores = [name for name in parts[0] if name in whole]
    found = np.stack([np.concatenate([part[name] for part in parts]) for name in scores], axis=1)
    if 2 * len(found) < num_resamples:  # those that are left are like the whole set, and vary too little
        return {}, {}
    return _ends(scores, found, np.array([whole[name] for name in scores]), percentile_levels(len(names), level))


def _one_by_one(
    compute: Callable[[np.ndarray], Mapping[str, float]], index: np.ndarray, draws: np.ndarray
) -> dict[str, np.ndarray]:
    """Scores of those draws that have some, one call of `compute` a draw; rows come group by group."""
    by_group, sizes = np.argsort(index, kind="stable"), np.bincount(index)
    replicates: list[Mapping[str, float]] = []
    for counts in draws:
        with suppress(ValueError):
            replicates.append(compute(by_group[_repeated(sizes, counts)]))
    names = replicates[0] if replicates else ()
    return {name: np.array([replicate[name] for replicate in replicates]) for name in names}


def sums_of_draws(
    groups: np.ndarray, draws: np.ndarray, codes: np.ndarray, num_codes: int, weights: np.ndarray | None = None
) -> np.ndarray:
    """How often each code occurs in each draw of groups, or the sum of the weights it occurs with.

    Args:
        groups: [M] int64.
        draws: [R, G] how often each group is drawn.
        codes: [M] int64, below `num_codes`.
        num_codes: K.
        weights: [M]; None = ones.
    Returns:
        [R, K] float64.
    """
    from scipy.sparse import coo_array  # here, because a cached run needs no scipy

    weights = np.ones(len(codes)) if weights is None else weights
    of_groups = coo_array((weights, (codes, groups)), shape=(num_codes, draws.shape[1])).tocsr()
    return np.ascontiguousarray((of_groups @ draws.T.astype(np.float64)).T)


def _ends(
    names: Sequence[str], replicates: np.ndarray, values: np.ndarray, levels: tuple[float, float]
) -> tuple[dict[str, float], dict[str, float]]:
    """Lower and upper ends by name, of replicates [B, S] of scores [S]."""
    ends = np.quantile(replicates - replicates.mean(axis=0) + values, levels, axis=0)
    # No end is outside what was seen: a share stays between 0 and 1.
    ends = np.clip(ends, np.minimum(values, replicates.min(axis=0)), np.maximum(values, replicates.max(axis=0)))
    low, high = (dict(zip(names, end.tolist(), strict=True)) for end in ends)
    return low, high


def _repeated(sizes: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Positions of rows that lie group by group, `sizes` of them, with each group `counts` times in a row."""
    lengths = sizes * counts
    within = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return np.repeat(np.cumsum(sizes) - sizes, lengths) + within % np.repeat(sizes, lengths)


def ratio_bootstrap(
    sums: Mapping[str, tuple[np.ndarray, np.ndarray]],
    groups: Sequence[str] | np.ndarray,
    *,
    level: float = LEVEL,
    num_resamples: int = 2000,
    seed: int = 0,
) -> tuple[dict[str, float], dict[str, float]]:
    """What `cluster_bootstrap` gives for scores that are quotients of two sums over rows, with the same draws.

    A group's rows are added up once, so that a replicate costs a product a group and no pass over rows.

    Args:
        sums: by name, what each row adds to numerator [N] and denominator [N] >= 0.
        groups: [N] recording or sequence of each row.
        level: probability each interval should cover.
        num_resamples: bootstrap replicates; one in which a denominator is 0 is left out.
        seed: of the resampling.
    Returns:
        The lower and the upper ends by name; both empty with fewer than two groups that add to a denominator.
    """
    names, index = np.unique(np.asarray(groups), return_inverse=True)
    if len(names) < 2 or not sums:
        return {}, {}
    columns = np.array([np.bincount(index, weights=column) for pair in sums.values() for column in pair])
    scored = (columns[1::2] > 0).any(axis=0)  # a group that is in no score is not there to be drawn
    names, columns = names[scored], columns[:, scored]
    if len(names) < 2:
        return {}, {}
    found = np.concatenate([draws @ columns.T for draws in _draws(len(names), num_resamples, seed)])
    totals, counts = found[:, ::2], found[:, 1::2]
    usable = (counts > 0).all(axis=1)
    if not usable.any():
        return {}, {}
    # A replicate that is usable has rows of every score, and so has the whole.
    values = columns[::2].sum(axis=1) / columns[1::2].sum(axis=1)
    return _ends(list(sums), totals[usable] / counts[usable], values, percentile_levels(len(names), level))


def _draws(group_count: int, num_resamples: int, seed: int) -> Iterator[np.ndarray]:
    """How often each group is drawn in each replicate, [replicates, group_count], in chunks that fit into memory."""
    generator = np.random.default_rng(seed)
    chunk = max(1, _CHUNK_NUMBERS // group_count)
    for start in range(0, num_resamples, chunk):
        size = min(chunk, num_resamples - start)
        yield generator.multinomial(group_count, np.full(group_count, 1 / group_count), size=size)
