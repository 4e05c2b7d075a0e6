"""How sure is a distance between two sets of features, and how far apart are two halves of the recorded one?

A percentile bootstrap of a Frechet distance is no interval: a resampled set has fewer different rows than the set, so
its distance is larger, and all replicates may lie above the value itself. Here both sets are cut at random into two
halves, whole recordings to one or the other, and the score of the first halves is compared with that of the second
halves. Half their difference varies as the score of the whole sets does: a mean over n rows exactly so, a distance to
first order, for halves of a sample share no row, and their bias is the same and falls out. The interval,

    value +/- t * root mean square of (first - second) / 2,

is about what the score of sets of these sizes would be on average; it does not cover the bias of small sets, which
`fd_infinity` and `kid` have not. Where both sets have the same distribution it is up to 1.4 times too wide.

Source: the repeated half-sample method of survey sampling, McCarthy, Review of the International Statistical Institute
37, 1969; t has one degree of freedom less than there are splits, or recordings of the set with fewer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from ctlev_core.plugin_contracts import NamedFeatureExtractor
from ctlev_core.plugins import Plugin
from ctlev_core.statistics.bootstrap import MIN_RECORDINGS, rows_of_groups
from ctlev_core.statistics.small_samples import t_quantile
from data_contracts.tables import Column, TableSchema

DISTANCE_ESTIMATES = TableSchema(
    "distance_estimates",
    1,
    None,
    (
        Column("subject", pa.string(), "which frames are compared with the recorded training frames"),
        Column("metric", pa.string(), "score, with the extractor"),
        Column("value", pa.float64(), "of all frames"),
        Column("low", pa.float64(), "lower end of its 95 % interval, from halves by recording", nullable=True),
        Column("high", pa.float64(), "upper end", nullable=True),
        Column("halved", pa.float64(), "mean over halves of both sets; compare with the floor", nullable=True),
        Column("floor", pa.float64(), "mean between the halves of the recorded training frames", nullable=True),
        Column("floor_low", pa.float64(), "central 95 % of the floor over the halvings, lower end", nullable=True),
        Column("floor_high", pa.float64(), "upper end", nullable=True),
        Column("num_predicted", pa.int64(), "frames compared", minimum=1),
        Column("num_target", pa.int64(), "recorded training frames", minimum=1),
        Column("num_features", pa.int64(), "features of a frame", minimum=1),
    ),
)
"""What a distance has to be read with; missing where there are too few recordings to tell."""


@dataclass(frozen=True)
class DistanceEstimate:
    """A score of two sets of features, and what is needed to read it. NaN where there are too few recordings to tell.

    Attributes:
        value: of all rows.
        low: lower end of the interval of `value`.
        high: upper end.
        halved: mean of the score over halves of both sets: larger than `value` by the bias of smaller sets.
        floor: mean of the score between halves of the reference set, what a perfect set of that size would get;
            compare with `halved`, which has the same bias where both sets are equally large. Of a score that has a
            reference of its own (`fd_to_...`) the mean score of halves of the reference set against that, no floor.
        floor_low: central 95 % of the floor over the random halves, lower end.
        floor_high: and upper end.
        num_predicted: rows judged.
        num_target: rows of the reference set.
        num_features: their length.
    """

    value: float
    low: float
    high: float
    halved: float
    floor: float
    floor_low: float
    floor_high: float
    num_predicted: int
    num_target: int
    num_features: int


def estimate_distances(
    compute: Callable[[np.ndarray, np.ndarray], Mapping[str, float]],
    predicted: np.ndarray,
    target: np.ndarray,
    *,
    predicted_groups: Sequence[str] | np.ndarray | None = None,
    target_groups: Sequence[str] | np.ndarray | None = None,
    num_splits: int = 20,
    level: float = 0.95,
    seed: int = 0,
) -> dict[str, DistanceEstimate]:
    """Scores of two sets of features with intervals and real-against-real floors.

    Args:
        compute: named scores of two sets of rows, as `compute` of the metrics with `INPUT = "features"`; it is called
            3 `num_splits` + 1 times, all but once on halves.
        predicted: [N, D] features of the set to judge.
        target: [M, D] features of the reference set.
        predicted_groups: [N] recording of each row; None = each row is its own. Halves never part a recording.
        target_groups: [M] recording of each row of the reference set.
        num_splits: random halvings.
        level: probability the interval should cover.
        seed: of the halvings.
    Returns:
        One estimate a score. Without `MIN_RECORDINGS` recordings in both sets, or where halves have too few rows for
        `compute`, the value stands alone.
    Raises:
        ValueError: groups do not fit the rows, `level` or `num_splits` is out of range, or `compute` raises it for the
            whole sets.
    """
    if not 0 < level < 1 or num_splits < 2:
        raise ValueError(f"level must be between 0 and 1 and num_splits at least 2, got {level} and {num_splits}")
    members = [_members(rows, groups) for rows, groups in ((predicted, predicted_groups), (target, target_groups))]
    scores = compute(predicted, target)
    fewest = min(len(groups) for groups in members)
    halves: list[tuple[Mapping[str, float], Mapping[str, float]]] = []
    floors: list[Mapping[str, float]] = []
    if fewest >= MIN_RECORDINGS:
        halves, floors = _halvings(compute, predicted, target, members, num_splits, seed)
    found = {}
    for name, value in scores.items():
        low = high = halved = floor = floor_low = floor_high = float("nan")
        if halves:
            pairs = np.array([[first[name], second[name]] for first, second in halves])
            deviation = np.sqrt(np.mean(np.diff(pairs, axis=1) ** 2)) / 2
            half_width = t_quantile(min(fewest, num_splits) - 1, level) * deviation
            low, high, halved = value - half_width, value + half_width, pairs.mean()
            between = [scores_of_halves[name] for scores_of_halves in floors]
            floor, (floor_low, floor_high) = np.mean(between), np.quantile(between, [0.025, 0.975])
        found[name] = DistanceEstimate(
            value=float(value),
            low=float(low),
            high=float(high),
            halved=float(halved),
            floor=float(floor),
            floor_low=float(floor_low),
            floor_high=float(floor_high),
            num_predicted=len(predicted),
            num_target=len(target),
            num_features=predicted.shape[1],
        )
    return found


def estimates_table(subject: str, estimates: Mapping[str, DistanceEstimate]) -> pa.Table:
    """Estimates by their names as rows of the table `distance_estimates`."""
    columns = {"subject": pa.array([subject] * len(estimates)), "metric": pa.array(list(estimates), pa.string())}
    for column in DISTANCE_ESTIMATES.columns[len(columns) :]:
        values = np.array([getattr(estimate, column.name) for estimate in estimates.values()])
        columns[column.name] = pa.array(values, column.type, from_pandas=True)
    return pa.table(columns)


def name_distance(plugin: Plugin, folder: Path, digest: str, score: str) -> str:
    """What a distance is called: as a ready-made extractor asks, else `fd_event_<plug-in>_<digest>`, never `fid`.

    Args:
        plugin: the feature extractor.
        folder: its model.
        digest: of the extractor's artefact; two classifiers trained on other frames are two scores.
        score: as `compute` of the metric names it, such as `fd`.
    """
    if isinstance(plugin.module, NamedFeatureExtractor):
        return plugin.module.name_score(folder, score)
    return f"{score}_event_{plugin.name}_{digest[:8]}"


def _members(rows: np.ndarray, groups: Sequence[str] | np.ndarray | None) -> list[np.ndarray]:
    """The rows of each group."""
    names = np.arange(len(rows)) if groups is None else np.asarray(groups)
    if names.shape != (len(rows),):
        raise ValueError(f"groups must be [{len(rows)}], one a row of features, got {names.shape}")
    return rows_of_groups(names)


def _halvings(
    compute: Callable[[np.ndarray, np.ndarray], Mapping[str, float]],
    predicted: np.ndarray,
    target: np.ndarray,
    members: list[list[np.ndarray]],
    num_splits: int,
    seed: int,
) -> tuple[list[tuple[Mapping[str, float], Mapping[str, float]]], list[Mapping[str, float]]]:
    """Scores of both pairs of halves of each split, and of the two halves of the target; empty if not to be had."""
    generator = np.random.default_rng(seed)
    halves, floors = [], []
    try:
        for _ in range(num_splits):
            (first, second), (real_first, real_second) = (_halve(groups, generator) for groups in members)
            halves.append(
                (compute(predicted[first], target[real_first]), compute(predicted[second], target[real_second]))
            )
            floors.append(compute(target[real_first], target[real_second]))
    except ValueError:
        return [], []
    return halves, floors


def _halve(groups: list[np.ndarray], generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a random half of the groups, and the other rows; of an odd number either half gets the larger share."""
    order = generator.permutation(len(groups))
    middle = (len(groups) + int(generator.integers(2))) // 2
    first, second = (np.sort(np.concatenate([groups[g] for g in part])) for part in np.split(order, [middle]))
    return first, second
