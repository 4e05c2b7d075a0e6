"""Consecutive frames of recordings, for downstream models that look at more than one.

Frames of a recording follow one another in time in every table, so a sequence is a stretch of rows. The frames need not
be equally far apart: where windows were left out, the next one that was kept follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_contracts.manifest import Manifest


@dataclass(frozen=True, eq=False)
class FrameSequences:
    """For each row the stretch of up to `length` rows of its recording that ends with it.

    Attributes:
        starts: [N] first row of the recording of each row.
        length: rows of a full sequence; the first rows of a recording have shorter ones.
    """

    starts: np.ndarray
    length: int

    def ending_at(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The sequences of some rows.

        Args:
            rows: [S] last rows, in any order.
        Returns:
            Rows [M] of the sequences, one sequence after the other, and the lengths [S] of the sequences.
        """
        lengths = np.minimum(rows - self.starts[rows] + 1, self.length)
        return np.repeat(rows - lengths + 1, lengths) + ages_in(lengths), lengths


def ages_in(lengths: np.ndarray) -> np.ndarray:
    """How many frames of its sequence are before each, [M], of sequences of the lengths [S], one after the other."""
    return np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def find_sequences(count: int, length: int, *names: Sequence[object]) -> FrameSequences:
    """Sequences of rows that lie beside one another and agree in every name.

    Args:
        count: N, rows in all.
        length: rows of a full sequence.
        names: [N] each, for example recordings and subjects; an empty one counts as N different names.
    Raises:
        ValueError: a list of names is of another length.
    """
    rows = np.arange(count)
    begins = rows == 0
    for each in names:
        if len(each) not in (0, count):
            raise ValueError(f"expected names of {count} rows, got {len(each)}")
        own = np.asarray(each) if len(each) else rows
        begins[1:] |= own[1:] != own[:-1]
    return FrameSequences(np.maximum.accumulate(np.where(begins, rows, 0)), length)


def find_training_sequences(
    count: int, length: int, *, recordings: Sequence[str], groups: Sequence[str], parts: Sequence[int]
) -> FrameSequences:
    """Sequences that cross from no recording, group or training set to the next.

    Args:
        count: N, rows in all.
        length: rows of a full sequence.
        recordings: N names; empty = each row is a recording of its own.
        groups: N names of what is held back whole; empty = the recordings.
        parts: rows of each training set, in order; empty = one set.
    Raises:
        ValueError: one of them does not fit the number of rows.
    """
    sets = [number for number, size in enumerate(parts) for _ in range(size)]
    return find_sequences(count, length, recordings, *[names for names in (groups, sets) if names])


def name_recordings(manifest: Manifest, rows: np.ndarray) -> list[str]:
    """Whose consecutive rows of a manifest are consecutive in time, [N].

    Recorded frames are named by their recording. Synthetic ones are made one by one, but of labels that may follow one
    another in time (`temporal_order: true`): those are named by the recording of the labels, the others each by itself.
    """
    if "source_id" not in manifest.table.column_names:
        names = manifest.column("recording_id")
        return [names[row] for row in rows]
    sources = manifest.column("source_id")
    named, before, number = [], ("", -1), 0
    for row in rows:
        name, _, time = sources[row].rpartition(":")
        moment = (name, int(time)) if name and time.isdecimal() else ("", -1)
        if moment[0] != before[0] or not 0 <= before[1] < moment[1]:
            number += 1
        named.append(f"{name}/{number}")
        before = moment
    return named
