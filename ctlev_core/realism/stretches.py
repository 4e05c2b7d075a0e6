"""Stretches: consecutive frames of a recording, all the same time apart, and the controls made of them.

A stretch is `length` frames that follow one another without a gap. Stretches do not overlap. Frames of synthetic
recordings are found in the same way, by the recording of their labels and the time in it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctlev_core.events.windows import spread

MIN_LENGTH = 3
"""Frames of a stretch, at least: with two, time can be shuffled in one way only, which is to turn it round."""


def find_stretches(names: Sequence[str], times_us: np.ndarray, step_us: int, length: int) -> np.ndarray:
    """Rows of frames that follow one another.

    Frames follow one another where they lie side by side, are of one recording, and their times differ by one step,
    give or take less than half of one: the time of a window is that of its first event.

    Args:
        names: [N] recording of each frame; an empty one is that of no other frame.
        times_us: [N] int64, time of each frame in its recording.
        step_us: from a frame to the next, > 0.
        length: frames of a stretch, at least `MIN_LENGTH`.
    Returns:
        [S, length] int64 rows, in order; S may be 0.
    Raises:
        ValueError: names and times differ in number, or length or step are too small.
    """
    times = np.asarray(times_us, np.int64)
    if times.shape != (len(names),):
        raise ValueError(f"times must be [{len(names)}], one a frame, got {times.shape}")
    if length < MIN_LENGTH or step_us <= 0:
        raise ValueError(f"stretches need {MIN_LENGTH} frames or more, a step above 0 us apart, got {length}, {step_us}")
    own = np.asarray(names, str)
    follows = (own[1:] == own[:-1]) & (own[1:] != "") & (2 * np.abs(np.diff(times) - step_us) < step_us)
    starts = np.flatnonzero(np.concatenate([[True], ~follows])) if len(own) else np.zeros(0, np.int64)
    stops = np.append(starts[1:], len(own))
    first = [np.arange(start, stop - length + 1, length) for start, stop in zip(starts, stops, strict=True)]
    found = np.concatenate([np.zeros(0, np.int64), *first])
    return found[:, None] + np.arange(length)


def choose_stretches(rows: np.ndarray, names: Sequence[str], wanted: int) -> np.ndarray:
    """At most `wanted` stretches [S, L] of all, from as many recordings as there can be, evenly spread.

    Args:
        rows: [S, L], of which those of a recording lie together.
        names: [N] recording of each frame.
        wanted: stretches.
    """
    if len(rows) <= wanted:
        return rows
    own = np.asarray(names, str)[rows[:, 0]]
    _, recording = np.unique(own, return_inverse=True)
    # The first stretches of all recordings, then the second ones: where there are too few turns, some recordings.
    begins = np.concatenate([[True], recording[1:] != recording[:-1]])
    turn = np.arange(len(rows)) - np.maximum.accumulate(np.where(begins, np.arange(len(rows)), 0))
    order = np.argsort(turn, kind="stable")
    full = int(np.searchsorted(np.bincount(turn).cumsum(), wanted, side="right"))
    kept = order[: np.count_nonzero(turn < full)]
    last = order[len(kept) :][: np.count_nonzero(turn == full)]
    chosen = np.concatenate([kept, last[spread(len(last), wanted - len(kept))]])
    return rows[np.sort(chosen)]


def shuffle_time(stretches: np.ndarray, seed: int = 0) -> np.ndarray:
    """The same stretches, the frames of each in an order drawn at random: the end of no order at all.

    Args:
        stretches: [S, L, ...].
        seed: of the orders.
    """
    generator = np.random.default_rng([seed, *stretches.shape[:2]])
    order = generator.permuted(np.tile(np.arange(stretches.shape[1]), (len(stretches), 1)), axis=1)
    return stretches[np.arange(len(stretches))[:, None], order]


def used_channels(frames: np.ndarray) -> slice:
    """Which channels of event images say something: red and blue, one of grey ones, or all three.

    Args:
        frames: [..., 3] uint8, recorded ones: what is made may have faint traces in the others.
    Returns:
        Of the last axis.
    """
    if not frames[..., 1].any():
        return slice(0, 3, 2)
    is_grey = (frames == frames[..., :1]).all()
    return slice(0, 1) if is_grey else slice(0, 3)


def stack_frames(stretches: np.ndarray) -> np.ndarray:
    """The frames of a stretch as the channels of one image, for the two-sample test.

    Args:
        stretches: [S, L, H, W, C] uint8.
    Returns:
        [S, H, W, L * C] uint8, the channels of a frame side by side.
    """
    count, length, height, width, channels = stretches.shape
    return np.ascontiguousarray(np.moveaxis(stretches, 1, 3)).reshape(count, height, width, length * channels)
