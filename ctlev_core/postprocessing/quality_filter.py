"""Refuse generated images that cannot be event images: empty, saturated, or of other colours.

What is rejected follows from recorded training frames: for each number below the range of their central 98 %, its odds
widened on either side by a factor, so that a recorded frame practically always passes and only gross failures are
rejected. A filter that is any narrower would choose which images are liked, and make scores of the generator better
than it is.

    active_share    pixels whose largest channel is at least 26 of 255
    brightness      mean of the largest channel, over 255
    bright_share    active pixels at 250 or more, over active pixels
    off_palette     with polarity: sum of green, over the sum of the largest channel; without: sum of the difference of
                    largest and smallest channel, over the sum of the largest. Recorded frames have 0; what a decoder
                    adds is let pass up to `MAX_OFF_PALETTE`

A rejected row is sampled again with a seed that follows from its own (`seed_of_attempt`), so that every row can still
be made again alone, whatever happened to the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from data_contracts.errors import DataError

WIDENING = 4.0
"""Ranges reach from a quarter of the odds p / (1 - p) at the 1 % quantile to four times those at the 99 % quantile."""
MAX_OFF_PALETTE = 0.25
_ACTIVE_VALUE, _BRIGHT_VALUE = 26, 250
_CAUSES = {
    "active_share": ("empty", "too many active pixels"),
    "brightness": ("too dark", "too bright"),
    "bright_share": ("", "saturated"),
    "off_palette": ("", "not the colours of event images"),
}


@dataclass(frozen=True)
class QualityFilter:
    """The range that each number of an image must lie in, both ends included."""

    polarity: bool
    ranges: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class FilteredImages:
    """Images that passed, or did not in the tries they had.

    Attributes:
        frames: [N, H, W, 3] uint8, the last try of each row.
        seeds: the seed each was made from.
        num_attempts: how often each was sampled.
        causes: why the last attempt was rejected; empty for those that passed.
    """

    frames: np.ndarray
    seeds: list[int]
    num_attempts: list[int]
    causes: list[str]


def fit_quality_filter(frames: np.ndarray, *, polarity: bool) -> QualityFilter:
    """The ranges of recorded training frames.

    Args:
        frames: [N, H, W, 3] uint8, N >= 1.
        polarity: red and blue images; otherwise grey ones.
    Raises:
        ValueError: another shape or dtype.
        DataError: no frame, or all are black.
    """
    numbers = measure_images(frames, polarity=polarity)
    if not len(frames) or not numbers["active_share"].any():
        raise DataError(f"a quality filter needs recorded frames that are not black, got {len(frames)} frames")
    ranges = {}
    for name, values in numbers.items():
        low, high = np.quantile(values, [0.01, 0.99])
        ranges[name] = (_scale_odds(float(low), 1 / WIDENING), _scale_odds(float(high), WIDENING))
    ranges["off_palette"] = (0.0, max(MAX_OFF_PALETTE, ranges["off_palette"][1]))
    # Too few bright pixels are no failure while the image as a whole is bright enough.
    ranges["bright_share"] = (0.0, ranges["bright_share"][1])
    return QualityFilter(polarity, ranges)


def measure_images(frames: np.ndarray, *, polarity: bool) -> dict[str, np.ndarray]:
    """The numbers [N] float64 of each image; see the head of this file. Those of a black image are 0."""
    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8:
        raise ValueError(f"frames must be [N, H, W, 3] uint8, got {frames.shape} {frames.dtype}")
    names = ("active_share", "brightness", "bright_share", "off_palette")
    found = {name: np.zeros(len(frames)) for name in names}
    for row, frame in enumerate(np.asarray(frames)):
        largest = frame.max(axis=2)
        total, num_active = int(largest.sum(dtype=np.int64)), np.count_nonzero(largest >= _ACTIVE_VALUE)
        if total == 0:
            continue
        off = frame[..., 1] if polarity else largest - frame.min(axis=2)
        found["active_share"][row] = num_active / largest.size
        found["brightness"][row] = total / largest.size / 255
        found["bright_share"][row] = np.count_nonzero(largest >= _BRIGHT_VALUE) / max(num_active, 1)
        found["off_palette"][row] = off.sum(dtype=np.int64) / total
    return found


def _scale_odds(share: float, factor: float) -> float:
    return share * factor / (1 - share + share * factor)


def find_causes(frames: np.ndarray, quality_filter: QualityFilter) -> list[str]:
    """Why each image [N, H, W, 3] uint8 is rejected: the first number that is out of its range; empty = it passes."""
    numbers = measure_images(frames, polarity=quality_filter.polarity)
    causes = [""] * len(frames)
    for row in range(len(frames)):
        for name, (low, high) in quality_filter.ranges.items():
            value = numbers[name][row]
            if not low <= value <= high:
                cause = _CAUSES[name][int(value > high)]
                causes[row] = f"{cause}: {name} {value:.4g}, expected {low:.4g} to {high:.4g}"
                break
    return causes


def seed_of_attempt(seed: int, number: int) -> int:
    """The seed of a row's first try (0) is its own; those of later ones follow from it. 32 bits."""
    return seed if number == 0 else int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def sample_until_accepted(
    sample: Callable[[np.ndarray, Sequence[int]], np.ndarray],
    seeds: Sequence[int],
    quality_filter: QualityFilter,
    *,
    max_attempts: int,
) -> FilteredImages:
    """Sample every row, and again those that the quality filter rejects.

    Args:
        sample: frames [n, H, W, 3] uint8 of the rows with these numbers [n] and these n seeds; a frame depends on its
            row and seed alone.
        seeds: of each row, N >= 1.
        quality_filter: from `fit_quality_filter`.
        max_attempts: of a row, at least 1; then its last frame is kept, with the cause.
    Raises:
        ValueError: no row, or no try is allowed.
    """
    if max_attempts < 1 or not len(seeds):
        raise ValueError(f"expected rows and at least one try, got {len(seeds)} rows and {max_attempts} tries")
    used = list(seeds)
    num_attempts, causes = [0] * len(used), [""] * len(used)
    frames: np.ndarray | None = None
    rows = list(range(len(used)))
    for number in range(max_attempts):
        for row in rows:
            used[row], num_attempts[row] = seed_of_attempt(seeds[row], number), number + 1
        made = sample(np.array(rows), [used[row] for row in rows])
        if frames is None:
            frames = np.array(made)
        else:
            frames[rows] = made
        for row, cause in zip(rows, find_causes(made, quality_filter), strict=True):
            causes[row] = cause
        rows = [row for row in rows if causes[row]]
        if not rows:
            break
    return FilteredImages(np.asarray(frames), used, num_attempts, causes)
