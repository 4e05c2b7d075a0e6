"""AEDAT 4, the files of iniVation's DV software: compressed packets of events, frames, IMU samples and triggers.

Only the event stream is read and written. Time stamps are the file's own, unix time in microseconds.

Source: iniVation, "AEDAT 4.0 file format"; decoded by the `aedat` package, in a process of its own.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.events.decoding import aedat4_encoding, aedat4_process, event_chunks
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize, check_events

VERSION = 1
HAS_SIGNATURE = True
SUFFIXES = (".aedat4",)

_MAGIC = b"#!AER-DAT4.0"
_SHORT, _INT, _UINT, _LONG = (struct.Struct(f"<{code}") for code in "HiIq")
_PACKET = struct.Struct("<ii")  # stream, bytes
_PACKET_EVENTS = 1 << 13
_LARGEST_SIDE = 1 << 15


def sniff(path: Path) -> bool:
    """Does the file start with the AEDAT 4 version line?"""
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def read(path: Path) -> Events:
    """All events of the file's one event stream.

    Raises:
        DataError: a cut or corrupt file, no or several event streams, or events that break `check_events`.
    """
    return event_chunks.concatenate(_read_packets(path))


def read_chunks(path: Path, num_events: int) -> Iterator[Events]:
    """The events of `read` in chunks, put together from the file's packets.

    Raises:
        DataError: as `read`.
    """
    return event_chunks.regroup(_read_packets(path), num_events)


def check_complete(path: Path) -> None:
    """Raise `DataError` where the file ends within a packet; the packets are counted, not decoded."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.readline()
        try:
            (header_bytes,) = _INT.unpack(file.read(_INT.size))
            header = file.read(header_bytes)
            end = _table_position(header)
            position, end = file.tell(), size if end < 0 else end
            while position < end:
                file.seek(position)
                _, packet_bytes = _PACKET.unpack(file.read(_PACKET.size))
                position += _PACKET.size + max(packet_bytes, 0)
        except struct.error:
            position = size + 1
    if position > size:
        raise DataError(f"{path}: not a complete AEDAT 4 file: it ends at byte {size}, within a packet or the header")


def _table_position(header: bytes) -> int:
    """Where the table of packets starts that follows the last one; -1 = there is none.

    It is the second field of a FlatBuffers table. Source: iniVation, "AEDAT 4.0 file format", IOHeader; FlatBuffers,
    "Internals": a table starts with the distance back to the list of its fields' places.
    """
    (table,) = _UINT.unpack_from(header, 0)
    (back,) = _INT.unpack_from(header, table)
    (num_bytes,) = _SHORT.unpack_from(header, table - back)
    place = _SHORT.unpack_from(header, table - back + 6)[0] if num_bytes >= 8 else 0
    return _LONG.unpack_from(header, table + place)[0] if place else -1


@contextlib.contextmanager
def one_stream(path: Path, kind: str, what: str) -> Iterator[tuple[dict[str, Any], Iterator[bytes]]]:
    """The one stream of a kind that a file must have, and the content of one packet of it after the other.

    Args:
        path: the file.
        kind: as of `aedat4_process`.
        what: names it in the message.
    Raises:
        DataError: here, and where packets are read: a cut or corrupt file, or no or several such streams.
    """
    try:
        with aedat4_process.decoding(str(path), kind) as (streams, packets):
            if len(streams) != 1:
                raise DataError(f"{path}: expected one {what}, got {len(streams)}")
            yield streams[0], packets
    except aedat4_process.DecoderError as error:
        raise DataError(f"{path}: not a complete AEDAT 4 file, the decoder says: {error}") from error


def _read_packets(path: Path) -> Iterator[Events]:
    """An empty chunk, then one a packet."""
    with one_stream(path, "events", "event stream") as (stream, packets):
        sensor_size = stream["width"], stream["height"]
        yield from event_chunks.check_chunks(_events(packets, sensor_size), str(path))


def _events(packets: Iterator[bytes], sensor_size: SensorSize) -> Iterator[Events]:
    yield event_chunks.empty_events(sensor_size)
    for packet in packets:
        rows = np.frombuffer(packet, aedat4_process.EVENT)
        # Past 2^63 the unsigned stamps of a corrupt file turn negative, which the check reports.
        yield Events(
            rows["t"].astype(np.int64), rows["x"].copy(), rows["y"].copy(), rows["on"].astype(np.uint8), sensor_size
        )


def write(path: Path, events: Events) -> None:
    """Write one stream of events, compressed with LZ4 as DV does, so that `read` returns them unchanged.

    Raises:
        DataError: events break `check_events`, or the sensor has more than 32,768 px a side.
    """
    import pyarrow as pa

    check_events(events, f"events to be written to {path}")
    if max(events.sensor_size) > _LARGEST_SIDE:
        raise DataError(
            f"{path}: AEDAT 4 holds sensors of at most {_LARGEST_SIDE} px a side, got {events.sensor_size[0]} x "
            f"{events.sensor_size[1]}"
        )

    def compress(content: bytes) -> bytes:
        return pa.compress(content, codec="lz4", asbytes=True)

    packets = []
    with path.open("wb") as file:
        file.write(aedat4_encoding.header(events.sensor_size, -1))
        for start in range(0, len(events), _PACKET_EVENTS):
            part = events.slice(start, start + _PACKET_EVENTS)
            content = compress(aedat4_encoding.packet(part))
            file.write(_PACKET.pack(0, len(content)))
            times = int(part.t[0]), int(part.t[-1])
            packets.append(aedat4_encoding.Packet(file.tell(), len(content), len(part), *times))
            file.write(content)
        table_place = file.tell()
        file.write(compress(aedat4_encoding.packet_table(packets)))
        file.seek(0)
        file.write(aedat4_encoding.header(events.sensor_size, table_place))
