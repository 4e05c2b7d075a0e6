"""Event files of several formats: against published numbers, round trips, and files that are broken on purpose."""

from __future__ import annotations

import tempfile
from pathlib import Path

import aedat4_writer
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from format_helpers import make_events, to_rows
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core import plugins
from ctlev_core.events import files as event_files
from data_contracts.errors import DataError

REAL = Path(__file__).resolve().parents[3].parent / "shared" / "real" / "events"
REAL_AEDAT4 = REAL / "person" / "tonic_sample.aedat4"
REAL_EVT2 = REAL / "spot" / "expelliarmus_evt2.raw"
REAL_EVT3 = REAL / "street" / "expelliarmus_evt3.raw"
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason="the real recordings are not beside the project")

WRITABLE = ("evt2", "evt3", "parquet")
SIZE = (640, 480)


# Real recordings ---------------------------------------------------------------------------------------------------


@needs_real
@pytest.mark.parametrize(
    ("path", "format_name", "sensor_size", "expected"),
    [
        (REAL_AEDAT4, "aedat4", (320, 240), (111_954, 589_917, None, None, 55_023, 56_931)),
        (REAL_EVT3, "evt3", (1280, 720), (219_596, 8_801, 11_718_656, 11_727_457, 115_532, 104_064)),
        (REAL_EVT2, "evt2", (640, 480), (539_481, 50_000, 1_317_888, 1_367_888, 367_855, 171_626)),
    ],
    ids=["aedat4", "evt3", "evt2"],
)
def test_real_recordings_give_the_published_numbers(path, format_name, sensor_size, expected):
    # Counts and durations on which several independent decoders agree (for EVT3's times: the specification).
    assert event_files.find_format(path).__name__.endswith(f".{format_name}")
    events = event_files.read_events_file(path)
    names = ("num_events", "duration_us", "t_first_us", "t_last_us", "num_positive", "num_negative")
    got = event_files.summarise(events)
    assert {name: got[name] for name, value in zip(names, expected, strict=True) if value is not None} == {
        name: value for name, value in zip(names, expected, strict=True) if value is not None
    }
    assert set(got) == set(names)
    assert events.sensor_size == sensor_size


@needs_real
@pytest.mark.parametrize("name", WRITABLE)
def test_a_real_recording_survives_every_format(name, tmp_path):
    events = event_files.read_events_file(REAL_EVT3)
    plugins.load("formats", name).write(tmp_path / "copy", events)
    again = event_files.read_events_file(tmp_path / "copy")
    assert to_rows(again) == to_rows(events)
    assert again.sensor_size == events.sensor_size


@needs_real
@pytest.mark.parametrize("keep", [0.0, 0.05, 0.5, 0.98])
def test_a_cut_aedat4_is_an_error_not_a_shorter_recording(keep, tmp_path):
    content = REAL_AEDAT4.read_bytes()
    path = tmp_path / "cut.aedat4"
    path.write_bytes(content[: max(int(keep * len(content)), 12)])
    with pytest.raises(DataError, match=r"cut\.aedat4: not a complete AEDAT 4 file"):
        event_files.read_events_file(path)


@pytest.mark.parametrize("name", ["aedat2", "aedat3", "aedat4", "dat", "evt2", "evt3", "hdf5", "npy", "npz", "parquet"])
def test_a_cut_is_found_without_decoding(name, tmp_path):
    path = tmp_path / "recording"
    rows = [(50 + 3 * i, i % 30, i % 20, i % 2) for i in range(400)]
    if name == "aedat4":  # without a table of packets, in which nothing is lost
        packets = [aedat4_writer.packet(rows[start : start + 100]) for start in range(0, 400, 100)]
        path.write_bytes(aedat4_writer.aedat4(packets))
    else:
        sizes = {"aedat2": (346, 260), "aedat3": (346, 260), "npy": (34, 34)}
        plugins.load("formats", name).write(path, make_events(rows, sizes.get(name, (304, 240))))
    event_files.check_complete(path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) - 51])  # within a record of whatever size
    with pytest.raises(DataError, match=r"cut inside|not a complete"):
        event_files.check_complete(path)


def test_files_of_no_event_format_are_left_to_their_readers(tmp_path):
    path = tmp_path / "labels.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file")
    event_files.check_complete(path)


@needs_real
def test_real_recordings_are_complete():
    for path in (REAL_AEDAT4, REAL_EVT2, REAL_EVT3):
        event_files.check_complete(path)


@needs_real
@pytest.mark.parametrize("first", [30, 300_000], ids=["header, where the decoder panics", "packet"])
def test_a_corrupt_aedat4_names_the_file(first, tmp_path):
    content = bytearray(REAL_AEDAT4.read_bytes())
    content[first : first + 370] = b"\xff" * 370
    path = tmp_path / "corrupt.aedat4"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"corrupt\.aedat4: not a complete AEDAT 4 file"):
        event_files.read_events_file(path)


# Round trips -------------------------------------------------------------------------------------------------------


# Steps reach past the half range of both clocks (2^23 and 2^33 us), where a reader must not mistake one for the other.
STEPS = st.one_of(st.integers(0, 100), st.integers(0, 2**25), st.sampled_from([2**23, 2**24, 2**33 + 1, 2**34, 2**35]))
ROWS = st.lists(st.tuples(STEPS, st.integers(0, 639), st.integers(0, 479), st.integers(0, 1)), max_size=20)


@pytest.mark.parametrize("name", WRITABLE)
@settings(max_examples=60, deadline=None)
@given(steps=ROWS)
def test_write_then_read_returns_the_events(name, steps):
    times = np.cumsum([step for step, *_ in steps], dtype=np.int64)
    events = make_events([(int(t), *rest) for t, (_, *rest) in zip(times, steps, strict=True)])
    module = plugins.load("formats", name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "events.bin"
        module.write(path, events)
        assert [other for other in plugins.names("formats") if plugins.load("formats", other).sniff(path)] == [name]
        again = module.read(path)
    assert to_rows(again) == to_rows(events)
    assert again.sensor_size == SIZE
    assert [again.t.dtype, again.x.dtype, again.y.dtype, again.p.dtype] == [np.int64, np.uint16, np.uint16, np.uint8]
    assert all(column.flags.writeable and column.flags.c_contiguous for column in (again.t, again.x, again.y, again.p))


@pytest.mark.parametrize("name", WRITABLE)
def test_writers_refuse_events_that_break_their_promises(name, tmp_path):
    module = plugins.load("formats", name)
    with pytest.raises(DataError, match="t decreases at event 1"):
        module.write(tmp_path / "file", make_events([(5, 0, 0, 1), (4, 0, 0, 1)]))
    assert not (tmp_path / "file").exists()


def test_write_events_parquet_leaves_only_the_finished_file(tmp_path):
    events = make_events([(1, 2, 3, 1)])
    event_files.write_events_parquet(tmp_path / "a.parquet", events)
    assert [path.name for path in tmp_path.iterdir()] == ["a.parquet"]
    assert to_rows(event_files.read_events_file(tmp_path / "a.parquet")) == [(1, 2, 3, 1)]


# Broken files ------------------------------------------------------------------------------------------------------


def test_reading_with_the_wrong_format_is_an_error(tmp_path):
    path = tmp_path / "a.raw"
    plugins.load("formats", "evt3").write(path, make_events([(0, 9, 8, 1)]))
    with pytest.raises(DataError, match="expected an EVT2 header, got EVT3"):
        plugins.load("formats", "evt2").read(path)
    with pytest.raises(DataError, match="not a complete AEDAT 4 file"):
        plugins.load("formats", "aedat4").read(path)
    with pytest.raises(DataError, match="not a complete Parquet file"):
        plugins.load("formats", "parquet").read(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"%",
        b"% evt 2.1\n% geometry 640x480\n",
        b"% format EVT21;height=1;width=1\n",
        b"\x00\xff" * 500,
        b"% \xff\n",
    ],
)
def test_an_unknown_file_lists_the_known_formats(content, tmp_path):
    path = tmp_path / "a.raw"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"a\.raw: not an event file.*aedat4 \(\.aedat4\).*evt3 \(\.raw, \.evt3\)"):
        event_files.read_events_file(path)


def test_the_content_decides_not_the_suffix(tmp_path):
    path = tmp_path / "misnamed.aedat4"
    plugins.load("formats", "parquet").write(path, make_events([(0, 0, 0, 1)]))
    assert event_files.find_format(path).__name__ == "ctlev_core.formats.parquet"


def test_a_missing_file_and_a_folder_are_errors(tmp_path):
    with pytest.raises(DataError, match="got nothing there"):
        event_files.find_format(tmp_path / "absent.raw")
    with pytest.raises(DataError, match="got a folder"):
        event_files.find_format(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.drop_columns("p"), "expected the columns"),
        (lambda table: table.set_column(0, "t", pa.array([1, 2], pa.int32())), "expected the columns"),
        (lambda table: table.set_column(0, "t", pa.array([1, None], pa.int64())), "expected no nulls"),
        (
            lambda table: table.replace_schema_metadata(None),
            "expected the metadata sensor_size as WIDTHxHEIGHT, got ''",
        ),
        (lambda table: table.replace_schema_metadata({"sensor_size": "6x4"}), "x must be below 6, got 7 at event 1"),
        (lambda table: table.set_column(0, "t", pa.array([2, 1], pa.int64())), "t decreases at event 1"),
    ],
)
def test_parquet_with_other_content_is_an_error(change, message, tmp_path):
    path = tmp_path / "a.parquet"
    plugins.load("formats", "parquet").write(path, make_events([(1, 0, 0, 1), (2, 7, 0, 1)]))
    pq.write_table(change(pq.read_table(path)), path)
    with pytest.raises(DataError, match=message):
        event_files.read_events_file(path)


def test_a_cut_parquet_file_is_an_error(tmp_path):
    path = tmp_path / "a.parquet"
    plugins.load("formats", "parquet").write(path, make_events([(1, 0, 0, 1)]))
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(DataError, match=r"a\.parquet: not a complete Parquet file"):
        event_files.read_events_file(path)


def test_a_parquet_file_that_promises_more_rows_than_it_has(tmp_path):
    # As found by fuzzing: Arrow reads what there is and says nothing.
    path = tmp_path / "a.parquet"
    parquet = plugins.load("formats", "parquet")
    parquet.write(path, make_events([(t, 2, 3, t % 2) for t in range(5)]))
    content = path.read_bytes()
    footer = len(content) - 8 - int.from_bytes(content[-8:-4], "little")
    stated = bytes([0x16, 2 * 5])  # Thrift's compact protocol: an i64 field, and the number in zigzag
    places = [place for place in range(footer, len(content)) if content.startswith(stated, place)]
    assert len(places) == 6  # of the file, of its row group, of its four columns
    refused = 0
    for place in places:
        path.write_bytes(content[: place + 1] + bytes([2 * 34]) + content[place + 2 :])
        metadata = pq.ParquetFile(path).metadata
        if {metadata.num_rows, metadata.row_group(0).num_rows} == {5}:
            continue  # a column's number is not looked at
        reads = (lambda: parquet.read(path), lambda: list(parquet.read_chunks(path, 3)))
        for read in (*reads, lambda: parquet.read_range(path, 0, 2)):
            with pytest.raises(DataError, match=r"a\.parquet: not a complete Parquet file: .* rows, expected"):
                read()
        refused += 1
    assert refused == 2


def test_parquet_in_a_folder_named_like_a_partition_has_no_extra_column(tmp_path):
    path = tmp_path / "class=person" / "a.parquet"
    path.parent.mkdir()
    plugins.load("formats", "parquet").write(path, make_events([(1, 2, 3, 0)]))
    assert to_rows(event_files.read_events_file(path)) == [(1, 2, 3, 0)]


def test_summary_of_a_few_events_and_of_none():
    assert event_files.summarise(make_events([(7, 0, 0, 1), (7, 1, 0, 0), (10, 2, 0, 1)])) == {
        "num_events": 3,
        "duration_us": 3,
        "t_first_us": 7,
        "t_last_us": 10,
        "num_positive": 2,
        "num_negative": 1,
    }
    assert set(event_files.summarise(make_events([])).values()) == {0}


def test_sensors_of_absurd_sizes_are_refused(tmp_path):
    """Such a size makes every window of events gigabytes."""
    events, size = make_events([(0, 0, 0, 1)]), (60_000, 50_000)
    evt3, parquet, hdf5 = (plugins.load("formats", name) for name in ("evt3", "parquet", "hdf5"))
    parquet.write(tmp_path / "a.parquet", events)
    table = pq.read_table(tmp_path / "a.parquet").replace_schema_metadata({"sensor_size": "60000x50000"})
    pq.write_table(table, tmp_path / "a.parquet")
    hdf5.write(tmp_path / "a.h5", events)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["events"].attrs["sensor_size"] = size
    evt3.write(tmp_path / "a.raw", events)
    content = (tmp_path / "a.raw").read_bytes().replace(b"640", b"60000").replace(b"480", b"50000")
    (tmp_path / "a.raw").write_bytes(content)
    (tmp_path / "a.aedat4").write_bytes(aedat4_writer.aedat4([aedat4_writer.packet([(0, 0, 0, 1)])], *size))
    for name in ("a.parquet", "a.h5", "a.raw", "a.aedat4"):
        with pytest.raises(DataError, match=rf"{name}: sensor_size must be of 16777216 px at most, got 60000 x 50000"):
            event_files.read_events_file(tmp_path / name)
