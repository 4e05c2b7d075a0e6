"""Prophesee DAT: a text header, two bytes for the type and size of an event, then 8 bytes an event.

Change-detection events are read, type 12 (`CD`) and type 0 (`2d`, as in N-CARS): 32 bits of time in microseconds, then
x (14 bits), y (14 bits) and polarity (bit 28). The clock overflows after 71 minutes, which a drop of more than half its
range shows. The header gives width and height; recordings without, such as N-CARS, whose crops differ, get the smallest
of 304 x 240, 320 x 320, 640 x 480 and 1280 x 720 px that holds all events.

Source: prophesee-automotive-dataset-toolbox, src/io/dat_events_tools.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ctlev_core.events.decoding import prophesee, record_files
from data_contracts.errors import DataError
from data_contracts.events import Events, check_events

VERSION = 1
HAS_SIGNATURE = True
SUFFIXES = (".dat",)

TYPE_2D, TYPE_CD = 0, 12
_TYPES = {TYPE_2D: "2d", TYPE_CD: "CD", 40: "external trigger"}
_EVENT_BYTES = 8
_LARGEST_SENSOR = 1 << 14
_LONGEST_GAP_US = 1 << 31


def sniff(path: Path) -> bool:
    """Is there a text header without an EVT encoding, then a known type of event of 8 bytes?"""
    header = prophesee.read_header(path)
    if header.size == 0 or header.encoding:
        return False
    kind = _read_type(path, header)
    return len(kind) == 2 and kind[0] in _TYPES and kind[1] == _EVENT_BYTES


def read(path: Path) -> Events:
    """The whole file.

    Raises:
        DataError: a version before 2, other events than of type 2d or CD, no or cut ones, an unknown sensor size,
            events outside the sensor, or time that runs backwards (an overflow of the 32-bit clock does not).
    """
    return record_files.read(_open(path))


def read_chunks(path: Path, num_events: int) -> Iterator[Events]:
    """The events of `read` in chunks; without a sensor size in the header, the file is read twice.

    Raises:
        DataError: as `read`.
    """
    return record_files.read_chunks(_open(path), num_events)


def check_complete(path: Path) -> None:
    """Raise `DataError` where the file is cut, as far as can be told without decoding it."""
    _open(path).num_records()


def _read_type(path: Path, header: prophesee.Header) -> bytes:
    with path.open("rb") as file:
        file.seek(header.size)
        return file.read(2)


def _open(path: Path) -> record_files.RecordFile:
    from ctlev_core.events.decoding import prophesee_decoding as decoding

    header = prophesee.read_header(path)
    kind = _read_type(path, header)
    if header.size == 0 or len(kind) < 2:
        raise DataError(
            f"{path}: not a DAT file: expected lines that start with '% ', then the type and size of events"
        )
    version = header.fields.get("Version", "")
    if version.isdecimal() and int(version) < 2:
        raise DataError(f"{path}: expected DAT of version 2, got version {version}, which packs x, y and p otherwise")
    if kind[0] not in (TYPE_2D, TYPE_CD) or kind[1] != _EVENT_BYTES:
        name = _TYPES.get(kind[0], "unknown")
        raise DataError(
            f"{path}: expected events of type 0 (2d) or 12 (CD) and 8 bytes, got type {kind[0]} ({name}) of {kind[1]} "
            f"bytes"
        )
    return record_files.RecordFile(
        path,
        header.size + 2,
        np.dtype("<u4"),
        items=2,
        unit="DAT record",
        decode=decoding.decode_dat,
        own_state=decoding.DAT_STATE,
        sensor_size=prophesee.stated_sensor_size(header) or prophesee.guess_sensor_size(path),
    )


def write(path: Path, events: Events, event_type: int = TYPE_CD) -> None:
    """Write events so that `read` returns them unchanged.

    Raises:
        DataError: events break `check_events`, there are none, the sensor has more than 2^14 px a side, or a gap of
            half the clock's range (36 minutes) or more precedes an event, which a reader could not count.
    """
    check_events(events, f"events to be written to {path}")
    width, height = events.sensor_size
    if max(width, height) > _LARGEST_SENSOR:
        raise DataError(f"{path}: DAT holds sensors up to 16384 x 16384 px, got {width} x {height}")
    if len(events) == 0:
        raise DataError(f"{path}: the format cannot hold a recording without events")
    gaps = np.diff(events.t, prepend=0)
    if gaps.max() >= _LONGEST_GAP_US:
        event = int(np.argmax(gaps >= _LONGEST_GAP_US))
        raise DataError(
            f"{path}: {gaps[event]} us before event {event} are more than half an overflow of the 32-bit clock; "
            f"subtract the first time stamp before writing"
        )
    records = np.empty((len(events), 2), "<u4")
    records[:, 0] = events.t & 0xFFFFFFFF
    records[:, 1] = events.p.astype(np.uint32) << 28 | events.y.astype(np.uint32) << 14 | events.x
    name = "2d" if event_type == TYPE_2D else "CD"
    lines = [f"Data file containing {name} events.", "Version 2", f"Height {height}", f"Width {width}"]
    with path.open("wb") as file:
        file.write("".join(f"% {line}\n" for line in lines).encode("ascii") + bytes([event_type, _EVENT_BYTES]))
        records.tofile(file)
