"""Consecutive frames of recordings, for downstream models that look at more than one.

Frames of a recording follow one another in time in every table, so a sequence is a stretch of rows. The frames need not
be equally far apart: where windows were left out, the next one that was kept follows.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_contracts.errors import DataError
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
        within = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        return np.repeat(rows - lengths + 1, lengths) + within, lengths


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


def stretch_lengths(names: Sequence[object]) -> list[int]:
    """How many consecutive rows have the same name, from the first row on; together they are all rows."""
    return [len(list(rows)) for _, rows in itertools.groupby(names)]


def frame_interval_us(manifest: Manifest, rows: np.ndarray) -> int:
    """Time from one frame to the next of its recording, the median over the given rows.

    Raises:
        DataError: no recording has two frames.
    """
    gaps = _gaps_us(manifest, rows)
    if not len(gaps) or not (gaps > 0).any():
        raise DataError(f"{manifest.ref.path}: no two frames follow one another in a recording")
    return int(np.median(gaps[gaps > 0]))


def name_stretches(manifest: Manifest, rows: np.ndarray, interval_us: int) -> tuple[str, ...]:
    """Names of the stretches of frames that follow one another every `interval_us`, of each row.

    A stretch ends with its recording, and where the next frame neither begins where this one ends nor ends one interval
    later, give or take a quarter: there a window was left out, or labels jump. Of synthetic frames, which have no
    window, the label's moment counts.
    """
    if "t_end_us" not in manifest.table.column_names:
        steps = _source_steps(manifest, rows)
        follows = (steps == 1) | (np.abs(steps - interval_us) <= interval_us / 4)
        return tuple(map(str, np.cumsum(np.concatenate([[0], ~follows])))) if len(rows) else ()
    starts, ends = (manifest.table[name].to_numpy()[rows] for name in ("t_start_us", "t_end_us"))
    gaps_us, between_us = _gaps_us(manifest, rows), starts[1:] - ends[:-1]
    tolerance_us = interval_us / 4
    touches = (gaps_us > 0) & (between_us >= 0) & (between_us <= tolerance_us)
    follows = touches | (np.abs(gaps_us - interval_us) <= tolerance_us)
    numbers = np.cumsum(np.concatenate([[0], ~follows])) if len(rows) else []
    return tuple(map(str, numbers))


def _source_steps(manifest: Manifest, rows: np.ndarray) -> np.ndarray:
    """From each row's label to the next [N - 1]: us, or 1 for the next frame; 0 between recordings."""
    sources = manifest.column("source_id")
    named = [sources[row].rpartition(":") for row in rows]
    places = np.array([(int(place) if place.isdecimal() else 0) for _, _, place in named])
    names = np.array([name for name, _, _ in named])
    return np.where((names[1:] == names[:-1]) & (names[1:] != ""), np.diff(places), 0)


def _gaps_us(manifest: Manifest, rows: np.ndarray) -> np.ndarray:
    """From the end of each row's window to that of the next row [N - 1]; 0 between recordings."""
    names = np.array(name_recordings(manifest, rows))
    return np.where(names[1:] == names[:-1], np.diff(manifest.table["t_end_us"].to_numpy()[rows]), 0)


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
