"""Which labelled moments are sampled from: every class and every recording has its turn."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from ctlev_core.events.windows import spread
from data_contracts.errors import DataError
from data_contracts.parts import PREFIX, part_of


def surrounded(recordings: Sequence[str], t_us: np.ndarray, half_us: int) -> np.ndarray:
    """Which moments [N] bool lie `half_us` or more from both ends of their recording; all of one where none does.

    Args:
        recordings: of N moments; those of one recording lie together, in the order of their times.
        t_us: [N] int64.
        half_us: half of a window of events.
    """
    names = np.array(recordings)
    kept = np.zeros(len(names), np.bool_)
    starts = np.flatnonzero(np.concatenate([[True], names[1:] != names[:-1]]))
    for rows in np.split(np.arange(len(names)), starts[1:]):
        times = t_us[rows]
        inside = (times - times[0] >= half_us) & (times[-1] - times >= half_us)
        kept[rows] = inside if inside.any() else True
    return kept


def balanced_choice(class_names: Sequence[str], recordings: Sequence[str], count: int, seed: int) -> np.ndarray:
    """`count` row indices in which the classes take turns, and within a class its recordings.

    Every class has a random order of its own, every row comes before any comes twice. The datasets of a union take
    turns before that, so that each has an equal share.
    """
    parts = _rows_of_parts(recordings)
    if len(parts) > 1:
        shares = [count // len(parts) + (number < count % len(parts)) for number in range(len(parts))]
        chosen = [
            rows[
                balanced_choice([class_names[row] for row in map(int, rows)], _without_part(recordings, rows), n, seed)
            ]
            for rows, n in zip(parts, shares, strict=True)
        ]
        turns = np.concatenate([np.arange(len(rows)) for rows in chosen])
        return np.concatenate(chosen)[np.argsort(turns, kind="stable")]
    classes = sorted(set(class_names))
    names, groups = np.array(class_names), np.array(recordings)
    queues: list[np.ndarray] = []
    for number, name in enumerate(classes):
        rows = np.flatnonzero(names == name)
        rounds = -(-count // (len(classes) * len(rows)))
        random = np.random.default_rng([seed, number])
        queues.append(np.concatenate([_in_turns(random.permutation(rows), groups) for _ in range(rounds)]))
    return np.array([queues[i % len(classes)][i // len(classes)] for i in range(count)], dtype=np.int64)


def choose_stretches(
    recordings: Sequence[str], t_us: np.ndarray, count: int, length: int, interval_us: int
) -> np.ndarray:
    """`count` row indices: stretches of `length` moments that follow one another every `interval_us`.

    A recording has as many stretches as fit into it one behind another. Of all of them so many as are needed are taken,
    evenly spread, and all again where they are too few; the last may be shorter.

    Args:
        recordings: of N moments; those of one recording lie together, in the order of their times.
        t_us: [N] int64.
        count: of moments.
        length: moments of a stretch.
        interval_us: from one to the next, which is kept to within a tenth.
    Raises:
        DataError: no recording has such a stretch.
    """
    stretches, offset = [], 0
    for _, group in itertools.groupby(recordings):
        size = len(list(group))
        for run in _runs(t_us[offset : offset + size], interval_us):
            whole = len(run) // length * length
            stretches += [offset + run[start : start + length] for start in range(0, whole, length)]
        offset += size
    if not stretches:
        raise DataError(
            f"no recording has labels for a stretch of {length} frames, one every {interval_us} us as training frames: "
            "label longer or more often"
        )
    needed = -(-count // length)
    chosen = np.sort(np.resize(spread(len(stretches), needed), needed))
    return np.concatenate([stretches[number] for number in chosen])[:count]


def _runs(t_us: np.ndarray, interval_us: int) -> Iterator[np.ndarray]:
    """Positions of moments that follow one another every `interval_us`; after a gap another run begins."""
    run = [0]
    while run[-1] < len(t_us) - 1:
        wanted_us = t_us[run[-1]] + interval_us
        after = int(np.searchsorted(t_us, wanted_us))
        near = [position for position in (after - 1, after) if run[-1] < position < len(t_us)]
        nearest = min(near, key=lambda position: abs(t_us[position] - wanted_us), default=-1)
        if nearest >= 0 and abs(t_us[nearest] - wanted_us) <= interval_us / 10:
            run.append(nearest)
        else:
            yield np.array(run)
            run = [run[-1] + 1]
    yield np.array(run)


def spread_choice(groups: Sequence[str], recordings: Sequence[str], count: int, seed: int) -> np.ndarray:
    """`count` different row indices, ascending: groups take turns until they are used up, and in them recordings.

    The datasets of a union have equal shares, as far as each has so many rows.

    Args:
        groups: [N] of each row.
        recordings: [N] of each row.
        count: at most N.
        seed: of the order in each group, and of groups in the last turn.
    """
    parts = _rows_of_parts(recordings)
    if len(parts) > 1:
        shares = _equal_shares([len(rows) for rows in parts], count)
        chosen = [
            rows[spread_choice(_of_rows(groups, rows), _without_part(recordings, rows), n, seed)]
            for rows, n in zip(parts, shares, strict=True)
        ]
        return np.sort(np.concatenate(chosen))
    names, of_recording = np.array(groups), np.array(recordings)
    known = sorted(set(groups))
    order = np.random.default_rng([seed, len(known)]).permutation(len(known))
    turn, place = np.empty(len(names), np.int64), np.empty(len(names), np.int64)
    for number, name in enumerate(known):
        random = np.random.default_rng([seed, number])
        rows = _in_turns(random.permutation(np.flatnonzero(names == name)), of_recording)
        turn[rows], place[rows] = np.arange(len(rows)), order[number]
    return np.sort(np.lexsort((place, turn))[:count])


def _rows_of_parts(recordings: Sequence[str]) -> list[np.ndarray]:
    """The rows of each dataset of a union, in the order of names; all rows where there is one dataset."""
    names = np.array([part_of(recording) for recording in recordings])
    return [np.flatnonzero(names == name) for name in np.unique(names)]


def _without_part(recordings: Sequence[str], rows: np.ndarray) -> list[str]:
    return [name.removeprefix(f"{PREFIX}{part_of(name)}/") for name in _of_rows(recordings, rows)]


def _of_rows(names: Sequence[str], rows: np.ndarray) -> list[str]:
    return [names[row] for row in map(int, rows)]


def _equal_shares(sizes: Sequence[int], count: int) -> list[int]:
    """How many to take of each of several sets, as equal as their sizes allow, `count` in all."""
    shares, left = [0] * len(sizes), count
    order = sorted(range(len(sizes)), key=lambda number: sizes[number])
    for place, number in enumerate(order):
        shares[number] = min(sizes[number], left // (len(sizes) - place))
        left -= shares[number]
    return shares


def _in_turns(rows: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """The rows, reordered so that groups take turns: first one row of each, then a second one, and so on."""
    _, of_row = np.unique(groups[rows], return_inverse=True)
    turn = np.empty(len(rows), np.int64)
    for group in range(of_row.max() + 1):
        members = np.flatnonzero(of_row == group)
        turn[members] = np.arange(len(members))
    return rows[np.argsort(turn, kind="stable")]
