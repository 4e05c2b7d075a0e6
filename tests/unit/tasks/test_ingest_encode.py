"""The stages between a dataset and its frames and conditions, on a small dataset that offers all a dataset may."""

import types
from dataclasses import replace

import numpy as np
import pytest

from ctlev_core import plugins
from ctlev_core.recordings.ingestion import check_track
from data_contracts import tables
from data_contracts.config import ConditionChoice, DatasetChoice, EncodingChoice, Frozen, Windows
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import ImageTrack, Labels, Part, Recording
from data_contracts.manifest import read_manifest
from tasks.condition import condition_frames
from tasks.encode import encode
from tasks.ingest import ingest
from tasks.realism import event_realism
from tasks.store import Store

SENSOR = (32, 24)


def make_events(seed):
    random = np.random.default_rng(seed)
    return Events(
        np.sort(random.integers(0, 1000, 100)).astype(np.int64),
        random.integers(0, SENSOR[0], 100).astype(np.uint16),
        random.integers(0, SENSOR[1], 100).astype(np.uint16),
        random.integers(0, 2, 100).astype(np.uint8),
        SENSOR,
    )


def make_dataset(*, images=False, windows=None, release=None, splits=("train", "test")):
    """A dataset module of a recording a split; finished event images, or those of `release`, in the place of events."""
    images = images or release is not None

    class Options(Frozen):
        """None."""

    def list_recordings(options):
        kind = {"has_events": not images, "has_event_images": images, "has_intensity": True, "sensor_size": SENSOR}
        return [
            Recording(f"{split}/one", f"{split} subject", (Part(split),), class_name="walk", **kind) for split in splits
        ]

    def read_labels(recording, options):
        t_us = np.array([0, 500, 1000], np.int64)
        joints = np.full((3, 13, 2), 8.0, np.float32) + np.arange(3, dtype=np.float32)[:, None, None]
        smpl = {"smpl_pose": 72, "smpl_betas": 10, "smpl_transl": 3}
        return Labels(
            ("walk",) * 3,
            t_us,
            joints,
            np.ones((3, 13), bool),
            "dhp19",
            joints3d=np.full((3, 13, 3), np.nan, np.float32),
            **{name: np.full((3, size), 0.5, np.float32) for name, size in smpl.items()},
        )

    def read_track(recording, options):
        values = np.zeros((3, SENSOR[1], SENSOR[0]), np.uint8)
        values[:, 8:12, 8:12] = np.array([50, 100, 200], np.uint8)[:, None, None]
        return ImageTrack(values, np.array([0, 500, 1000], np.int64))

    module = types.SimpleNamespace(
        VERSION=1,
        Options=Options,
        list_recordings=list_recordings,
        read_events=lambda recording, options: make_events(len(recording.recording_id)),
        read_labels=read_labels,
        read_event_images=read_track if release is None else lambda recording, options: release,
        read_intensity_frames=read_track,
    )
    if windows is not None:
        module.read_windows = lambda recording, options: np.array(windows, np.int64).reshape(-1, 2)
    return module


def run_stage(stage, **arguments):
    """What a Prefect task does, without Prefect."""
    return stage.run(stage.key(arguments, Store()), arguments)[0]


@pytest.fixture
def frames_of(home, monkeypatch):
    """Ingest and encode a dataset module; returns both manifests."""

    def run(module, windows=None, held_out=None, **encoding):
        original = plugins.load
        monkeypatch.setattr(
            plugins, "load", lambda kind, name: module if (kind, name) == ("datasets", "test") else original(kind, name)
        )
        recordings = run_stage(ingest, dataset=DatasetChoice(name="test"))
        choice = EncodingChoice(name="event_histogram", options=encoding)
        asked = {"encoding": choice, "windows": windows or Windows(num_events=40), "held_out": held_out}
        frames = run_stage(encode, recordings=recordings, **asked)
        return read_manifest(recordings), read_manifest(frames)

    return run


def test_events_labels_and_intensity_frames_arrive(frames_of):
    recordings, frames = frames_of(make_dataset())
    assert len(frames) == 4 and frames.array("histograms").shape == (4, 2, 24, 32)
    events = make_events(len("train/one"))
    counts = np.zeros((2, 24, 32), int)
    np.add.at(counts, (1 - events.p[:40].astype(int), events.y[:40], events.x[:40]), 1)
    np.testing.assert_array_equal(frames.array("histograms")[0], counts)
    assert frames.labels.smpl_pose is not None and frames.labels.smpl_pose.shape == (4, 72)
    track = recordings.array("intensity/train/one")
    assert track.shape == (3, 24, 32) and recordings.array("intensity/train/one.t_us").tolist() == [0, 500, 1000]
    assert recordings.column("event_images_file") == ["", ""]


def test_test_recordings_are_not_encoded_where_options_are_chosen(frames_of):
    splits = ("train", "validation", "test")
    _, every = frames_of(make_dataset(splits=splits))
    _, chosen = frames_of(make_dataset(splits=splits), held_out="validation")
    assert set(every.column("split")) == set(splits) and every.held_out == "test"
    assert set(chosen.column("split")) == {"train", "validation"} and chosen.held_out == "validation"
    kept = np.flatnonzero(np.array(every.column("split")) != "test")
    assert chosen.column("sample_id") == [every.column("sample_id")[row] for row in kept]
    np.testing.assert_array_equal(chosen.array("frames"), every.array("frames")[kept])


def test_recordings_of_fewer_events_than_a_window_say_how_many_they_have(frames_of):
    said = (
        r"no window in split 'train': its recordings have \d+ events at most there, and a window takes 1,000,000; set"
    )
    with pytest.raises(DataError, match=said):
        frames_of(make_dataset(), windows=Windows(num_events=1_000_000))


def test_without_recordings_for_validation_there_are_no_frames(frames_of):
    with pytest.raises(DataError, match="no window in split 'validation'"):
        frames_of(make_dataset(), held_out="validation")


def test_finished_event_images_become_frames_with_the_labels_of_their_moment(frames_of):
    recordings, frames = frames_of(make_dataset(images=True), polarity=False, image_size=(16, 16))
    assert recordings.column("num_events") == [0, 0] and recordings.column("t_last_us") == [1000, 1000]
    assert len(frames) == 6 and frames.array("frames").shape == (6, 16, 16, 3)
    square = frames.array("histograms")[:3, 0, 8:12, 8:12]
    assert frames.array("histograms").shape == (6, 1, 24, 32), "grey values as they were released"
    assert [(int(image.min()), int(image.max())) for image in square] == [(50, 50), (100, 100), (200, 200)]
    # 32 x 24 onto 16 x 16: half the size, 2 px of bar above and below.
    assert (frames.array("frames")[:3, 6:8, 4:6] == 255).all(), "averaging must not leave sparse images dim"
    assert frames.labels.joints2d is not None
    np.testing.assert_allclose(frames.labels.joints2d[:3, 0], [[4.0, 6.0], [4.5, 6.5], [5.0, 7.0]])


@pytest.mark.parametrize(("labels", "kept"), [("mean", [0, 400, 1500]), ("interpolated", [0, 400])])
def test_finished_event_images_far_from_every_label_are_left_out(frames_of, labels, kept):
    """Labels are at 0, 500 and 1000 us: what was true half a second ago is no label, as for windows of events."""
    times = np.array([0, 400, 1500, 1501, 500_000], np.int64)
    release = ImageTrack(np.full((len(times), SENSOR[1], SENSOR[0]), 9, np.uint8), times)
    _, frames = frames_of(make_dataset(release=release), windows=Windows(num_events=40, labels=labels), polarity=False)
    assert frames.column("t_end_us") == 2 * kept


@pytest.mark.parametrize("side", [16, 64, 100])
def test_the_raw_and_the_released_layout_of_a_recording_give_the_same_frames(frames_of, side):
    """As DHP19: the release holds the counts of each window, three standard deviations of them being white."""
    windows = Windows(num_events=25)
    _, at_sensor = frames_of(make_dataset(), windows=windows, polarity=False)
    rows = at_sensor.rows_where(split="train")
    release = ImageTrack(at_sensor.array("frames")[rows][..., 0].copy(), np.arange(len(rows), dtype=np.int64))
    options = {"polarity": False, "image_size": (side, side)}
    _, raw = frames_of(make_dataset(), windows=windows, **options)
    _, released = frames_of(make_dataset(release=release), windows=windows, **options)
    found = released.array("frames")[released.rows_where(split="train")]
    np.testing.assert_array_equal(found, raw.array("frames")[raw.rows_where(split="train")])
    assert found.any(axis=(1, 2, 3)).all() and raw.array("histograms").shape[2:] == (24, 32)


def test_counts_of_sensors_of_different_sizes_lie_in_the_corner_of_the_largest(frames_of):
    module, smaller = make_dataset(), make_events(3)
    inside = (smaller.x < 20) & (smaller.y < 10)
    columns = (getattr(smaller, name)[inside] for name in ("t", "x", "y", "p"))
    small = Events(*columns, (20, 10))
    module.read_events = lambda recording, options: small if recording.parts[0].split == "test" else make_events(1)
    with pytest.raises(DataError, match="sensors differ in size"):
        frames_of(module, windows=Windows(num_events=5))
    _, frames = frames_of(module, windows=Windows(num_events=5), image_size=(16, 16))
    histograms = np.asarray(frames.array("histograms"))
    tested = frames.rows_where(split="test")
    assert histograms.shape[2:] == (24, 32) and frames.array("frames").shape[1:] == (16, 16, 3)
    assert not histograms[tested][:, :, 10:].any() and not histograms[tested][..., 20:].any()
    assert histograms.sum(axis=(1, 2, 3)).tolist() == [5] * len(frames)


def test_finished_event_images_have_no_polarity(frames_of):
    with pytest.raises(DataError, match="no polarity"):
        frames_of(make_dataset(images=True), polarity=True)


def test_windows_of_the_dataset_are_used_as_they_are(frames_of):
    module = make_dataset(windows=[[0, 10], [10, 10], [10, 35]])
    recordings, frames = frames_of(module, windows=Windows(method="dataset"))
    assert len(recordings.attached(tables.WINDOWS)) == 6
    assert frames.column("num_events") == [10, 25] * 2, "the empty window is dropped"


def test_windows_that_the_dataset_does_not_have_are_an_error(frames_of):
    with pytest.raises(DataError, match="without windows of its own"):
        frames_of(make_dataset(), windows=Windows(method="dataset"))


@pytest.mark.parametrize("wrong", [[[0, 200]], [[10, 5]], [[20, 30], [0, 10]]])
def test_wrong_windows_are_refused(frames_of, wrong):
    with pytest.raises(DataError, match="ascending ranges within 100 events"):
        frames_of(make_dataset(windows=wrong), windows=Windows(method="dataset"))


def test_prompts_draw_from_the_names_the_dataset_knows(frames_of):
    module = make_dataset()
    module.read_synonyms = lambda options: {"walk": ["stroll", "amble"]}
    recordings, frames = frames_of(module, windows=Windows(num_events=10))

    def prompts(**options):
        choice = ConditionChoice(name="text", options={"template": "{class_name}", **options})
        made = run_stage(
            condition_frames,
            recordings=recordings.ref,
            frames=frames.ref,
            condition=choice,
            encoding=EncodingChoice(name="event_histogram"),
            seed=0,
        )
        return set(read_manifest(made).column("prompt"))

    assert prompts() == {"stroll", "amble"}
    assert prompts(synonyms={"walk": ["march"]}) == {"march"}, "the user's names come first"


def test_labels_of_the_datasets_windows_are_taken_as_they_are(frames_of):
    module = make_dataset(windows=[[0, 10], [10, 10], [10, 35]])

    def read_window_labels(recording, options):
        return module.read_labels(recording, options).take([2, 1, 0])

    module.read_window_labels = read_window_labels
    _, frames = frames_of(module, windows=Windows(method="dataset"))
    assert frames.labels.joints2d is not None
    assert frames.labels.joints2d[:2, 0, 0].tolist() == [10.0, 8.0], "the middle one belongs to the empty window"


@pytest.mark.parametrize("held", [1 << 22, 10])
def test_a_window_that_ends_at_a_label_has_that_label(frames_of, monkeypatch, held):
    """Labels are 500 us apart: windows of 100 us that tile a recording are up to 300 us from any."""
    monkeypatch.setattr("ctlev_core.recordings.encoding.MAX_EVENTS", held)
    monkeypatch.setattr(encode, "version", 10**6 + held)  # not the cached artefact
    _, frames = frames_of(make_dataset(), Windows(method="duration", duration_us=100, anchor="labels"))
    assert frames.column("recording_id") == ["train/one", "test/one"], "at 0 and 1000 us there are no whole windows"
    assert frames.labels.joints2d[:, 0].tolist() == [[9, 9], [9, 9]]
    for name, row in zip(frames.column("recording_id"), frames.table.to_pylist(), strict=True):
        inside = [t for t in make_events(len(name)).t.tolist() if 400 < t <= 500]
        assert (row["t_start_us"], row["t_end_us"]) == (inside[0], inside[-1])
        assert row["num_events"] == len(inside)


def test_interpolated_labels_are_those_of_the_windows_end(frames_of):
    windows = Windows(method="duration", duration_us=100, labels="interpolated")
    _, frames = frames_of(make_dataset(), windows)
    ends = np.array(frames.column("t_end_us"))
    assert len(frames) == 18, "all windows are between labels"
    assert frames.labels.t_us.tolist() == frames.column("t_us") == frames.column("t_end_us")
    np.testing.assert_allclose(frames.labels.joints2d[:, 0, 0], 8 + ends / 500, rtol=1e-6)


def test_mean_labels_are_those_of_the_windows_middle(frames_of):
    _, frames = frames_of(make_dataset(), Windows(method="duration", duration_us=100))
    middles = (np.array(frames.column("t_start_us")) + np.array(frames.column("t_end_us"))) // 2
    assert frames.labels.t_us.tolist() == frames.column("t_us") == middles.tolist()


def test_images_where_there_is_no_label_are_left_out(frames_of):
    track = ImageTrack(np.full((4, SENSOR[1], SENSOR[0]), 9, np.uint8), np.array([0, 250, 1000, 1001], np.int64))
    _, frames = frames_of(make_dataset(release=track), Windows(labels="interpolated"), polarity=False)
    assert frames.column("t_end_us") == [0, 250, 1000] * 2
    assert frames.labels.joints2d[:3, 0, 0].tolist() == [8, 8.5, 10]


@pytest.mark.parametrize("method", ["count", "duration", "whole"])
def test_recordings_larger_than_what_is_held_give_the_same_frames(frames_of, monkeypatch, method):
    windows = Windows(method=method, num_events=7, duration_us=90, min_events=3, max_windows=9)
    _, whole = frames_of(make_dataset(), windows=windows)
    expected = (
        [np.asarray(whole.array(name)) for name in ("histograms", "frames")],
        whole.table.drop_columns("joints3d_mm"),
    )
    monkeypatch.setattr("ctlev_core.recordings.encoding.MAX_EVENTS", 10)
    monkeypatch.setattr("ctlev_core.recordings.encoding.MAX_WINDOWS", 2)
    monkeypatch.setattr("ctlev_core.recordings.encoding.MAX_GAP", 3)
    monkeypatch.setattr(encode, "version", 10**6)  # not the cached artefact
    _, chunks = frames_of(make_dataset(), windows=windows)
    for name, array in zip(("histograms", "frames"), expected[0], strict=True):
        np.testing.assert_array_equal(chunks.array(name), array)
    assert chunks.table.drop_columns("joints3d_mm").equals(expected[1]), "without a column of NaN, which equals nothing"


def test_recordings_without_events_have_no_event_numbers_in_the_realism_table(frames_of):
    recordings, _ = frames_of(make_dataset(images=True), polarity=False)
    made = read_manifest(run_stage(event_realism, recordings=recordings.ref, reference=None, held_out=None))
    assert not len(made)


def key_of(dataset):
    return ingest.key({"dataset": dataset}, Store())


def test_what_a_dataset_says_of_a_file_enters_the_key(monkeypatch, tmp_path):
    """A caption beside it, or the folder it lies in: neither is in the file or need be in the recording's id."""
    (tmp_path / "a.raw").write_bytes(b"1")

    class Options(Frozen):
        """None."""

    recording = Recording("a", "someone", (Part("train"),), "walk", files=(tmp_path / "a.raw",))
    changed = [
        recording,
        replace(recording, class_name="run"),
        replace(recording, subject="another"),
        replace(recording, parts=(Part("test"),)),
    ]
    keys = set()
    for said in changed:
        module = types.SimpleNamespace(VERSION=1, Options=Options, list_recordings=lambda options, r=said: [r])
        monkeypatch.setattr(
            plugins, "load_options", lambda _, m=module: plugins.Plugin("datasets", "fake", m, Options())
        )
        keys.add(key_of(DatasetChoice(name="fake")))
    assert len(keys) == 4


@pytest.mark.parametrize(
    ("t_us", "message"), [([0, 20, 10], r"times of labels must ascend, got \[20, 10\] us"), ([], "got none")]
)
def test_tracks_out_of_order_and_empty_ones_are_refused(t_us, message):
    recording = Recording("a", "someone", (Part("train"),))
    labels = Labels(("walk",) * len(t_us), np.array(t_us, np.int64))
    with pytest.raises(DataError, match=message):
        check_track(labels, recording, "test")


@pytest.mark.parametrize(("count", "told"), [(65_534, False), (65_535, True), (70_000, True)])
def test_counts_that_stop_at_what_they_can_hold_are_told(frames_of, caplog, count, told):
    """A hot pixel."""
    events = make_events(0)
    t = np.sort(np.random.default_rng(0).integers(0, 1000, count))
    hot = Events(t, np.full(count, 7, np.uint16), np.full(count, 5, np.uint16), np.ones(count, np.uint8), SENSOR)
    module = make_dataset()
    module.read_events = lambda recording, options: hot if recording.recording_id == "test/one" else events
    frames_of(module, Windows(method="whole"))
    said = [record.getMessage() for record in caplog.records if "counts stop there" in record.getMessage()]
    expected = "recording 'test/one', window 0: pixel x = 7, y = 5 fired 65535 times or more; counts stop there"
    assert said == ([expected] if told else [])
