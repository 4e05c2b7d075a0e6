"""Which labelled moments are sampled from: every class and every recording has its turn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


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

    Every class has a random order of its own, every row comes before any comes twice.
    """
    classes = sorted(set(class_names))
    names, groups = np.array(class_names), np.array(recordings)
    queues: list[np.ndarray] = []
    for number, name in enumerate(classes):
        rows = np.flatnonzero(names == name)
        rounds = -(-count // (len(classes) * len(rows)))
        random = np.random.default_rng([seed, number])
        queues.append(np.concatenate([_in_turns(random.permutation(rows), groups) for _ in range(rounds)]))
    return np.array([queues[i % len(classes)][i // len(classes)] for i in range(count)], dtype=np.int64)


def spread_choice(groups: Sequence[str], recordings: Sequence[str], count: int, seed: int) -> np.ndarray:
    """`count` different row indices, ascending: groups take turns until they are used up, and in them recordings.

    Args:
        groups: [N] of each row.
        recordings: [N] of each row.
        count: at most N.
        seed: of the order in each group, and of groups in the last turn.
    """
    names, of_recording = np.array(groups), np.array(recordings)
    known = sorted(set(groups))
    order = np.random.default_rng([seed, len(known)]).permutation(len(known))
    turn, place = np.empty(len(names), np.int64), np.empty(len(names), np.int64)
    for number, name in enumerate(known):
        random = np.random.default_rng([seed, number])
        rows = _in_turns(random.permutation(np.flatnonzero(names == name)), of_recording)
        turn[rows], place[rows] = np.arange(len(rows)), order[number]
    return np.sort(np.lexsort((place, turn))[:count])


def _in_turns(rows: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """The rows, reordered so that groups take turns: first one row of each, then a second one, and so on."""
    _, of_row = np.unique(groups[rows], return_inverse=True)
    turn = np.empty(len(rows), np.int64)
    for group in range(of_row.max() + 1):
        members = np.flatnonzero(of_row == group)
        turn[members] = np.arange(len(members))
    return rows[np.argsort(turn, kind="stable")]
