"""Stretches: consecutive frames of a recording, all the same time apart, and the controls made of them.

A stretch is `length` frames that follow one another without a gap. Stretches do not overlap. Frames of synthetic
recordings are found in the same way, by the recording of their labels and the time in it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctlev_core.events.windows import spread
from ctlev_core.labels.source_moments import source_moment
from data_contracts.errors import DataError
from data_contracts.manifest import Manifest

SHUFFLED = "recorded shuffled"
"""What recorded stretches in shuffled order are called in tables."""
STACKED_SIDE_PX = 32
"""Larger frames are made smaller for the two-sample test."""
WINDOW_TOLERANCE, LABEL_TOLERANCE = 0.5, 0.1
"""Of a step: the time of a window is that of its first event, and varies; that of a label does not."""
MIN_LENGTH = 3
"""Frames of a stretch, at least: with two, time can be shuffled in one way only, which is to turn it round."""


def find_stretches(
    names: Sequence[str], times_us: np.ndarray, step_us: int, length: int, tolerance: float = WINDOW_TOLERANCE
) -> np.ndarray:
    """Rows of frames that follow one another.

    Frames follow one another where they lie side by side, are of one recording, and their times differ by one step.

    Args:
        names: [N] recording of each frame; an empty one is that of no other frame.
        times_us: [N] int64, time of each frame in its recording.
        step_us: from a frame to the next, > 0.
        length: frames of a stretch, at least `MIN_LENGTH`.
        tolerance: times may differ by less than this share of a step more or less.
    Returns:
        [S, length] int64 rows, in order; S may be 0.
    Raises:
        ValueError: names and times differ in number, or length or step are too small.
    """
    times = np.asarray(times_us, np.int64)
    if times.shape != (len(names),):
        raise ValueError(f"times must be [{len(names)}], one a frame, got {times.shape}")
    if length < MIN_LENGTH or step_us <= 0:
        raise ValueError(
            f"stretches need {MIN_LENGTH} frames, a step above 0 us apart, or more; got {length}, {step_us} us"
        )
    own = np.asarray(names, str)
    follows = (own[1:] == own[:-1]) & (own[1:] != "") & (np.abs(np.diff(times) - step_us) < tolerance * step_us)
    breaks = [*np.flatnonzero(~follows) + 1, len(own)]
    first = [np.arange(start, stop - length + 1, length) for start, stop in itertools.pairwise([0, *breaks])]
    found = np.concatenate(first)
    return found[:, None] + np.arange(length)


@dataclass(frozen=True, eq=False)
class Stretches:
    """Stretches of a set of frames.

    Attributes:
        rows: [S, L] int64, rows of the frames, those of a recording together.
        names: [S] recording of each; of synthetic ones that of their labels.
    """

    rows: np.ndarray
    names: np.ndarray

    def __len__(self) -> int:
        return len(self.rows)

    def spread(self, wanted: int) -> Stretches:
        """At most `wanted` of them, of as many recordings as there can be, evenly spread over these."""
        if len(self) <= wanted:
            return self
        begins = np.concatenate([[True], self.names[1:] != self.names[:-1]])
        number = np.arange(len(self))
        turn = number - np.maximum.accumulate(np.where(begins, number, 0))
        # The first stretches of all recordings, then the second ones, ...: of the last that fit, some.
        of_turn = np.bincount(turn)
        last = int(np.searchsorted(of_turn.cumsum(), wanted))
        kept, some = np.flatnonzero(turn < last), np.flatnonzero(turn == last)
        chosen = np.sort(np.concatenate([kept, some[spread(len(some), wanted - len(kept))]]))
        return Stretches(self.rows[chosen], self.names[chosen])


def recorded_stretches(frames: Manifest, split: str, step_us: int, length: int) -> Stretches:
    """Those of recorded frames of a split; see `find_stretches`."""
    rows = frames.rows_where(split=split)
    names, times = np.array(frames.column("recording_id"), str)[rows], frames.table["t_start_us"].to_numpy()[rows]
    found = find_stretches(names.tolist(), times, step_us, length)
    return Stretches(rows[found], names[found[:, 0]])


def labelled_stretches(made: Manifest, frames: Manifest, step_us: int, length: int) -> Stretches:
    """Those of synthetic frames, or of conditions, whose labels follow one another in time.

    Args:
        made: has a column `source_id`: a moment, `RECORDING:TIME`, or the recorded frame whose labels they are.
        frames: recorded ones.
        step_us: as for `find_stretches`.
        length: likewise.
    """
    moments = zip(frames.column("recording_id"), frames.column("t_start_us"), strict=True)
    of_frame = dict(zip(frames.column("sample_id"), moments, strict=True))
    sources = [of_frame.get(source) or source_moment(source) for source in made.column("source_id")]
    names = [name if t_us >= 0 else "" for name, t_us in sources]
    times = np.array([t_us for _, t_us in sources], np.int64)
    tolerance = LABEL_TOLERANCE if of_frame.keys().isdisjoint(made.column("source_id")) else WINDOW_TOLERANCE
    rows = find_stretches(names, times, step_us, length, tolerance)
    return Stretches(rows, np.array(names, str)[rows[:, 0]])


def check_stretches(frames: Manifest, conditions: Manifest, step_us: int, length: int) -> None:
    """Raise `DataError` where recorded training frames, or the labels to sample from, have no stretch.

    Args:
        frames: recorded ones.
        conditions: labels to sample from.
        step_us: as for `find_stretches`.
        length: likewise.
    """
    wanted = f"sequence_length: expected {length} frames in a row, each {step_us} us after the one before"
    if not len(recorded_stretches(frames, "train", step_us, length)):
        raise DataError(
            f"{wanted}; no recording in {frames.ref.path} has so many training frames. Choose a shorter length or "
            "longer recordings; a window without events ends a row"
        )
    if not len(labelled_stretches(conditions, frames, step_us, length)):
        raise DataError(
            f"{wanted}; labels to sample from in {conditions.ref.path} do not follow one another so. They must be one "
            "window apart (of the studio: condition_rate_hz), and num_synthetic must take all of a recording"
        )


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


def stack_frames(frames: np.ndarray) -> np.ndarray:
    """The frames of a stretch, and how much they differ from one to the next, as the channels of one image.

    The two-sample test sees time so: of 200 recorded stretches of 8 frames it tells those with shuffled frames with an
    area of .99, without differences .92 (sd over trainings .004 and .03), and of frames of 64 px, without either, .87.
    What moves does so by more than a pixel; the finest noise is what the test of single frames sees.

    Args:
        frames: [L, H, W, C] uint8.
    Returns:
        [h, w, (2 L - 1) C] uint8, L frames and L - 1 absolute differences, the channels of each side by side; made
        smaller by a whole factor where the image is larger than `STACKED_SIDE_PX`.
    """
    import cv2

    height, width = frames.shape[1:3]
    factor = -(-max(height, width) // STACKED_SIDE_PX)
    size = max(1, round(width / factor)), max(1, round(height / factor))
    small = frames
    if factor > 1:
        resized = [cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames]
        small = np.stack(resized).reshape(len(frames), size[1], size[0], -1)  # of one channel it drops the axis
    differences = np.abs(np.diff(small.astype(np.int16), axis=0)).astype(np.uint8)
    planes = np.concatenate([small, differences])
    return np.ascontiguousarray(np.moveaxis(planes, 0, 2)).reshape(*planes.shape[1:3], -1)
