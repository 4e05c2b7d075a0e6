"""The FlatBuffers of an AEDAT 4 file with one stream of events: its header, packets, and the table of packets.

A buffer starts with its own length. 64-bit values lie at multiples of 8 bytes from there.

Source: iniVation, "AEDAT 4.0 file format", docs.inivation.com; FlatBuffers, "Internals", flatbuffers.dev.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from data_contracts.events import Events, SensorSize

VERSION_LINE = b"#!AER-DAT4.0\r\n"
LZ4 = 1
_ROOT = 32
"""Where the table of a buffer lies: after length, place of the table, identifier and list of the fields' places."""
_EVENT = np.dtype(
    {"names": ["t", "x", "y", "p"], "formats": ["<i8", "<i2", "<i2", "u1"], "offsets": [0, 8, 10, 12], "itemsize": 16}
)
_TABLE_ROW = np.dtype(
    {
        "names": ["fields", "place", "stream", "bytes", "num_events", "first", "last"],
        "formats": ["<i4", "<i8", "<i4", "<i4", "<i8", "<i8", "<i8"],
        "offsets": [0, 4, 12, 16, 20, 28, 36],
        "itemsize": 48,
    }
)
"""A table: the distance back to the list of its fields' places, then its fields; padded so that the next is aligned."""

_XML = """<dv version="2.0"><node name="outInfo" path="/mainloop/Recorder/outInfo/">
<node name="0" path="/mainloop/Recorder/outInfo/0/"><attr key="compression" type="string">LZ4</attr>
<attr key="originalModuleName" type="string">{source}</attr><attr key="originalOutputName" type="string">events</attr>
<attr key="typeDescription" type="string">Array of events (polarity ON/OFF).</attr>
<attr key="typeIdentifier" type="string">EVTS</attr>
<node name="info" path="/mainloop/Recorder/outInfo/0/info/"><attr key="sizeX" type="int">{width}</attr>
<attr key="sizeY" type="int">{height}</attr><attr key="source" type="string">{source}</attr>
<attr key="tsOffset" type="long">0</attr></node></node></node></dv>"""


@dataclass(frozen=True)
class Packet:
    """What the table of packets says of one; `place` is the file's byte after the header of the packet."""

    place: int
    num_bytes: int
    num_events: int
    first_us: int
    last_us: int


def header(sensor_size: SensorSize, table_place: int) -> bytes:
    """Version line and IOHeader; its length does not depend on `table_place`, the byte where the table starts."""
    width, height = sensor_size
    text = _XML.format(source="ctlev", width=width, height=height).encode("ascii")
    # The table: compression, place of the table, distance to the text.
    table = struct.pack("<iqI", LZ4, table_place, 4)
    return VERSION_LINE + _buffer(b"IOHE", (4, 8, 16), table, struct.pack("<I", len(text)) + text + b"\0")


def packet(events: Events) -> bytes:
    """An EventPacket, not compressed."""
    rows = np.zeros(len(events), _EVENT)
    for name in ("t", "x", "y", "p"):
        rows[name] = getattr(events, name)
    table = struct.pack("<I", 8) + bytes(4)
    return _buffer(b"EVTS", (4,), table, struct.pack("<I", len(rows)) + rows.tobytes())


def packet_table(packets: list[Packet]) -> bytes:
    """A FileDataTable, not compressed: what each packet holds."""
    vector = _ROOT + 8
    start = vector + 4 + 4 * len(packets)
    start += (4 - start) % 8  # the 64-bit fields follow 4 bytes of the row
    places = start + _TABLE_ROW.itemsize * np.arange(len(packets))
    rows = np.zeros(len(packets), _TABLE_ROW)
    for row, one in zip(rows, packets, strict=True):
        row["place"], row["bytes"], row["num_events"] = one.place, one.num_bytes, one.num_events
        row["first"], row["last"] = one.first_us, one.last_us
    # All rows share one list of their fields' places. It stands at the end, so the distance back is negative.
    fields = struct.pack("<7H", 14, 44, 4, 12, 20, 28, 36)
    rows["fields"] = places - (start + rows.nbytes)
    offsets = (places - (vector + 4 + 4 * np.arange(len(packets)))).astype("<u4")
    content = struct.pack("<I", len(packets)) + offsets.tobytes()
    content = content.ljust(start - vector, b"\0") + rows.tobytes() + fields
    return _buffer(b"FTAB", (4,), struct.pack("<I", 4), content)


def _buffer(identifier: bytes, places: tuple[int, ...], table: bytes, content: bytes) -> bytes:
    """A size-prefixed buffer of one table.

    Args:
        identifier: four letters.
        places: of the fields, counted from the start of the table.
        table: its fields, which follow the four bytes of the distance back to the list of their places.
        content: what fields refer to, right after the table.
    """
    fields = struct.pack(f"<{2 + len(places)}H", 4 + 2 * len(places), 4 + len(table), *places)
    head = struct.pack("<I", _ROOT - 4) + identifier + bytes(_ROOT - 12 - len(fields)) + fields
    body = head + struct.pack("<i", len(fields)) + table + content
    return struct.pack("<I", len(body)) + body
