"""Formats of fixed-size records (DAT, ATIS, AEDAT 2.0): files written with struct, and the rules one at a time."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from ctlev_core import plugins
from ctlev_core.events import files as event_files
from ctlev_core.events.decoding import event_chunks, record_files
from data_contracts.errors import DataError
from data_contracts.events import Events

Row = tuple[int, int, int, int]


def make_events(rows: list[Row], sensor_size: tuple[int, int]) -> Events:
    t, x, y, p = np.array(rows, np.int64).reshape(-1, 4).T
    return Events(t.copy(), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), sensor_size)


def to_rows(events: Events) -> list[Row]:
    return list(zip(events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True))


def read_both_ways(path: Path, name: str) -> Events:
    """Read whole and in chunks of two, which must agree."""
    module = plugins.load("formats", name)
    events = module.read(path)
    chunks = list(module.read_chunks(path, 2))
    assert to_rows(event_chunks.concatenate(chunks)) == to_rows(events)
    assert all(chunk.sensor_size == events.sensor_size for chunk in chunks)
    return events


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are decoded two records at a time, so that every state is carried from block to block."""
    monkeypatch.setattr(record_files, "_SMALLEST_BLOCK", 2)


def raises_both_ways(path: Path, name: str, match: str) -> None:
    module = plugins.load("formats", name)
    with pytest.raises(DataError, match=match):
        module.read(path)
    with pytest.raises(DataError, match=match):
        list(module.read_chunks(path, 2))


# DAT ---------------------------------------------------------------------------------------------------------------

SIZED = "% Data file containing CD events.\n% Version 2\n% Height 240\n% Width 304\n"


def write_dat(path: Path, rows: list[Row], header: str = SIZED, kind: int = 12, size: int = 8) -> Path:
    records = b"".join(struct.pack("<II", t, p << 28 | y << 14 | x) for t, x, y, p in rows)
    path.write_bytes(header.encode() + bytes([kind, size]) + records)
    return path


@pytest.mark.parametrize("kind", [0, 12])
def test_dat_of_both_event_types(kind, tmp_path):
    rows = [(0, 0, 0, 0), (7, 303, 239, 1), (7, 5, 6, 1)]
    path = write_dat(tmp_path / "a.dat", rows, kind=kind)
    assert event_files.find_format(path).__name__.endswith(".dat")
    events = read_both_ways(path, "dat")
    assert to_rows(events) == rows
    assert events.sensor_size == (304, 240)


def test_dat_without_a_size_gets_the_smallest_sensor(tmp_path):
    path = write_dat(tmp_path / "a.dat", [(0, 119, 99, 0)], header="% Data file containing 2d events.\n", kind=0)
    assert read_both_ways(path, "dat").sensor_size == (304, 240)
    path = write_dat(tmp_path / "a.dat", [(0, 304, 99, 0)], header="% Version 2\n")
    assert read_both_ways(path, "dat").sensor_size == (320, 320)


def test_dat_of_the_first_version_is_refused(tmp_path):
    path = write_dat(tmp_path / "a.dat", [(0, 1, 1, 0)], header="% Version 1\n")
    raises_both_ways(path, "dat", "expected DAT of version 2, got version 1, which packs x, y and p otherwise")


def test_dat_clock_overflows_at_32_bits(tmp_path):
    clock = [0, 2**31, 2**32 - 1, 0, 2**31 - 1, 2**32 - 2, 5]
    path = write_dat(tmp_path / "a.dat", [(t, 1, 1, 0) for t in clock])
    expected = [0, 2**31, 2**32 - 1, 2**32, 2**32 + 2**31 - 1, 2**33 - 2, 2**33 + 5]
    assert read_both_ways(path, "dat").t.tolist() == expected


def test_dat_overflows_are_found_in_every_block_of_the_decoder(tmp_path):
    # Blocks of 8,192 records take a shorter way where the clock never drops.
    t = np.arange(40_000, dtype=np.int64) * 500_000
    rows = [(int(value) % 2**32, 1, 1, 0) for value in t]
    assert read_both_ways(write_dat(tmp_path / "a.dat", rows), "dat").t.tolist() == t.tolist()


def test_dat_time_that_jumps_back_names_the_event(tmp_path):
    path = write_dat(tmp_path / "a.dat", [(9, 0, 0, 0), (9, 0, 0, 0), (8, 0, 0, 0)])
    raises_both_ways(path, "dat", r"a\.dat: t decreases at event 2: 9 us, then 8 us")


@pytest.mark.parametrize(("x", "y", "message"), [(304, 0, "x must be below 304"), (0, 240, "y must be below 240")])
def test_dat_one_pixel_beyond_the_sensor_is_an_error(x, y, message, tmp_path):
    raises_both_ways(write_dat(tmp_path / "a.dat", [(0, 303, 239, 0), (1, x, y, 0)]), "dat", message)


def test_dat_broken_files(tmp_path):
    path = write_dat(tmp_path / "a.dat", [])
    raises_both_ways(path, "dat", "the file ends after its .*-byte header, expected DAT records")
    content = write_dat(path, [(0, 0, 0, 0), (1, 1, 1, 1)]).read_bytes()
    for cut in range(1, 8):
        path.write_bytes(content[:-cut])
        raises_both_ways(path, "dat", r"a\.dat: cut inside a record")
    raises_both_ways(write_dat(path, [(0, 0, 0, 0)], kind=40), "dat", r"got type 40 \(external trigger\)")
    path.write_bytes(SIZED.encode())
    with pytest.raises(DataError, match="not an event file"):
        event_files.find_format(path)


def test_dat_writer_refuses_gaps_a_reader_could_not_count(tmp_path):
    module = plugins.load("formats", "dat")
    with pytest.raises(DataError, match="before event 1 are more than half an overflow"):
        module.write(tmp_path / "a.dat", make_events([(0, 0, 0, 0), (2**31, 0, 0, 0)], (304, 240)))
    with pytest.raises(DataError, match="cannot hold a recording without events"):
        module.write(tmp_path / "a.dat", make_events([], (304, 240)))


# ATIS --------------------------------------------------------------------------------------------------------------


def write_atis(path: Path, records: list[Row]) -> Path:
    """Rows of (23-bit time, x, y, p), markers among them."""
    path.write_bytes(b"".join(struct.pack(">BBBH", x, y, p << 7 | t >> 16, t & 0xFFFF) for t, x, y, p in records))
    return path


def test_atis_overflow_markers_add_to_all_later_times(tmp_path):
    records = [
        (5, 1, 2, 1),
        (8000, 3, 4, 0),
        (0, 0, 240, 0),
        (10, 33, 33, 1),
        (0, 9, 240, 1),
        (0, 0, 240, 0),
        (1, 0, 0, 0),
    ]
    path = write_atis(tmp_path / "a.bin", records)
    assert to_rows(read_both_ways(path, "atis")) == [
        (5, 1, 2, 1),
        (8000, 3, 4, 0),
        (8192 + 10, 33, 33, 1),
        (3 * 8192 + 1, 0, 0, 0),
    ]


def test_atis_times_use_all_23_bits(tmp_path):
    path = write_atis(tmp_path / "a.bin", [(0x7FFFFE, 255, 239, 0), (0x7FFFFF, 0, 0, 1)])
    events = read_both_ways(path, "atis")
    assert to_rows(events) == [(0x7FFFFE, 255, 239, 0), (0x7FFFFF, 0, 0, 1)]
    assert events.sensor_size == (304, 240)


@pytest.mark.parametrize(("x", "y", "expected"), [(33, 33, (34, 34)), (34, 0, (240, 180)), (0, 180, (304, 240))])
def test_atis_sensor_is_the_smallest_that_holds_all_events(x, y, expected, tmp_path):
    assert read_both_ways(write_atis(tmp_path / "a.bin", [(0, x, y, 0)]), "atis").sensor_size == expected


def test_atis_broken_files(tmp_path):
    path = tmp_path / "a.bin"
    raises_both_ways(write_atis(path, [(0, 0, 241, 0)]), "atis", "y = 241 px fit none of the known sensors 34 x 34")
    raises_both_ways(write_atis(path, [(0, 0, 240, 0)]), "atis", "expected events, got overflow markers alone")
    raises_both_ways(write_atis(path, [(5, 0, 0, 0), (4, 0, 0, 0)]), "atis", "t decreases at event 1: 5 us, then 4 us")
    path.write_bytes(b"")
    raises_both_ways(path, "atis", "the file is empty")
    path.write_bytes(b"123456")
    raises_both_ways(path, "atis", "cut inside a record: 6 bytes")


def test_atis_is_recognised_by_plausible_times_alone(tmp_path):
    module = plugins.load("formats", "atis")
    random = np.random.default_rng(0)
    times = np.sort(random.integers(0, 300_000, 5000)).tolist()
    path = write_atis(tmp_path / "a.anything", [(t, 5, 6, 1) for t in times])
    assert event_files.find_format(path) is module
    shuffled = random.permutation(times).tolist()
    for content in (
        write_atis(path, [(t, 5, 6, 1) for t in shuffled]).read_bytes(),
        b"\0" * 5000,
        b"12345" * 1000,
        random.bytes(5000),
        b"",
    ):
        path.write_bytes(content)
        assert not module.sniff(path)
    times[1000] = times[999] - 1  # one slip is for `read` to name
    write_atis(path, [(t, 5, 6, 1) for t in times])
    with pytest.raises(DataError, match="t decreases at event 1000"):
        event_files.read_events_file(path)
    few = write_atis(tmp_path / "few.bin", [(0, 5, 200, 1)])
    assert module.sniff(few)
    assert not module.sniff(few.rename(tmp_path / "few.dat"))


# AEDAT 2.0 ---------------------------------------------------------------------------------------------------------


def write_aedat2(path: Path, records: list[tuple[int, int]], chip: str | None = "DAVIS240C") -> Path:
    lines = "#!AER-DAT2.0\r\n" + (f"# AEChip: eu.seebetter.ini.chips.davis.{chip}\r\n" if chip else "")
    path.write_bytes(lines.encode() + b"".join(struct.pack(">II", *record) for record in records))
    return path


def davis(x: int, y: int, p: int, camera: int = 0) -> int:
    return y << 22 | x << 12 | p << 11 | camera


def test_aedat2_image_is_turned_upright(tmp_path):
    path = write_aedat2(tmp_path / "a.aedat", [(davis(0, 0, 1), 3), (davis(239, 179, 0), 3), (davis(1, 2, 0), 4)])
    events = read_both_ways(path, "aedat2")
    assert event_files.find_format(path).__name__.endswith(".aedat2")
    assert events.sensor_size == (240, 180)
    assert to_rows(events) == [(3, 239, 179, 1), (3, 0, 0, 0), (4, 238, 177, 0)]


def test_aedat2_samples_and_special_events_are_skipped(tmp_path):
    records = [(0x80000000 | davis(1, 1, 0), 1), (0x400, 2), (davis(5, 5, 1), 3), (0x80000FFF, 3)]
    assert len(read_both_ways(write_aedat2(tmp_path / "a.aedat", records), "aedat2")) == 1


def test_aedat2_of_several_cameras_names_the_dataset(tmp_path):
    path = write_aedat2(tmp_path / "a.aedat", [(davis(1, 1, 0, 2), 1), (davis(1, 1, 0, 3), 2)], "DAVIS346B")
    raises_both_ways(path, "aedat2", "of 2 cameras, expected one; for recordings of DHP19 use the dataset dhp19")


def test_aedat2_sensor_size_without_a_name_comes_from_the_events(tmp_path):
    for (x, y), expected in {(0, 1): (240, 180), (240, 0): (346, 260), (346, 1): (640, 480)}.items():
        path = write_aedat2(tmp_path / "a.aedat", [(davis(x, y, 0), 1), (davis(20, 0, 0), 1)], None)
        assert read_both_ways(path, "aedat2").sensor_size == expected
    path = write_aedat2(tmp_path / "a.aedat", [(5, 1)], None)
    raises_both_ways(path, "aedat2", "the header names no camera, and none of the 1 addresses passes 16 bits")
    path = write_aedat2(tmp_path / "a.aedat", [(5, 1)], "CochleaAMS1c")
    raises_both_ways(path, "aedat2", "unknown camera 'CochleaAMS1c'; known: DVS128")


def test_aedat2_dvs128_layout(tmp_path):
    records = [(3 << 8 | 2 << 1 | 1, 5), (0x8000, 6), (127 << 8 | 127 << 1, 7)]
    events = read_both_ways(write_aedat2(tmp_path / "a.aedat", records, "DVS128"), "aedat2")
    assert to_rows(events) == [(5, 125, 124, 0), (7, 0, 0, 1)]
    raises_both_ways(write_aedat2(tmp_path / "a.aedat", [(1 << 16, 0)], "DVS128"), "aedat2", "has 16-bit addresses")


def test_aedat2_beyond_the_sensor_or_back_in_time_is_an_error(tmp_path):
    path = write_aedat2(tmp_path / "a.aedat", [(davis(240, 0, 0), 1)])
    raises_both_ways(path, "aedat2", "x must be below 240, got 240 at event 0")
    path = write_aedat2(tmp_path / "a.aedat", [(davis(0, 0, 0), 5), (davis(0, 0, 0), 4)])
    raises_both_ways(path, "aedat2", "t decreases at event 1: 5 us, then 4 us")
    path = write_aedat2(tmp_path / "a.aedat", [(davis(0, 0, 0), 2**32 - 1), (davis(0, 0, 0), 4)])
    assert read_both_ways(path, "aedat2").t.tolist() == [2**32 - 1, 2**32 + 4]
