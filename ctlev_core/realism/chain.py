"""Where does a generator lose realism? Recorded frames after each of its parts, against what they were.

Frames that went through a part are compared with the very frames that were put in, recording by recording: whole
recordings are learnt from or held out, and what was made of a recording goes with it, so that neither other subjects
nor another mix of classes is told apart. Frames that come out unchanged have an area (`c2st`) of exactly 0.5. Beside it
stand the numbers of `ctlev_core.realism.summary`, and how far each is from that of the recorded frames: the mean over
recordings of the difference, with a bootstrap interval over recordings. The floor is the area between random halves of
the recorded frames, which are other recordings.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctlev_core.realism.distances import estimate_numbers
from ctlev_core.realism.summary import Summary, summarise_frames
from ctlev_core.realism.two_sample import C2ST, TwoSampleTest, compare_frames, compare_halves
from ctlev_core.statistics.bootstrap import MIN_RECORDINGS, bootstrap_interval
from data_contracts.training_sets import RECORDED

NAN = float("nan")


@dataclass(frozen=True)
class ChainMeasurement:
    """One number of the frames of a link, with 95 % intervals; NaN = not known.

    Attributes:
        metric: `c2st` or a number of `ctlev_core.realism.summary`.
        value: of these frames.
        low: lower end of its interval.
        high: upper end.
        difference: from the recorded frames; NaN for `c2st`.
        difference_low: lower end of its interval.
        difference_high: upper end.
        num_samples: frames.
        note: why there is no value, or what it has to be read with.
    """

    metric: str
    value: float
    low: float = NAN
    high: float = NAN
    difference: float = NAN
    difference_low: float = NAN
    difference_high: float = NAN
    num_samples: int = 0
    note: str = ""

    def row(self) -> dict[str, Any]:
        """Columns of the table `realism_chain`; what is not known is None."""
        row = dataclasses.asdict(self)
        return row | {name: None for name, value in row.items() if isinstance(value, float) and np.isnan(value)}


def summarise_recordings(frames: np.ndarray, groups: Sequence[str] | np.ndarray) -> dict[str, Summary]:
    """The numbers of the frames of each recording.

    Args:
        frames: [N, H, W, 3] uint8.
        groups: [N] recording of each.
    """
    names = np.asarray(groups)
    return {str(name): summarise_frames(frames[names == name]) for name in dict.fromkeys(names.tolist())}


def measure_recorded(
    frames: np.ndarray, groups: Sequence[str] | np.ndarray, halved: np.ndarray, halved_groups: Sequence[str], seed: int
) -> list[ChainMeasurement]:
    """The first row: how well halves of recorded frames are told apart, and the numbers of recorded frames.

    Args:
        frames: [N, H, W, 3] uint8, those that are sent through.
        groups: [N] recording of each.
        halved: [M, H, W, 3] uint8 recorded frames, best twice as many: so many have the other rows in both sets.
        halved_groups: [M] recording of each.
        seed: of halves, networks and resampling.
    """
    tested = _of_test(compare_halves(halved, np.array(halved_groups, str), seed))
    return [tested, *_numbers(summarise_recordings(frames, groups), {}, len(frames), seed)]


def measure_processed(
    frames: np.ndarray,
    recorded: np.ndarray,
    groups: Sequence[str] | np.ndarray,
    summaries: Mapping[str, Summary],
    seed: int,
) -> list[ChainMeasurement]:
    """A further row: frames that went through something, against what they were.

    Args:
        frames: [N, H, W, 3] uint8.
        recorded: [N, H, W, 3] uint8, the same frames before.
        groups: [N] recording of each.
        summaries: `summarise_recordings` of the recorded frames.
        seed: of halvings, networks and resampling.
    Raises:
        ValueError: there is not one processed frame for each recorded one.
    """
    if frames.shape != recorded.shape:
        raise ValueError(f"expected one processed frame a recorded one, {recorded.shape}, got {frames.shape}")
    names = np.array(groups, str)
    told = compare_frames(
        frames, recorded, first_groups=names, second_groups=names, names=("processed", RECORDED), seed=seed
    )
    return [_of_test(told), *_numbers(summarise_recordings(frames, names), summaries, len(frames), seed)]


def _of_test(told: TwoSampleTest) -> ChainMeasurement:
    return ChainMeasurement(C2ST, told.value, told.low, told.high, num_samples=told.num_first, note=told.note)


def _numbers(
    of_frames: Mapping[str, Summary], of_recorded: Mapping[str, Summary], count: int, seed: int
) -> list[ChainMeasurement]:
    found = []
    for name, estimate in estimate_numbers(list(of_frames.values()), seed).items():
        differences = _differences(name, of_frames, of_recorded)
        low = high = NAN
        if len(differences) >= MIN_RECORDINGS:
            low, high = bootstrap_interval(differences, seed=seed)
        mean = float(differences.mean()) if len(differences) else NAN
        found.append(ChainMeasurement(name, estimate.value, estimate.low, estimate.high, mean, low, high, count))
    return found


def _differences(name: str, first: Mapping[str, Summary], second: Mapping[str, Summary]) -> np.ndarray:
    """Of a number, in every recording in which both sets have it."""
    return np.array(
        [
            summary.numbers[name] - second[recording].numbers[name]
            for recording, summary in first.items()
            if name in summary.numbers and recording in second and name in second[recording].numbers
        ]
    )
