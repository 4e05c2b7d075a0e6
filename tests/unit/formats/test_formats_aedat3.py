"""AEDAT 3.1: files packed by hand after iniVation's specification, and each of its rules."""

import struct

import numpy as np
import pytest
from format_helpers import assert_events, make_events, raises_both_ways, read_both_ways, to_rows

from ctlev_core.events import files as event_files
from ctlev_core.formats import aedat3 as reader
from data_contracts.errors import DataError

POLARITY, FRAME, SPECIAL = 1, 2, 0
CAMERA = ("#Source 0: DAVIS240C",)


def header(sources=CAMERA, file_format="RAW"):
    lines = ["#!AER-DAT3.1", f"#Format: {file_format}", *sources, "#Start-Time: 2016-04-01 10:00:00 (TZ+0200)"]
    return "".join(f"{line}\r\n" for line in [*lines, "#!END-HEADER"]).encode()


def event(t, x, y, p, valid=1):
    """8 bytes: bit 0 valid, 1 polarity, 2 to 16 y, 17 to 31 x; then the time."""
    return struct.pack("<Ii", valid + 2 * p + 4 * y + 2**17 * x, t)


def packet(body, kind=POLARITY, source=0, size=8, time_place=4, overflows=0, number=None):
    number = len(body) // size if number is None else number
    return struct.pack("<hhiiiiii", kind, source, size, time_place, overflows, number, number, number) + body


def write(tmp_path, *packets, head=None):
    path = tmp_path / "a.aedat"
    path.write_bytes((header() if head is None else head) + b"".join(packets))
    return path


def test_polarity_events_are_read_and_other_packets_skipped(tmp_path):
    path = write(
        tmp_path,
        packet(b"\x01" * 8, SPECIAL),
        packet(event(1, 239, 0, 1) + event(1, 0, 179, 0) + event(7, 2, 3, 1)),
        packet(b"\xff" * 3 * 40, FRAME, size=40, time_place=12, number=3),
        packet(b""),
        packet(event(9, 4, 5, 0) + event(12, 6, 7, 1)),
    )
    events = read_both_ways(path)
    assert event_files.find_format(path) is reader and events.sensor_size == (240, 180)
    assert_events(events, [1, 1, 7, 9, 12], [239, 0, 2, 4, 6], [0, 179, 3, 5, 7], [1, 0, 1, 0, 1])
    event_files.check_complete(path)


def test_bytes_of_one_event(tmp_path):
    """x = 100, y = 50, ON and valid, at 1,000 us: 100 * 2^17 + 50 * 4 + 2 + 1 = 0x00C800CB."""
    path = write(tmp_path, packet(bytes.fromhex("cb00c800 e8030000")))
    assert to_rows(reader.read(path)) == [(1000, 100, 50, 1)]


def test_invalid_events_are_dropped(tmp_path):
    # One outside of the sensor too: where a filter marked it, it is not looked at.
    rows = event(5, 1, 1, 1) + event(2, 999, 1, 1, valid=0) + event(6, 2, 2, 0)
    assert to_rows(read_both_ways(write(tmp_path, packet(rows)))) == [(5, 1, 1, 1), (6, 2, 2, 0)]


def test_overflows_of_the_clock_are_the_upper_bits_of_the_time(tmp_path):
    path = write(tmp_path, packet(event(2**31 - 1, 0, 0, 1)), packet(event(0, 0, 0, 0), overflows=1))
    assert read_both_ways(path).t.tolist() == [2**31 - 1, 2**31]
    path = write(tmp_path, packet(event(3, 0, 0, 1), overflows=2**31 - 1))
    assert read_both_ways(path).t.tolist() == [(2**31 - 1) * 2**31 + 3]


@pytest.mark.parametrize(
    ("sources", "expected"),
    [
        (("#Source 0: DVS128",), (128, 128)),
        (("#Source 1: DVS128", "#Source 0: DAVIS346Bcbsi"), (346, 260)),
        (("#Source 0: Processor", "#-Source 3: DAVIS208Mono"), (208, 192)),
        (("#Source 0: Unheard-of",), (34, 34)),  # the smallest common one that holds the events
    ],
)
def test_the_header_names_the_camera(tmp_path, sources, expected):
    path = write(tmp_path, packet(event(5, 33, 33, 1)), head=header(sources))
    assert read_both_ways(path).sensor_size == expected


def test_no_events_are_an_empty_recording_of_a_known_camera(tmp_path):
    events = read_both_ways(write(tmp_path, packet(b"\0" * 8, SPECIAL)))
    assert len(events) == 0 and events.sensor_size == (240, 180)
    raises_both_ways(write(tmp_path, head=header(())), "no events, and nothing else tells the sensor size")


ONE = event(5, 1, 1, 1)
REFUSED = {
    "a cut packet": (packet(ONE)[:-1], r"a packet reaches to byte \d+, the file ends at byte"),
    "a cut packet header": (packet(ONE) + packet(ONE)[:27], "ends within the header of a packet"),
    "negative number": (packet(ONE, number=-1), "got -1 events of 8 bytes"),
    "negative size": (packet(ONE, size=-8, number=1), "got 1 events of -8 bytes"),
    "compressed": (packet(ONE, kind=POLARITY - 2**15), "got -32767: compressed or corrupt"),
    "another layout": (packet(ONE * 2, size=16), "expected polarity events of 8 bytes with their time at byte 4"),
    "another place of the time": (packet(ONE, time_place=0), "got 8 bytes, time at byte 0"),
    "negative overflows": (packet(ONE, overflows=-1), "expected overflows of the clock from 0 on, got -1"),
    "negative time": (packet(event(-5, 1, 1, 1)), "expected times of 31 bits, got -5"),
    "two cameras": (packet(ONE) + packet(ONE, source=1), "polarity events of the sources 0 and 1"),
    "outside of the sensor": (packet(event(5, 240, 1, 1)), "x must be below 240, got 240 at event 0"),
    "back in time": (packet(ONE) + packet(event(4, 1, 1, 1)), "t decreases at event 1: 5 us, then 4 us"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_packets_that_are_refused(tmp_path, kind):
    content, message = REFUSED[kind]
    raises_both_ways(write(tmp_path, content), rf"a\.aedat.*{message}")


@pytest.mark.parametrize(
    ("head", "message"),
    [
        (b"#!AER-DAT3.0\r\n#Source 0: DVS128\r\n", "expected the first line #!AER-DAT3.1, got b'#!AER-DAT3.0'"),
        (header(file_format="Serial-TS"), "expected packets of the format RAW, got b'#Format: Serial-TS'"),
        (header()[:-20], "the header has no last line #!END-HEADER, got b'"),
        (b"#!AER-DAT3.1\r\n" + b"# x\r\n" * 300_000 + b"#!END-HEADER\r\n", "the header has no last line"),
    ],
)
def test_headers_that_are_refused(tmp_path, head, message):
    raises_both_ways(write(tmp_path, head=head), rf"a\.aedat: .*{message}")


def test_what_is_written_follows_the_format(tmp_path):
    rows = [(5, 1, 2, 1), (2**31 - 1, 345, 259, 0), (2**31, 0, 0, 1), (2**62 - 1, 7, 8, 0)]
    reader.write(tmp_path / "a", make_events(rows, (346, 260)))
    expected = header(("#Source 0: DAVIS346",)).replace(
        b"2016-04-01 10:00:00 (TZ+0200)", b"1970-01-01 00:00:00 (TZ+0000)"
    )
    expected += packet(event(5, 1, 2, 1) + event(2**31 - 1, 345, 259, 0))
    expected += packet(event(0, 0, 0, 1), overflows=1) + packet(event(2**31 - 1, 7, 8, 0), overflows=2**31 - 1)
    assert (tmp_path / "a").read_bytes() == expected
    assert to_rows(read_both_ways(tmp_path / "a")) == rows


def test_packets_hold_at_most_4096_events(tmp_path):
    rows = [(t, t % 100, t % 90, t % 2) for t in range(9000)]
    reader.write(tmp_path / "a", make_events(rows, (128, 128)))
    assert to_rows(reader.read(tmp_path / "a")) == rows
    content, place, counts = (tmp_path / "a").read_bytes(), len((tmp_path / "a").read_bytes()) - 3 * 28 - 8 * 9000, []
    while place < len(content):
        counts.append(struct.unpack_from("<i", content, place + 20)[0])
        place += 28 + 8 * counts[-1]
    assert counts == [4096, 4096, 808]


def test_what_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"for sensors of 128 x 128, .*640 x 480 px, got 320 x 240"):
        reader.write(tmp_path / "a", make_events([(1, 2, 3, 1)], (320, 240)))
    with pytest.raises(DataError, match=r"holds times below 2\^62 us, got 4611686018427387904"):
        reader.write(tmp_path / "a", make_events([(2**62, 2, 3, 1)]))
    with pytest.raises(DataError, match="t decreases at event 1"):
        reader.write(tmp_path / "a", make_events([(5, 2, 3, 1), (4, 2, 3, 1)]))
    assert not (tmp_path / "a").exists()


def test_an_empty_recording_is_written(tmp_path):
    reader.write(tmp_path / "a", make_events([], (240, 180)))
    events = reader.read(tmp_path / "a")
    assert len(events) == 0 and events.sensor_size == (240, 180) and events.t.dtype == np.int64


@pytest.mark.parametrize("lost", [800 * 8, 800 * 8 - 3])
def test_a_file_that_becomes_shorter_while_it_is_read_is_an_error(tmp_path, lost):
    path = tmp_path / "a.aedat3"
    reader.write(path, make_events([(t, 0, 0, 1) for t in range(50_000)]))
    chunks = reader.read_chunks(path, 100)
    next(chunks)
    with path.open("r+b") as file:  # within the last packet
        file.truncate(path.stat().st_size - lost)
    with pytest.raises(DataError, match=r"a\.aedat3: the file became shorter while it was read"):
        list(chunks)
