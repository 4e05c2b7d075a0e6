"""Precision, recall, density and coverage of a set of features against a reference: do they lie among one another?

Each row has a ball that reaches to its k-th nearest neighbour in its own set. Precision: share of the rows judged that
lie in the ball of some reference row; recall: the reverse; density: in how many reference balls a row lies, over k;
coverage: share of the reference balls with a row inside.

Source: Kynkaanniemi et al., NeurIPS 2019 (precision, recall); Naeem et al., ICML 2020 (density, coverage, and the
package prdc). As in the papers' formulas the border belongs to the ball; prdc's code leaves it out, which only shows
where rows repeat: there a set would not lie within itself.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ctlev_core.scoring.gaussians import check_features, check_same_width, scale_of

_BLOCK_NUMBERS = 4_000_000
_GROUP = 32
"""Values of which the least is found first where the nearest few of many rows are looked for."""
_ROUNDING = 1e-12
"""Of squared distances, relative to the squared norms they are the difference of."""


def compute_prdc(judged: np.ndarray, reference: np.ndarray, num_neighbours: int = 5) -> dict[str, float]:
    """`precision`, `recall`, `density` and `coverage`; all but density lie in [0, 1].

    Args:
        judged: [N, D], N > num_neighbours.
        reference: [M, D], M > num_neighbours.
        num_neighbours: k; the papers take 3 and 5.
    Raises:
        ValueError: shapes do not fit, a set is too small, or a value is not finite (names the row).
    """
    judged, reference = check_features(judged, "first"), check_features(reference, "second")
    check_same_width(judged, reference)
    if num_neighbours < 1 or min(len(judged), len(reference)) <= num_neighbours:
        raise ValueError(
            f"{num_neighbours} neighbours need 1 or more and sets of more rows, got {len(judged)} and {len(reference)}"
        )
    origin = reference[0].astype(np.float64)
    judged, reference = judged - origin, reference - origin
    # Who is near whom does not change with the scale.
    scale = scale_of(judged, reference)
    judged, reference = judged / scale, reference / scale
    judged_radii, reference_radii = (_squared_radii(rows, num_neighbours) for rows in (judged, reference))
    is_precise, count = np.zeros(len(judged), bool), 0
    recalled, covered = [], []
    for squared, start in _squared_distances(reference, judged, at_least=True):
        inside = squared <= reference_radii[start : start + len(squared), None]
        is_precise |= inside.any(axis=0)
        each = np.count_nonzero(inside, axis=1)
        count += int(each.sum())
        covered.append(each > 0)
        recalled.append((squared <= judged_radii).any(axis=1))
    return {
        "precision": float(is_precise.mean()),
        "recall": float(np.concatenate(recalled).mean()),
        "density": count / (num_neighbours * len(judged)),
        "coverage": float(np.concatenate(covered).mean()),
    }


def _squared_distances(a: np.ndarray, b: np.ndarray, *, at_least: bool = False) -> Iterator[tuple[np.ndarray, int]]:
    """Blocks of squared distances [n, M], overwritten by the next one, and where in `a` each block starts.

    With `at_least` they are as much smaller as rounding may have made them larger.
    """
    kept = 1 - _ROUNDING if at_least else 1.0
    norms_a, norms_b = (kept * np.einsum("nd,nd->n", rows, rows) for rows in (a, b))
    step = min(len(a), max(1, _BLOCK_NUMBERS // len(b)))
    memory, across = np.empty((step, len(b))), -2 * b.T
    for start in range(0, len(a), step):
        rows = a[start : start + step]
        squared = np.matmul(rows, across, out=memory[: len(rows)])
        squared += norms_b
        squared += norms_a[start : start + step, None]
        yield squared, start


def _squared_radii(rows: np.ndarray, num_neighbours: int) -> np.ndarray:
    """Squared distance [N] of each row to its k-th nearest other row."""
    radii = []
    for squared, start in _squared_distances(rows, rows):
        own = np.arange(len(squared))
        squared[own, start + own] = 0.0
        radii.append(np.partition(_near_ones(squared, num_neighbours + 1), num_neighbours, axis=1)[:, num_neighbours])
    return np.concatenate(radii)


def _near_ones(values: np.ndarray, count: int) -> np.ndarray:
    """Of each row [N] some of its values, among them its `count` smallest ones.

    They lie in the `count` groups of the smallest minima, for each of those has a value that is as small.
    """
    num_groups = values.shape[1] // _GROUP
    if num_groups < 2 * count:
        return values
    grouped = values[:, : num_groups * _GROUP].reshape(len(values), num_groups, _GROUP)
    chosen = np.argpartition(grouped.min(axis=2), count, axis=1)[:, :count]
    near = grouped[np.arange(len(values))[:, None], chosen].reshape(len(values), -1)
    return np.concatenate([near, values[:, num_groups * _GROUP :]], axis=1)
