"""Labels that are chosen to cover poses, or because they are hard: stages on a small simulated dataset."""

import numpy as np
import pytest
from pydantic import ValidationError

from ctlev_core.labels.pose_choice import pose_vectors
from ctlev_core.labels.rows_to_sample import inner_moments, label_moments, moments_in_image
from data_contracts.errors import DataError
from data_contracts.experiment import Experiment
from data_contracts.manifest import read_manifest
from flows.command_line import PRESETS, load_preset
from flows.prepare_dataset import choose_labels, condition_asked_samples
from tasks.encode import encode
from tasks.ingest import ingest
from tasks.subset import take_fold

COUNT = 12
OPTIONS = {"num_train_recordings": 6, "num_test_recordings": 3, "num_condition_recordings": 5, "label_rate_hz": 20}


def experiment(**changes):
    values = load_preset(Experiment, PRESETS, "smoke", ["keep_fraction=null", "oracle=null"]).model_dump()
    values |= {
        "dataset": {"name": "studio", "options": OPTIONS},
        "windows": {"num_events": 300, "max_windows": 3},
        "encoding": {"name": "event_histogram", "options": {"polarity": False, "image_size": [64, 64], "fit": "crop"}},
        "downstream": {"name": "pose2d", "options": {"num_steps": 2, "width": 0.25}},
        "metrics": [{"name": "mpjpe2d"}],
        "baselines": {},
        "mixtures": [],
        "num_synthetic": COUNT,
        "export": None,
    } | changes
    return Experiment.model_validate(values)


@pytest.fixture
def prepared(at_once):
    asked = experiment()
    recordings = ingest(dataset=asked.dataset)
    return asked, recordings, encode(recordings, encoding=asked.encoding, windows=asked.windows)


def moments_of(made):
    return list(zip(made.column("recording_id"), made.column("t_us"), strict=True))


def test_covering_labels_are_the_farthest_poses_and_become_the_conditions(prepared):
    asked, recordings, frames = prepared
    made = choose_labels(asked, recordings, recordings, frames, "coverage")
    table = read_manifest(made)
    values = np.array(table.column("value"))
    assert len(table) == COUNT and len(set(moments_of(table))) == COUNT and (np.diff(values) <= 0).all()
    # The first is the farthest of all from every recorded training pose, whatever the test frames show.
    source, of_frames = read_manifest(recordings), read_manifest(frames)
    moments = label_moments(source)
    rows = inner_moments(moments, of_frames)
    pool = moments_in_image(moments.take(rows), source, source, of_frames, asked.encoding, 0)
    learnt = of_frames.labels.take(of_frames.rows_where(split="train"))
    vectors, known = (pose_vectors(one, (64, 64)) for one in (pool, learnt))
    nearest = np.linalg.norm(vectors[:, None] - known, axis=2).min(axis=1)
    assert table.column("moment")[0] == rows[nearest.argmax()] and values[0] == pytest.approx(nearest.max(), rel=1e-6)
    # They are farther from one another than random ones are.
    random = read_manifest(condition_asked_samples(asked, recordings, recordings, frames, asked.condition))
    covering = read_manifest(
        condition_asked_samples(
            experiment(baselines={"b": {"labels": "coverage"}}),
            recordings,
            recordings,
            frames,
            asked.condition,
            baseline="b",
        )
    )
    assert covering.column("source_id") == [f"{name}:{t}" for name, t in moments_of(table)]
    left = [
        np.linalg.norm(vectors[:, None] - pose_vectors(made.labels, (64, 64)), axis=2).min(axis=1).max()
        for made in (covering, random)
    ]
    assert left[0] < left[1]


@pytest.mark.slow
def test_hard_labels_are_of_the_quarter_with_the_largest_errors_to_expect(prepared):
    asked, recordings, frames = prepared
    table = read_manifest(choose_labels(asked, recordings, recordings, frames, "hard"))
    rows = inner_moments(label_moments(read_manifest(recordings)), read_manifest(frames))
    chosen = set(table.column("moment"))
    assert len(table) == COUNT and chosen <= set(rows.tolist()) and len(chosen) <= round(len(rows) / 4)
    assert min(table.column("value")) > 0
    # Sought again it is the same choice, and random frames take no part in it.
    other = experiment(num_synthetic=5)
    few = read_manifest(choose_labels(other, recordings, recordings, frames, "hard"))
    assert few.column("moment") == table.column("moment")[:5]


def test_folds_hold_each_training_recording_out_once_and_have_no_test_frames(prepared):
    _, _, frames = prepared
    whole = read_manifest(frames)
    rows = whole.rows_where(split="train")
    recordings = np.array(whole.column("recording_id"))
    held_out = []
    for fold in range(2):
        made = read_manifest(take_fold(frames, fold=fold, num_folds=2, seed=0))
        assert made.column("sample_id") == np.array(whole.column("sample_id"))[rows].tolist()
        np.testing.assert_array_equal(made.array("frames")[:], whole.images(rows))
        names, splits = np.array(made.column("recording_id")), np.array(made.column("split"))
        assert not set(names[splits == "train"]) & set(names[splits == "validation"])
        assert set(splits) == {"train", "validation"}
        held_out += sorted(set(names[splits == "validation"]))
    assert sorted(held_out) == sorted(set(recordings[rows]))
    with pytest.raises(DataError, match="7 folds need as many recordings, got 6"):
        take_fold(frames, fold=0, num_folds=7, seed=0)


def test_more_labels_than_moments_come_again_in_the_same_order(prepared):
    _asked, recordings, frames = prepared
    count = len(inner_moments(label_moments(read_manifest(recordings)), read_manifest(frames)))
    many = experiment(num_synthetic=count + 3)
    moments = read_manifest(choose_labels(many, recordings, recordings, frames, "coverage")).column("moment")
    assert len(set(moments[:count])) == count and moments[count:] == moments[:3]


def test_without_label_only_recordings_there_is_nothing_to_choose_from(at_once):
    asked = experiment(dataset={"name": "studio", "options": OPTIONS | {"num_condition_recordings": 0}})
    recordings = ingest(dataset=asked.dataset)
    frames = encode(recordings, encoding=asked.encoding, windows=asked.windows)
    with pytest.raises(DataError, match="chosen from recordings of split 'condition', got none"):
        choose_labels(asked, recordings, recordings, frames, "coverage")


def test_baselines_with_labels_of_their_own_are_scaled_too():
    asked = experiment(baselines={"coverage": {"labels": "coverage"}}, scaling=[0.25], training_sets=["recorded"])
    assert asked.baselines["coverage"].generator == asked.generator
    assert [str(one) for one in asked.all_training_sets] == [
        "recorded", "recorded+synthetic@0.25", "recorded+coverage@0.25",
    ]  # fmt: skip
    # Keys of what was stored before there was a choice stay.
    assert "labels" not in experiment().model_dump(mode="json") and experiment().labels == "random"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"labels": "coverage", "temporal_order": True}, "labels 'coverage': leave out temporal_order, and view 'new'"),
        ({"labels": "hard", "view": "new"}, "labels 'hard': leave out temporal_order, and view 'new'"),
        (
            {"baselines": {"hard": {"labels": "hard"}}, "target": {"name": "studio"}},
            "baselines.hard.labels 'hard' goes by recorded frames of the dataset; leave out target",
        ),
        ({"labels": "easy"}, "'random', 'coverage' or 'hard'"),
    ],
)
def test_choices_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(ValidationError, match=message):
        experiment(**changes)
