"""Event counts as classes: every small count one of its own, large ones together.

A network that gives a probability for every class can say what a mean cannot: that a pixel has one event or none, but
not half of one. Counts below `NUM_SINGLE` are classes of their own; beyond, each class is a quarter wider than the one
before, and the counts within it are drawn as training frames have them.

Noise is added to the square root of the count, scaled to a standard deviation of 1 over all training pixels: the
spread of a count of independent events is the square root of its mean, so that all counts are equally hard to tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_contracts.errors import DataError
from data_contracts.image_rows import Images, image_chunks

NUM_SINGLE = 16
_GROWTH = 1.25


@dataclass(frozen=True, eq=False)
class CountClasses:
    """Classes of counts.

    Attributes:
        starts: [K] int64 smallest count of each class; the first is 0.
        values: [V] int64 counts that training frames have, ascending.
        shares: [V] float64 how often, of all pixels.
        mean: of the square roots of the counts of all training pixels.
        deviation: their standard deviation.
    """

    starts: np.ndarray
    values: np.ndarray
    shares: np.ndarray
    mean: float
    deviation: float

    def __len__(self) -> int:
        return len(self.starts)

    @property
    def embeddings(self) -> np.ndarray:
        """[K] float32: what each class is in the space that noise is added in."""
        members = self.classes_of(self.values)
        weights = np.bincount(members, self.shares, len(self))
        means = np.bincount(members, self.shares * np.sqrt(self.values), len(self)) / np.maximum(weights, 1e-300)
        # A class that no training pixel is in stands for its smallest count.
        roots = np.where(weights > 0, means, np.sqrt(self.starts))
        return ((roots - self.mean) / self.deviation).astype(np.float32)

    @property
    def event_step(self) -> float:
        """From no event to one, in the same space: the scale of the noise that hides single events."""
        return 1.0 / self.deviation

    def classes_of(self, counts: np.ndarray) -> np.ndarray:
        """Class of each count, int64, of the same shape."""
        return np.searchsorted(self.starts, counts, side="right") - 1

    def draw(self, classes: np.ndarray, uniform: np.ndarray) -> np.ndarray:
        """A count of each class: its own, or for one of several counts as training pixels of the class have it.

        Args:
            classes: [...] int64.
            uniform: [...] in [0, 1), one for each.
        Returns:
            [...] uint16.
        """
        counts = self.starts[classes]
        several = np.flatnonzero((classes >= NUM_SINGLE).ravel())
        if len(several):
            members = self.classes_of(self.values)
            before = np.concatenate([[0.0], np.cumsum(self.shares)])
            first, last = (np.searchsorted(members, classes.ravel()[several], side=side) for side in ("left", "right"))
            places = before[first] + uniform.ravel()[several] * (before[last] - before[first])
            found = np.clip(np.searchsorted(before, places, side="right") - 1, first, np.maximum(last - 1, first))
            known = last > first
            counts.reshape(-1)[several[known]] = self.values[found[known]]
        return counts.astype(np.uint16)


def fit_classes(counts: Images) -> CountClasses:
    """The classes of training frames.

    Args:
        counts: [N, ...] uint16, read in parts where they are on disk.
    Raises:
        DataError: there is no event, or all pixels have equally many.
    """
    found = np.zeros(1 << 16, np.int64)
    for part in image_chunks(counts):
        found += np.bincount(part.ravel(), minlength=len(found))
    values = np.flatnonzero(found)
    frequencies = found[values]
    if len(values) < 2:
        raise DataError(
            f"a count decoder needs training frames with events in some pixels and fewer in others, and all have "
            f"{values.tolist()[:1] or 'no pixels'}"
        )
    starts = list(range(NUM_SINGLE))
    width = 1.0
    while starts[-1] + width <= values[-1]:
        width *= _GROWTH
        starts.append(starts[-1] + int(np.ceil(width)))
    used = np.array(starts[: max(int(np.searchsorted(starts, values[-1], side="right")), 2)], np.int64)
    shares = frequencies / frequencies.sum()
    roots = np.sqrt(values)
    mean = float(shares @ roots)
    return CountClasses(used, values, shares, mean, float(np.sqrt(shares @ (roots - mean) ** 2)))
