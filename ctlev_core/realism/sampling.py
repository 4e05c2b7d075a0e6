"""How real sampled frames look: a two-sample test against held-out recorded frames, active and isolated pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctlev_core.realism.distances import estimate_numbers
from ctlev_core.realism.summary import summarise_frames
from ctlev_core.realism.two_sample import C2ST, MIN_FRAMES, TwoSampleTest, compare_frames, compare_halves
from ctlev_core.statistics.sampling_errors import HELD_OUT, OF_HALVES, Measurement

STATISTICS = ("active_pixel_share", "isolated_pixel_share")


def realism_of_samples(
    frames: np.ndarray, groups: Sequence[str], real: np.ndarray, recordings: Sequence[str]
) -> list[Measurement]:
    """`c2st` against held-out recorded frames, and statistics of the samples.

    Args:
        frames: [N, H, W, 3] uint8, samples of one subject.
        groups: [N] condition of each.
        real: [M, H, W, 3] uint8, held-out recorded frames.
        recordings: [M] recording of each.
    Returns:
        What there are enough frames for: nothing with fewer than `MIN_FRAMES` samples.
    """
    told = compare_frames(frames, real, first_groups=np.array(groups, str), second_groups=np.array(recordings, str))
    return _measured(C2ST, told) + _statistics("", frames, groups)


def realism_of_real(real: np.ndarray, recordings: Sequence[str]) -> list[Measurement]:
    """The same of the held-out recorded frames: `c2st` between their halves, and their statistics."""
    told = compare_halves(real, np.array(recordings, str))
    return _measured(C2ST + OF_HALVES, told) + _statistics(HELD_OUT, real, recordings)


def _measured(metric: str, told: TwoSampleTest) -> list[Measurement]:
    if np.isnan(told.value):
        return []
    return [Measurement(metric, HELD_OUT, told.value, told.num_first, told.low, told.high)]


def _statistics(against: str, frames: np.ndarray, groups: Sequence[str]) -> list[Measurement]:
    if len(frames) < MIN_FRAMES:
        return []
    names = np.array(groups, str)
    found = estimate_numbers([summarise_frames(frames[names == name]) for name in dict.fromkeys(names.tolist())])
    return [
        Measurement(name, against, found[name].value, len(frames), found[name].low, found[name].high)
        for name in STATISTICS
        if name in found
    ]
