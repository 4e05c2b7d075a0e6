"""ATIS 40-bit records, the `.bin` files of N-Caltech101 and N-MNIST: five big-endian bytes an event and no header.

Byte 0 is x, byte 1 is y, bit 7 of byte 2 the polarity (1 = ON), the other 23 bits the time in microseconds. A record
with y = 240, a row the sensor does not have, is no event but adds 2^13 us to all later times. Nothing states the sensor
size: it is the smallest of 34 x 34 (N-MNIST), 240 x 180 (N-Caltech101) and 304 x 240 px (the ATIS) that holds all
events. Events are as the camera gave them; loaders that shift a recording to its smallest x and y do more than read.

Source: G. Orchard, event-Python, eventvision.py, read_dataset; https://www.garrickorchard.com/datasets.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ctlev_core.events.decoding import record_files
from ctlev_core.events.decoding.sensor_sizes import smallest_sensor
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize, check_events

VERSION = 1
SUFFIXES = (".bin",)
HAS_SIGNATURE = False
"""Nothing marks the file: it is recognised by times that ascend, and only where no other format is."""

SENSORS: tuple[SensorSize, ...] = ((34, 34), (240, 180), (304, 240))

_RECORD_BYTES = 5
_OVERFLOW_ROW, _OVERFLOW_US, _CLOCK_US = 240, 1 << 13, 1 << 23
_NUM_SNIFFED, _NUM_CERTAIN = 4096, 16
_MAX_MARKERS = 1 << 16
_TEXT = bytes([9, 10, 13, *range(32, 127)])


def sniff(path: Path) -> bool:
    """Do the first records read as events: rows of the sensor, and times that advance and hardly ever descend?

    One descent among a hundred is let pass here, so that `read` can name it; bytes of other files give one every other
    time. Fewer than 16 records prove little: then none may descend, and the suffix has to be `.bin` too.
    """
    size = path.stat().st_size
    if size == 0 or size % _RECORD_BYTES:
        return False
    with path.open("rb") as file:
        head = file.read(_RECORD_BYTES * _NUM_SNIFFED)
    if not head.translate(None, _TEXT):
        return False
    records = np.frombuffer(head, np.uint8).reshape(-1, _RECORD_BYTES).astype(np.int64)
    rows = records[:, 1]
    t = (records[:, 2] & 0x7F) << 16 | records[:, 3] << 8 | records[:, 4]
    t += _OVERFLOW_US * np.cumsum(rows == _OVERFLOW_ROW)
    t = t[rows != _OVERFLOW_ROW]
    if rows.max() > _OVERFLOW_ROW or len(t) == 0 or np.count_nonzero(t[1:] < t[:-1]) * 100 > len(t):
        return False
    return t[-1] > t[0] if len(records) >= _NUM_CERTAIN else path.suffix.lower() in SUFFIXES


def read(path: Path) -> Events:
    """The whole file.

    Raises:
        DataError: an empty file, a cut record, no event among the markers, a row past the sensor, or time that runs
            backwards.
    """
    return record_files.read(_open(path))


def read_chunks(path: Path, num_events: int) -> Iterator[Events]:
    """The events of `read` in chunks; the file is read twice, first for the sensor size.

    Raises:
        DataError: as `read`.
    """
    return record_files.read_chunks(_open(path), num_events)


def check_complete(path: Path) -> None:
    """Raise `DataError` where the file is cut, as far as can be told without decoding it."""
    _open(path).num_records()


def _open(path: Path) -> record_files.RecordFile:
    from ctlev_core.events.decoding.atis_decoding import decode_atis

    def sensor_size(state: np.ndarray, num_events: int) -> SensorSize:
        if num_events == 0:
            raise DataError(f"{path}: expected events, got overflow markers alone")
        return smallest_sensor(
            int(state[record_files.LARGEST_X]), int(state[record_files.LARGEST_Y]), str(path), SENSORS
        )

    dtype = np.dtype(np.uint8)
    return record_files.RecordFile(path, 0, dtype, _RECORD_BYTES, "40-bit record", decode_atis, (0,), sensor_size)


def write(path: Path, events: Events) -> None:
    """Write events so that `read` returns them unchanged.

    Raises:
        DataError: events break `check_events`, there are none, they lie past the 8 bits of a coordinate, `read` would
            take another sensor size, or the time stamps are too far apart for overflow markers.
    """
    check_events(events, f"events to be written to {path}")
    if len(events) == 0:
        raise DataError(f"{path}: the format cannot hold a recording without events")
    if events.x.max() > 255:
        raise DataError(f"{path}: the format holds x up to 255 px, got {events.x.max()}")
    found = smallest_sensor(int(events.x.max()), int(events.y.max()), str(path), SENSORS)
    if found != events.sensor_size:
        raise DataError(
            f"{path}: the format states no sensor size, and from these events a reader would take "
            f"{found[0]} x {found[1]}, not {events.sensor_size[0]} x {events.sensor_size[1]} px"
        )
    # Markers due before each event, so that what is left of its time fits 23 bits.
    markers = np.maximum(events.t - (_CLOCK_US - _OVERFLOW_US), 0) // _OVERFLOW_US
    if markers[-1] > _MAX_MARKERS:
        raise DataError(
            f"{path}: t = {events.t[-1]} us takes {markers[-1]} overflow markers, expected at most {_MAX_MARKERS}; "
            f"subtract the first time stamp before writing"
        )
    records = np.zeros((len(events) + int(markers[-1]), _RECORD_BYTES), np.uint8)
    records[:, 1] = _OVERFLOW_ROW
    clock = events.t - markers * _OVERFLOW_US
    place = np.arange(len(events)) + markers
    columns = [events.x, events.y, events.p.astype(np.int64) << 7 | clock >> 16, clock >> 8 & 0xFF, clock & 0xFF]
    records[place] = np.stack(columns, axis=1)
    records.tofile(path)
