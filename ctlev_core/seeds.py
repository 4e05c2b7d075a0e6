"""A seed for each row, so that no row depends on which others are made with it."""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Sequence

import numpy as np


def check_seed(seed: int, where: str) -> int:
    """The seed; raises `ValueError` where it is no whole number of 0 or more."""
    try:
        whole = -1 if isinstance(seed, bool) else operator.index(seed)
    except TypeError:
        whole = -1
    if whole < 0:
        raise ValueError(f"{where}: seed must be a whole number of 0 or more, got {seed!r}")
    return whole


def sample_seeds(seed: int, count: int) -> list[int]:
    """Seeds of rows 0 .. count - 1, the same for every `count`."""
    return [int(np.random.SeedSequence([seed, row]).generate_state(1)[0]) for row in range(count)]


def distinct_seeds(seeds: Sequence[int]) -> list[int]:
    """The same seeds, but of those that are equal only the first: the k-th gets one that follows from it and from k.

    Frames of one motion share the noise they are sampled from; a sensor's noise is another in every frame.
    """
    seen: Counter[int] = Counter()
    found = []
    for seed in seeds:
        number, seen[seed] = seen[seed], seen[seed] + 1
        found.append(seed if number == 0 else int(np.random.SeedSequence([seed, number]).generate_state(1)[0]))
    return found
