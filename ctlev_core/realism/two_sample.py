"""How well can a network tell two sets of frames apart? A classifier two-sample test.

A small convolutional network learns from one half of the frames which set a frame is from; `c2st` is the area under the
ROC curve on the other half: the probability that of two held-out frames, one of each set, it takes the right one for
that of the first. 0.5 = it cannot tell, 1 = it always can. The sets need not be matched in what they show: a different
mix of classes or poses is told as well as a different look.

Whole recordings belong to one half or the other. Two random halvings, each half once to learn from and once held out,
are four trainings, each with weights of its own; the value is their mean. From each set there are equally many frames.
The interval (95 %, percentiles) is over recordings, drawn anew for all trainings alike, and over trainings.

Areas clearly below 0.5 are no better than 0.5: frames of one set are near copies of the other's, and a network that
learnt a copy as one set's takes the original for it.

Source: Lopez-Paz & Oquab, Revisiting Classifier Two-Sample Tests, ICLR 2017, who test the accuracy; the area needs no
threshold.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core.realism.roc import HeldOut, interval_of_mean_area
from ctlev_core.statistics.bootstrap import MIN_RECORDINGS
from data_contracts.tables import TWO_SAMPLE_TESTS

C2ST = "c2st"
MAX_FRAMES = 400
"""Of a larger set so many; see `choose_rows`."""
MIN_FRAMES = 40
"""With fewer in either set the area says too little to be given."""
MIN_HALF = 10
"""Frames of a set to learn from, at least."""
NUM_HALVINGS = 2


@dataclass(frozen=True)
class TwoSampleTest:
    """An area under the ROC curve, and what is needed to read it.

    Attributes:
        value: mean over the trainings; NaN where it could not be measured.
        low: lower end of the 95 % interval; NaN with fewer than `MIN_RECORDINGS` recordings in a set.
        high: upper end.
        deviation: sample standard deviation over the trainings.
        num_first: frames of the first set that were learnt from or held out, each in turn both.
        num_second: of the second set.
        note: why there is no area, or what it has to be read with; empty = nothing.
    """

    value: float
    low: float
    high: float
    deviation: float
    num_first: int
    num_second: int
    note: str = ""

    def row(self) -> dict[str, Any]:
        """Columns of the table `two_sample_tests`, without whose test it is; what is not known is None."""
        row = dataclasses.asdict(self)
        return row | {name: None for name, value in row.items() if isinstance(value, float) and np.isnan(value)}


def compare_frames(
    first: np.ndarray,
    second: np.ndarray,
    *,
    first_groups: Sequence[str] | np.ndarray,
    second_groups: Sequence[str] | np.ndarray,
    names: tuple[str, str] = ("first", "second"),
    seed: int = 0,
) -> TwoSampleTest:
    """Tell frames of two sets apart; see the head of this file.

    Args:
        first: [N, H, W, C] uint8, C channels of any meaning.
        second: [M, H, W, C] uint8.
        first_groups: [N] recording of each frame; one that both sets name is in the same half for both.
        second_groups: [M] recording of each frame.
        names: of the sets, for the note.
        seed: of halvings, networks and resampling.
    Returns:
        The area; NaN with the reason where there are too few frames or recordings, or frames of different sizes.
    Raises:
        ValueError: a shape or dtype is none of those.
    """
    sets, recordings = _checked((first, second), (first_groups, second_groups))
    counts = len(first), len(second)
    if first.shape[1:] != second.shape[1:]:
        return _unknown(counts, f"frames of different sizes: {first.shape[1:3]} and {second.shape[1:3]}")
    count = min(*counts, MAX_FRAMES)
    if count < MIN_FRAMES:
        return _unknown(counts, f"fewer than {MIN_FRAMES} frames in a set")
    rows = [choose_rows(len(frames), count, seed) for frames in sets]
    sets = [frames[chosen] for frames, chosen in zip(sets, rows, strict=True)]
    recordings = [of_set[chosen] for of_set, chosen in zip(recordings, rows, strict=True)]
    every, index = np.unique(np.concatenate(recordings), return_inverse=True)
    groups = index[:count], index[count:]
    kinds, fewest = _kinds(groups, len(every)), min(len(np.unique(of_set)) for of_set in groups)
    if fewest < 2:
        return _unknown(counts, "a set is of one recording, which cannot be both learnt from and held out")
    trainings = []
    for number in range(NUM_HALVINGS):
        in_half = _halve(kinds, np.random.default_rng([seed, number]))
        for learnt in (in_half, ~in_half):
            if min(np.count_nonzero(learnt[of_set]) for of_set in groups) < MIN_HALF:
                return _unknown(counts, f"half of the recordings have fewer than {MIN_HALF} frames of a set")
            trainings.append(_train_and_test(sets, groups, learnt, [seed, len(trainings)]))
    areas = np.array([training.area for training in trainings])
    low = high = float("nan")
    if fewest >= MIN_RECORDINGS:
        low, high = interval_of_mean_area(trainings, kinds, np.random.default_rng([seed, NUM_HALVINGS]))
    return TwoSampleTest(
        value=float(areas.mean()),
        low=low,
        high=high,
        deviation=float(areas.std(ddof=1)),
        num_first=count,
        num_second=count,
        note=_note(sets, names, high),
    )


def compare_halves(frames: np.ndarray, groups: Sequence[str] | np.ndarray, seed: int = 0) -> TwoSampleTest:
    """The floor: two random halves of one set told apart, whole recordings to one or the other.

    Args:
        frames: [N, H, W, C] uint8.
        groups: [N] recording of each frame.
        seed: of the halves, and as for `compare_frames`.
    """
    (frames,), (names,) = _checked((frames,), (groups,))
    every, index = np.unique(names, return_inverse=True)
    counts = len(frames) // 2, len(frames) - len(frames) // 2
    if counts[0] < MIN_FRAMES:
        return _unknown(counts, f"fewer than {MIN_FRAMES} frames in a set")
    if len(every) < 4:
        return _unknown(counts, f"{len(every)} recordings, which cannot be halved twice")
    in_half = _halve(np.zeros(len(every)), np.random.default_rng([seed, NUM_HALVINGS + 1]))[index]
    return compare_frames(
        frames[in_half], frames[~in_half], first_groups=names[in_half], second_groups=names[~in_half], seed=seed
    )


def tests_table(group: str, tests: Mapping[str, TwoSampleTest]) -> pa.Table:
    """The table `two_sample_tests`.

    Args:
        group: whose frames they are of.
        tests: by subject, `A against B`.
    """
    rows = [{"group": group, "subject": subject} | test.row() for subject, test in tests.items()]
    return pa.Table.from_pylist(rows, schema=TWO_SAMPLE_TESTS.arrow())


def choose_rows(count: int, wanted: int, seed: int = 0) -> np.ndarray:
    """At most `wanted` of `count` rows in order: one at random from each of as many equal stretches.

    Rows at equal distances would be of one class where classes take turns.
    """
    if count <= wanted:
        return np.arange(count)
    ends = np.arange(wanted + 1, dtype=np.int64) * count // wanted
    return np.random.default_rng([seed, count, wanted]).integers(ends[:-1], ends[1:])


def _train_and_test(
    sets: list[np.ndarray], groups: tuple[np.ndarray, np.ndarray], learnt: np.ndarray, seed: list[int]
) -> HeldOut:
    from ctlev_core.realism.two_sample_network import learn_and_score

    known = [learnt[of_set] for of_set in groups]
    scores = learn_and_score(
        sets[0][known[0]],
        sets[1][known[1]],
        held_out=(sets[0][~known[0]], sets[1][~known[1]]),
        seed=int(np.random.SeedSequence(seed).generate_state(1)[0]),
    )
    return HeldOut.make(scores, [of_set[~rows] for of_set, rows in zip(groups, known, strict=True)])


def _kinds(groups: tuple[np.ndarray, np.ndarray], count: int) -> np.ndarray:
    """[count] of each recording: 1 = of the first set alone, 2 = of the second alone, 3 = of both."""
    return np.isin(np.arange(count), groups[0]) + 2 * np.isin(np.arange(count), groups[1])


def _halve(kinds: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """[count] bool, the recordings of a random half: of each kind half."""
    in_half = np.zeros(len(kinds), bool)
    for kind in np.unique(kinds):
        members = generator.permutation(np.flatnonzero(kinds == kind))
        in_half[members[: (len(members) + int(generator.integers(2))) // 2]] = True
    return in_half


def _checked(
    sets: Sequence[np.ndarray], groups: Sequence[Sequence[str] | np.ndarray]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    names = [np.asarray(of_set) for of_set in groups]
    for frames, of_set in zip(sets, names, strict=True):
        if frames.ndim != 4 or frames.dtype != np.uint8:
            raise ValueError(f"frames must be [N, H, W, channels] uint8, got {frames.shape} {frames.dtype}")
        if of_set.shape != (len(frames),):
            raise ValueError(f"groups must be [{len(frames)}], one a frame, got {of_set.shape}")
    return list(sets), names


def _unknown(counts: tuple[int, int], note: str) -> TwoSampleTest:
    nan = float("nan")
    return TwoSampleTest(nan, nan, nan, nan, *counts, note)


def _note(sets: list[np.ndarray], names: tuple[str, str], high: float) -> str:
    notes = []
    for name, frames in zip(names, sets, strict=True):
        num_empty = int((frames.reshape(len(frames), -1) == 0).all(axis=1).sum())
        if num_empty:
            notes.append(f"{num_empty} of {len(frames)} {name} frames are empty")
        elif (frames == frames[0]).all():
            notes.append(f"all {name} frames are equal")
    if high < 0.5:
        notes.append("below 0.5, as where frames of one set are near copies of the other's")
    return "; ".join(notes)
