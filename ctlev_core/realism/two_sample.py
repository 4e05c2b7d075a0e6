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
threshold. Area with ties: Mann & Whitney, Annals of Mathematical Statistics 18, 1947.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from ctlev_core.intervals import MIN_RECORDINGS
from ctlev_core.windows import spread
from data_contracts.tables import Column, TableSchema

C2ST = "c2st"
MAX_FRAMES = 400
"""Of a larger set so many, evenly spread."""
MIN_FRAMES = 40
"""With fewer in either set the area says too little to be given."""
MIN_HALF = 10
"""Frames of a set to learn from, at least."""
NUM_HALVINGS = 2
_NUM_REPLICATES = 1000

TWO_SAMPLE_TESTS = TableSchema(
    "two_sample_tests",
    1,
    None,
    (
        Column("group", pa.string(), "whose frames: as in the table of scores"),
        Column("setting", pa.string(), "`A against B`: which sets are told apart"),
        Column("value", pa.float64(), "area under the ROC curve, mean over trainings", nullable=True),
        Column("low", pa.float64(), "lower end of its 95 % interval", nullable=True),
        Column("high", pa.float64(), "upper end", nullable=True),
        Column("deviation", pa.float64(), "of the area over trainings", nullable=True),
        Column("num_first", pa.int64(), "frames of A", minimum=0),
        Column("num_second", pa.int64(), "frames of B", minimum=0),
        Column("note", pa.string(), "why there is no area, or what it has to be read with"),
    ),
)


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


def compare_frames(
    first: np.ndarray,
    second: np.ndarray,
    *,
    first_groups: Sequence[str] | np.ndarray,
    second_groups: Sequence[str] | np.ndarray,
    seed: int = 0,
) -> TwoSampleTest:
    """Tell frames of two sets apart; see the head of this file.

    Args:
        first: [N, H, W, 3] uint8.
        second: [M, H, W, 3] uint8.
        first_groups: [N] recording of each frame. One that both sets name is in the same half for both.
        second_groups: [M] recording of each frame.
        seed: of halvings, networks and resampling.
    Returns:
        The area; NaN with the reason where there are too few frames or recordings.
    Raises:
        ValueError: shapes or dtypes do not fit.
    """
    sets, names = _checked((first, second), (first_groups, second_groups))
    count = min(len(sets[0]), len(sets[1]), MAX_FRAMES)
    if count < MIN_FRAMES:
        return _unknown(sets, f"fewer than {MIN_FRAMES} frames in a set: {len(sets[0])} and {len(sets[1])}")
    rows = [spread(len(frames), count) for frames in sets]
    sets = [frames[chosen] for frames, chosen in zip(sets, rows, strict=True)]
    names = [of_set[chosen] for of_set, chosen in zip(names, rows, strict=True)]
    every, index = np.unique(np.concatenate(names), return_inverse=True)
    groups = index[:count], index[count:]
    if min(len(np.unique(of_set)) for of_set in groups) < 2:
        return _unknown(sets, "a set is of one recording, which cannot be both learnt from and held out")
    trainings = []
    for number in range(NUM_HALVINGS):
        in_half = _halve(groups, len(every), np.random.default_rng([seed, number]))
        for learnt in (in_half, ~in_half):
            if min(min(learnt[of_set].sum(), (~learnt[of_set]).sum()) for of_set in groups) < MIN_HALF:
                return _unknown(sets, f"halves by recording have fewer than {MIN_HALF} frames of a set")
            trainings.append(_train_and_test(sets, groups, learnt, [seed, len(trainings)]))
    areas = np.array([training.area for training in trainings])
    low = high = float("nan")
    if min(len(np.unique(of_set)) for of_set in groups) >= MIN_RECORDINGS:
        low, high = _interval(trainings, groups, len(every), seed)
    return TwoSampleTest(
        value=float(areas.mean()),
        low=low,
        high=high,
        deviation=float(areas.std(ddof=1)),
        num_first=count,
        num_second=count,
        note=_note(sets, high),
    )


def compare_halves(frames: np.ndarray, groups: Sequence[str] | np.ndarray, seed: int = 0) -> TwoSampleTest:
    """The floor: two random halves of one set told apart, whole recordings to one or the other.

    Args:
        frames: [N, H, W, 3] uint8.
        groups: [N] recording of each frame.
        seed: of the halves, and as for `compare_frames`.
    """
    (frames,), (names,) = _checked((frames,), (groups,))
    every, index = np.unique(names, return_inverse=True)
    if len(every) < 4:
        return TwoSampleTest(*[float("nan")] * 4, 0, 0, f"halves of {len(every)} recordings cannot be halved again")
    in_half = _halve((index, index), len(every), np.random.default_rng([seed, NUM_HALVINGS]))[index]
    return compare_frames(
        frames[in_half], frames[~in_half], first_groups=names[in_half], second_groups=names[~in_half], seed=seed
    )


def area_under_roc(first: np.ndarray, second: np.ndarray) -> float:
    """Share of the pairs of scores, one of each set, of which the first's is larger; equal ones count half.

    Args:
        first: [N] scores, N > 0.
        second: [M] scores, M > 0.
    """
    return float(_wins(first, second).mean())


def _wins(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[N, M]: 1 where the first score is larger, 0.5 where both are equal, 0 else."""
    return (np.sign(first[:, None] - second[None]) + 1) / 2


@dataclass(frozen=True, eq=False)
class _Training:
    """Area of one network, and its parts: wins [A, B] and pairs [A, B] of held-out recordings of either set."""

    area: float
    first: np.ndarray
    second: np.ndarray
    wins: np.ndarray
    pairs: np.ndarray


def _train_and_test(
    sets: list[np.ndarray], groups: tuple[np.ndarray, np.ndarray], learnt: np.ndarray, seed: list[int]
) -> _Training:
    from ctlev_core.realism.two_sample_network import learn_and_score

    known = [learnt[of_set] for of_set in groups]
    network_seed = int(np.random.SeedSequence(seed).generate_state(1)[0])
    scores = learn_and_score(
        *(frames[rows] for frames, rows in zip(sets, known, strict=True)),
        held_out=(sets[0][~known[0]], sets[1][~known[1]]),
        seed=network_seed,
    )
    (first, of_first), (second, of_second) = (
        np.unique(of_set[~rows], return_inverse=True) for of_set, rows in zip(groups, known, strict=True)
    )
    members = np.eye(len(first))[of_first], np.eye(len(second))[of_second]
    wins = members[0].T @ _wins(*scores) @ members[1]
    return _Training(area_under_roc(*scores), first, second, wins, np.outer(*(m.sum(axis=0) for m in members)))


def _halve(groups: tuple[np.ndarray, np.ndarray], count: int, generator: np.random.Generator) -> np.ndarray:
    """[count] bool, the recordings of a random half: of those of both sets, of the first alone, of the second alone."""
    kind = np.isin(np.arange(count), groups[0]) + 2 * np.isin(np.arange(count), groups[1])
    in_half = np.zeros(count, bool)
    for number in range(1, 4):
        members = generator.permutation(np.flatnonzero(kind == number))
        in_half[members[: (len(members) + int(generator.integers(2))) // 2]] = True
    return in_half


def _interval(
    trainings: list[_Training], groups: tuple[np.ndarray, np.ndarray], count: int, seed: int
) -> tuple[float, float]:
    generator = np.random.default_rng([seed, NUM_HALVINGS + 1])
    weights = np.zeros((_NUM_REPLICATES, count))
    kind = np.isin(np.arange(count), groups[0]) + 2 * np.isin(np.arange(count), groups[1])
    for number in range(1, 4):
        members = np.flatnonzero(kind == number)
        if len(members):
            weights[:, members] = generator.multinomial(
                len(members), np.full(len(members), 1 / len(members)), _NUM_REPLICATES
            )
    areas = np.empty((_NUM_REPLICATES, len(trainings)))
    for column, training in zip(areas.T, trainings, strict=True):
        of_first, of_second = weights[:, training.first], weights[:, training.second]
        wins, pairs = (((of_first @ part) * of_second).sum(axis=1) for part in (training.wins, training.pairs))
        column[:] = np.divide(wins, pairs, out=np.full_like(wins, np.nan), where=pairs > 0)
    areas = areas[np.isfinite(areas).all(axis=1)]
    if not len(areas):
        return float("nan"), float("nan")
    # A mean over so few trainings varies too little when they are drawn from themselves; stretched, it does not.
    drawn = np.take_along_axis(areas, generator.integers(len(trainings), size=areas.shape), axis=1).mean(axis=1)
    middle = areas.mean(axis=1)
    found = middle + np.sqrt(len(trainings) / (len(trainings) - 1)) * (drawn - middle)
    low, high = np.clip(np.quantile(found, [0.025, 0.975]), 0, 1)
    return float(low), float(high)


def _checked(
    sets: Sequence[np.ndarray], groups: Sequence[Sequence[str] | np.ndarray]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    names = [np.asarray(of_set) for of_set in groups]
    for frames, of_set in zip(sets, names, strict=True):
        if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8:
            raise ValueError(f"frames must be [N, H, W, 3] uint8, got {frames.shape} {frames.dtype}")
        if of_set.shape != (len(frames),):
            raise ValueError(f"groups must be [{len(frames)}], one a frame, got {of_set.shape}")
    if len({frames.shape[1:] for frames in sets}) > 1:
        raise ValueError(f"sets must have frames of one size, got {[frames.shape[1:3] for frames in sets]}")
    return list(sets), names


def _unknown(sets: list[np.ndarray], note: str) -> TwoSampleTest:
    return TwoSampleTest(*[float("nan")] * 4, len(sets[0]), len(sets[1]), note)


def _note(sets: list[np.ndarray], high: float) -> str:
    notes = []
    for name, frames in zip(("first", "second"), sets, strict=True):
        num_empty = int((frames.reshape(len(frames), -1) == 0).all(axis=1).sum())
        if num_empty:
            notes.append(f"{num_empty} of {len(frames)} frames of the {name} set are empty")
        elif (frames == frames[0]).all():
            notes.append(f"all frames of the {name} set are equal")
    if high < 0.5:
        notes.append("below 0.5: frames of one set are near copies of the other's")
    return "; ".join(notes)
