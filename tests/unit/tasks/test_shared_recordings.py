"""Short recordings share files: what is read is what was written, whoever computes, and after a kill."""

import dataclasses
import json
import os
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from ctlev_core import plugins
from ctlev_core.recordings import recording_groups
from ctlev_core.recordings.recording_groups import recording_groups as grouped
from ctlev_core.recordings.stored_events import SharedEventsWriter, StoredEvents, stored_events
from data_contracts import table_writer, tables
from data_contracts.config import DatasetChoice, EncodingChoice, Frozen, Windows
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import Labels, Part, Recording
from data_contracts.manifest import read_manifest, rows_by_recording
from tasks.encode import encode
from tasks.ingest import ingest
from tasks.store import Store

SENSOR = (32, 24)
ROOT = Path(__file__).resolve().parents[3]
EVERY_TENTH_IS_LONG = 10
NUM_GROUPS, COUNT = 16, 40
"""At least so many groups of so many recordings: groups of two, as 300 are without being told."""


def make_events(seed, num_events=50, duration_us=900_000, signal=False):
    random = np.random.default_rng(seed)
    t = np.sort(random.integers(5, duration_us, num_events))
    t[[0, -1]] = 5, 5 + duration_us
    x, y = (random.integers(0, side, num_events).astype(np.uint16) for side in SENSOR)
    marks = random.random(num_events) < 0.5 if signal else None
    return Events(t, x, y, random.integers(0, 2, num_events).astype(np.uint8), SENSOR, signal=marks)


def equal(first, second):
    columns = ("t", "x", "y", "p", "signal", "sensor_size")
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in columns)


def expected_events(number):
    """As the dataset below has them: every tenth lasts a second, the others less."""
    return make_events(number, duration_us=1_000_000 if number % EVERY_TENTH_IS_LONG == 0 else 999_999)


def make_dataset(count, read=None):
    class Options(Frozen):
        """None."""

    def read_events(recording, options):
        number = int(recording.recording_id)
        if read is not None:
            read(number)
        return expected_events(number)

    return types.SimpleNamespace(
        VERSION=1,
        Options=Options,
        list_recordings=lambda options: [
            Recording(f"{n:05d}", f"s{n}", (Part("test" if n % 5 == 4 else "train"),), f"class {n % 3}")
            for n in range(count)
        ],
        read_events=read_events,
        read_labels=lambda recording, options: Labels((recording.class_name,), np.zeros(1, np.int64)),
    )


def run(stage, **arguments):
    return stage.run(stage.key(arguments, Store()), arguments)[0]


def install(monkeypatch, module):
    original = plugins.load
    monkeypatch.setattr(
        plugins, "load", lambda kind, name: module if (kind, name) == ("datasets", "test") else original(kind, name)
    )


def make_both(home, monkeypatch, module, workers):
    monkeypatch.setenv("CTLEV_HOME", str(home))
    monkeypatch.setenv("CTLEV_WORKERS", str(workers))
    monkeypatch.setattr(recording_groups, "MIN_GROUPS", NUM_GROUPS)
    install(monkeypatch, module)
    recordings = run(ingest, dataset=DatasetChoice(name="test"))
    frames = run(
        encode,
        recordings=recordings,
        encoding=EncodingChoice(name="event_histogram", options={"image_size": (16, 16)}),
        windows=Windows(method="whole"),
    )
    return read_manifest(recordings, full=True), read_manifest(frames, full=True)


@pytest.mark.parametrize("signal", [False, True])
def test_a_shared_file_gives_each_recording_and_parts_of_it(tmp_path, signal):
    recordings = [make_events(seed, 1 + 40 * seed, signal=signal and seed % 2 == 0) for seed in range(5)]
    with SharedEventsWriter(tmp_path / "a.arrow") as writer:
        assert [writer.append(events, "test") for events in recordings] == [0, 1, 2, 3, 4]
    for number in (3, 0, 4, 1, 2):
        stored, events = StoredEvents(tmp_path / "a.arrow", number, SENSOR), recordings[number]
        assert equal(stored.read(0, len(events)), events)
        middle = len(events) // 2
        assert equal(stored.read(middle, len(events)), events.slice(middle, len(events)))
        with pytest.raises(DataError, match=f"a.arrow, recording {number}: expected a range within 0 to {len(events)}"):
            stored.read(0, len(events) + 1)
    with pytest.raises(DataError, match="expected a recording from 0 to 4, got 5"):
        StoredEvents(tmp_path / "a.arrow", 5, SENSOR).read(0, 1)


def test_damaged_shared_files_are_errors(tmp_path):
    path = tmp_path / "a.arrow"
    with SharedEventsWriter(path) as writer:
        for seed in range(3):
            writer.append(make_events(seed), "test")
    whole = path.read_bytes()
    stored = StoredEvents(path, 1, SENSOR)
    for size in (0, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(DataError, match=r"a\.arrow"):
            stored.read(0, 50)
    path.unlink()
    with pytest.raises(DataError, match="got nothing there"):
        stored.read(0, 50)
    with pa.ipc.new_file(str(path), pa.schema([("t", pa.int64())])):
        pass
    with pytest.raises(DataError, match="expected the columns"):
        stored.read(0, 50)


@pytest.mark.parametrize(("count", "size"), [(1, 1), (255, 1), (256, 2), (20_000, 156), (1_500_000, 2_048)])
def test_groups_cover_all_recordings_in_order(count, size):
    groups = grouped(range(count))
    assert [number for number, _ in groups] == list(range(len(groups)))
    assert len(groups[0][1]) == size and max(len(members) for _, members in groups) == size
    assert [group[0] for _, group in groups] == list(range(0, count, size)) and groups[-1][1][-1] == count - 1


def test_rows_of_recordings_that_lie_together():
    table = pa.table({"recording_id": ["b", "b", "a", "d", "d", "d"]})
    asked = pa.chunked_array([["a", "b"], ["c", "d"]])
    assert rows_by_recording(table, asked).tolist() == [[2, 3], [0, 2], [0, 0], [3, 6]]
    assert rows_by_recording(table.slice(0, 0), asked).tolist() == [[0, 0]] * 4


@pytest.mark.parametrize("step", [1, 3, 100])
def test_a_table_does_not_depend_on_how_many_rows_come_at_a_time(tmp_path, monkeypatch, step):
    monkeypatch.setattr(table_writer, "ROW_GROUP", 8)
    count = 30
    rows = pa.table(
        {"recording_id": [str(n) for n in range(count)], "event_start": range(count), "event_stop": range(count)}
    ).cast(tables.WINDOWS.arrow())
    contents = []
    for name, size in (("whole", count), ("parts", step)):
        (tmp_path / name).mkdir()
        with table_writer.TableWriter(tmp_path / name, tables.WINDOWS) as writer:
            for start in range(0, count, size):
                writer.append(rows.slice(start, size))
        contents.append((tmp_path / name / "windows.parquet").read_bytes())
    assert contents[0] == contents[1]


def test_short_recordings_share_files_and_long_ones_have_their_own(tmp_path, monkeypatch):
    made, frames = make_both(tmp_path, monkeypatch, make_dataset(COUNT), workers=1)
    rows = made.table.to_pylist()
    assert [row["recording_id"] for row in rows if row["events_batch"] is None] == [
        f"{n:05d}" for n in range(0, COUNT, EVERY_TENTH_IS_LONG)
    ]
    shared = {row["events_file"] for row in rows if row["events_batch"] is not None}
    assert len(shared) == 20 and len(set(made.column("events_file"))) == 24, "groups of two"
    for number, row in enumerate(rows):
        stored = stored_events(made, row)
        assert equal(stored.read(0, row["num_events"]), expected_events(number))
        assert row["duration_us"] == (1_000_000 if number % EVERY_TENTH_IS_LONG == 0 else 999_999)
    assert frames.column("recording_id") == [f"{n:05d}" for n in range(COUNT)]
    assert frames.column("class_name") == [f"class {n % 3}" for n in range(COUNT)]
    counts = np.asarray(frames.array("histograms"))
    assert (counts.sum(axis=(1, 2, 3)) == 50).all()


def test_one_worker_and_two_make_the_same(tmp_path, monkeypatch):
    module = make_dataset(COUNT)
    found = [make_both(tmp_path / str(n), monkeypatch, module, workers=n) for n in (1, 2)]
    for first, second in zip(*found, strict=True):
        assert first.ref.digest == second.ref.digest, "of the manifest, which has the digests of all files"


def test_an_interrupted_ingest_goes_on_from_its_finished_groups(tmp_path, monkeypatch):
    read, fails_at = [], [37]

    def note(number):
        if number in fails_at:
            raise KeyboardInterrupt
        read.append(number)

    with pytest.raises(KeyboardInterrupt):
        make_both(tmp_path / "killed", monkeypatch, make_dataset(COUNT, note), workers=1)
    assert read == list(range(37))
    read.clear()
    fails_at.clear()
    again = make_both(tmp_path / "killed", monkeypatch, make_dataset(COUNT, note), workers=1)
    # Groups of two: that of 36 and 37 is not finished.
    assert read == list(range(36, COUNT))
    whole = make_both(tmp_path / "whole", monkeypatch, make_dataset(COUNT), workers=1)
    assert [made.ref.digest for made in again] == [made.ref.digest for made in whole]


def test_labels_of_different_kinds_are_refused_across_groups(tmp_path, monkeypatch):
    module = make_dataset(COUNT)
    plain = module.read_labels

    def read_labels(recording, options):
        labels = plain(recording, options)
        if recording.recording_id < "00020":
            return labels
        arrays = {"joints2d": np.ones((1, 13, 2), np.float32), "visible": np.ones((1, 13), bool)}
        return dataclasses.replace(labels, **arrays, joint_set="dhp19")

    module.read_labels = read_labels
    with pytest.raises(DataError, match="cannot mix labels of different kinds"):
        make_both(tmp_path, monkeypatch, module, workers=1)


def benchmark(count, **environment):
    """Rows of the benchmark's table, by the name of the step."""
    script = ROOT / "benchmarks" / "many_recordings.py"
    command = [sys.executable, str(script), str(count), "--events", "50", "--contents", "100"]
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    told = subprocess.run(
        [*command, "--json"], env=os.environ | environment | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert told.returncode == 0, told.stderr
    return json.loads(told.stdout.splitlines()[-1])


@pytest.mark.release
@pytest.mark.timeout(1200)
def test_twenty_thousand_recordings_take_few_files_and_hardly_more_memory(tmp_path):
    """Killed in the middle and resumed; with one worker and with two."""
    small, large = benchmark(5_000, CTLEV_WORKERS="1"), benchmark(20_000, CTLEV_WORKERS="1")
    for step in ("ingest", "encode", "verify"):
        # Rows of tables grow; 10 kB a recording, as with records of Python, would be 150 MiB.
        assert large[step]["peak_mib"] - small[step]["peak_mib"] < 60, step
    most = len(grouped(range(20_000))) + 8  # tables, and the record
    assert recording_groups.MIN_GROUPS <= most < 140
    assert large["ingest"]["files"] <= most
    assert large["ingest"]["rows"] == large["encode"]["rows"] == 20_000
    spread = benchmark(20_000, CTLEV_WORKERS="2")
    for step in ("ingest", "encode"):
        assert spread[step]["digest"] == large[step]["digest"]
