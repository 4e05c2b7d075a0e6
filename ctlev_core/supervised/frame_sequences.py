"""Consecutive frames of recordings, for downstream models that look at more than one.

Frames of a recording follow one another in time in every table, so a sequence is a stretch of rows. The frames need not
be equally far apart: where windows were left out, the next one that was kept follows.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from data_contracts.errors import DataError
from data_contracts.manifest import Manifest

_WINDOW = {"t_start_us", "t_end_us"}
"""Columns of recorded frames, and of conditions."""


@dataclass(frozen=True, eq=False)
class FrameSequences:
    """For each row the stretch of up to `length` rows of its recording that ends with it.

    Attributes:
        starts: [N] first row of the recording of each row.
        length: rows of a full sequence; the first rows of a recording have shorter ones.
    """

    starts: np.ndarray
    length: int

    def ending_at(self, rows: np.ndarray, *, single: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """The sequences of some rows.

        Args:
            rows: [S] last rows, in any order.
            single: each row is a sequence by itself.
        Returns:
            Rows [M] of the sequences, one sequence after the other, and the lengths [S] of the sequences.
        """
        lengths = np.minimum(rows - self.starts[rows] + 1, 1 if single else self.length)
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


def stretch_lengths(names: Sequence[object]) -> list[int]:
    """How many consecutive rows have the same name, from the first row on; together they are all rows."""
    return [len(list(rows)) for _, rows in itertools.groupby(names)]


def frame_interval_us(table: pa.Table, rows: np.ndarray, where: object) -> int:
    """Time from one frame to the next of its recording, the lower median over rows of a table of frames.

    Synthetic frames have no windows: of them it is the time between labels, or 1 where labels are those of frames.

    Raises:
        DataError: no recording has two frames; `where` says of what.
    """
    steps = _steps(table, rows)
    if not (steps > 0).any():
        raise DataError(f"{where}: no two frames follow one another in a recording")
    return int(np.quantile(steps[steps > 0], 0.5, method="lower"))


def training_interval_us(frames: Manifest) -> int:
    """`frame_interval_us` of training frames."""
    return frame_interval_us(frames.table, frames.rows_where(split="train"), frames.ref.path)


def name_stretches(table: pa.Table, rows: np.ndarray, interval_us: int) -> tuple[str, ...]:
    """Names of the stretches of frames that follow one another every `interval_us`, of each row of a table of frames.

    A stretch ends with its recording, and where the next frame neither begins where this one ends nor ends one interval
    later, give or take a quarter: there a window was left out, or labels jump. Of synthetic frames, which have no
    window, the label's moment counts.
    """
    if not len(rows):
        return ()
    steps, tolerance_us = _steps(table, rows), interval_us / 4
    follows = np.abs(steps - interval_us) <= tolerance_us
    if set(table.column_names) >= _WINDOW:
        starts, ends = (table[name].to_numpy()[rows] for name in ("t_start_us", "t_end_us"))
        between_us = starts[1:] - ends[:-1]
        follows |= (steps > 0) & (between_us >= 0) & (between_us <= tolerance_us)
    else:
        follows |= steps == 1
    return tuple(map(str, np.cumsum(np.concatenate([[0], ~follows]))))


def name_followed(table: pa.Table, interval_us: int, where: object) -> tuple[str, ...]:
    """`name_stretches` of all rows, of which some must follow one another.

    Raises:
        DataError: none does; `where` says of what.
    """
    names = name_stretches(table, np.arange(table.num_rows), interval_us)
    if len(names) == len(set(names)) > 1:
        raise DataError(
            f"{where}: none of {len(names)} labels to sample from follows another by {interval_us} us, as training "
            "frames do: set stretch_length, or take labels of that rate"
        )
    return names


def _steps(table: pa.Table, rows: np.ndarray) -> np.ndarray:
    """From each row to the next [N - 1], 0 between recordings: us, or, of labels of frames, how many frames."""
    if set(table.column_names) >= _WINDOW:
        names, moments = np.array(_recordings(table, rows)), table["t_end_us"].to_numpy()[rows]
    else:
        sources = table["source_id"].to_pylist()
        named = [sources[row].rpartition(":") for row in rows]
        names = np.array([name or f"row {row}" for row, (name, *_) in enumerate(named)])
        moments = np.array([int(moment) if moment.isdecimal() else 0 for *_, moment in named])
    return np.where(names[1:] == names[:-1], np.diff(moments), 0)


def name_recordings(manifest: Manifest, rows: np.ndarray) -> list[str]:
    """Whose consecutive rows of a manifest are consecutive in time, [N].

    Recorded frames are named by their recording. Synthetic ones are made one by one, but of labels that may follow one
    another in time (`temporal_order: true`): those are named by the recording of the labels, the others each by itself.
    """
    return _recordings(manifest.table, rows)


def _recordings(table: pa.Table, rows: np.ndarray) -> list[str]:
    if "source_id" not in table.column_names:
        names = table["recording_id"].to_pylist()
        return [names[row] for row in rows]
    sources = table["source_id"].to_pylist()
    named, before, number = [], ("", -1), 0
    for row in rows:
        name, _, time = sources[row].rpartition(":")
        moment = (name, int(time)) if name and time.isdecimal() else ("", -1)
        if moment[0] != before[0] or not 0 <= before[1] < moment[1]:
            number += 1
        named.append(f"{name}/{number}")
        before = moment
    return named
