"""The stage `realism` on frames made by hand: what the two-sample tests compare, and when there is none."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from ctlev_core.realism import two_sample
from data_contracts import tables
from data_contracts.labels import Labels
from data_contracts.manifest import label_columns, read_manifest, write_manifest
from tasks.realism import realism, realism_floors
from tasks.stage import Output

pytestmark = pytest.mark.usefixtures("quick_two_sample_tests")


def frame_set(folder, pictures, recordings, splits):
    folder.mkdir(parents=True)
    count = len(pictures)
    np.save(folder / "frames.npy", pictures)
    columns = {
        "sample_id": [f"{name}:{row}" for row, name in enumerate(recordings)], "recording_id": recordings,
        "subject": recordings, "split": splits, "class_name": ["a"] * count,
        **dict.fromkeys(("t_start_us", "t_end_us", "t_us", "num_events"), pa.array([1] * count, pa.int64())),
        **label_columns(Labels(("a",) * count, np.zeros(count, np.int64))),
    }  # fmt: skip
    return read_manifest(write_manifest(folder, pa.table(columns), tables.FRAMES))


def synthetic_set(folder, pictures, sources):
    folder.mkdir(parents=True)
    count = len(pictures)
    np.save(folder / "frames.npy", pictures)
    names = [f"made/{row}" for row in range(count)]
    columns = {
        "sample_id": names, "recording_id": names, "condition_id": names, "source_id": [f"{s}:0" for s in sources],
        "subject": ["ann"] * count, "split": ["train"] * count, "class_name": ["a"] * count, "prompt": ["p"] * count,
        "generator": ["g"] * count, "checkpoint_digest": ["c"] * count, "scheduler": ["ddim"] * count,
        "num_inference_steps": pa.array([4] * count, pa.int32()), "guidance_scale": [1.0] * count,
        "seed": [0] * count, "num_attempts": pa.array([1] * count, pa.int32()), "rejected": [""] * count,
        **label_columns(Labels(("a",) * count, np.zeros(count, np.int64))),
    }  # fmt: skip
    table = pa.table(columns).select([column.name for column in tables.SYNTHETIC.columns])
    return read_manifest(write_manifest(folder, table, tables.SYNTHETIC))


def noise(count, share, seed):
    active = np.random.default_rng(seed).random((count, 12, 12, 1)) < share
    return (active * np.uint8(150)).repeat(3, axis=-1)


def _run(stage, folder, *inputs, **options):
    folder.mkdir()
    return write_manifest(folder, stage.function(Output(folder, folder), *inputs, **options), stage.schema)


@pytest.fixture
def run(tmp_path):
    def call(real, generated, names=("synthetic", "gan")):
        floors = read_manifest(_run(realism_floors, tmp_path / "floors", real))
        made = [
            read_manifest(_run(realism, tmp_path / name, real, one, floors, name=name))
            for one, name in zip(generated, names, strict=True)
        ]
        parts = [floors.table, *(one.attached(tables.TWO_SAMPLE_TESTS) for one in made)]
        tests = [test for part in parts for test in part.to_pylist()]
        rows = [row for one in made for row in one.table.to_pylist()]
        return rows, {(test["group"], test["subject"]): test for test in tests}

    return call


def test_every_generator_is_told_from_training_and_test_frames_beside_both_floors(tmp_path, run):
    count = 80
    recordings = [f"r{row // 2}" for row in range(2 * count)]
    real = frame_set(tmp_path / "recorded", noise(2 * count, 0.2, 0), recordings, ["train"] * count + ["test"] * count)
    alike = synthetic_set(tmp_path / "alike", noise(count, 0.2, 1), ["elsewhere"] * count)
    other = synthetic_set(tmp_path / "other", noise(count, 0.6, 2), ["elsewhere"] * count)
    rows, tests = run(real, [alike, other])
    assert set(tests) == {
        ("frames", "recorded against recorded"), ("frames", "test against recorded"), ("frames", "test against test"),
        ("frames", "synthetic against recorded"),
        ("frames", "synthetic against test"), ("frames of gan", "gan against recorded"),
        ("frames of gan", "gan against test"),
    }  # fmt: skip
    for (group, setting), test in tests.items():
        if setting.startswith("gan"):
            assert test["value"] > 0.95
        else:
            assert test["low"] < 0.5 < test["high"], (group, setting)
    scored = {(row["group"], row["subject"]): row for row in rows if row["metric"] == "c2st"}
    floors = ("recorded against recorded", "test against test", "test against recorded")
    assert set(scored) == {*tests, *(("frames of gan", setting) for setting in floors)}
    found = scored["frames of gan", "gan against test"]
    assert (found["value"], found["low"]) == tuple(
        tests["frames of gan", "gan against test"][k] for k in ("value", "low")
    )
    assert found["num_samples"] == count
    assert {row["group"] for row in rows} == {"frames", "frames of gan"}, "no recordings, no events"


def test_frames_for_validation_take_the_place_of_test_frames(tmp_path, run, monkeypatch):
    monkeypatch.setattr("ctlev_core.realism.two_sample_network.NUM_STEPS", 2)
    splits = ["train"] * 80 + ["validation"] * 80
    real = frame_set(tmp_path / "recorded", noise(160, 0.2, 0), [f"r{row // 2}" for row in range(160)], splits)
    made = synthetic_set(tmp_path / "made_set", noise(80, 0.2, 1), ["elsewhere"] * 80)
    _, tests = run(real, [made], ("synthetic",))
    assert {subject for _, subject in tests} == {
        "recorded against recorded", "validation against recorded", "validation against validation",
        "synthetic against recorded", "synthetic against validation",
    }  # fmt: skip


def test_with_few_frames_the_table_says_why_and_the_scores_have_no_row(tmp_path, run):
    real = frame_set(tmp_path / "recorded", noise(20, 0.2, 0), [f"r{row}" for row in range(20)], ["train"] * 20)
    made = synthetic_set(tmp_path / "made_set", np.zeros((50, 12, 12, 3), np.uint8), ["elsewhere"] * 50)
    rows, tests = run(real, [made], ("synthetic",))
    assert all(test["value"] is None and "fewer than 40 frames" in test["note"] for test in tests.values())
    assert not [row for row in rows if row["metric"] == "c2st"]
    assert tests["frames", "synthetic against test"]["num_second"] == 0


def test_frames_made_from_a_recording_are_held_out_with_it(tmp_path, run, monkeypatch):
    count = 40
    recordings = [f"r{row}" for row in range(count)]
    real = frame_set(tmp_path / "recorded", noise(count, 0.2, 0), recordings, ["train"] * count)
    made = synthetic_set(tmp_path / "made_set", noise(count, 0.2, 1), [*recordings[:-1], "elsewhere"])
    seen = []
    compare = two_sample.compare_frames

    def watch(first, second, **groups):
        seen.append(groups["first_groups"].tolist())
        return compare(first, second, **groups)

    monkeypatch.setattr(two_sample, "compare_frames", watch)
    run(real, [made], ("synthetic",))
    assert [*recordings[:-1], f"made/{count - 1}"] in seen
