"""A seed for each row, so that no row depends on which others are made with it."""

from __future__ import annotations

import numpy as np


def sample_seeds(seed: int, count: int) -> list[int]:
    """Seeds of rows 0 .. count - 1, the same for every `count`."""
    return [int(np.random.SeedSequence([seed, row]).generate_state(1)[0]) for row in range(count)]
