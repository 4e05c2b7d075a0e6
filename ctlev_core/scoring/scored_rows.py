"""What a metric says of a model's predictions: for some rows with an interval, and row by row."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core.plugin_contracts import MetricOfSums, PreparedMetric
from ctlev_core.plugins import Plugin
from ctlev_core.scoring.pose import quotients
from ctlev_core.statistics.bootstrap import MIN_RECORDINGS, cluster_bootstrap, ratio_bootstrap
from data_contracts.labels import Labels


def score_each_row(
    metric: Plugin, prediction: Mapping[str, Any], labels: Labels, scores: Mapping[str, float]
) -> dict[str, pa.Array]:
    """What each row adds to the one of the metric's scores that is the rows' mean, and its weight in that mean.

    Joints count alike in a score, not frames: of a frame of which half is out of the picture there are fewer. Which of
    several scores the rows belong to is seen from their mean; where it is not the first, and the first is a quotient of
    sums, those of the first are taken.
    """
    values = metric.module.compute_rows(prediction, labels, metric.options)
    sums = (
        metric.module.compute_sums(prediction, labels, metric.options)
        if isinstance(metric.module, MetricOfSums)
        else {}
    )
    of = {name: np.asarray(sums[name][1] if name in sums else np.ones(len(values)), np.float64) for name in scores}

    def distance(name: str) -> float:
        scored = ~np.isnan(values) & (of[name] > 0)
        if not scored.any():
            return np.inf
        return round(abs(float(np.average(values[scored], weights=of[name][scored])) - scores[name]), 9)

    name, first = min(scores, key=distance), next(iter(scores))  # of those that are as near the first
    if name != first and first in sums:
        # The first score is what training sets are compared by; its rows are what they add to it.
        with np.errstate(invalid="ignore", divide="ignore"):
            numerators, denominators = (np.asarray(part, np.float64) for part in sums[first])
            name, values = first, np.where(denominators > 0, numerators / denominators, np.nan)
    return {
        "metric": pa.array([name] * len(values), pa.string()),
        "value": pa.array(values, pa.float64(), from_pandas=True),
        "weight": pa.array(of[name], pa.float64()),
    }


def score_rows(
    metric: Plugin, prediction: Any, labels: Any, members: np.ndarray, recordings: np.ndarray
) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """The scores of some rows, and the ends of their intervals."""

    def pick(chosen: np.ndarray) -> dict[str, Any]:
        return {
            name: values if name == "classes" else np.asarray(values)[members[chosen]]
            for name, values in prediction.items()
        }

    def compute(chosen: np.ndarray) -> dict[str, float]:
        return metric.module.compute(pick(chosen), labels.take(chosen), metric.options)

    every = np.arange(len(members))
    few = len(set(recordings.tolist())) < MIN_RECORDINGS
    if isinstance(metric.module, MetricOfSums):
        sums = metric.module.compute_sums(pick(every), labels, metric.options)
        if not all(count.any() for _, count in sums.values()):
            raise ValueError("nothing to score in these rows")
        scores = quotients(sums)
        enough = {
            name: pair for name, pair in sums.items() if len(np.unique(recordings[pair[1] > 0])) >= MIN_RECORDINGS
        }
        return (scores, *ratio_bootstrap(enough, recordings))
    # Names are compared once rather than for each of many resamplings.
    prepared = isinstance(metric.module, PreparedMetric)
    resampled = metric.module.prepare(pick(every), labels, metric.options) if prepared else compute
    scores = resampled(every)
    return (scores, {}, {}) if few else (scores, *cluster_bootstrap(resampled, recordings))
