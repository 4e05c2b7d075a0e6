"""What a metric says of a model's predictions: for some rows with an interval, and row by row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core.plugin_contracts import MetricOfSums, PreparedMetric
from ctlev_core.plugins import Plugin
from ctlev_core.scoring.pose import Sums, quotients
from ctlev_core.statistics.bootstrap import MIN_RECORDINGS, cluster_bootstrap, ratio_bootstrap
from data_contracts.labels import Labels

Scored = tuple[dict[str, float], dict[str, float], dict[str, float]]
"""Scores, and the lower and upper ends of their intervals, by name."""


@dataclass(frozen=True, eq=False)
class RowScores:
    """The scores of a model by one metric.

    Attributes:
        metric: a plug-in.
        prediction: of N rows.
        labels: N.
        recordings: [N] the recording of each row.
    """

    metric: Plugin
    prediction: Mapping[str, Any]
    labels: Labels
    recordings: np.ndarray

    def of(self, members: np.ndarray) -> Scored:
        """The scores of the rows `members`, and their intervals over recordings.

        Raises:
            ValueError: there is nothing to score in them, or the metric does not fit the rows.
        """
        recordings = self.recordings[members]
        if self._sums:
            return _of_sums({name: (a[members], b[members]) for name, (a, b) in self._sums.items()}, recordings)
        every, labels = np.arange(len(members)), self.labels.take(members)

        def pick(chosen: np.ndarray) -> dict[str, Any]:
            return {
                name: values if name == "classes" else np.asarray(values)[members[chosen]]
                for name, values in self.prediction.items()
            }

        def compute(chosen: np.ndarray) -> dict[str, float]:
            return self.metric.module.compute(pick(chosen), labels.take(chosen), self.metric.options)

        # Names are compared once rather than for each of many resamplings.
        prepared = isinstance(self.metric.module, PreparedMetric)
        resampled = self.metric.module.prepare(pick(every), labels, self.metric.options) if prepared else compute
        scores = resampled(every)
        few = len(set(recordings.tolist())) < MIN_RECORDINGS
        return (scores, {}, {}) if few else (scores, *cluster_bootstrap(resampled, recordings))

    def each_row(self, scores: Mapping[str, float]) -> dict[str, pa.Array]:
        """What each row adds to the one of the scores that is the rows' mean, and its weight in that mean.

        Joints count alike in a score, not frames: of a frame of which half is out of the picture there are fewer. Which
        of several scores the rows belong to is seen from their mean; where it is not the first, and the first is a
        quotient of sums, those of the first are taken.

        Args:
            scores: of all rows.
        """
        values, sums = self.metric.module.compute_rows(self.prediction, self.labels, self.metric.options), self._sums
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

    @cached_property
    def _sums(self) -> Sums:
        """What every row adds to scores that are quotients of sums, once for all groups; empty of other metrics."""
        if not isinstance(self.metric.module, MetricOfSums):
            return {}
        sums = self.metric.module.compute_sums(self.prediction, self.labels, self.metric.options)
        if empty := [name for name, (_, count) in sums.items() if not count.any()]:
            raise ValueError(f"nothing to score in {len(self.labels)} rows for {', '.join(empty)}")
        return sums


def _of_sums(sums: Sums, recordings: np.ndarray) -> Scored:
    """Scores of rows, each with an interval over those recordings in which it has something to count.

    Raises:
        ValueError: there is nothing to count for the first score; another one is left out then.
    """
    counted = {name: pair for name, pair in sums.items() if pair[1].any()}
    if (first := next(iter(sums))) not in counted:
        raise ValueError(f"nothing to score in {len(recordings)} rows for {first}")
    together: dict[tuple[str, ...], Sums] = {}
    for name, pair in counted.items():
        together.setdefault(tuple(np.unique(recordings[pair[1] > 0]).tolist()), {})[name] = pair
    low, high = {}, {}
    for names, same in together.items():
        if len(names) >= MIN_RECORDINGS:
            lower, upper = ratio_bootstrap(same, recordings)
            low, high = low | lower, high | upper
    return quotients(counted), low, high
