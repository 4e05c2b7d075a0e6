"""AEDAT 4: what is written follows the format; a corrupt file is an error, whatever it does to the decoder."""

import struct
import subprocess
import sys
import textwrap
import threading
from xml.etree import ElementTree

import aedat
import pyarrow as pa
import pytest
from aedat4_writer import aedat4, header, packet
from format_helpers import make_events, to_rows

from ctlev_core.events import files as event_files
from ctlev_core.events.decoding import aedat4_process
from ctlev_core.formats import aedat4 as reader
from data_contracts.errors import DataError

ROWS = [(1, 2, 3, 1), (5, 319, 239, 0), (5, 0, 0, 1), (9, 7, 8, 0)]
NO_SUCH_MEMORY = header(320, 240) + struct.pack("<ii", 0, -1) + b"x" * 30
"""A packet of 2^32 - 1 bytes."""


def write(tmp_path, content):
    (tmp_path / "a.aedat4").write_bytes(content)
    return tmp_path / "a.aedat4"


def test_events_are_read_whole_and_in_chunks(tmp_path):
    path = write(tmp_path, aedat4([packet(ROWS[:3]), packet([]), packet(ROWS[3:])]))
    assert to_rows(reader.read(path)) == ROWS and reader.read(path).sensor_size == (320, 240)
    assert [to_rows(chunk) for chunk in reader.read_chunks(path, 3)] == [ROWS[:3], ROWS[3:]]
    assert event_files.find_format(path) is reader


def test_no_events_are_an_empty_recording(tmp_path):
    assert len(reader.read(write(tmp_path, aedat4([])))) == 0


LONELY = """
    import resource, sys
    from pathlib import Path
    from ctlev_core.formats import aedat4
    from data_contracts.errors import DataError
    resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        aedat4.read(Path(sys.argv[1]))
    except DataError as error:
        print("DataError:", error)
"""


def test_a_file_that_aborts_the_decoder_does_not_end_us(tmp_path):
    path = write(tmp_path, NO_SUCH_MEMORY)
    command = [sys.executable, "-c", textwrap.dedent(LONELY), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert (
        f"DataError: {path}: not a complete AEDAT 4 file, the decoder says: its process ended with SIG" in done.stdout
    )


WHOLE = aedat4([packet(ROWS)])
CORRUPT = {
    "header": WHOLE[:18] + b"\xff\xff\xff\x7f" + WHOLE[22:],
    "cut": WHOLE[:-1],
    "version line alone": WHOLE[:14],
    "length of a packet": NO_SUCH_MEMORY,
    "number of events": aedat4([packet(ROWS, 1 << 31)]),
}


@pytest.mark.parametrize("kind", CORRUPT)
def test_corrupt_files_are_named(tmp_path, kind):
    path = write(tmp_path, CORRUPT[kind])
    with pytest.raises(DataError, match=r"a\.aedat4: not a complete AEDAT 4 file") as refused:
        reader.read(path)
    assert len(str(refused.value)) < 500


def test_who_stops_reading_leaves_no_process(tmp_path, monkeypatch):
    started = []

    class Watched(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            started.append(self)

    monkeypatch.setattr(aedat4_process.subprocess, "Popen", Watched)
    path = write(tmp_path, aedat4([packet(ROWS)] * 1 + [packet([(10, 1, 1, 1)] * 1000)] * 200))
    before = set(threading.enumerate())  # other tests of the process may have left some
    chunks = reader.read_chunks(path, 2)
    assert to_rows(next(chunks)) == ROWS[:2]
    chunks.close()
    assert started[0].returncode is not None and set(threading.enumerate()) <= before


# Written files, taken apart with a reader of FlatBuffers of our own ---------------------------------------------------


def unpack(buffer, place, code):
    return struct.unpack_from(f"<{code}", buffer, place)[0]


def refer(buffer, place):
    return place + unpack(buffer, place, "I")


def field(buffer, table, number):
    """Where a field of a table lies."""
    places = table - unpack(buffer, table, "i")
    assert 4 + 2 * number < unpack(buffer, places, "H")
    return table + unpack(buffer, places + 4 + 2 * number, "H")


def root(buffer, identifier):
    assert unpack(buffer, 0, "I") == len(buffer) - 4 and buffer[8:12] == identifier
    return refer(buffer, 4)


def decompress(content):
    return pa.CompressedInputStream(pa.BufferReader(content), "lz4").read()


def take_apart(path):
    """Compression, XML, packets as (place, bytes, rows) and the table's rows of a file of one stream."""
    content = path.read_bytes()
    assert content[:14] == b"#!AER-DAT4.0\r\n"
    length = unpack(content, 14, "I")
    head = content[14 : 18 + length]
    table = root(head, b"IOHE")
    text = refer(head, field(head, table, 2))
    xml = head[text + 4 : text + 4 + unpack(head, text, "I")]
    table_place = unpack(head, field(head, table, 1), "q")
    packets, place = [], 18 + length
    while place < table_place:
        stream, num_bytes = struct.unpack_from("<ii", content, place)
        body = decompress(content[place + 8 : place + 8 + num_bytes])
        vector = refer(body, field(body, root(body, b"EVTS"), 0))
        assert (vector + 4) % 8 == 0
        rows = [struct.unpack_from("<qhhB", body, vector + 4 + 16 * i) for i in range(unpack(body, vector, "I"))]
        packets.append((place + 8, num_bytes, rows))
        place += 8 + num_bytes
        assert stream == 0
    assert place == table_place
    body = decompress(content[table_place:])
    vector = refer(body, field(body, root(body, b"FTAB"), 0))
    listed = []
    for number in range(unpack(body, vector, "I")):
        row = refer(body, vector + 4 + 4 * number)
        places = [field(body, row, k) for k in range(5)]
        assert all(places[k] % 8 == 0 for k in (0, 2, 3, 4))
        listed.append([unpack(body, places[0], "q"), *struct.unpack_from("<ii", body, places[1])])
        listed[-1] += [unpack(body, places[k], "q") for k in (2, 3, 4)]
    return unpack(head, field(head, table, 0), "i"), xml, packets, listed


def write_many(tmp_path):
    rows = [(10**15 + 7 * t, t % 640, t % 479, t % 2) for t in range(20_000)]
    reader.write(tmp_path / "a", make_events(rows))
    return rows


def test_written_files_follow_the_format(tmp_path):
    rows = write_many(tmp_path)
    compression, xml, packets, listed = take_apart(tmp_path / "a")
    assert compression == 1  # LZ4
    info = ElementTree.fromstring(xml).find("node/node[@name='0']/node[@name='info']")
    assert info is not None
    assert {one.get("key"): one.text for one in info} == {
        "sizeX": "640", "sizeY": "480", "source": "ctlev", "tsOffset": "0",
    }  # fmt: skip
    assert [len(part) for *_, part in packets] == [8192, 8192, 3616]
    assert [row for *_, part in packets for row in part] == rows
    assert listed == [[place, 0, size, len(part), part[0][0], part[-1][0]] for place, size, part in packets]


def test_the_aedat_package_reads_what_is_written(tmp_path):
    rows = write_many(tmp_path)
    (tmp_path / "a").rename(tmp_path / "a.aedat4")
    decoder = aedat.Decoder(str(tmp_path / "a.aedat4"))
    assert decoder.id_to_stream() == {0: {"type": "events", "width": 640, "height": 480}}
    assert [row for part in decoder for row in part["events"].tolist()] == [(*row[:3], bool(row[3])) for row in rows]


@pytest.mark.parametrize(
    ("rows", "sensor_size"),
    [
        ([], (34, 34)),
        ([(0, 0, 0, 0)], (1, 1)),
        ([(2**63 - 1, 32_767, 0, 1)], (32_768, 4)),
        ([(5, 0, 32_767, 1)], (4, 32_768)),
    ],
)
def test_the_smallest_and_the_largest_are_written(tmp_path, rows, sensor_size):
    reader.write(tmp_path / "a", make_events(rows, sensor_size))
    reader.check_complete(tmp_path / "a")
    again = reader.read(tmp_path / "a")
    assert to_rows(again) == rows and again.sensor_size == sensor_size


def test_a_written_file_that_is_cut_is_refused(tmp_path):
    write_many(tmp_path)
    content = (tmp_path / "a").read_bytes()
    *_, (place, _, _) = take_apart(tmp_path / "a")[2]
    for stop in (place - 8, place, len(content) // 2, 40):  # before the last packet, too: the table follows it
        (tmp_path / "a").write_bytes(content[:stop])
        with pytest.raises(DataError, match="not a complete AEDAT 4 file"):
            reader.check_complete(tmp_path / "a")


def test_sensors_too_large_are_not_written(tmp_path):
    with pytest.raises(DataError, match="at most 32768 px a side, got 40000 x 4"):
        reader.write(tmp_path / "a", make_events([(0, 0, 0, 0)], (40_000, 4)))
    assert not (tmp_path / "a").exists()
