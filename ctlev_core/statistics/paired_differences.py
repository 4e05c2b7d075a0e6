"""How much better is one training set than another, and how sure is that? Both are scored on the same samples.

Recordings are drawn, the same for both training sets, and so are the trainings of each training set, independently: an
interval covers the choice of test recordings and what varies between trainings with other seeds. Both are few, so that
deviations of replicates from the score are stretched as `small_samples` has it, and then by the quantile of t, whose
degrees of freedom are Satterthwaite's of the variances of recordings and of the trainings of each training set. Of a
training set with one training nothing is known about its spread, and the interval covers recordings alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from ctlev_core.statistics.bootstrap import MIN_RECORDINGS, score_text
from ctlev_core.statistics.small_samples import stretch, variance_of_mean, widening

NUM_RESAMPLES = 4000
_CHUNK_NUMBERS = 4_000_000
_UNKNOWN = (float("nan"), float("nan"))


@dataclass(frozen=True)
class Difference:
    """A difference, or a share, and the ends of its 95 % interval (NaN = unknown)."""

    value: float
    low: float
    high: float

    @property
    def is_certain(self) -> bool:
        """Does the interval exclude zero?"""
        return self.low > 0 or self.high < 0

    def text(self) -> str:
        """For a table cell: `-0.412 [-0.533, -0.291]`, or the value alone."""
        return score_text(self.value, self.low, self.high, signed=True)


@dataclass(frozen=True, eq=False)
class Trainings:
    """Scores of N samples by each of R trainings of one training set.

    Attributes:
        values: [R, N] float64; NaN = no score.
        sample_ids: [N] names of the samples.
        recordings: [N] the recording of each.
        samples_digest: of the samples' images and labels.
        weights: [N] of the samples in the mean, the same for all trainings; None = all alike.
    """

    values: np.ndarray
    sample_ids: tuple[str, ...]
    recordings: tuple[str, ...]
    samples_digest: str = ""
    weights: np.ndarray | None = None

    def scores_the_same_as(self, other: Trainings) -> bool:
        """Are both about the same samples, in the same order?"""
        return (self.samples_digest, self.sample_ids, self.recordings) == (
            other.samples_digest,
            other.sample_ids,
            other.recordings,
        )


def read_trainings(samples: pa.Table) -> dict[tuple[str, str], Trainings]:
    """The trainings by training set and score, from a table of the schema `PAIRED_SAMPLES`.

    Settings whose trainings were scored on different samples are left out.
    """
    found: dict[tuple[str, str], dict[int, list]] = {}
    columns = [samples[name].to_pylist() for name in ("subject", "metric", "training", "sample_id", "recording_id")]
    values, weights = (samples[name].to_numpy(zero_copy_only=False).astype(np.float64) for name in ("value", "weight"))
    digests = samples["samples_digest"].to_pylist()
    for row, (training_set, metric, training, sample_id, recording) in enumerate(zip(*columns, strict=True)):
        same = found.setdefault((training_set, metric), {}).setdefault(training, [[], [], [], digests[row], []])
        for column, value in zip(same[:3] + same[4:], (sample_id, recording, values[row], weights[row]), strict=True):
            column.append(value)
    trainings = {}
    for key, of_key in found.items():
        first, *others = of_key.values()
        if all((other[0], other[1], other[3]) == (first[0], first[1], first[3]) for other in others):
            stacked = np.array([one[2] for one in of_key.values()], np.float64)
            trainings[key] = Trainings(stacked, tuple(first[0]), tuple(first[1]), first[3], np.array(first[4]))
    return trainings


def paired_difference(before: Trainings, after: Trainings, seed: int = 0) -> Difference:
    """Mean score after minus mean score before.

    Raises:
        ValueError: they are not about the same samples, or no sample is scored by all trainings.
    """
    return _contrast(_vary([before, after], seed), {0: -1.0, 1: 1.0})


def share_of_gain(start: Trainings, reached: Trainings, oracle: Trainings, seed: int = 0) -> Difference | None:
    """How much of the way from the start to the oracle was gone: 1 = all of it.

    Returns:
        The share and its interval; None where it is not certain that the oracle differs from the start.

    Raises:
        ValueError: as `paired_difference`.
    """
    varied = _vary([start, reached, oracle], seed)
    gain = _contrast(varied, {0: -1.0, 2: 1.0})
    if not gain.is_certain:
        return None
    value = varied.values
    share = float((value[1] - value[0]) / (value[2] - value[0]))
    # Of what the share varies with to first order: what all training sets have in common is not part of it.
    draws = value + varied.deviations * widening(varied.parts({0: share - 1.0, 1: 1.0, 2: -share}))
    shares = (draws[:, 1] - draws[:, 0]) / (draws[:, 2] - draws[:, 0])
    return Difference(share, *_ends(shares))


def unpaired_difference(before: Trainings, after: Trainings, seed: int = 0) -> Difference:
    """The same for other samples: recordings are drawn independently, too.

    Raises:
        ValueError: no sample is scored by all trainings of a training_set.
    """
    first, second = _vary([before], seed), _vary([after], seed + 1)
    value = float(second.values[0] - first.values[0])
    deviations = second.deviations[:, 0] - first.deviations[:, 0]
    by = widening([*first.parts({0: 1.0}), *second.parts({0: 1.0})])
    return Difference(value, *_ends(value + by * deviations))


@dataclass(frozen=True, eq=False)
class _Varied:
    """What is known of S training sets on the same samples.

    Attributes:
        values: [S] mean score.
        deviations: [NUM_RESAMPLES, S] of replicates, recordings and trainings drawn; NaN with too few recordings.
        recordings: [NUM_RESAMPLES, S] the part of them that recordings have.
        num_recordings: that are scored.
        trainings: of each training set the variance of its mean over trainings, and the degrees of freedom.
    """

    values: np.ndarray
    deviations: np.ndarray
    recordings: np.ndarray
    num_recordings: int
    trainings: tuple[tuple[float, float], ...]

    def parts(self, weights: Mapping[int, float]) -> list[tuple[float, float]]:
        """Variances, with degrees of freedom, of a weighted sum of the training sets."""
        sampled = sum(weight * self.recordings[:, of_set] for of_set, weight in weights.items())
        parts = [(float(np.var(sampled)), self.num_recordings - 1.0)]
        for of_set, weight in weights.items():
            variance, freedom = self.trainings[of_set]
            parts.append((weight**2 * variance, freedom))
        return parts


def _contrast(varied: _Varied, weights: Mapping[int, float]) -> Difference:
    """A weighted sum of the training sets' scores, with its interval."""
    value = sum(weight * float(varied.values[of_set]) for of_set, weight in weights.items())
    deviations = np.sum([weight * varied.deviations[:, of_set] for of_set, weight in weights.items()], axis=0)
    return Difference(value, *_ends(value + widening(varied.parts(weights)) * deviations))


def _vary(training_sets: Sequence[Trainings], seed: int) -> _Varied:
    first = training_sets[0]
    if not all(first.scores_the_same_as(other) for other in training_sets):
        raise ValueError("paired scores must be about the same samples in the same order")
    weights = np.ones(len(first.recordings)) if first.weights is None else first.weights
    scored = ~np.any([np.isnan(training_set.values).any(axis=0) for training_set in training_sets], axis=0) & (
        weights > 0
    )
    if not scored.any():
        raise ValueError(f"none of the {len(scored)} samples is scored by every training")
    names, index = np.unique(np.asarray(first.recordings)[scored], return_inverse=True)
    weights = weights[scored]
    counts = np.bincount(index, weights=weights)
    sums = []
    for training_set in training_sets:
        of_set = np.stack([np.bincount(index, weights=weights * values) for values in training_set.values[:, scored]])
        # In the order of their scores, so that the order of trainings changes nothing.
        sums.append(of_set[np.argsort(of_set.sum(axis=1), kind="stable")])
    found = np.array([of_set.sum() / (len(of_set) * counts.sum()) for of_set in sums])
    trainings = tuple(variance_of_mean(of_set.sum(axis=1) / counts.sum()) for of_set in sums)
    if len(names) < MIN_RECORDINGS:
        unknown = np.full((1, len(training_sets)), np.nan)
        return _Varied(found, unknown, unknown, len(names), trainings)
    generator = np.random.default_rng(seed)
    drawn = [
        [(times @ of_set.T) / (times @ counts)[:, None] for of_set in sums]
        for times in _draw_recordings(len(names), generator)
    ]
    of_trainings = [np.concatenate(parts) for parts in zip(*drawn, strict=True)]
    recordings = (np.stack([means.mean(axis=1) for means in of_trainings], axis=1) - found) * stretch(len(names))
    of_draws = np.stack([_draw_trainings(means, generator) for means in of_trainings], axis=1)
    return _Varied(found, recordings + of_draws, recordings, len(names), trainings)


def _draw_recordings(count: int, generator: np.random.Generator) -> Iterator[np.ndarray]:
    """How often each recording is drawn in each replicate, in chunks that fit into memory."""
    chunk = max(1, _CHUNK_NUMBERS // count)
    for start in range(0, NUM_RESAMPLES, chunk):
        yield generator.multinomial(count, np.full(count, 1 / count), size=min(chunk, NUM_RESAMPLES - start))


def _draw_trainings(means: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """How much the mean over trainings [B] of replicates [B, R] changes where trainings are drawn as well."""
    count = means.shape[1]
    if count < 2:
        return np.zeros(len(means))
    weights = generator.multinomial(count, np.full(count, 1 / count), size=len(means)) / count
    return stretch(count) * ((weights * means).sum(axis=1) - means.mean(axis=1))


def _ends(draws: np.ndarray) -> tuple[float, float]:
    if np.isnan(draws).any():
        return _UNKNOWN
    low, high = np.quantile(draws, [0.025, 0.975])
    return float(low), float(high)
