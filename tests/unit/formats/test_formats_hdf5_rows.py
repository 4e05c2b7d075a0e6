"""HDF5 of Prophesee: rows of events, plain, with HDF5's filters, and with chunks of ECF from an encoder of our own."""

from __future__ import annotations

import struct

import ecf_writer
import h5py
import numpy as np
import pytest
from format_helpers import P, T, X, Y, assert_events, raises_both_ways, read_both_ways, to_rows
from hypothesis import given
from hypothesis import strategies as st

from ctlev_core.events.decoding import ecf_decoding
from ctlev_core.formats import hdf5 as reader


def decode(content, count):
    t, x, y, p = (np.empty(count, kind) for kind in ("i8", "u2", "u2", "u1"))
    problem = ecf_decoding.decode_ecf(np.frombuffer(content, np.uint8), t, x, y, p)
    rows = zip(t.tolist(), x.tolist(), y.tolist(), p.tolist(), strict=True)
    return ecf_decoding.PROBLEMS[problem], [] if problem else list(rows)


def write_rows(path, name="CD/events", geometry="640x480", fields=ecf_writer.ROW, **options):
    rows = np.zeros(4, fields)
    for key, values in zip("txyp", (T, X, Y, P), strict=True):
        if key in (rows.dtype.names or ()):
            rows[key] = values
    with h5py.File(path, "w") as file:
        file.create_dataset(name, data=rows, **options)
        if geometry:
            file.attrs["geometry"] = geometry
    return path


# Rows --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options", [{}, {"compression": "gzip", "chunks": (3,), "shuffle": True}], ids=["plain", "gzip"]
)
@pytest.mark.parametrize("name", ["CD/events", "events"])
def test_rows_are_read(tmp_path, name, options):
    events = read_both_ways(write_rows(tmp_path / "a.h5", name, **options))
    assert_events(events)
    assert events.sensor_size == (640, 480)


def test_the_sensor_is_the_geometry_or_the_smallest(tmp_path):
    assert read_both_ways(write_rows(tmp_path / "a.h5", geometry=None)).sensor_size == (346, 260)
    assert read_both_ways(write_rows(tmp_path / "b.h5", geometry=np.bytes_(b"1280x720"))).sensor_size == (1280, 720)
    raises_both_ways(
        write_rows(tmp_path / "c.h5", geometry="large"), r"c\.h5: expected the attribute geometry as WIDTH"
    )


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ([("t", "i8"), ("x", "u2"), ("y", "u2")], r"CD/events: no column p .*; got t, x, y"),
        ([("t", "i8"), ("x", "u2", 2), ("y", "u2"), ("p", "u1")], "CD/events: expected numbers"),
        ([("t", "i8"), ("x", "S3"), ("y", "u2"), ("p", "u1")], "CD/events: expected numbers"),
    ],
)
def test_rows_of_other_fields_are_refused(tmp_path, fields, message):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["CD/events"] = np.zeros(3, fields)
    raises_both_ways(tmp_path / "a.h5", rf"a\.h5: {message}")


def test_a_table_of_rows_is_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["CD/events"] = np.zeros((3, 2), ecf_writer.ROW)
    raises_both_ways(tmp_path / "a.h5", r"CD/events: expected rows \[N\], got \(3, 2\)")


# ECF ---------------------------------------------------------------------------------------------------------------

BY_HAND = {
    # The first event of Prophesee's own tests: y << 12 | x << 1 | p is 0x2002, the upper 24 bits of the first word.
    "one event": ("06000000 0400000000000000 01 00022000 00000000 00000000", [(4, 1, 2, 0)]),
    # Three events of theirs, of one time and row: x << 1 | p is 0x001, 0x015 and 0x029.
    "packed x": (
        "0d000000 1027000000000000 03 e302 1500 2901 0000",
        [(10_000, 0, 23, 1), (10_000, 10, 23, 1), (10_000, 20, 23, 1)],
    ),
    # x = 5 with 6 and 10 in its mask, 10001; then 300 us = 0x12c later x = 3 alone.
    "masks": (
        "10000000 6400000000000000 03 fcf2f1 01 2401 b100 6000 83 01",
        [(100, 5, 9, 1), (100, 6, 9, 1), (100, 10, 9, 1), (400, 3, 9, 0)],
    ),
    "long runs": (
        "a0000000 0100000000000000 0f2800 5f002800" + "e000" * 40 + "a8",
        [(1, 7, 2, 1)] * 40,
    ),
}


@pytest.mark.parametrize("kind", BY_HAND)
def test_chunks_encoded_by_hand(kind):
    content, rows = BY_HAND[kind]
    layout = {"one event": 2, "packed x": 1}.get(kind, 0)
    assert decode(bytes.fromhex(content), len(rows)) == ("", rows)
    assert ecf_writer.encode(rows, layout) == bytes.fromhex(content)  # the encoder of the tests below is right


STEPS = st.one_of(st.integers(0, 20), st.sampled_from([0, 14, 15, 16, 255, 2**40]))
ROWS = st.lists(
    st.tuples(STEPS, st.integers(0, 2047), st.integers(0, 2047), st.integers(0, 1), st.integers(1, 150), st.booleans()),
    min_size=1,
    max_size=12,
)


@given(start=st.sampled_from([0, 5, 2**50]), runs=ROWS, layout=st.integers(0, 3), stray_bits=st.booleans())
def test_every_layout_gives_the_events(start, runs, layout, stray_bits):
    rows, t = [], start
    for step, x, y, p, count, same in runs:
        t += step
        rows += [(t, x if same else min(x + place, 2047), y, p) for place in range(count)]
    assert decode(ecf_writer.encode(rows, layout, stray_bits), len(rows)) == ("", rows)


def make_rows(count):
    random = np.random.default_rng(0)
    t = np.cumsum(random.integers(0, 30, count)) + 1_000_000
    columns = (t, random.integers(0, 1280, count), random.integers(0, 720, count), random.integers(0, 2, count))
    return list(zip(*(column.tolist() for column in columns), strict=True))


@pytest.mark.parametrize("padded", [False, True])
def test_files_of_ecf_are_read(tmp_path, padded):
    """HDF5 pads the last chunk with rows of zeros, whose time goes back: the encoder repeats the one before."""
    rows = make_rows(100)
    parts = [rows[start : start + 30] for start in range(0, 100, 30)]
    if padded:
        parts[-1] = parts[-1] + [(parts[-1][-1][0], 0, 0, 0)] * 20
    chunks = [ecf_writer.encode(part, layout) for part, layout in zip(parts, (0, 1, 2, 0), strict=True)]
    events = read_both_ways(ecf_writer.write(tmp_path / "a.h5", chunks, 100, 30))
    assert to_rows(events) == rows and events.sensor_size == (1280, 720)


def test_each_chunk_is_decoded_once_a_pass(tmp_path, monkeypatch):
    decoded = []
    decode_ecf = ecf_decoding.decode_ecf
    monkeypatch.setattr(ecf_decoding, "decode_ecf", lambda *given: decoded.append(1) or decode_ecf(*given))
    rows = make_rows(90)
    chunks = [ecf_writer.encode(rows[start : start + 30], 0) for start in range(0, 90, 30)]
    path = ecf_writer.write(tmp_path / "a.h5", chunks, 90, 30)
    assert sum(map(len, reader.read_chunks(path, 7))) == 90 and len(decoded) == 3


GOOD = ecf_writer.encode(make_rows(30), 0)
COUNT = struct.Struct("<I")
BROKEN = {
    "cut": (GOOD[:-1], "not a complete chunk: it ends too early"),
    "shorter than its head": (GOOD[:11], "expected from 12 to 589827 bytes, got 11"),
    "fewer events": (COUNT.pack(29 << 2) + GOOD[4:], "expected from 30 to 65535 events, got 29"),
    "too many events": (COUNT.pack(65_536 << 2) + GOOD[4:], "expected from 30 to 65535 events, got 65536"),
    "a long run": (GOOD[:12] + b"\x0f\xff\xff" + GOOD[13:], "a run passes its number of events"),
    "a long difference": (GOOD[:12] + b"\xf1" * 17 + GOOD[12:], "a time difference has more than 64 bits"),
    "runs of nothing": (GOOD[:12] + bytes(1000), "it ends too early"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_chunks_are_refused(tmp_path, kind):
    content, message = BROKEN[kind]
    path = ecf_writer.write(tmp_path / "a.h5", [GOOD, content], 60, 30)
    raises_both_ways(path, rf"a\.h5: CD/events: chunk from row 30 on: .*{message}")


@pytest.mark.parametrize("layout", [0, 1, 2])
def test_a_chunk_cut_anywhere_is_refused(layout):
    rows = [(5, 1, 1, 1)] * 200 + make_rows(30)
    content = ecf_writer.encode(rows, layout)
    assert decode(content, len(rows)) == ("", rows)
    for stop in range(12, len(content)):
        assert decode(content[:stop], len(rows))[0] == "it ends too early"


def test_a_missing_chunk_is_refused(tmp_path):
    path = ecf_writer.write(tmp_path / "a.h5", [GOOD], 60, 30)
    raises_both_ways(path, r"a\.h5: CD/events: chunk from row 30 on: expected it to be stored with the filter ECF")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"shuffle": True}, r"expected ECF as its only filter, got the filters \[2, 36559\]"),
        ({"filter_mask": 1}, "chunk from row 0 on: expected it to be stored with the filter ECF, got none"),
        (
            {"fields": np.dtype([(name, "i4") for name in ("ts", "x", "y", "p")])},
            "expected the fields x, y, p, t, got ts, x, y, p",
        ),
    ],
)
def test_other_uses_of_the_filter_are_refused(tmp_path, options, message):
    path = ecf_writer.write(tmp_path / "a.h5", [GOOD], 30, 30, **options)
    raises_both_ways(path, rf"a\.h5: CD/events: {message}")


def test_events_beyond_the_geometry_are_refused(tmp_path):
    chunk = ecf_writer.encode([(5, 640, 1, 1)], 0)
    raises_both_ways(ecf_writer.write(tmp_path / "a.h5", [chunk], 1, 30, "640x480"), "x must be below 640, got 640 at")


def test_an_empty_recording_of_ecf(tmp_path):
    events = reader.read(ecf_writer.write(tmp_path / "a.h5", [], 0, 30))
    assert len(events) == 0 and events.sensor_size == (1280, 720)
