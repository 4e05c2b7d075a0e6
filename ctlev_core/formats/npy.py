"""A NumPy array of events: structured with fields t, x, y, p in any order, or [N, 4] with columns x, y, t, p.

Fields may have any name of `event_tables.COLUMN_NAMES` and any numeric type, of either byte order. Polarity is {0, 1},
{-1, 1} or bool. Times: integers are microseconds, and so are floats none of which has a fraction, because one type for
all four columns turns microseconds into such floats; other floats are seconds. Nothing states the sensor size: it is
the smallest common one that holds all events. Arrays of Python objects are refused, and nothing is ever unpickled.

Source: the column order x, y, t, p of [N, 4] is that of rpg_event_representation_learning and MVSEC.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np

from ctlev_core.events.decoding import array_files, event_chunks, event_tables
from ctlev_core.events.decoding.sensor_sizes import smallest_sensor
from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, check_events

VERSION = 2
HAS_SIGNATURE = True
SUFFIXES = (".npy",)
COLUMNS = ("x", "y", "t", "p")
"""Of an [N, 4] array."""

_BLOCK = 1 << 18


def sniff(path: Path) -> bool:
    """Does the file start like a NumPy array? Whether it holds events is for `read` to say."""
    with path.open("rb") as file:
        return file.read(len(array_files.MAGIC)) == array_files.MAGIC


def read(path: Path) -> Events:
    """The whole file.

    Raises:
        DataError: a cut file, another layout, Python objects, no events, or events that break `check_events`.
    """
    return event_chunks.concatenate(_chunks(path, 1 << 62))


def read_chunks(path: Path, num_events: int) -> Iterator[Events]:
    """The events of `read` in chunks; the file is read twice, first for its sensor and its unit of time.

    Raises:
        DataError: as `read`.
    """
    return event_chunks.regroup(_chunks(path, min(num_events, _BLOCK)), num_events)


def check_complete(path: Path) -> None:
    """Raise `DataError` where the file is cut, as far as can be told without decoding it."""
    with path.open("rb") as file:
        array_files.read_array_header(file, str(path), path.stat().st_size)


def write(path: Path, events: Events) -> None:
    """Write a structured array, so that `read` returns the events unchanged.

    Raises:
        DataError: events break `check_events`, there are none, or `read` would take another sensor size.
    """
    check_events(events, f"events to be written to {path}")
    if len(events) == 0:
        raise DataError(f"{path}: the format cannot hold a recording without events")
    found = smallest_sensor(int(events.x.max()), int(events.y.max()), str(path))
    if found != events.sensor_size:
        raise DataError(
            f"{path}: the format states no sensor size, and from these events a reader would take "
            f"{found[0]} x {found[1]}, not {events.sensor_size[0]} x {events.sensor_size[1]} px"
        )
    records = np.empty(len(events), [(name, dtype) for name, dtype in EVENT_DTYPES.items()])
    for name in EVENT_DTYPES:
        records[name] = getattr(events, name)
    with path.open("wb") as file:
        np.save(file, records, allow_pickle=False)


def _chunks(path: Path, num_events: int) -> Iterator[Events]:
    def chunks() -> Iterator[event_tables.Columns]:
        return _read_columns(path, num_events)

    return event_tables.to_events(chunks, str(path), whole_floats_are_us=True)


def _read_columns(path: Path, num_events: int) -> Iterator[event_tables.Columns]:
    where = str(path)
    with path.open("rb") as file:
        header = array_files.read_array_header(file, where, path.stat().st_size)
        structured = header.dtype.names is not None
        if len(header.shape) != (1 if structured else 2) or (not structured and header.shape[1] != len(COLUMNS)):
            raise DataError(
                f"{where}: expected a structured array [N] or an array [N, 4] of {', '.join(COLUMNS)}, got "
                f"{header.shape} {header.dtype}"
            )
        total = header.shape[0]
        for start in range(0, max(total, 1), num_events):
            count = min(num_events, total - start)
            if structured:
                yield array_files.split_structured(array_files.read_items(file, header.dtype, count, where), where)
            elif header.fortran_order:
                columns = (_read_column(file, header, column, start, count, where) for column in range(len(COLUMNS)))
                yield dict(zip(COLUMNS, columns, strict=True))
            else:
                items = array_files.read_items(file, header.dtype, count * len(COLUMNS), where)
                yield dict(zip(COLUMNS, items.reshape(count, len(COLUMNS)).T, strict=True))


def _read_column(
    file: IO[bytes], header: array_files.ArrayHeader, column: int, start: int, count: int, where: str
) -> np.ndarray:
    file.seek(header.offset + (column * header.shape[0] + start) * header.dtype.itemsize)
    return array_files.read_items(file, header.dtype, count, where)
