"""Reading and writing event files of any format: in chunks, in stretches, and one format for each file."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core import plugins
from ctlev_core.events import files as event_files
from ctlev_core.events.decoding import event_chunks
from data_contracts.errors import DataError
from data_contracts.events import Events

REAL = Path(__file__).resolve().parents[3].parent / "shared" / "real" / "events"
SIZE = (640, 480)
WRITABLE = {
    "aedat2": (346, 260),
    "aedat3": (346, 260),
    "aedat4": SIZE,
    "atis": (240, 180),
    "csv": SIZE,
    "dat": SIZE,
    "evt2": SIZE,
    "evt3": SIZE,
    "hdf5": SIZE,
    "npy": SIZE,
    "npz": SIZE,
    "parquet": SIZE,
}
SUFFIXES = {"atis": ".bin"}


def make_events(
    num_events: int, sensor_size: tuple[int, int] = SIZE, duration_us: int = 10**6, seed: int = 0
) -> Events:
    random = np.random.default_rng(seed)
    width, height = sensor_size
    events = Events(
        np.sort(random.integers(0, duration_us, num_events)),
        random.integers(0, width, num_events).astype(np.uint16),
        random.integers(0, height, num_events).astype(np.uint16),
        random.integers(0, 2, num_events).astype(np.uint8),
        sensor_size,
    )
    if num_events:  # the last column and row, so that files without a size tell it
        events.x[0], events.y[0] = width - 1, height - 1
    return events


def assert_same(got: Events, expected: Events) -> None:
    assert got.sensor_size == expected.sensor_size
    for name in "txyp":
        column = getattr(got, name)
        assert column.dtype == getattr(expected, name).dtype
        np.testing.assert_array_equal(column, getattr(expected, name))


# Formats -----------------------------------------------------------------------------------------------------------


def test_every_format_that_writes_is_tested_here():
    assert set(WRITABLE) == {
        name for name in plugins.names("formats") if hasattr(plugins.load("formats", name), "write")
    }


@pytest.mark.parametrize("name", WRITABLE)
@settings(max_examples=15, deadline=None)
@given(
    num_events=st.integers(1, 300),
    duration_us=st.sampled_from([1, 100, 10**6, 2**24 + 5, 2**33]),
    chunk=st.integers(1, 400),
    seed=st.integers(0, 100),
)
def test_write_then_read_whole_or_in_chunks(name, num_events, duration_us, chunk, seed):
    if name == "atis":
        duration_us = min(max(duration_us, 100), 10**6)  # times that stand still do not tell an ATIS file
    if name == "dat":
        duration_us = min(duration_us, 2**31)
    events = make_events(num_events, WRITABLE[name], duration_us, seed)
    module = plugins.load("formats", name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"events{SUFFIXES.get(name, '')}"
        module.write(path, events)
        assert event_files.find_format(path) is module
        assert_same(event_files.read_events_file(path), events)
        chunks = list(event_files.read_event_chunks(path, chunk))
    assert [len(part) for part in chunks[:-1]] == [chunk] * (len(chunks) - 1)
    assert_same(event_chunks.concatenate(chunks), events)


@pytest.mark.parametrize("name", WRITABLE)
def test_equal_events_in_large_blocks(name, tmp_path):
    # More events than the readers' blocks, several of the same time, row and polarity side by side.
    events = make_events(150_000, WRITABLE[name], 20_000)
    order = np.lexsort((events.x, events.p, events.y, events.t))
    events = Events(*(getattr(events, column)[order] for column in "txyp"), events.sensor_size)
    path = tmp_path / f"events{SUFFIXES.get(name, '')}"
    plugins.load("formats", name).write(path, events)
    assert_same(event_files.read_events_file(path), events)
    assert_same(event_chunks.concatenate(event_files.read_event_chunks(path, 40_001)), events)


@pytest.mark.parametrize("name", ["aedat3", "aedat4", "csv", "evt2", "evt3", "hdf5", "npz", "parquet"])
def test_a_recording_without_events_is_one_empty_chunk(name, tmp_path):
    plugins.load("formats", name).write(tmp_path / "events", make_events(0))
    chunks = list(event_files.read_event_chunks(tmp_path / "events"))
    assert [(len(chunk), chunk.sensor_size) for chunk in chunks] == [(0, SIZE)]
    assert_same(event_files.read_events_file(tmp_path / "events"), make_events(0))


def test_evt3_vectors_save_words_and_keep_the_order(tmp_path):
    # 64 pixels of one row at once, then the same backwards, where no vector can keep the order.
    x = np.concatenate([np.arange(64), np.arange(64)[::-1]]).astype(np.uint16)
    zeros = np.zeros(128, np.int64)
    events = Events(zeros, x, zeros.astype(np.uint16), zeros.astype(np.uint8), SIZE)
    module = plugins.load("formats", "evt3")
    module.write(tmp_path / "a.raw", events)
    assert_same(module.read(tmp_path / "a.raw"), events)
    words = np.fromfile(tmp_path / "a.raw", "<u2")[-73:] >> 12
    assert np.count_nonzero(words == 4) == 6 and np.count_nonzero(words == 3) == 1
    assert np.count_nonzero(words == 2) == 64


def test_two_formats_that_claim_a_file_are_named(tmp_path, monkeypatch):
    path = tmp_path / "events"
    plugins.load("formats", "evt2").write(path, make_events(3))
    monkeypatch.setattr(plugins.load("formats", "dat"), "sniff", lambda path: True)
    with pytest.raises(DataError, match="could be any of the formats dat, evt2; expected exactly one"):
        event_files.find_format(path)


def test_formats_without_a_signature_are_asked_last(tmp_path, monkeypatch):
    path = tmp_path / "events"
    plugins.load("formats", "evt2").write(path, make_events(3))
    monkeypatch.setattr(plugins.load("formats", "csv"), "sniff", lambda path: True)
    assert event_files.find_format(path).__name__.endswith(".evt2")


@pytest.mark.skipif(not REAL.is_dir(), reason="the real recordings are not beside the project")
@pytest.mark.parametrize(
    "file", ["person/tonic_sample.aedat4", "street/expelliarmus_evt3.raw", "spot/expelliarmus_evt2.raw"]
)
def test_real_recordings_in_chunks(file, tmp_path):
    events = event_files.read_events_file(REAL / file)
    summary = event_files.write_event_chunks_parquet(
        tmp_path / "a.parquet", event_files.read_event_chunks(REAL / file, 10_007)
    )
    assert summary.result() == event_files.summarise(events)
    assert_same(event_files.read_events_file(tmp_path / "a.parquet"), events)


def test_a_file_that_cannot_be_read_is_a_data_error(tmp_path, monkeypatch):
    def refuse(path):
        raise PermissionError("no permission")

    monkeypatch.setattr(plugins.load("formats", "evt2"), "sniff", refuse)
    (tmp_path / "a.raw").write_bytes(b"x")
    with pytest.raises(DataError, match=r"a\.raw: cannot be read: no permission"):
        event_files.find_format(tmp_path / "a.raw")


# Chunks ------------------------------------------------------------------------------------------------------------


def test_chunks_that_do_not_join_are_an_error(tmp_path, monkeypatch):
    module = plugins.load("formats", "evt2")
    module.write(tmp_path / "a.raw", make_events(5))

    def give(*chunks):
        monkeypatch.setattr(module, "read_chunks", lambda path, num_events: iter(chunks))
        return list(event_files.read_event_chunks(tmp_path / "a.raw"))

    late, early = make_events(5), make_events(5)
    late.t[:], early.t[:] = 7, 6
    assert len(give(early, late, late)) == 3
    with pytest.raises(DataError, match="t decreases at event 10: 7 us, then 6 us"):
        give(early, late, early)
    with pytest.raises(DataError, match=r"sensor_size must be \(640, 480\) throughout, got \(34, 34\) from event 5 on"):
        give(early, make_events(5, (34, 34)))


@pytest.mark.parametrize("name", ["evt2", "dat", "csv", "npy", "npz", "hdf5"])
def test_time_that_jumps_back_at_a_joint_is_found(name, tmp_path):
    good = make_events(8)
    good.t[:] = [10, 20, 30, 40, 50, 60, 70, 80]
    path = tmp_path / "events"
    plugins.load("formats", name).write(path, good)
    content = path.read_bytes()
    module = plugins.load("formats", name)
    if name == "evt2":
        content = content[:-4] + bytes([content[-4], content[-3], 0, content[-1] & 0xF0])
    elif name == "dat":
        content = content[:-8] + (5).to_bytes(4, "little") + content[-4:]
    elif name == "csv":
        content = content.replace(b"\n80,", b"\n69,")
    else:
        bad = Events(np.array([10, 20, 30, 40, 50, 60, 70, 69]), good.x, good.y, good.p, good.sensor_size)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "check_events", lambda events, where: events)
            module.write(path, bad)
        content = path.read_bytes()
    path.write_bytes(content)
    with pytest.raises(DataError, match="t decreases at event 7: 70 us, then"):
        list(event_files.read_event_chunks(path, 7))
    with pytest.raises(DataError, match="t decreases at event 7: 70 us, then"):
        event_files.read_events_file(path)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 9), min_size=1, max_size=8), st.integers(1, 12))
def test_regroup_keeps_events_and_order(lengths, size):
    events = make_events(sum(lengths))
    stops = np.cumsum(lengths).tolist()
    chunks = [events.slice(stop - length, stop) for length, stop in zip(lengths, stops, strict=True)]
    groups = list(event_chunks.regroup(chunks, size))
    assert [len(group) for group in groups[:-1]] == [size] * (len(groups) - 1)
    assert len(groups) == max(1, -(-sum(lengths) // size))
    assert_same(event_chunks.concatenate(groups), events)


# Our own files -----------------------------------------------------------------------------------------------------


def test_parquet_written_in_chunks_is_the_file_written_whole(tmp_path):
    events = make_events(600_000)
    event_files.write_events_parquet(tmp_path / "whole.parquet", events)
    chunks = event_chunks.regroup([events], 7_001)
    summary = event_files.write_event_chunks_parquet(tmp_path / "chunks.parquet", chunks)
    assert summary.result() == event_files.summarise(events)
    assert (tmp_path / "whole.parquet").read_bytes() == (tmp_path / "chunks.parquet").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["chunks.parquet", "whole.parquet"]


def test_a_stretch_of_a_parquet_file_is_the_slice(tmp_path):
    events = make_events(600_000)
    path = tmp_path / "a.parquet"
    event_files.write_events_parquet(path, events)
    group = pq.ParquetFile(path).metadata.row_group(0).num_rows
    for start, stop in [(0, 0), (0, 1), (group - 1, group + 1), (group, 2 * group), (599_999, 600_000), (0, 600_000)]:
        assert_same(event_files.read_events_range(path, start, stop), events.slice(start, stop))
    for start, stop in [(-1, 5), (5, 4), (0, 600_001)]:
        with pytest.raises(DataError, match="expected a range within 0 to 600000"):
            event_files.read_events_range(path, start, stop)
    plugins.load("formats", "evt2").write(tmp_path / "a.raw", make_events(3))
    with pytest.raises(DataError, match="only parts of Parquet files can be read, got evt2"):
        event_files.read_events_range(tmp_path / "a.raw", 0, 1)


def test_wrong_chunks_leave_no_file(tmp_path):
    good, bad = make_events(10), make_events(10)
    bad.x[3] = 640
    for chunks in ([good, bad], [good, good.slice(0, 1)], []):
        with pytest.raises(DataError, match="events to be written"):
            event_files.write_event_chunks_parquet(tmp_path / "a.parquet", chunks)
        assert not list(tmp_path.iterdir())


# Memory ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="reads the peak memory from /proc")
@pytest.mark.parametrize("name", ["evt3", "hdf5", "npy"])
def test_memory_of_a_chunked_read_does_not_grow_with_the_file(name, tmp_path):
    # A process of its own, because the highest memory of this one is behind it (and VmHWM, because ru_maxrss is taken
    # over from the parent). 8 million events are 104 MB as columns;
    # what is allowed holds the chunks (3 MB) and the libraries but not the recording.
    events = make_events(8_000_000, WRITABLE[name], 16_000_000 if name != "atis" else 8_000_000)
    plugins.load("formats", name).write(tmp_path / "events", events)
    plugins.load("formats", name).write(tmp_path / "few", events.slice(0, 1000))
    del events
    code = f"""
        import re
        from pathlib import Path
        from ctlev_core.events import files as event_files
        peak = lambda: int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024
        folder = Path({str(tmp_path)!r})
        try:
            list(event_files.read_event_chunks(folder / "few"))  # compiles
        except ValueError:
            pass
        before = peak()
        total = sum(len(chunk) for chunk in event_files.read_event_chunks(folder / "events", 1 << 18))
        chunks = peak() - before
        event_files.read_events_file(folder / "events")
        print(total, chunks, peak() - before)
    """
    result = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=True)
    total, in_chunks, whole = (float(number) for number in result.stdout.split())
    assert total == 8_000_000
    assert in_chunks < 80, f"{in_chunks} MB"
    assert whole > 95, f"{whole} MB: the measurement sees no memory"


def test_what_is_signal_survives_a_parquet_file_read_in_any_way(tmp_path):
    events = make_events(600_000)
    marked = replace(events, signal=np.random.default_rng(1).random(len(events)) < 0.7)
    event_files.write_event_chunks(
        tmp_path / "a.parquet", [marked.slice(0, 1000), marked.slice(1000, 600_000)], "parquet"
    )
    whole = event_files.read_events_file(tmp_path / "a.parquet")
    assert_same(whole, events)
    chunks = list(event_files.read_event_chunks(tmp_path / "a.parquet", 70_001))
    stretch = event_files.read_events_range(tmp_path / "a.parquet", 262_100, 300_000)
    assert marked.signal is not None
    for got, expected in (
        (whole, marked.signal),
        (event_chunks.concatenate(chunks), marked.signal),
        (stretch, marked.signal[262_100:300_000]),
    ):
        assert got.signal is not None and got.signal.dtype == np.bool_
        np.testing.assert_array_equal(got.signal, expected)
    event_files.write_events_parquet(tmp_path / "b.parquet", events)
    assert event_files.read_events_file(tmp_path / "b.parquet").signal is None


def test_signal_must_be_known_of_all_events_or_of_none(tmp_path):
    events = make_events(20)
    marked = replace(events, signal=np.ones(20, bool))
    for first, second in ((marked, events), (events, marked)):
        with pytest.raises(DataError, match="signal must be known of all events or of none, not so from 10 on"):
            event_files.write_event_chunks_parquet(tmp_path / "a.parquet", [first.slice(0, 10), second.slice(10, 20)])
    with pytest.raises(DataError, match=r"column signal must be \[20\] bool"):
        event_files.write_events_parquet(tmp_path / "a.parquet", replace(events, signal=np.ones(19, bool)))
    assert not list(tmp_path.iterdir())
