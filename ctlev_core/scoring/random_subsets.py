"""The mean of a score over random subsets of two large sets, where all pairs of rows would take too long."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def mean_over_subsets(
    compute: Callable[[np.ndarray, np.ndarray], float],
    a: np.ndarray,
    b: np.ndarray,
    *,
    subset_size: int,
    num_subsets: int,
    seed: int,
) -> float:
    """An unbiased score of pairs of rows: of all rows at once, or its mean over subsets, which has the same
    expectation.

    Args:
        compute: the score of two sets, whose time grows with the number of pairs.
        a: [N, D].
        b: [M, D].
        subset_size: rows of each subset, drawn without replacement; 0, or where the subsets have as many pairs as the
            sets, all rows at once.
        num_subsets: how many subsets the mean is taken over.
        seed: of the drawing.
    Raises:
        ValueError: a subset of 1 row, or no subset.
    """
    if subset_size != 0 and (subset_size < 2 or num_subsets < 1):
        raise ValueError(f"a mean needs subsets of at least 2 rows, got {num_subsets} of {subset_size}")
    pairs = len(a) ** 2 + len(b) ** 2 + len(a) * len(b)
    if subset_size == 0 or pairs <= 3 * num_subsets * subset_size**2:
        return compute(a, b)
    generator = np.random.default_rng(seed)
    values = []
    for _ in range(num_subsets):
        first, second = (rows[generator.permutation(len(rows))[:subset_size]] for rows in (a, b))
        values.append(compute(first, second))
    return float(np.mean(values))
