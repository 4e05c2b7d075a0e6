"""The stage `sequence_realism` on recordings made by hand: what is compared, shuffled time, too little data."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ctlev_core.realism.stretches import SHUFFLED
from data_contracts import tables
from data_contracts.labels import Labels
from data_contracts.manifest import label_columns, read_manifest, write_manifest
from tasks.sequence_realism import MAX_STRETCHES, sequence_realism
from tasks.stage import Output

LENGTH, STEP_US, SIDE = 4, 20_000, 24
pytestmark = pytest.mark.usefixtures("quick_two_sample_tests")


def moving_dots(count, speed, seed, length=LENGTH):
    """`count` recordings of a block that moves right: frames [count * length, ...], its middle in each, [.., 2] px."""
    rng = np.random.default_rng(seed)
    frames, middles = np.zeros((count, length, SIDE, SIDE, 3), np.uint8), np.zeros((count, length, 2))
    for recording, places in zip(frames, middles, strict=True):
        x, y = rng.integers(3, 6), rng.integers(3, SIDE - 4)
        for number, frame in enumerate(recording):
            frame[y - 2 : y + 3, x - 2 : x + 1, 0] = frame[y - 2 : y + 3, x + 1 : x + 3, 2] = 200
            places[number] = x + 0.5, y + 0.5
            x += speed
    return frames.reshape(-1, SIDE, SIDE, 3), middles.reshape(-1, 2)


def labels_at(middles):
    joints = np.repeat(middles[:, None], 13, axis=1).astype(np.float32)
    names, visible = ("walk",) * len(joints), np.ones(joints.shape[:2], bool)
    return Labels(names, np.zeros(len(joints), np.int64), joints2d=joints, visible=visible, joint_set="dhp19")


def times(count, length=LENGTH):
    return np.tile(np.arange(length) * STEP_US, count).tolist()


def recorded(folder, train, test, labelled=True, length=LENGTH):
    folder.mkdir(parents=True)
    np.save(folder / "frames.npy", np.concatenate([train[0], test[0]]))
    counts = len(train[0]) // length, len(test[0]) // length
    names = np.repeat([f"r{number}" for number in range(sum(counts))], length).tolist()
    split = ["train"] * len(train[0]) + ["test"] * len(test[0])
    middles = np.concatenate([train[1], test[1]])
    labels = labels_at(middles) if labelled else Labels(("walk",) * len(names), np.zeros(len(names), np.int64))
    columns = {
        "sample_id": [f"{name}:{row}" for row, name in enumerate(names)], "recording_id": names,
        "subject": names, "split": split, "class_name": ["walk"] * len(names),
        "t_start_us": times(sum(counts), length), "t_end_us": times(sum(counts), length),
        "t_us": times(sum(counts), length), "num_events": [9] * len(names), **label_columns(labels),
    }  # fmt: skip
    return read_manifest(write_manifest(folder, pa.table(columns), tables.FRAMES))


def synthetic(folder, made, step_us=STEP_US):
    folder.mkdir(parents=True)
    pictures, middles = made
    np.save(folder / "frames.npy", pictures)
    count = len(pictures)
    names = [f"made/{row}" for row in range(count)]
    sources = [f"pose/{row // LENGTH}:{row % LENGTH * step_us}" for row in range(count)]
    columns = {
        "sample_id": names, "recording_id": names, "condition_id": names, "source_id": sources,
        "subject": ["ann"] * count, "split": ["train"] * count, "class_name": ["walk"] * count, "prompt": ["p"] * count,
        "generator": ["g"] * count, "checkpoint_digest": ["c"] * count, "scheduler": ["ddim"] * count,
        "num_inference_steps": pa.array([4] * count, pa.int32()), "guidance_scale": [1.0] * count,
        "seed": [0] * count, "num_attempts": pa.array([1] * count, pa.int32()), "rejected": [""] * count,
        **label_columns(labels_at(middles)),
    }  # fmt: skip
    table = pa.table(columns).select([column.name for column in tables.SYNTHETIC.columns])
    return read_manifest(write_manifest(folder, table, tables.SYNTHETIC))


@pytest.fixture
def run(tmp_path):
    def call(frames, generated, names, number=0):
        folder = tmp_path / f"measured{number}"
        folder.mkdir()
        settings = {"names": names, "length": LENGTH, "step_us": STEP_US}
        table = sequence_realism.function(Output(folder, folder), frames, generated, **settings)
        tests = pq.read_table(folder / f"{tables.TWO_SAMPLE_TESTS.name}.parquet").to_pylist()
        return table.to_pylist(), {test["subject"]: test for test in tests}

    return call


def values(rows, metric):
    return {row["subject"]: row["value"] for row in rows if row["metric"] == metric}


@pytest.mark.slow
def test_generators_and_shuffled_time_stand_beside_recorded_stretches(tmp_path, run):
    count = 80
    frames = recorded(tmp_path / "recorded", moving_dots(count, 3, 0), moving_dots(count, 3, 1))
    alike = synthetic(tmp_path / "alike", moving_dots(count, 3, 2))
    pictures, middles = moving_dots(count, 3, 3)
    order = np.random.default_rng(0).permuted(np.tile(np.arange(LENGTH), (count, 1)), axis=1)
    without_time = pictures.reshape(count, LENGTH, SIDE, SIDE, 3)[np.arange(count)[:, None], order]
    still = synthetic(tmp_path / "still", (without_time.reshape(pictures.shape), middles))
    rows, tests = run(frames, [alike, still], ("synthetic", "gan"))
    sets = {"recorded", SHUFFLED, "test", "synthetic", "gan"}
    assert set(values(rows, "flow_agreement")) == sets
    flow, stays = values(rows, "flow_agreement"), values(rows, "persistent_share")
    assert all(flow[name] > 0.8 for name in ("recorded", "test", "synthetic"))
    assert all(flow[name] < 0.5 for name in (SHUFFLED, "gan"))
    # Of 5 columns 3 lie within 1 px of their place 3 px on.
    assert all(stays[name] == pytest.approx(3 / 5) for name in ("recorded", "test", "synthetic"))
    assert stays["gan"] < 0.5 and stays[SHUFFLED] < 0.5
    assert set(tests) == {
        "recorded against recorded", "test against test", "test against recorded", f"{SHUFFLED} against recorded",
        "synthetic against recorded", "synthetic against test", "gan against recorded", "gan against test",
    }  # fmt: skip
    for subject, test in tests.items():
        if subject.startswith((SHUFFLED, "gan")):
            assert test["low"] > 0.6, subject
        else:
            assert test["low"] < 0.5 < test["high"], subject
    assert values(rows, "c2st") == {subject: test["value"] for subject, test in tests.items()}
    assert {row["task"] for row in rows} == {"realism"} and {row["group"] for row in rows} == {"sequences"}
    assert {row["num_samples"] for row in rows if row["metric"] == "flow_agreement"} == {count}
    assert all(row["low"] <= row["value"] <= row["high"] for row in rows if row["metric"] != "c2st")


@pytest.mark.slow
def test_the_same_frames_give_the_same_numbers(tmp_path, run):
    frames = recorded(tmp_path / "recorded", moving_dots(45, 2, 0), moving_dots(45, 2, 1))
    made = synthetic(tmp_path / "made", moving_dots(45, 2, 2))
    assert run(frames, [made], ("synthetic",)) == run(frames, [made], ("synthetic",), 1)


def test_with_few_stretches_there_is_no_area_and_the_table_says_why(tmp_path, run):
    frames = recorded(tmp_path / "recorded", moving_dots(6, 3, 0), moving_dots(3, 3, 1))
    far_apart = synthetic(tmp_path / "far", moving_dots(6, 3, 2), step_us=3 * STEP_US)
    rows, tests = run(frames, [far_apart], ("synthetic",))
    assert all(test["value"] is None and "fewer than 40 frames" in test["note"] for test in tests.values())
    assert tests["synthetic against recorded"]["num_first"] == 0
    assert values(rows, "c2st") == {} and "synthetic" not in values(rows, "persistent_share")
    intervals = {row["subject"]: row["low"] for row in rows if row["metric"] == "persistent_share"}
    assert intervals["recorded"] is not None and intervals["test"] is None, "three recordings say too little"


def test_frames_without_joints_have_the_other_numbers(tmp_path, run):
    frames = recorded(tmp_path / "recorded", moving_dots(6, 3, 0), moving_dots(6, 3, 1), labelled=False)
    rows, _ = run(frames, [], ())
    found = {row["metric"] for row in rows}
    assert {"rate_correlation_lag1", "persistent_share", "polarity_kept_share"} >= found
    assert "persistent_share" in found


def test_of_many_stretches_some_are_read(tmp_path, run, monkeypatch):
    monkeypatch.setattr("tasks.sequence_realism.MAX_STRETCHES", 7)
    assert MAX_STRETCHES >= 80, "or half of the recordings have too few for the floor"
    made = moving_dots(10, 1, 0, length=2 * LENGTH)
    frames = recorded(tmp_path / "recorded", made, moving_dots(1, 1, 1, length=2 * LENGTH), length=2 * LENGTH)
    rows, tests = run(frames, [], ())
    assert tests["recorded against recorded"]["num_first"] + tests["recorded against recorded"]["num_second"] == 7
    (recordings,) = {row["num_samples"] for row in rows if row["subject"] == "recorded"}
    assert recordings == 7
