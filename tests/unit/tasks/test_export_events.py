"""Generated frames to event files and back, and the search for copies, on a small dataset."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ctlev_core import plugins
from ctlev_core.events import files as event_files
from ctlev_core.scoring.memorisation import CLOSEST_PAIRS
from ctlev_core.supervised.frame_sequences import frame_interval_us
from data_contracts import tables
from data_contracts.config import EncodingChoice
from data_contracts.errors import DataError
from data_contracts.event_export import EventExport
from data_contracts.events import Events
from data_contracts.labels import Labels
from data_contracts.manifest import LABEL_COLUMNS, Manifest, label_columns, read_manifest, write_manifest
from tasks import export_events as task
from tasks.memorisation import memorisation
from tasks.stage import Output

SIZE = (24, 18)
NUM_EVENTS = 200
PER_RECORDING = 6
ENCODING = plugins.load("encodings", "event_histogram")


def make_events(seed: int) -> Events:
    """A vertical edge that crosses the sensor once a window."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, 60_000, PER_RECORDING * NUM_EVENTS))
    x = np.clip(SIZE[0] * (t % 10_000) / 10_000 + rng.normal(0, 1.5, len(t)), 0, SIZE[0] - 1)
    y, p = rng.integers(0, SIZE[1], len(t)), rng.random(len(t)) < 0.6
    return Events(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), SIZE)


def labels_of_rows(count: int) -> dict[str, pa.Array]:
    joints = np.arange(count * 26, dtype=np.float32).reshape(count, 13, 2)
    return label_columns(Labels(("walk",) * count, np.arange(count), joints, np.ones((count, 13), bool), "dhp19"))


def write_recordings(folder) -> Manifest:
    folder.mkdir()
    rows, parts = [], []
    for number in range(4):
        events, name = make_events(number), f"r{number}"
        event_files.write_events_parquet(folder / f"{name}.parquet", events)
        of_events = event_files.summarise(events)
        rows.append(
            {
                "recording_id": name, "subject": name, "class_name": "walk", "splits": "train",
                "sensor_width_px": SIZE[0], "sensor_height_px": SIZE[1], "num_windows": None,
                "events_file": f"{name}.parquet", "events_batch": None,
                "event_images_file": "", "intensity_file": "", **of_events,
            }
        )  # fmt: skip
        parts.append({"recording_id": name, "split": "train", "event_start": 0, "event_stop": len(events)})
    pq.write_table(pa.Table.from_pylist(parts, tables.PARTS.arrow()), folder / "parts.parquet")
    ref = write_manifest(folder, pa.Table.from_pylist(rows, tables.RECORDINGS.arrow()), tables.RECORDINGS)
    return read_manifest(ref)


def write_frames(folder, polarity: bool, num_events: int | None = None) -> Manifest:
    folder.mkdir()
    options, rows, histograms = ENCODING.Options(polarity=polarity), [], []
    for number in range(4):
        events = make_events(number)
        ranges = np.arange(PER_RECORDING)[:, None] * NUM_EVENTS + [0, NUM_EVENTS]
        histograms.append(ENCODING.encode(events, ranges, options))
        for window, (start, stop) in enumerate(ranges):
            rows.append(
                {
                    "sample_id": f"r{number}:{window}", "recording_id": f"r{number}", "subject": f"r{number}",
                    "split": "train", "class_name": "walk", "t_start_us": events.t[start],
                    "t_end_us": events.t[stop - 1], "t_us": events.t[stop - 1],
                    "num_events": NUM_EVENTS if num_events is None else num_events,
                }
            )  # fmt: skip
    histograms = np.concatenate(histograms)
    np.save(folder / "histograms.npy", histograms)
    np.save(folder / "frames.npy", ENCODING.render_image(histograms, options))
    table = pa.Table.from_pylist(rows)
    for name, column in labels_of_rows(len(rows)).items():
        table = table.append_column(name, column)
    return read_manifest(write_manifest(folder, table.select(tables.FRAMES.arrow().names), tables.FRAMES))


def write_generated(folder, frames: np.ndarray, sources: list[str] | None = None) -> Manifest:
    folder.mkdir()
    count = len(frames)
    np.save(folder / "frames.npy", frames)
    names = [f"synthetic/{row:06d}" for row in range(count)]
    same = {
        "subject": "s", "split": "train", "class_name": "walk", "prompt": "", "generator": "test 1", "scheduler": "",
        "checkpoint_digest": "", "num_inference_steps": 1, "guidance_scale": 1.0, "num_attempts": 1,
        "rejected": "",
    }  # fmt: skip
    ids = {name: names for name in ("sample_id", "recording_id", "condition_id", "source_id")}
    ids |= {} if sources is None else {"source_id": sources}
    columns = {**ids, **{name: [value] * count for name, value in same.items()}, "seed": list(range(count))}
    columns |= labels_of_rows(count)
    table = pa.table({name: pa.array(columns[name]) for name in tables.SYNTHETIC.arrow().names})
    return read_manifest(write_manifest(folder, table.cast(tables.SYNTHETIC.arrow()), tables.SYNTHETIC))


def export(tmp_path, generated, polarity=True, name="out", **options) -> Manifest:
    frames = write_frames(tmp_path / f"{name}-frames", polarity)
    recordings = write_recordings(tmp_path / f"{name}-recordings")
    folder = tmp_path / name
    folder.mkdir()
    encoding = EncodingChoice(name="event_histogram", options={"polarity": polarity})
    inputs = (Output(folder, tmp_path), generated, frames, recordings)
    table = task.export_events.function(*inputs, encoding=encoding, export=EventExport(**options))
    return read_manifest(write_manifest(folder, table, tables.EVENT_STREAMS))


def streams(made: Manifest) -> list[Events]:
    """The stream of each row, as a reader of the table finds it; times from the start of its window."""
    found = []
    for row in made.table.to_pylist():
        events = event_files.read_events_file(made.path(row["file"]))
        events = events.slice(row["event_start"], row["event_start"] + row["num_events"])
        if len(events):
            assert row["t_start_us"] <= events.t[0] and events.t[-1] == row["t_end_us"]
        found.append(Events(events.t - row["t_start_us"], events.x, events.y, events.p, events.sensor_size))
    return found


def real_frames(tmp_path, polarity=True) -> np.ndarray:
    frames = np.array(write_frames(tmp_path / "others", polarity).array("frames"))[::3]
    frames[2] = 0
    return frames


@pytest.mark.parametrize("polarity", [True, False])
@pytest.mark.parametrize("name", ["parquet", "evt2", "evt3"])
@pytest.mark.parametrize("one_file", [True, False])
def test_files_hold_the_frames(tmp_path, polarity, name, one_file):
    frames = real_frames(tmp_path, polarity)
    generated = write_generated(tmp_path / "generated", frames)
    made = export(tmp_path, generated, polarity, format=name, one_file=one_file)
    assert len(set(made.column("file"))) == (1 if one_file else len(frames))
    assert made.column("sample_id") == generated.column("sample_id")
    assert made.column("has_polarity") == [polarity] * len(frames) and all(made.column("is_exact"))
    for column in LABEL_COLUMNS.values():
        assert made.table[column].equals(generated.table[column])
    options = ENCODING.Options(polarity=polarity)
    for row, events in enumerate(streams(made)):
        assert events.sensor_size == SIZE and (polarity or events.p.all())
        counts = ENCODING.encode(events, np.array([[0, len(events)]]), options)
        np.testing.assert_array_equal(ENCODING.render_image(counts, options)[0], frames[row])
    assert made.column("num_events")[2] == 0
    if one_file:
        starts, ends = made.column("t_start_us"), made.column("t_end_us")
        assert [b - a for a, b in zip(ends, starts[1:], strict=False)] == [100_000] * (len(frames) - 1)


@pytest.mark.parametrize("one_file", [True, False])
def test_stretches_are_streams_that_encode_to_their_frames(tmp_path, one_file):
    """Six frames, of labels that follow one another as training frames do, but for one jump and one other recording."""
    interval_us = frame_interval_us(
        write_frames(tmp_path / "learnt", True).table, np.arange(4 * PER_RECORDING), "frames"
    )
    sources = [f"a:{number * interval_us}" for number in (0, 1, 2, 7, 8)] + ["b:0"]
    frames = real_frames(tmp_path)[:6]
    generated = write_generated(tmp_path / "generated", frames, sources)
    made = export(tmp_path, generated, one_file=one_file, streams="stretches", gap_us=123)
    rows = made.table.to_pylist()
    assert len({row["file"] for row in rows}) == (1 if one_file else 3)
    for stretch in ([0, 1, 2], [3, 4], [5]):
        begin_us = rows[stretch[0]]["t_start_us"]
        events = event_files.read_events_file(made.path(rows[stretch[0]]["file"]))
        assert (np.diff(events.t) >= 0).all()
        for number, row in enumerate(stretch):
            assert rows[row]["t_start_us"] == begin_us + number * interval_us
            window = np.searchsorted(events.t, [rows[row]["t_start_us"], rows[row]["t_start_us"] + interval_us])
            counts = ENCODING.encode(events, window[None], ENCODING.Options())
            assert np.array_equal(ENCODING.render_image(counts, ENCODING.Options())[0], frames[row])
            assert rows[row]["event_start"] == window[0] or not rows[row]["num_events"]
            assert rows[row]["num_events"] == window[1] - window[0]


def test_a_row_depends_on_its_own_seed_alone(tmp_path):
    frames = real_frames(tmp_path)
    all_rows = streams(export(tmp_path, write_generated(tmp_path / "all", frames), name="a"))
    few = streams(export(tmp_path, write_generated(tmp_path / "few", frames[:3]), name="b", one_file=True))
    for one, other in zip(all_rows[:3], few, strict=True):
        for column in "txyp":
            np.testing.assert_array_equal(getattr(one, column), getattr(other, column))


def test_published_events_replace_older_ones(tmp_path):
    made = export(tmp_path, write_generated(tmp_path / "generated", real_frames(tmp_path)))
    for _ in range(2):
        assert "8 streams in" in task.publish_events(made.ref, tmp_path / "home", "demo")
    table = pq.read_table(tmp_path / "home" / "events" / "demo" / "event_streams.parquet")
    for file in table["file"].to_pylist():
        assert (tmp_path / "home" / "events" / "demo" / file).is_file()
    assert len(list((tmp_path / "home" / "events").iterdir())) == 1


def test_windows_are_found_in_their_recording(tmp_path):
    recordings, frames = write_recordings(tmp_path / "r"), write_frames(tmp_path / "f", True)
    rows = frames.table.to_pylist()
    for row, window in zip(rows, task._windows(rows, recordings), strict=True):
        events = make_events(int(row["recording_id"][1:]))
        inside = (events.t >= row["t_start_us"]) & (events.t <= row["t_end_us"])
        np.testing.assert_array_equal(window.t, events.t[inside])
        np.testing.assert_array_equal(window.x, events.x[inside])


def test_memory_for_windows_does_not_grow_with_the_recordings(tmp_path):
    recordings, rows = write_recordings(tmp_path / "r"), write_frames(tmp_path / "f", True).table.to_pylist()
    first, parts = recordings.table.slice(0, 1), recordings.attached(tables.PARTS)
    index = first.column_names.index("recording_id")
    names = pa.array([f"other{number:05d}" for number in range(20_000)])
    others = first.take(np.zeros(len(names), int)).set_column(index, first.schema.field(index), names)
    other_parts = parts.take(np.zeros(len(names), int)).set_column(0, parts.schema.field(0), names)

    class Many:
        table = pa.concat_tables([others, recordings.table])

        def attached(self, schema):
            return pa.concat_tables([other_parts, parts])

        def __getattr__(self, name):
            return getattr(recordings, name)

    tracemalloc.start()
    found = sum(len(events) for events in task._windows(rows, Many()))
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found >= len(rows) * NUM_EVENTS and peak_bytes < 2e6, "Python's records of all would be 20 MB"


def test_what_cannot_be_exported_is_refused(tmp_path, monkeypatch):
    generated = write_generated(tmp_path / "generated", real_frames(tmp_path))
    with monkeypatch.context() as patch, pytest.raises(DataError, match="'aedat4' is read, not written"):
        patch.delattr(plugins.load("formats", "aedat4"), "write")
        export(tmp_path, generated, name="a", format="aedat4")
    recordings = write_recordings(tmp_path / "r")
    images = write_frames(tmp_path / "f", True, num_events=0)
    inputs = (Output(tmp_path, tmp_path), generated, images, recordings)
    with pytest.raises(DataError, match="finished event image"):
        task.export_events.function(*inputs, encoding=EncodingChoice(name="event_histogram"), export=EventExport())
    with pytest.raises(DataError, match="got 'voxel_grid'"):
        task.export_events.function(*inputs, encoding=EncodingChoice(name="voxel_grid"), export=EventExport())


def test_copies_are_found_with_the_frames_they_copy(tmp_path):
    frames = write_frames(tmp_path / "f", True)
    made = np.array(frames.array("frames"))[[5, 20]]
    other = write_frames(tmp_path / "g", True)
    noise = np.random.default_rng(0).permuted(np.array(other.array("frames")).reshape(24, -1, 3), axis=1)
    generated = write_generated(tmp_path / "generated", np.concatenate([made, noise[:6].reshape(6, 18, 24, 3)]))
    folder = tmp_path / "out"
    folder.mkdir()
    table = memorisation.function(
        Output(folder, tmp_path), frames, generated, None, downstream=None, subject="synthetic"
    )
    manifest = read_manifest(write_manifest(folder, table, tables.SCORES))
    rows = manifest.table.to_pylist()
    values = {row["metric"]: row["value"] for row in rows if row["subject"] == "synthetic"}
    assert values["duplicates"] == 2 and values["close_share"] >= 0.25
    assert set(manifest.column("group")) == {"small pictures"} and {
        row["num_samples"] for row in rows if row["subject"] == "synthetic"
    } == {8}
    pairs = manifest.attached(CLOSEST_PAIRS).to_pylist()
    assert [(pair["generated_row"], pair["training_row"]) for pair in pairs[:2]] == [(0, 5), (1, 20)]
    assert pairs[0]["training_id"] == "r0:5" and pairs[0]["distance"] == 0


@pytest.mark.parametrize("fit", ["crop", "pad"])
def test_times_are_learnt_in_the_pixels_that_counts_are_of(fit):
    """Events in image pixels have the histogram of those in sensor pixels, and one pixel has the gaps of several."""
    events, options = make_events(0), ENCODING.Options(image_size=(8, 8), fit=fit, resampling="events")
    seen = task._in_image(events, options)
    assert seen.sensor_size == (8, 8) and (len(seen) < len(events)) == (fit == "crop")
    expected = ENCODING.encode(events, np.array([[0, len(events)]]), options)
    np.testing.assert_array_equal(ENCODING.encode(seen, np.array([[0, len(seen)]]), ENCODING.Options()), expected)
    own = task._in_image(events, ENCODING.Options())
    assert all(np.array_equal(getattr(own, name), getattr(events, name)) for name in ("t", "x", "y", "p"))
