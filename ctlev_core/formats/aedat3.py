"""AEDAT 3.1, the files of iniVation's cAER and of jAER: a text header, then packets of one kind of event each.

Polarity events are read; packets of frames, inertial data, special and other events are skipped. Events that the camera
or a filter marked as invalid are dropped. The header names the camera and so the sensor size; without a known name it
is the smallest common one that holds all events. AEDAT 3.0, whose rows count from the bottom, is refused.

Source: iniVation, "AEDAT 3.1 file format", docs.inivation.com; libcaer, events/common.h and events/polarity.h.
"""

from __future__ import annotations

import itertools
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from ctlev_core.events.decoding import event_chunks, event_tables
from ctlev_core.events.decoding.sensor_sizes import INIVATION_CAMERAS
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize, check_events

VERSION = 1
HAS_SIGNATURE = True
SUFFIXES = (".aedat3",)

_SIGNATURE, _VERSION_LINE, _LAST_LINE = b"#!AER-DAT3.", b"#!AER-DAT3.1", b"#!END-HEADER"
_MAX_HEADER_BYTES = 1 << 20
_PACKET = struct.Struct("<hhiiiiii")
"""Type, source, bytes an event, place of its time stamp, overflows of the clock, capacity, events, valid events."""
_POLARITY = 1
_EVENT = np.dtype([("data", "<u4"), ("t", "<i4")])
_TIME_PLACE = 4
_CLOCK_BITS = 31
_BLOCK = 1 << 18
_PACKET_EVENTS = 1 << 12


@dataclass(frozen=True)
class _Header:
    """The text before the packets.

    Attributes:
        cameras: sensor size of the sources that are known cameras, by their numbers.
        earlier: sensor sizes of known cameras from which the file's sources got their events.
        size: bytes before the first packet.
    """

    cameras: dict[int, SensorSize]
    earlier: set[SensorSize]
    size: int


@dataclass(frozen=True)
class _Packet:
    """Polarity events of one source; `place` is the byte of the first."""

    place: int
    source: int
    overflows: int
    num_events: int


def sniff(path: Path) -> bool:
    """Does the file start with the version line of AEDAT 3?"""
    with path.open("rb") as file:
        return file.read(len(_SIGNATURE)) == _SIGNATURE


def read(path: Path) -> Events:
    """The whole file.

    Raises:
        DataError: AEDAT 3.0, a compressed or cut file, events of several sources, events outside the sensor, or time
            that runs backwards (an overflow of the 31-bit clock does not).
    """
    return event_chunks.concatenate(_chunks(path, _BLOCK))


def read_chunks(path: Path, num_events: int) -> Iterator[Events]:
    """The events of `read` in chunks; where the header names no known camera, the file is read twice.

    Raises:
        DataError: as `read`.
    """
    return event_chunks.regroup(_chunks(path, min(num_events, _BLOCK)), num_events)


def check_complete(path: Path) -> None:
    """Raise `DataError` where the file ends within a packet; events are not decoded."""
    with path.open("rb") as file:
        for _ in _polarity_packets(file, path, _read_header(path).size):
            pass


def _read_header(path: Path) -> _Header:
    cameras: dict[int, SensorSize] = {}
    earlier: set[SensorSize] = set()
    with path.open("rb") as file:
        version = file.readline(_MAX_HEADER_BYTES).rstrip()
        if version != _VERSION_LINE:
            raise DataError(f"{path}: expected the first line {_VERSION_LINE.decode()}, got {version[:40]!r}")
        while (line := file.readline(_MAX_HEADER_BYTES)).startswith(b"#") and file.tell() <= _MAX_HEADER_BYTES:
            line = line.rstrip()
            if line == _LAST_LINE:
                return _Header(cameras, earlier, file.tell())
            if line.startswith(b"#Format:") and line.split(b":")[1].strip() != b"RAW":
                raise DataError(f"{path}: expected packets of the format RAW, got {line[:60]!r}")
            named = re.match(rb"#(-?)Source\s+(\d{1,5}):\s*(\w+)", line)
            camera = _known_camera(named[3].decode("ascii", "replace")) if named else None
            if named and camera and named[1]:
                earlier.add(camera)
            elif named and camera:
                cameras[int(named[2])] = camera
    raise DataError(
        f"{path}: not a complete AEDAT 3.1 file: the header has no last line {_LAST_LINE.decode()}, got {line[:40]!r}"
    )


def _known_camera(name: str) -> SensorSize | None:
    known = re.match("|".join(INIVATION_CAMERAS), name.upper())
    return INIVATION_CAMERAS[known[0]] if known else None


def _polarity_packets(file: IO[bytes], path: Path, place: int) -> Iterator[_Packet]:
    """The packets of polarity events from `place` on; the headers of all are checked."""
    end = path.stat().st_size
    while place < end:
        file.seek(place)
        head = file.read(_PACKET.size)
        if len(head) < _PACKET.size:
            raise DataError(f"{path}: not a complete AEDAT 3.1 file: it ends within the header of a packet, byte {end}")
        kind, source, event_bytes, time_place, overflows, _, num_events, _ = _PACKET.unpack(head)
        where = f"{path}: packet at byte {place}"
        if kind < 0:
            raise DataError(f"{where}: expected the type of its events from 0 on, got {kind}: compressed or corrupt")
        if event_bytes < 0 or num_events < 0:
            raise DataError(f"{where}: expected counts from 0 on, got {num_events} events of {event_bytes} bytes")
        place += _PACKET.size + event_bytes * num_events
        if place > end:
            raise DataError(
                f"{path}: not a complete AEDAT 3.1 file: a packet reaches to byte {place}, the file ends at byte {end}"
            )
        if kind == _POLARITY and num_events:
            if (event_bytes, time_place) != (_EVENT.itemsize, _TIME_PLACE):
                raise DataError(
                    f"{where}: expected polarity events of 8 bytes with their time at byte 4, got {event_bytes} bytes, "
                    f"time at byte {time_place}"
                )
            if overflows < 0:
                raise DataError(f"{where}: expected overflows of the clock from 0 on, got {overflows}")
            yield _Packet(place - event_bytes * num_events, source, overflows, num_events)


def _chunks(path: Path, num_events: int) -> Iterator[Events]:
    header = _read_header(path)

    def chunks() -> Iterator[event_tables.Columns]:
        yield _columns(np.empty(0, _EVENT), 0, "")
        with path.open("rb") as file:
            first: _Packet | None = None
            for packet in _polarity_packets(file, path, header.size):
                first = first or packet
                if packet.source != first.source:
                    raise DataError(
                        f"{path}: polarity events of the sources {first.source} and {packet.source}, expected those of "
                        f"one camera"
                    )
                for start in range(0, packet.num_events, num_events):
                    count = min(num_events, packet.num_events - start)
                    file.seek(packet.place + start * _EVENT.itemsize)
                    content = file.read(count * _EVENT.itemsize)
                    if len(content) != count * _EVENT.itemsize:
                        raise DataError(f"{path}: the file became shorter while it was read")
                    events = np.frombuffer(content, _EVENT)
                    yield _columns(events, packet.overflows, f"{path}: packet with events from byte {packet.place}")

    with path.open("rb") as file:
        first = next(_polarity_packets(file, path, header.size), None)
    size = header.cameras.get(first.source) if first else None
    named = {*header.cameras.values(), *header.earlier}
    if size is None and len(named) == 1:
        (size,) = named
    yield from event_tables.to_events(chunks, str(path), size)


def _columns(events: np.ndarray, overflows: int, where: str) -> event_tables.Columns:
    valid = events["data"] & 1 == 1
    data, t = events["data"][valid], events["t"][valid].astype(np.int64)
    if len(t) and t.min() < 0:
        raise DataError(f"{where}: expected times of 31 bits, got {t.min()}")
    return {
        "t": t + (overflows << _CLOCK_BITS),
        "x": (data >> 17).astype(np.uint16),
        "y": (data >> 2 & 0x7FFF).astype(np.uint16),
        "p": (data >> 1 & 1).astype(np.uint8),
    }


def write(path: Path, events: Events) -> None:
    """Write events of a DVS128 or DAVIS so that `read` returns them unchanged.

    The start of the recording, which the format asks for, is not known: it is written as the year 1970.

    Raises:
        DataError: events break `check_events`, the sensor is of no known camera, or times are past 2^62 us.
    """
    check_events(events, f"events to be written to {path}")
    names: dict[SensorSize, str] = {}
    for name, size in INIVATION_CAMERAS.items():
        names.setdefault(size, name)
    if events.sensor_size not in names:
        raise DataError(
            f"{path}: AEDAT 3.1 is written for sensors of {', '.join(f'{w} x {h}' for w, h in names)} px, got "
            f"{events.sensor_size[0]} x {events.sensor_size[1]}"
        )
    if len(events) and events.t[-1] >> 62:
        raise DataError(f"{path}: AEDAT 3.1 holds times below 2^62 us, got {events.t[-1]}")
    lines = [
        _VERSION_LINE.decode(),
        "#Format: RAW",
        f"#Source 0: {names[events.sensor_size]}",
        "#Start-Time: 1970-01-01 00:00:00 (TZ+0000)",
        _LAST_LINE.decode(),
    ]
    rows = np.empty(len(events), _EVENT)
    x, y, p = (column.astype(np.uint32) for column in (events.x, events.y, events.p))
    rows["data"], rows["t"] = x << 17 | y << 2 | p << 1 | 1, events.t & (1 << _CLOCK_BITS) - 1
    # A packet has one number of overflows.
    overflows = events.t >> _CLOCK_BITS
    breaks = {*range(0, len(events), _PACKET_EVENTS), *(np.flatnonzero(np.diff(overflows)) + 1).tolist(), len(events)}
    starts = sorted(breaks)
    with path.open("wb") as file:
        file.write("".join(f"{line}\r\n" for line in lines).encode("ascii"))
        for start, stop in itertools.pairwise(starts):
            counts = (stop - start,) * 3
            file.write(_PACKET.pack(_POLARITY, 0, _EVENT.itemsize, _TIME_PLACE, int(overflows[start]), *counts))
            file.write(rows[start:stop].tobytes())
