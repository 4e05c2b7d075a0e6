"""Which rows of the training sets make a batch, and which are held back for validation.

Everything here is a function of the seed and the step alone, so that a run that is killed goes on with the same rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ctlev_core.supervised.options import SupervisedOptions
from data_contracts.errors import DataError

# Random streams of one seed; a stream never depends on how often another was used. Stream 1 is augmentation.
_STREAM_ORDER, _STREAM_VALIDATION = 0, 2


@dataclass(frozen=True, eq=False)
class TrainingRows:
    """Rows to learn from and rows held back.

    Attributes:
        pools: one array of rows, or two where batches are mixed: of the first training set, and of the others.
        mixing: share of each batch that comes from the first of two pools.
        held_back: rows for validation, ascending; in no pool.
    """

    pools: tuple[np.ndarray, ...]
    mixing: float
    held_back: np.ndarray

    def batch(self, batch_size: int, seed: int, step: int) -> np.ndarray:
        """Rows [batch_size] of step `step`.

        Each pool is walked through in an endless row of permutations of its own. Where `mixing` times `batch_size` is
        no whole number, batches alternate between the two nearest; after any number of steps the first pool has given
        its share, rounded.
        """
        if len(self.pools) == 1:
            return self.pools[0][batch_rows(len(self.pools[0]), batch_size, seed, step)]
        start, stop = (round(number * batch_size * self.mixing) for number in (step, step + 1))
        spans = ((start, stop), (step * batch_size - start, (step + 1) * batch_size - stop))
        return np.concatenate(
            [
                pool[walk(len(pool), first, last - first, (seed, _STREAM_ORDER, part + 1))]
                for part, (pool, (first, last)) in enumerate(zip(self.pools, spans, strict=True))
            ]
        )


def batch_rows(count: int, batch_size: int, seed: int, step: int) -> np.ndarray:
    """Rows [batch_size] of step `step`: consecutive chunks of an endless row of permutations of the training set."""
    return walk(count, step * batch_size, batch_size, (seed, _STREAM_ORDER))


def plan_rows(
    count: int,
    options: SupervisedOptions,
    *,
    seed: int,
    parts: Sequence[int] = (),
    groups: Sequence[str] = (),
    classes: np.ndarray | None = None,
) -> TrainingRows:
    """Share out the rows of the training sets.

    Args:
        count: rows of all sets together.
        options: `mixing` and `validation_share`.
        seed: of the choice of rows to hold back.
        parts: rows of each set, in order; empty = one set.
        groups: [count] subject or recording of each row, which are held back whole; empty = each row is its own.
        classes: [count] int; rows are held back only while each class keeps others to learn from.
    Raises:
        ValueError: `parts` or `groups` do not fit `count`.
        DataError: one of several sets to mix has no rows, or no group can be held back.
    """
    parts = tuple(parts) or (count,)
    if sum(parts) != count or min(parts) < 0 or len(groups) not in (0, count):
        raise ValueError(f"parts and groups must cover {count} rows, got parts {parts} and {len(groups)} groups")
    rows = np.arange(count)
    held_back = rows[:0]
    if options.validation_share:
        # Sets without rows come before the first one with some, if any do: its rows are the first ones.
        size = next((size for size in parts if size), 0)
        own = np.asarray(groups[:size]) if len(groups) else rows[:size]
        held_back = _hold_back(own, options.validation_share, seed, classes)
    kept = np.ones(count, bool)
    kept[held_back] = False
    if options.mixing is None or len(parts) == 1:
        return TrainingRows((rows[kept],), 1.0, held_back)
    pools = tuple(part[kept[part]] for part in np.split(rows, [parts[0]]))
    if not all(len(pool) for pool in pools):
        raise DataError(f"mixing {options.mixing:g} needs rows in the first training set and in others, got {parts}")
    return TrainingRows(pools, options.mixing, held_back)


def _hold_back(groups: np.ndarray, share: float, seed: int, classes: np.ndarray | None) -> np.ndarray:
    """The rows of groups in a random order until they are the wanted share, but never more than half of all.

    `classes` [at least N] are those of all training sets; the N groups are the first rows of them.
    """
    count = len(groups)
    names, index = np.unique(groups, return_inverse=True)
    members = np.split(np.argsort(index, kind="stable"), np.cumsum(np.bincount(index))[:-1])
    left = np.zeros(0, np.int64) if classes is None else np.bincount(classes)
    held = np.zeros(count, bool)
    for group in np.random.default_rng([seed, _STREAM_VALIDATION]).permutation(len(names)):
        if held.sum() >= share * count:
            break
        rows = members[group]
        lost = 0 if classes is None else np.bincount(classes[rows], minlength=len(left))
        if 2 * (held.sum() + len(rows)) <= count and (left - lost > 0)[left > 0].all():
            held[rows] = True
            left = left - lost
    if not held.any():
        raise DataError(
            f"validation_share {share:g}: none of the {len(names)} subjects or recordings of {count} rows can be held "
            "back; each has more than half of the rows, or all rows of a class"
        )
    return np.flatnonzero(held)


def walk(count: int, first: int, number: int, entropy: tuple[int, ...]) -> np.ndarray:
    """Rows first .. first + number - 1 of an endless row of permutations of 0 .. count - 1."""
    rows = np.empty(number, dtype=np.int64)
    filled = 0
    while filled < number:
        epoch, offset = divmod(first + filled, count)
        chunk = _permutation(count, (*entropy, epoch))[offset : offset + number - filled]
        rows[filled : filled + len(chunk)] = chunk
        filled += len(chunk)
    return rows


@lru_cache(maxsize=4)
def _permutation(count: int, entropy: tuple[int, ...]) -> np.ndarray:
    """Kept between steps: of a million rows it would take as long as a small network's step."""
    order = np.random.default_rng(list(entropy)).permutation(count)
    order.flags.writeable = False
    return order
