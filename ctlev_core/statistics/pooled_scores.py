"""Scores of training sets over several draws of the training recordings, and how sure they are.

A group of experiments differs in its draw alone: which few recordings each class learnt from, or which people, motions
and cameras there were. All are tested on the same samples, or each on samples of its own. A score is the mean over
draws, trainings and samples. What varies is drawn with replacement:

- test recordings, the same for all training sets and trainings, and for all draws that share them;
- draws, the same for all training_sets: differences of training sets are paired by draw;
- within each draw fine-tunings of the generator, and within these classifier seeds, for each training set
  independently. Training t learnt from the frames of fine-tuning t % G. Every training has a classifier seed of its
  own, so that no seed meets two fine-tunings: seeds are drawn within the fine-tuning. Settings without a generator have
  seeds only.

Deviations of R repetitions are stretched by sqrt(R/(R - 1)), for drawing R with replacement makes the variance of their
mean (R - 1)/R of what it is (Rao & Wu, Resampling Inference with Complex Survey Data, JASA 1988).

The means of draws already vary with what was trained within them, and with recordings of their own. Drawing again
within draws would count that spread twice, so that deviations of each level are shrunk to the variance that the levels
below do not explain (Davison & Hinkley, Bootstrap Methods and their Application, 1997, section 3.8; Carpenter,
Goldstein & Rasbash, A Novel Bootstrap Procedure for Assessing the Relationship between Class Size and Achievement,
JRSS C 2003). Together they have, for draws, the larger of the variance found between draws and that explained by what
is within.

Three draws say little about their own spread. Percentiles of replicates, or 1.96 standard deviations of them, cover the
truth in only 82 % of studies where draws vary most. The interval is therefore the score and t standard deviations of
the replicates: half widths of what recordings and of what draws add, each by the t quantile of its own degrees of
freedom, add up in squares. Those of a sum over training sets are Satterthwaite's (Biometrics Bulletin 1946). In
simulated studies of three draws such intervals cover the truth in 93 to 98 %.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyarrow as pa

from ctlev_core.statistics.bootstrap import MIN_RECORDINGS
from ctlev_core.statistics.paired_differences import NUM_RESAMPLES, Difference
from ctlev_core.statistics.small_samples import satterthwaite, stretch, t_quantile
from data_contracts.errors import DataError
from data_contracts.training_sets import ORACLE, RECORDED, LabelAgreement, TrainingSet

WITHOUT_GENERATOR = (RECORDED, ORACLE)
"""Settings made of these alone learnt from no generator's frames."""
_HALVINGS = 20
_KEY = ("subject", "training", "sample_id", "recording_id", "value", "weight", "samples_digest")


class DrawsDiffer(DataError):
    """The experiments of a group were not tested on the same samples."""


@dataclass(frozen=True, eq=False)
class _Tested:
    """The samples of an experiment, sorted by name.

    Attributes:
        ids: [N].
        recordings: [N] the recording of each.
        weights: [N] in the mean.
        digest: of images and labels.
    """

    ids: tuple[str, ...]
    recordings: tuple[str, ...]
    weights: np.ndarray
    digest: str

    def differs_from(self, other: _Tested) -> str:
        """What differs, in words; empty where nothing does."""
        if self.ids != other.ids:
            missing = len(set(self.ids) ^ set(other.ids))
            return f"{len(self.ids)} and {len(other.ids)} samples, {missing} of them in one alone"
        if self.recordings != other.recordings:
            return "the same names of samples, of other recordings"
        if not np.array_equal(self.weights, other.weights):
            return "the same samples with other weights"
        return "" if self.digest == other.digest else "the same names of samples, with other images or labels"


@dataclass(frozen=True, eq=False)
class _Varied:
    """What is known of one training set.

    Attributes:
        value: its score.
        draws: [D] score of each draw.
        recordings: [B] deviations of replicates of the test recordings.
        within: [B] deviations of replicates of fine-tunings and seeds.
        variance: of the mean of one draw, as trainings within explain it; NaN = one training, nothing known.
        freedom: degrees of freedom of that variance.
    """

    value: float
    draws: np.ndarray
    recordings: np.ndarray
    within: np.ndarray
    variance: float
    freedom: float


class PooledScores:
    """Scores of one metric over the experiments of a group; results are those of equal seeds whatever the row order.

    Attributes:
        training_sets: those that every experiment has, in the order of the first.
        num_draws: experiments.
        num_generators: fine-tunings in each.
        num_trainings: by training set, in each experiment.
        num_samples: test samples that every training has a score of; with `own_tests` those of all draws.
        num_recordings: their recordings. With fewer than `MIN_RECORDINGS` in a draw there are no intervals.
        own_tests: each draw has test recordings of its own.
    """

    def __init__(
        self, draws: Sequence[pa.Table], metric: str, num_generators: int, seed: int = 0, *, own_tests: bool = False
    ) -> None:
        """Args:
            draws: of each experiment the table of the schema `PAIRED_SAMPLES`.
            metric: which score.
            num_generators: fine-tunings of the generator in each experiment; training t used number t % G.
            seed: of the resampling.
            own_tests: the experiments were tested on different samples, and were meant to be.

        Raises:
            DrawsDiffer: experiments were tested on different samples, or, with `own_tests`, some on the same.
            ValueError: fewer than two experiments, none scored by this metric, training sets with other numbers of
                trainings in other draws, numbers that are no multiple of `num_generators`, or no sample scored by all.
        """
        if len(draws) < 2:
            raise ValueError(f"scores are pooled over at least two draws, got {len(draws)}")
        read = [_read(table, metric, number) for number, table in enumerate(draws)]
        tested = [one for one, _ in read]
        _check_tests(tested, own_tests=own_tests)
        self.num_draws, self.num_generators, self.own_tests = len(draws), num_generators, own_tests
        self.training_sets = tuple(name for name in read[0][1] if all(name in found for _, found in read))
        values = {name: [found[name] for _, found in read] for name in self.training_sets}
        self.num_trainings = {name: _count_trainings(name, of_set) for name, of_set in values.items()}
        scored = [
            ~np.any([np.isnan(of_set[draw]).any(axis=0) for of_set in values.values()], axis=0) & (one.weights > 0)
            for draw, one in enumerate(tested)
        ]
        if not own_tests:
            scored = [np.all(scored, axis=0)] * len(draws)
        if not all(rows.any() for rows in scored):
            raise ValueError(f"none of the {len(scored[0])} samples is scored by every training of every draw")
        random = np.random.default_rng(seed)
        # Draws that share their recordings share how often each of these is drawn.
        pairs = list(zip(tested, scored, strict=True))
        once = [_Recordings.draw(*pair, random) for pair in (pairs if own_tests else pairs[:1])]
        recordings = once if own_tests else once * len(draws)
        self.num_samples = sum(one.num_samples for one in once)
        self.num_recordings = sum(len(one.weights) for one in once)
        self._fewest_recordings = min(len(one.weights) for one in once)
        self._freedom_of_recordings = float(sum(len(one.weights) - 1 for one in once))
        self._draw_weights = _stretched(random, self.num_draws, (NUM_RESAMPLES,))
        self._of: dict[str, _Varied] = {}
        # In the order of names, so that the order of rows changes nothing.
        for name in sorted(self.training_sets):
            sums = [one.add_up(of_draw) for one, of_draw in zip(recordings, values[name], strict=True)]
            groups = num_generators if _has_generator(name) else 1
            self._of[name] = _vary(name, sums, recordings, groups, random)

    def score(self, training_set: str) -> Difference:
        """Mean score of a training set, with its 95 % interval.

        Raises:
            KeyError: not every experiment has this training set; so do the other methods.
        """
        return self._contrast({training_set: 1.0})[0]

    def difference(self, before: str, after: str) -> Difference:
        """Mean score after minus mean score before, paired by test recording and by draw."""
        return self._contrast(_minus(after, before))[0]

    def probability(self, training_set: str, other: str, *, lower_is_better: bool = False) -> float:
        """How probable it is that the training set beats the other: the share of replicates in which it does.

        Replicates are spread as widely as the interval is, so that both say the same. Equal scores count as half.
        NaN with too few recordings. Source: Bouthillier et al., Accounting for Variance in Machine Learning Benchmarks,
        MLSys 2021.
        """
        replicates = self._contrast(_minus(training_set, other))[1] * (-1 if lower_is_better else 1)
        if np.isnan(replicates).any():
            return float("nan")
        return float((replicates > 0).mean() + (replicates == 0).mean() / 2)

    def share_of_gain(self, start: str, reached: str, oracle: str) -> Difference | None:
        """How much of the way from the start to the oracle was gone: 1 = all of it.

        Returns:
            The share and its interval: all shares s of which `reached - start - s (oracle - start)` may be 0 (Fieller,
            Some Problems in Interval Estimation, JRSS B 1954). None where it is not certain that there is a gain.
        """
        gain, advance = self.difference(start, oracle), self.difference(start, reached)
        if not gain.is_certain:
            return None
        share = advance.value / gain.value
        ends = [self._end_of_share(share, step, (start, reached, oracle)) for step in (-1.0, 1.0)]
        return Difference(share, *ends)

    def _end_of_share(self, share: float, step: float, names: tuple[str, str, str]) -> float:
        start, reached, oracle = names

        def inside(s: float) -> float:
            weights = _added((reached, 1.0), (start, s - 1.0), (oracle, -s))
            found = self._contrast(weights)[0]
            return (found.high - found.low) / 2 - abs(found.value)

        if inside(share) <= 0:
            return share
        while inside(share + step) > 0:
            step *= 2
            if abs(step) > 1e6:
                return math.copysign(math.inf, step)
        near, far = share, share + step
        for _ in range(_HALVINGS):
            middle = (near + far) / 2
            near, far = (middle, far) if inside(middle) > 0 else (near, middle)
        return (near + far) / 2

    def _contrast(self, weights: Mapping[str, float]) -> tuple[Difference, np.ndarray]:
        """A weighted sum of scores with its interval, and the replicates of it [B], as wide as the interval."""
        parts = [(weight, self._of[name]) for name, weight in weights.items()]
        value = sum(weight * part.value for weight, part in parts)
        if self._fewest_recordings < MIN_RECORDINGS:
            return Difference(value, float("nan"), float("nan")), np.full(1, np.nan)
        zeros = np.zeros(NUM_RESAMPLES)
        replicates = sum((weight * part.recordings for weight, part in parts), zeros)
        sampled = float(replicates.var()), self._freedom_of_recordings
        draws = sum((weight * part.draws for weight, part in parts), np.zeros(self.num_draws))
        within = [(weight**2 * part.variance, part.freedom) for weight, part in parts]
        deviations = sum((weight * part.within for weight, part in parts), zeros)
        if self.own_tests:
            # Scores of draws vary with their recordings as they do with their trainings.
            within.append((sampled[0] * self.num_draws, sampled[1]))
            more, repeated = _vary_draws(draws, self._draw_weights, deviations + replicates, within)
            return _interval(value, more, [repeated])
        more, repeated = _vary_draws(draws, self._draw_weights, deviations, within)
        return _interval(value, replicates + more, [sampled, repeated])


def pool_values(values: np.ndarray, num_generators: int, seed: int = 0) -> Difference:
    """Mean of scores that have samples of their own, as those of synthetic frames against their labels have.

    What samples add to the spread is then part of that between fine-tunings, and nothing is drawn but these, seeds and
    draws.

    Args:
        values: [D, R] score of each training of each draw; training t used the frames of fine-tuning t % G.
        num_generators: G.
        seed: of the resampling.

    Raises:
        ValueError: fewer than two draws, or R is no multiple of G.
    """
    values = np.asarray(values, np.float64)
    if values.ndim != 2 or len(values) < 2:
        raise ValueError(f"scores are pooled over at least two draws, got values of shape {values.shape}")
    random = np.random.default_rng(seed)
    draw_weights = _stretched(random, len(values), (NUM_RESAMPLES,))
    one = _Recordings(np.ones(1, bool), np.zeros(1, int), np.ones(1), np.ones(1), np.ones((NUM_RESAMPLES, 1)))
    part = _vary("scores", list(values[..., None]), [one] * len(values), num_generators, random)
    more, repeated = _vary_draws(part.draws, draw_weights, part.within, [(part.variance, part.freedom)])
    return _interval(part.value, more, [repeated])[0]


def _read(table: pa.Table, metric: str, number: int) -> tuple[_Tested, dict[str, np.ndarray]]:
    """The tested samples, and of each training set the values [R, N], both in the order of the samples' names."""
    metrics, of_metric = _encoded(table["metric"])
    training_sets, of_set = _encoded(table["subject"])
    chosen = np.array([name == metric for name in metrics], bool)[of_metric]
    chosen &= ~np.array([LabelAgreement.parse(name) is not None for name in training_sets], bool)[of_set]
    table = table.filter(pa.array(chosen)).select(list(_KEY))
    if not len(table):
        raise ValueError(f"draw {number} has no samples scored by {metric!r}")
    codes, names = {}, {}
    for column in ("subject", "sample_id", "recording_id", "samples_digest"):
        names[column], codes[column] = _encoded(table[column])
    training, value, weight = (table[name].to_numpy() for name in ("training", "value", "weight"))
    count = len(names["sample_id"])
    first = np.full(count, -1)
    first[codes["sample_id"][::-1]] = np.arange(len(table))[::-1]
    recordings = codes["recording_id"][first]
    same = (recordings[codes["sample_id"]] == codes["recording_id"]) & (weight[first][codes["sample_id"]] == weight)
    if len(names["samples_digest"]) > 1 or not same.all():
        raise DrawsDiffer(f"the trainings of draw {number} must be tested on the same samples, got different ones")
    found = {}
    # In the order of the table's rows.
    for code in dict.fromkeys(codes["subject"].tolist()):
        of_set = codes["subject"] == code
        trainings, rows = np.unique(training[of_set], return_inverse=True)
        values, times = np.full((len(trainings), count), np.nan), np.zeros((len(trainings), count), int)
        place = rows, codes["sample_id"][of_set]
        values[place] = value[of_set]
        np.add.at(times, place, 1)
        if (times != 1).any():
            raise DrawsDiffer(
                f"training set {names['subject'][code]!r} of draw {number}: each training must score each of the "
                f"{count} samples once, got {times.min()} to {times.max()} times"
            )
        found[names["subject"][code]] = values
    of_samples = tuple(names["recording_id"][code] for code in recordings)
    return _Tested(tuple(names["sample_id"]), of_samples, weight[first], names["samples_digest"][0]), found


def _encoded(column: pa.ChunkedArray) -> tuple[list[str], np.ndarray]:
    """The different texts, sorted, and the number of each row's among them."""
    encoded = column.combine_chunks().dictionary_encode()
    names = np.asarray(encoded.dictionary.to_pylist())
    order = np.argsort(names)
    return names[order].tolist(), np.argsort(order)[encoded.indices.to_numpy(zero_copy_only=False)]


def _count_trainings(name: str, draws: Sequence[np.ndarray]) -> int:
    counts = [len(values) for values in draws]
    if len(set(counts)) > 1:
        raise ValueError(f"training set {name!r} must have as many trainings in every draw, got {counts}")
    return counts[0]


def _check_tests(tested: Sequence[_Tested], *, own_tests: bool) -> None:
    """Raise unless draws were tested on the same samples, or each on its own."""
    seen: dict[str, int] = {}
    for number, one in enumerate(tested):
        if not own_tests and (difference := one.differs_from(tested[0])):
            raise DrawsDiffer(f"draws 0 and {number} must be tested on the same samples, got {difference}")
        first = seen.setdefault(one.digest, number)
        if own_tests and first != number:
            raise DrawsDiffer(
                f"each draw must be tested on samples of its own, got the same for draws {first} and {number}"
            )


@dataclass(frozen=True, eq=False)
class _Recordings:
    """The test recordings of a draw.

    Attributes:
        scored: [N] bool, the samples that count.
        index: [S] recording of each of them.
        sample_weights: [S].
        weights: [n] of the recordings.
        times: [B, n] how often each is drawn.
    """

    scored: np.ndarray
    index: np.ndarray
    sample_weights: np.ndarray
    weights: np.ndarray
    times: np.ndarray

    @classmethod
    def draw(cls, tested: _Tested, scored: np.ndarray, random: np.random.Generator) -> _Recordings:
        """Those of scored samples."""
        names, index = np.unique(np.asarray(tested.recordings)[scored], return_inverse=True)
        times = random.multinomial(len(names), np.full(len(names), 1 / len(names)), size=NUM_RESAMPLES)
        weights = tested.weights[scored]
        return cls(scored, index, weights, np.bincount(index, weights), times)

    @property
    def num_samples(self) -> int:
        """Samples that count."""
        return len(self.index)

    @cached_property
    def _order(self) -> np.ndarray:
        """[S] samples, recording by recording."""
        return np.argsort(self.index, kind="stable")

    @cached_property
    def _drawn_weights(self) -> np.ndarray:
        """[B] of all recordings drawn."""
        return self.times @ self.weights

    def add_up(self, values: np.ndarray) -> np.ndarray:
        """Values of samples [R, N], weighted and added up by recording: [R, n]."""
        starts = np.searchsorted(self.index[self._order], np.arange(len(self.weights)))
        return np.add.reduceat((values[:, self.scored] * self.sample_weights)[:, self._order], starts, axis=-1)

    def deviations(self, sums: np.ndarray) -> np.ndarray:
        """[B] of replicates of the recordings from the mean, which is of sums [n], stretched; zeros for one alone."""
        if len(self.weights) < 2:
            return np.zeros(len(self.times))
        found = (self.times @ sums) / self._drawn_weights
        return (found - sums.sum() / self.weights.sum()) * stretch(len(self.weights))


def _has_generator(training_set: str) -> bool:
    return not all(name in WITHOUT_GENERATOR for name in TrainingSet.parse(training_set).names)


def _stretched(random: np.random.Generator, count: int, shape: tuple[int, ...]) -> np.ndarray:
    """Weights [*shape, count] of deviations from a mean: of a drawing of `count`, stretched; zeros for one alone."""
    if count < 2:
        return np.zeros((*shape, count))
    times = random.multinomial(count, np.full(count, 1 / count), size=shape)
    return times * (stretch(count) / count)


def _vary(
    name: str,
    sums: Sequence[np.ndarray],
    recordings: Sequence[_Recordings],
    groups: int,
    random: np.random.Generator,
) -> _Varied:
    """Replicates of one training set.

    Args:
        name: of the training set, for errors.
        sums: of each draw [R, n] weighted values of each recording.
        recordings: of each draw.
        groups: fine-tunings that its trainings take turns with.
        random: draws fine-tunings and seeds.
    """
    num_draws, num_trainings = len(sums), len(sums[0])
    if num_trainings % groups:
        raise ValueError(
            f"training set {name!r}: the number of trainings must be a multiple of the {groups} fine-tunings, "
            f"got {num_trainings}"
        )
    pairs = list(zip(sums, recordings, strict=True))
    sampled = np.mean([one.deviations(of_draw.mean(axis=0)) for of_draw, one in pairs], axis=0)
    seeds = num_trainings // groups
    # Training t = seed number t // G of fine-tuning t % G.
    scores = np.stack([of_draw.sum(axis=-1) / one.weights.sum() for of_draw, one in pairs])
    scores = scores.reshape(num_draws, seeds, groups)
    tuned = _mean(scores)
    means = _mean(tuned)
    of_seeds = float(scores.var(axis=1, ddof=1).mean()) / seeds if seeds > 1 else 0.0
    of_tuned = float(tuned.var(axis=1, ddof=1).mean()) if groups > 1 else 0.0
    by_seed = seeds > 1 and of_seeds >= of_tuned
    within = np.zeros(len(sampled))
    for draw in range(num_draws):
        # One draw after the other: memory for one is enough.
        shrunk = math.sqrt(max(0.0, 1 - of_seeds / of_tuned)) if of_tuned else 0.0
        drawn = _stretched(random, groups, (len(sampled),))
        within += drawn @ (tuned[draw] - means[draw]) * shrunk
        for group in range(groups):
            drawn = _stretched(random, seeds, (len(sampled),))
            within += drawn @ (scores[draw, :, group] - tuned[draw, group]) / groups
    if num_trainings == 1:
        variance, freedom = float("nan"), 0.0
    elif by_seed:
        variance, freedom = of_seeds / groups, float(num_draws * groups * (seeds - 1))
    else:
        variance, freedom = of_tuned / groups, float(num_draws * (groups - 1))
    return _Varied(float(means.mean()), means, sampled, within / num_draws, variance, freedom)


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean over the second axis; that of equal numbers is exactly this number, so that they deviate by exactly 0."""
    first = values[:, 0]
    return first + (values - first[:, None]).mean(axis=1)


def _vary_draws(
    means: np.ndarray, weights: np.ndarray, within: np.ndarray, explained: Sequence[tuple[float, float]]
) -> tuple[np.ndarray, tuple[float, float]]:
    """Deviations of replicates [B] of draws and of what was trained within them; their variance and its freedom.

    Args:
        means: [D] of each draw.
        weights: [B, D] of their deviations.
        within: [B] deviations of what was trained within draws.
        explained: (variance of the mean of a draw, degrees of freedom) of each training set.
    """
    count = len(means)
    found = float(means.var(ddof=1))
    known = [(variance, freedom) for variance, freedom in explained if not math.isnan(variance)]
    expected = sum(variance for variance, _ in known)
    if found > expected:
        deviations = weights @ (means - means.mean()) * math.sqrt(1 - expected / found)
        return deviations + within, (found / count, count - 1.0)
    return within, (expected / count, satterthwaite(known))


def _interval(
    value: float, deviations: np.ndarray, parts: Sequence[tuple[float, float]]
) -> tuple[Difference, np.ndarray]:
    """The interval of replicates' deviations [B] around a value, and replicates that are as widely spread.

    Args:
        value: the score or difference.
        deviations: of replicates.
        parts: (variance, degrees of freedom) of what recordings and draws add.
    """
    total = sum(variance for variance, _ in parts)
    squares = sum(variance * t_quantile(freedom) ** 2 for variance, freedom in parts)
    normal = t_quantile(math.inf)
    quantile = math.sqrt(squares / total) if total else normal
    half = quantile * float(deviations.std())
    return Difference(value, value - half, value + half), value + deviations * (quantile / normal)


def _minus(after: str, before: str) -> dict[str, float]:
    return _added((after, 1.0), (before, -1.0))


def _added(*terms: tuple[str, float]) -> dict[str, float]:
    """Weights by training set; those of one that is named twice are added."""
    weights: dict[str, float] = {}
    for name, weight in terms:
        weights[name] = weights.get(name, 0.0) + weight
    return weights
