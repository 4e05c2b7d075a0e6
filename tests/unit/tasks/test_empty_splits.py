"""A split without rows is refused by the stages that score, with the name of what was read."""

import numpy as np
import pyarrow as pa
import pytest

from data_contracts import tables
from data_contracts.config import ConditionChoice, DownstreamChoice, EncodingChoice, MetricChoice
from data_contracts.errors import DataError
from data_contracts.labels import Labels
from data_contracts.manifest import label_columns, read_manifest, write_manifest
from tasks.condition import condition_some_frames
from tasks.evaluate import score_distance, score_model
from tasks.stage import Output


def frame_set(folder, split, count=3):
    folder.mkdir()
    np.save(folder / "frames.npy", np.zeros((count, 40, 40, 3), np.uint8))
    columns = {
        "sample_id": [f"{folder.name}/{row}" for row in range(count)],
        "recording_id": ["r"] * count,
        "subject": ["s"] * count,
        "split": [split] * count,
        "class_name": ["a"] * count,
        **dict.fromkeys(("t_start_us", "t_end_us", "t_us", "num_events"), pa.array([1] * count, pa.int64())),
        **label_columns(Labels(("a",) * count, np.zeros(count, np.int64))),
    }
    return read_manifest(write_manifest(folder, pa.table(columns), tables.FRAMES))


def test_an_empty_test_split_is_refused_before_the_model_is_read(tmp_path):
    data = frame_set(tmp_path / "recorded", "train")
    with pytest.raises(DataError, match=r"recorded: no rows in split 'test' to score on"):
        score_model.function(
            Output(tmp_path, tmp_path), None, data, [data], [], downstream=DownstreamChoice(name="classifier"),
            metrics=[MetricChoice(name="classification")], subject="recorded", split="test", seed=0,
        )  # fmt: skip


@pytest.mark.parametrize(("splits", "named"), [(("train", "train"), "other: .* 'test'"), (("test", "test"), "'train'")])
def test_an_empty_set_of_frames_is_compared_with_nothing(tmp_path, splits, named, monkeypatch):
    from ctlev_core.downstream import classifier

    extractor, real, other = (
        frame_set(tmp_path / name, split)
        for name, split in zip(("x", "recorded", "other"), ("train", *splits), strict=True)
    )
    monkeypatch.setattr(classifier, "features", lambda folder, frames: np.zeros((len(frames), 2), np.float32))
    with pytest.raises(DataError, match=named):
        score_distance.function(
            Output(tmp_path, tmp_path), extractor, real, other, downstream=DownstreamChoice(name="classifier"),
            distances=[MetricChoice(name="frechet")], subject="synthetic", split="test", seed=0,
        )  # fmt: skip


def test_conditions_of_an_empty_split_are_refused(tmp_path):
    data = frame_set(tmp_path / "recorded", "train")
    with pytest.raises(DataError, match=r"recorded: expected frames of split 'test', got none"):
        condition_some_frames.function(
            Output(tmp_path, tmp_path), None, data, condition=ConditionChoice(name="text"),
            encoding=EncodingChoice(name="event_histogram"), split="test", count=5, seed=0,
        )  # fmt: skip
