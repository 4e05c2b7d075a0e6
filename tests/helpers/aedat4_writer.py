"""Small AEDAT 4 files, whole and broken, with their flatbuffers packed by hand.

Source: iniVation, "AEDAT 4.0 file format"; Google, "FlatBuffers internals".
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence

XML = """<dv version="2.0"><node name="outInfo" path="/"><node name="0" path="/0/">
<attr key="compression" type="string">NONE</attr><attr key="typeIdentifier" type="string">EVTS</attr>
<node name="info" path="/0/info/"><attr key="sizeX" type="int">{width}</attr>
<attr key="sizeY" type="int">{height}</attr>
<attr key="source" type="string">x</attr></node></node></node></dv>"""


def header(width: int, height: int) -> bytes:
    """Version line and IOHeader: compression none, no table of packets, the streams as XML."""
    xml = XML.format(width=width, height=height).encode() + b"\0"
    # Root offset, identifier, vtable (6 slots of 2 bytes: sizes, 3 fields), table, string.
    vtable = struct.pack("<HHHHH", 10, 24, 4, 8, 16)
    table_at = 4 + 4 + 12  # the vtable is padded to 12
    table = struct.pack("<iiqII", table_at - 8, 0, -1, 8, 0)
    text = struct.pack("<I", len(xml) - 1) + xml
    body = struct.pack("<I", table_at) + b"IOHE" + vtable.ljust(12, b"\0") + table + text
    return b"#!AER-DAT4.0\r\n" + struct.pack("<I", len(body)) + body


def packet(events: Sequence[tuple[int, int, int, int]], count: int | None = None) -> bytes:
    """One packet of (t, x, y, p) for stream 0; `count` is the number the vector claims to hold."""
    rows = b"".join(struct.pack("<qhhB3x", t, x, y, p) for t, x, y, p in events)
    table_at = 4 + 4 + 8
    # The vector's offset is from its field; its elements are at a multiple of 8 in the size-prefixed buffer.
    table = struct.pack("<iI", table_at - 8, 8) + bytes(4)
    vector = struct.pack("<I", len(events) if count is None else count) + rows
    body = struct.pack("<I", table_at) + b"EVTS" + struct.pack("<HHHxx", 6, 8, 4) + table + vector
    prefixed = struct.pack("<I", len(body)) + body
    return struct.pack("<ii", 0, len(prefixed)) + prefixed


def aedat4(packets: Iterable[bytes], width: int = 320, height: int = 240) -> bytes:
    """A whole file."""
    return header(width, height) + b"".join(packets)
