"""The stage that trains: what it hands to a model from several sets of frames."""

from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch

from ctlev_core.downstream import classifier, smpl_regressor
from data_contracts import tables
from data_contracts.config import DownstreamChoice
from data_contracts.errors import DataError
from data_contracts.labels import History, Labels
from data_contracts.manifest import label_columns, read_manifest, write_manifest
from tasks.downstream import train_downstream
from tasks.stage import Output


def frame_set(folder, rows):
    """A manifest of frames; `rows` are (split, subject, recording, class). Frame i is filled with the number i."""
    folder.mkdir()
    count = len(rows)
    splits, subjects, recordings, classes = zip(*rows, strict=True)
    labels = Labels(classes, np.zeros(count, np.int64))
    frames = np.broadcast_to(np.arange(count, dtype=np.uint8)[:, None, None, None], (count, 40, 40, 3))
    np.save(folder / "frames.npy", frames)
    whole = pa.array([1] * count, pa.int64())
    columns = {
        "sample_id": [f"{folder.name}/{row}" for row in range(count)],
        "recording_id": list(recordings),
        "subject": list(subjects),
        "split": list(splits),
        "class_name": list(classes),
        **dict.fromkeys(("t_start_us", "t_end_us", "t_us", "num_events"), whole),
        **label_columns(labels),
    }
    return read_manifest(write_manifest(folder, pa.table(columns), tables.FRAMES))


def run(tmp_path, sets, choice):
    output = Output(tmp_path / "artefact", tmp_path / "work")
    output.folder.mkdir(exist_ok=True)
    return train_downstream.function(output, sets, downstream=choice, seed=0)


@pytest.fixture
def given(monkeypatch):
    """What the classifier was called with, instead of training it."""
    calls: list[dict[str, Any]] = []

    def train(frames, labels, options, **settings):
        calls.append({"frames": frames[:, 0, 0, 0].tolist(), "classes": labels.class_names, **settings})
        return History([1], [0.5], [1], [0.25])

    monkeypatch.setattr(classifier, "train", train)
    return calls


RECORDED = [
    ("train", "S1", "S1/a", "x"),
    ("test", "S3", "S3/a", "x"),
    ("train", "S2", "S2/a", "y"),
    ("train", "S2", "S2/b", "x"),
]
MADE = [("train", "S1", "made/0", "x"), ("train", "S9", "made/1", "y")]


def test_sizes_and_subjects_of_all_sets_reach_the_model(tmp_path, given):
    sets = [frame_set(tmp_path / "recorded", RECORDED), frame_set(tmp_path / "made", MADE)]
    table = run(tmp_path, sets, DownstreamChoice(name="classifier"))
    assert given[0]["frames"] == [0, 2, 3, 0, 1] and given[0]["classes"] == ("x", "y", "x", "x", "y")
    assert given[0]["parts"] == [3, 2] and given[0]["groups"] == ["S1", "S2", "S2", "S1", "S9"]
    assert table["curve"].to_pylist() == ["training", "validation"] and table["loss"].to_pylist() == [0.5, 0.25]


def test_of_one_subject_recordings_are_told_apart(tmp_path, given):
    alone = [(split, "S1", recording, name) for split, _, recording, name in RECORDED]
    run(tmp_path, [frame_set(tmp_path / "recorded", alone)], DownstreamChoice(name="classifier"))
    assert given[0]["parts"] == [3] and given[0]["groups"] == ["S1/a", "S2/a", "S2/b"]


def test_an_empty_set_is_named_and_one_of_several_may_be_empty(tmp_path, given):
    empty = frame_set(tmp_path / "empty", [("test", "S1", "S1/a", "x")])
    with pytest.raises(DataError, match="empty: no rows in split 'train' to learn from"):
        run(tmp_path, [empty], DownstreamChoice(name="classifier"))
    run(tmp_path, [empty, frame_set(tmp_path / "made", MADE)], DownstreamChoice(name="classifier"))
    assert given[0]["parts"] == [0, 2] and given[0]["groups"] == ["S1", "S9"]


def test_a_model_of_sequences_is_told_the_recordings(tmp_path, monkeypatch):
    told: list[dict[str, Any]] = []

    def train(frames, labels, options, **settings):
        told.append(settings)
        return History([1], [0.5], [], [])

    monkeypatch.setattr(smpl_regressor, "train_sequences", train)
    sets = [frame_set(tmp_path / "recorded", RECORDED), frame_set(tmp_path / "made", MADE)]
    run(tmp_path, sets, DownstreamChoice(name="smpl_regressor"))
    assert told[0]["recordings"] == ["S1/a", "S2/a", "S2/b", "made/0", "made/1"]
    assert told[0]["groups"] == ["S1", "S2", "S2", "S1", "S9"] and told[0]["parts"] == [3, 2]


class Means(torch.nn.Module):
    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images.mean([2, 3])


def test_a_ready_made_extractor_goes_through_the_stage_without_losses(tmp_path):
    torch.jit.script(Means()).save(str(tmp_path / "means.pt"))
    choice = DownstreamChoice(name="torchscript", options={"file": str(tmp_path / "means.pt"), "trusted": True})
    table = run(tmp_path, [frame_set(tmp_path / "recorded", RECORDED)], choice)
    assert len(table) == 0
    ref = write_manifest(tmp_path / "artefact", table, tables.TRAINING)
    assert set(read_manifest(ref, full=True).files) == {"model/config.json", "model/network/network.pt"}
