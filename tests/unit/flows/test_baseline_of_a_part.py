"""A baseline that learns from one dataset of a union, is asked for its labels, and is scored on every dataset."""

from functools import partial

import numpy as np
import pytest
import yaml
from pydantic import ValidationError
from test_cdehp import write_picture, write_shot
from test_pose_presets import dhp19_raw

from ctlev_core import plugins
from ctlev_core.plugins import PluginError
from data_contracts.experiment import Experiment
from data_contracts.manifest import read_manifest
from data_contracts.parts import only_part, part_of
from flows.command_line import PRESETS, load_preset
from flows.evaluate import evaluate, sensor_of
from flows.full_experiment import full_experiment
from flows.inputs import check_inputs
from flows.prepare_dataset import condition_asked_samples, condition_training_frames
from flows.studies import load_study
from tasks.downstream import train_downstream
from tasks.encode import encode
from tasks.evaluate import score_model
from tasks.finetune import finetune
from tasks.ingest import ingest
from tasks.sample import sample
from tasks.stage import call_flow, planning

SMALL = {"num_train_recordings": 2, "num_test_recordings": 1, "num_condition_recordings": 2, "label_rate_hz": 60}
NEAR = {"name": "studio", "options": {**SMALL, "seed": 1}}
GREY = {"name": "studio", "options": {**SMALL, "seed": 2, "sensor_size": [96, 64], "intensity_rate_hz": 60}}


def experiment(part="grey", **changes):
    values = load_preset(Experiment, PRESETS, "smoke", ["keep_fraction=null", "oracle=null", "scaling=[]"]).model_dump()
    values |= {
        "dataset": {"name": "union", "options": {"parts": {"near": NEAR, "grey": GREY}}},
        "windows": {"num_events": 300, "max_windows": 4},
        "encoding": {"name": "event_histogram", "options": {"polarity": False, "image_size": [64, 64], "fit": "crop"}},
        "baselines": {
            "event_gan": {
                "condition": {"name": "intensity_pair"},
                "generator": {"name": "event_gan", "options": {"num_steps": 1}},
                "part": part,
            }
        },
        "downstream": {"name": "pose2d", "options": {"num_steps": 1, "width": 0.25}},
        "metrics": [{"name": "mpjpe2d"}, {"name": "mpjpe2d_sensor"}],
        "mixtures": [],
        "num_synthetic": 6,
        "stochastic_rounding": False,
        "export": None,
    } | changes
    return Experiment(**values)


def test_it_learns_from_and_is_asked_for_its_part_alone(at_once):
    asked = experiment()
    baseline = asked.baselines["event_gan"]
    recordings = ingest(dataset=asked.dataset)
    frames = encode(recordings, encoding=asked.encoding, windows=asked.windows)
    learnt = condition_training_frames(asked, recordings, frames, baseline.condition, baseline.part)
    conditions = condition_asked_samples(asked, recordings, recordings, frames, baseline.condition, baseline.part)
    both = condition_asked_samples(asked, recordings, recordings, frames, asked.condition)
    assert {part_of(name) for name in read_manifest(conditions).column("source_id")} == {"grey"}
    assert {part_of(name) for name in read_manifest(both).column("source_id")} == {"near", "grey"}
    # What it learns from are the rows of the part among the joint training frames.
    table = read_manifest(frames)
    of_both = np.array(table.column("sample_id"))[table.rows_where(split="train")].tolist()
    assert read_manifest(learnt).column("sample_id") == [name for name in of_both if part_of(name) == "grey"]


@pytest.mark.slow
def test_it_is_scored_on_every_part(at_once):
    asked = experiment()
    baseline = asked.baselines["event_gan"]
    recordings = ingest(dataset=asked.dataset)
    frames = encode(recordings, encoding=asked.encoding, windows=asked.windows)
    learnt = condition_training_frames(asked, recordings, frames, baseline.condition, baseline.part)
    conditions = condition_asked_samples(asked, recordings, recordings, frames, baseline.condition, baseline.part)
    checkpoint = finetune(frames, learnt, generator=baseline.generator, seed=0)
    made = sample(
        checkpoint, frames, conditions, sampling=baseline.sampling_choice, max_attempts=1, seed=0, part="grey"
    )
    model = train_downstream([made], downstream=asked.downstream, seed=0)
    score = partial(score_model, model, downstream=asked.downstream, metrics=list(asked.metrics), seed=0)
    own = score(frames, [made], [], subject="event_gan", split="test", sensor=sensor_of(asked, recordings))
    found = {(row["group"], row["metric"]): row["value"] for row in read_manifest(own).table.to_pylist()}
    for group in ("all", "dataset near", "dataset grey"):
        assert {metric for name, metric in found if name == group} == {"mpjpe2d_px", "mpjpe2d_sensor_px"}
    agreement = score(made, [], [], subject="a", split="train", sensor=sensor_of(asked, recordings, "grey"))
    assert {"mpjpe2d_px", "mpjpe2d_sensor_px"} == set(read_manifest(agreement).column("metric"))


def test_its_labels_are_in_the_image_as_its_pictures_are(at_once):
    """Labels of another sensor are fitted onto the first; of a part alone, that is its own."""
    asked = experiment()
    recordings = ingest(dataset=asked.dataset)
    frames = encode(recordings, encoding=asked.encoding, windows=asked.windows)
    of_union = experiment(dataset=GREY, baselines={})
    alone = ingest(dataset=of_union.dataset)
    alone_frames = encode(alone, encoding=asked.encoding, windows=asked.windows)
    one = condition_asked_samples(asked, recordings, recordings, frames, asked.condition, "grey")
    other = condition_asked_samples(of_union, alone, alone, alone_frames, asked.condition)
    moments = [
        {name.rpartition("/")[2]: row for name, row in zip(m.column("source_id"), m.labels.joints2d, strict=True)}
        for m in map(read_manifest, (one, other))
    ]
    shared = set(moments[0]) & set(moments[1])
    assert shared
    for name in shared:
        np.testing.assert_allclose(moments[0][name], moments[1][name], atol=1e-4)


def test_the_plan_says_so_and_other_stages_keep_their_keys(home):
    def plan(part):
        with planning() as rows:
            call_flow(evaluate, experiment(part, metrics=[{"name": "mpjpe2d"}]))
        return {(row.stage, row.label): row.key for row in rows}

    named, whole = plan("grey"), plan(None)
    told = {label for _, label in set(named) - set(whole)}
    assert told == {
        "condition_frames: intensity_pair, training, grey alone",
        "condition_samples: intensity_pair, to sample, grey alone",
    }
    changed = {label for (stage, label), key in named.items() if whole.get((stage, label), key) != key}
    assert changed and all("event_gan" in label or label in ("finetune", "sample") for label in changed)


def test_table_2_of_the_paper_is_planned_as_it_says(home, tmp_path):
    """On files in the published layouts; with the bundled base model, for the paper's is not at hand."""
    (tmp_path / "dhp19").mkdir()
    dhp19_raw(tmp_path / "dhp19")
    for shot in ("train/A0001P0001S00", "train/A0001P0003S00", "valid/A0001P0002S00"):
        folder = write_shot(tmp_path / "cdehp" / "outdoor" / shot)
        for number in range(2):
            write_picture(folder / f"color_image/{number:06d}.png", 9, size=(848, 480), channels=3)
    values = yaml.safe_load((PRESETS / "paper.yaml").read_text())
    part = values["experiments"]["pose_both"]
    part |= {"set": part["set"][-2:], "feature_extractor": None}
    values |= {"experiments": {"pose_both": part}, "sets": {}}
    (tmp_path / "table2.yaml").write_text(yaml.safe_dump(values))
    given = [f"paths.{name}={tmp_path / name}" for name in ("dhp19", "cdehp")]
    study = load_study(str(tmp_path / "table2.yaml"), given)
    with planning() as rows:
        call_flow(full_experiment, study)
    told = {row.label: row.arguments for row in rows}
    alone = told["condition_samples: intensity_pair, to sample, cdehp alone"]
    assert (alone["part"], alone["count"]) == ("cdehp", 10_000)
    assert told["condition_frames: intensity_pair, training, cdehp alone"]["part"] == "cdehp"
    assert "part" not in told["condition_samples: skeleton, to sample"]
    scored = {f"score_model: pose2d on {name}, seed 0: {name}" for name in ("recorded", "event_gan", "synthetic")}
    assert scored <= set(told)
    assert all(told[name]["metrics"][1]["plugin"] == "metrics/mpjpe2d_sensor" for name in scored)
    # Both datasets have poses that nothing is learnt from, so that half of the samples are of each.
    dataset = plugins.load_options(study.experiments["pose_both"].dataset)
    listed = dataset.module.list_recordings(dataset.options)
    kept_apart = {part_of(one.recording_id) for one in listed if one.parts[0].split == "condition"}
    assert kept_apart == {"dhp19", "cdehp"}


def test_frames_of_other_parts_are_in_no_split_and_keep_their_rows(at_once):
    asked = experiment()
    recordings = ingest(dataset=asked.dataset)
    frames = read_manifest(encode(recordings, encoding=asked.encoding, windows=asked.windows))
    kept = only_part(frames, "near")
    assert len(kept) == len(frames) and only_part(frames, None) is frames
    rows = np.concatenate([kept.rows_where(split=split) for split in ("train", "test")])
    assert set(rows) == {row for row, name in enumerate(frames.column("recording_id")) if part_of(name) == "near"}
    assert {part_of(name) for name in only_part(read_manifest(recordings), "near").column("recording_id")} == {"near"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"part": "far"}, r"baselines\.event_gan\.part: expected one of near, grey, got 'far'"),
        ({"dataset": NEAR}, r"part: expected a dataset that is a union, got 'grey'"),
        ({"poses": NEAR}, "leave out other poses"),
    ],
)
def test_a_part_that_there_is_not_is_refused(changes, message):
    with pytest.raises(ValidationError, match=message):
        experiment(**changes)


def test_a_part_without_pictures_is_refused_before_anything_is_read():
    check_inputs(experiment())
    for part in ("near", None):
        with pytest.raises(PluginError, match=r"intensity frames, and part 'near', dataset 'studio' .* has none; name"):
            check_inputs(experiment(part))
