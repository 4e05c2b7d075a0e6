"""Scores by class and by subject, what may not be both learnt from and tested on, and what lies beside distances."""

import logging

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ctlev_core.downstream import classifier
from ctlev_core.scoring.subsets import MAX_SINGLE_SUBJECTS, class_groups, subject_groups
from data_contracts import tables
from data_contracts.config import DownstreamChoice, MetricChoice
from data_contracts.errors import DataError
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest, ManifestRef, label_columns, read_manifest, write_manifest
from tasks.evaluate import _refuse_overlap, score_distance, score_model
from tasks.stage import Output


def rows_of(groups):
    return {name: rows.tolist() for name, rows in groups}


def test_all_rows_and_each_class():
    assert rows_of(class_groups(["walk", "", "run", "walk"])) == {"all": [0, 1, 2, 3], "run": [2], "walk": [0, 3]}
    assert rows_of(class_groups(["all", "cat"])) == {"all": [0, 1], "class all": [0], "cat": [1]}


def test_subjects_apart_where_both_kinds_occur():
    groups = rows_of(subject_groups(["ann", "bob", "ann", "eve"], ["1", "2", "3", "4"], {"bob", "joe"}))
    assert groups["subjects learnt from"] == [1] and groups["subjects not learnt from"] == [0, 2, 3]
    new = rows_of(subject_groups(["ann", "eve", "ann"], ["1", "2", "3"], {"bob"}))
    assert new == {"subject ann": [0, 2], "subject eve": [1]}


def test_one_subject_or_one_a_recording_says_nothing_more():
    assert subject_groups(["ann", "ann"], ["1", "2"], set()) == []
    assert subject_groups(["1", "2"], ["1", "2"], set()) == []
    many = [f"{number:02d}" for number in range(MAX_SINGLE_SUBJECTS + 1)]
    assert subject_groups(many * 2, [str(number) for number in range(2 * len(many))], set()) == []


def frame_set(folder, rows):
    """Rows of (recording, subject, split), all of the class a."""
    folder.mkdir(parents=True)
    recordings, subjects, splits = zip(*rows, strict=True)
    np.save(folder / "frames.npy", np.zeros((len(rows), 4, 4, 3), np.uint8))
    columns = {
        "sample_id": [f"{name}:{split}:{row:05d}" for row, (name, _, split) in enumerate(rows)],
        "recording_id": list(recordings), "subject": list(subjects), "split": list(splits),
        "class_name": ["a"] * len(rows),
        **dict.fromkeys(("t_start_us", "t_end_us", "t_us", "num_events"), pa.array([1] * len(rows), pa.int64())),
        **label_columns(Labels(("a",) * len(rows), np.zeros(len(rows), np.int64))),
    }  # fmt: skip
    return read_manifest(write_manifest(folder, pa.table(columns), tables.FRAMES))


@pytest.fixture
def score(tmp_path, monkeypatch):
    """The scores of a model that finds the class of every other frame."""

    def predict(folder, frames):
        return {"classes": np.array(["a", "b"]), "probability": np.eye(2)[np.arange(len(frames)) % 2]}

    monkeypatch.setattr(classifier, "predict", predict)
    monkeypatch.delattr(classifier, "predict_recordings")

    def run(data, *training_sets):
        table = score_model.function(
            Output(tmp_path, tmp_path), data, data, list(training_sets), [], subject="recorded", split="test", seed=0,
            downstream=DownstreamChoice(name="classifier"), metrics=[MetricChoice(name="classification")],
        )  # fmt: skip
        rows = [row for row in table.to_pylist() if row["metric"] == "accuracy"]
        return {row["group"]: (row["value"], row["num_samples"]) for row in rows}

    return run


def test_recordings_split_in_time_are_scored_apart_from_unseen_subjects(tmp_path, score):
    rows = [
        ("1", "ann", "train"),
        ("1", "ann", "test"),
        ("2", "bob", "test"),
        ("3", "bob", "test"),
        ("4", "eve", "train"),
    ]
    data = frame_set(tmp_path / "recorded", rows)
    assert score(data, data) == {
        "all": (2 / 3, 3), "a": (2 / 3, 3), "subjects learnt from": (1, 1), "subjects not learnt from": (1 / 2, 2),
        "subject ann": (1, 1), "subject bob": (1 / 2, 2),
    }  # fmt: skip


def test_each_of_a_few_unseen_subjects_has_its_own_score(tmp_path, score):
    rows = [("0", "joe", "train"), ("1", "ann", "test"), ("2", "bob", "test"), ("3", "ann", "test")]
    data = frame_set(tmp_path / "recorded", rows)
    assert score(data, data) == {"all": (2 / 3, 3), "a": (2 / 3, 3), "subject ann": (1, 2), "subject bob": (0, 1)}


def test_a_recording_learnt_from_and_tested_on_is_refused(tmp_path, score):
    data = frame_set(tmp_path / "recorded", [("0", "joe", "train"), ("1", "ann", "test")])
    more = frame_set(tmp_path / "more", [("8", "eve", "train"), ("1", "ann", "train")])
    with pytest.raises(DataError, match=r"recording '1' is in the training data .*more and in split 'test'"):
        score(data, data, more)


def test_frames_made_from_poses_of_a_tested_recording_are_refused(tmp_path):
    data = frame_set(tmp_path / "recorded", [("0", "joe", "train"), ("1", "ann", "test")])
    columns = {"sample_id": ["s/0", "s/1"], "subject": ["eve", "ann"], "source_id": ["7:100", "1:200"]}
    table = pa.table({**columns, "split": ["train", "train"]})
    made = Manifest(ManifestRef(key="made", path=tmp_path / "made"), tables.SYNTHETIC, table, {})
    with pytest.raises(DataError, match=r"recording '1' is in the training data .*made"):
        _refuse_overlap(data, np.array([1]), [made], "test")


def test_a_subject_of_the_same_name_in_another_set_is_a_warning(tmp_path, score, caplog):
    data = frame_set(tmp_path / "recorded", [("0", "joe", "train"), ("1", "ann", "test")])
    more = frame_set(tmp_path / "more", [("8", "ann", "train"), ("9", "joe", "train")])
    with caplog.at_level(logging.WARNING, "tasks.evaluate"):
        score(data, data, more)
    assert [record.args[1] for record in caplog.records] == ["ann"]
    caplog.clear()
    score(data, data)
    assert not caplog.records


def test_a_distance_lies_beside_what_real_frames_score_against_one_another(tmp_path, monkeypatch):
    data = frame_set(
        tmp_path / "recorded", [(str(r), "ann", "test" if r % 2 else "train") for r in range(14) for _ in "abc"]
    )
    monkeypatch.setattr(
        classifier, "features", lambda folder, frames: np.random.default_rng(len(frames)).normal(size=(len(frames), 3))
    )
    (tmp_path / "out").mkdir()
    table = score_distance.function(
        Output(tmp_path / "out", tmp_path), data, data, data, downstream=DownstreamChoice(name="classifier"),
        distances=[MetricChoice(name="frechet"), MetricChoice(name="kid")], subject="held-out", split="test", seed=0,
    )  # fmt: skip
    beside = pq.read_table(tmp_path / "out" / "distance_estimates.parquet").to_pylist()
    same = ("subject", "metric", "value", "low", "high")
    assert [[row[name] for name in same] for row in beside] == [
        [row[name] for name in same] for row in table.to_pylist()
    ]
    assert all(row["num_features"] == 3 and row["num_target"] == 21 for row in beside)
    assert all(row["floor_low"] < row["floor"] < row["floor_high"] for row in beside)
