"""Pixel values, event counts or grey levels, as classes: every small one its own, large ones together.

A network that gives a probability for every class can say what a mean cannot: that a pixel has one event or none, but
not half of one. Values below `NUM_SINGLE` are classes of their own; beyond, each class is a quarter wider than the one
before, and the values within it are drawn as training frames have them.

Noise is added to the square root of the value, scaled to a standard deviation of 1 over all training pixels: the spread
of a count of independent events is the square root of its mean, so that all counts are equally hard to tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_contracts.errors import DataError
from data_contracts.image_rows import Images, image_chunks

NUM_SINGLE = 16
_GROWTH = 1.25


@dataclass(frozen=True, eq=False)
class ValueClasses:
    """Classes of values.

    Attributes:
        starts: [K] int64 smallest value of each class; the first is 0.
        values: [V] int64 values that training frames have, ascending.
        shares: [V] float64 how often, of all pixels.
        mean: of the square roots of the values of all training pixels.
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
        # A class that no training pixel is in stands for its smallest value.
        roots = np.where(weights > 0, means, np.sqrt(self.starts))
        return ((roots - self.mean) / self.deviation).astype(np.float32)

    @property
    def active_step(self) -> float:
        """From 0 to the median of the other values, in the same space: the scale of the noise that hides pixels."""
        active = self.values > 0
        cumulated = np.cumsum(self.shares[active])
        median = self.values[active][np.searchsorted(cumulated, cumulated[-1] / 2)]
        return float(np.sqrt(median)) / self.deviation

    def classes_of(self, values: np.ndarray) -> np.ndarray:
        """Class of each value, int64, of the same shape."""
        return np.searchsorted(self.starts, values, side="right") - 1

    def draw(self, classes: np.ndarray, uniform: np.ndarray) -> np.ndarray:
        """A value of each class: its own, or for one of several values as training pixels of the class have it.

        Args:
            classes: [...] int64.
            uniform: [...] in [0, 1), one for each.
        Returns:
            [...] uint16.
        """
        drawn = self.starts[classes]
        several = np.flatnonzero((classes >= NUM_SINGLE).ravel())
        if len(several):
            members = self.classes_of(self.values)
            before = np.concatenate([[0.0], np.cumsum(self.shares)])
            first, last = (np.searchsorted(members, classes.ravel()[several], side=side) for side in ("left", "right"))
            places = before[first] + uniform.ravel()[several] * (before[last] - before[first])
            found = np.clip(np.searchsorted(before, places, side="right") - 1, first, np.maximum(last - 1, first))
            known = last > first
            drawn.reshape(-1)[several[known]] = self.values[found[known]]
        return drawn.astype(np.uint16)


def fit_classes(training_values: Images) -> ValueClasses:
    """The classes of training frames.

    Args:
        training_values: [N, ...] uint8 or uint16, read in parts where they are on disk.
    Raises:
        DataError: all pixels have the same value, as where there is no event.
    """
    found = np.zeros(1 << 16, np.int64)
    for part in image_chunks(training_values):
        found += np.bincount(part.ravel(), minlength=len(found))
    values = np.flatnonzero(found)
    frequencies = found[values]
    if len(values) < 2:
        raise DataError(
            "a pixel decoder needs training frames with events in some pixels and fewer in others; all pixels have the "
            f"value {values.tolist()[0] if len(values) else 'of none'}"
        )
    starts = list(range(NUM_SINGLE + 1))
    width = 1.0
    while starts[-1] + width <= values[-1]:
        width *= _GROWTH
        starts.append(starts[-1] + int(np.ceil(width)))
    used = np.array(starts[: max(int(np.searchsorted(starts, values[-1], side="right")), 2)], np.int64)
    shares = frequencies / frequencies.sum()
    roots = np.sqrt(values)
    mean = float(shares @ roots)
    return ValueClasses(used, values, shares, mean, float(np.sqrt(shares @ (roots - mean) ** 2)))
