"""Scores that do not fit the model are refused in the plan; what a body file holds is in the key."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from ctlev_core import plugins
from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.metrics import pve
from ctlev_core.plugins import PluginError
from ctlev_core.scoring.checks import check_dataset, check_distances, check_frames, check_labels, check_metrics
from data_contracts import tables
from data_contracts.config import DatasetChoice, DownstreamChoice, MetricChoice, cache_material
from data_contracts.errors import DataError
from data_contracts.experiment import Experiment
from data_contracts.labels import Labels
from data_contracts.manifest import label_columns, write_manifest
from flows.command_line import PRESETS, load_preset, preset_names
from flows.full_experiment import full_experiment
from tasks.stage import call_flow, planning

FITTING = {
    "classifier": {"classification", "zero_shot"},
    "pose2d": {"mpjpe2d", "mpjpe2d_sensor", "oks", "pck2d"},
    "smpl_regressor": {"mpjpe2d", "mpjpe2d_sensor", "oks", "pck2d", "mpjpe3d", "pck3d", "pve"},
    "inception": set(),
    "torchscript": set(),
    "transformers_features": set(),
}


def plan(*overrides):
    with planning() as rows:
        call_flow(full_experiment, load_preset(Experiment, PRESETS, "smoke", list(overrides)))
    return {row.label: row.key for row in rows if row.stage in ("score_model", "score_distance")}


def test_each_model_takes_the_metrics_of_what_it_predicts():
    assert set(FITTING) <= set(plugins.names("downstream"))
    for model, fitting in FITTING.items():
        for metric in plugins.names("metrics"):
            if metric in fitting:
                check_metrics(DownstreamChoice(name=model), [MetricChoice(name=metric)])
            else:
                with pytest.raises(PluginError, match=rf"metrics: .*{metric!r}"):
                    check_metrics(DownstreamChoice(name=model), [MetricChoice(name=metric)])


def test_predictions_hold_what_a_model_says_it_predicts():
    """The names that metrics look for, per kind of input, are in the docstrings that promise them."""
    columns = {"joints2d": "`joints2d`", "joints3d": "`joints3d`", "smpl": "`smpl_pose`", "classes": "`classes`"}
    for model in FITTING:
        module = plugins.load("downstream", model)
        text = (module.predict.__doc__ or "") + (getattr(module, "predict_sequences", module.predict).__doc__ or "")
        for name in module.PREDICTS:
            assert columns[name] in text, (model, name)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "metrics=[{name: mpjpe2d}, {name: mpjpe3d}]",
            r"'mpjpe3d' expected a downstream model that predicts joints3d, got 'pose2d', which predicts joints2d",
        ),
        ("metrics=[{name: kid}]", r"expected metrics of predictions, got 'kid'.*name it under distances"),
        ("distances=[{name: mpjpe2d}]", r"got 'mpjpe2d', which compares joints2d; name it under metrics"),
        ("feature_extractor={name: pose2d}", r"expected a model with features, got 'pose2d', which has none"),
        (
            "downstream={name: torchscript, options: {file: FILE, trusted: true}}",
            r"got 'torchscript', which predicts nothing but",
        ),
    ],
)
def test_a_plan_that_cannot_be_scored_is_refused_before_anything_is_written(override, message, monkeypatch, tmp_path):
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path / "home"))
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(PluginError, match=message):
        plan(override.replace("FILE", str(tmp_path / "file")))
    assert not (tmp_path / "home" / "artefacts").exists()


def test_every_preset_can_be_scored():
    for name in preset_names():
        if name in ("all_routes", "demo", "nmnist", "paper", "rehearsal", "usefulness") or name.endswith("_repeated"):
            continue  # studies, made of others
        experiment = load_preset(Experiment, PRESETS, name, [])
        check_metrics(experiment.downstream, experiment.metrics)
        if experiment.feature_extractor is not None:
            check_distances(experiment.feature_extractor, experiment.distances)


def some_labels(**changes):
    row = {"joints2d": np.zeros((1, 13, 2), np.float32), "visible": np.ones((1, 13), bool), "joint_set": "dhp19"}
    return Labels(("walk",), np.zeros(1, np.int64), **{**row, **changes})


SOLID = np.zeros((1, 13, 3), np.float32)


@pytest.mark.parametrize(
    ("metric", "options", "labels", "message"),
    [
        ("mpjpe3d", {}, some_labels(), "expected labels with joints3d, got mine, which has joints2d, classes"),
        ("pve", {}, some_labels(), "expected labels with smpl"),
        ("classification", {}, replace(some_labels(), class_names=("",)), "with classes, got mine, which has joints2d"),
        ("mpjpe2d", {}, Labels(("",), np.zeros(1, np.int64)), "which has none of any kind"),
        ("oks", {}, some_labels(joint_set="hands"), "'oks' does not fit the labels of mine: .* sigmas, got 'hands'"),
        ("pck2d", {}, some_labels(joint_set=""), "the torso needs a joint set of"),
        ("pck2d", {"normaliser": "head"}, some_labels(joint_set="hands"), "the head needs a joint set of"),
        ("mpjpe3d", {}, some_labels(joints3d=SOLID, joint_set="hands"), "no hips to align by"),
        ("pck3d", {}, some_labels(joints3d=SOLID, joint_set="hands"), "no hips to align by"),
        (
            "pck3d",
            {"alignment": "none", "head_threshold": 0.5},
            some_labels(joints3d=SOLID, joint_set="hands"),
            "the head needs a joint set of",
        ),
    ],
)
def test_labels_that_a_metric_cannot_use_are_refused(metric, options, labels, message):
    with pytest.raises(PluginError, match=message):
        check_labels([MetricChoice(name=metric, options=options)], labels, "mine")


@pytest.mark.parametrize("joint_set", sorted(JOINT_SETS))
def test_all_pose_metrics_take_the_joint_sets_there_are(joint_set):
    count = len(JOINT_SETS[joint_set].joints)
    flat, solid = np.zeros((1, count, 2), np.float32), np.zeros((1, count, 3), np.float32)
    labels = some_labels(joints2d=flat, visible=np.ones((1, count), bool), joints3d=solid, joint_set=joint_set)
    head = {"normaliser": "head"}
    chosen = [("mpjpe2d", {}), ("pck2d", {}), ("pck2d", head), ("mpjpe3d", {}), ("pck3d", {"head_threshold": 0.5})]
    chosen += [("oks", {})] * (joint_set != "smpl")  # nobody has measured how far annotators disagree about a spine
    check_labels([MetricChoice(name=name, options=options) for name, options in chosen], labels, "mine")


def test_a_dataset_is_asked_for_the_labels_of_one_recording():
    """Objects have classes and no joints."""
    objects = DatasetChoice(name="studio_objects")
    check_dataset([MetricChoice(name="classification")], objects)
    with pytest.raises(PluginError, match="got dataset 'studio_objects', which has classes"):
        check_dataset([MetricChoice(name="mpjpe2d")], objects)


def test_a_dataset_without_recordings_for_validation_is_refused_in_the_plan():
    metrics = [MetricChoice(name="classification")]
    with pytest.raises(DataError, match="evaluate_on is 'validation', but its options hold no recordings back"):
        check_dataset(metrics, DatasetChoice(name="studio_objects"), "validation")
    held_back = DatasetChoice(name="studio_objects", options={"num_validation_per_class": 1})
    check_dataset(metrics, held_back, "validation")


def test_frames_that_are_there_already_are_looked_at_in_the_plan(tmp_path):
    metrics = [MetricChoice(name="mpjpe2d")]
    check_frames(metrics, tmp_path / "planned")
    columns = {
        "sample_id": ["a"], "recording_id": ["r"], "subject": ["s"], "split": ["test"], "class_name": ["walk"],
        **dict.fromkeys(("t_start_us", "t_end_us", "t_us", "num_events"), pa.array([1], pa.int64())),
        **label_columns(Labels(("walk",), np.zeros(1, np.int64))),
    }  # fmt: skip
    write_manifest(tmp_path, pa.table(columns), tables.FRAMES)
    with pytest.raises(PluginError, match=r"'mpjpe2d' expected labels with joints2d, got .*, which has classes"):
        check_frames(metrics, tmp_path)


BODY = ("downstream={name: smpl_regressor}", "feature_extractor=null")


def test_another_body_is_another_key_and_another_place_is_not(monkeypatch, tmp_path):
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path / "home"))

    def keys(path):
        return plan(*BODY, f"metrics=[{{name: pve, options: {{body: {path}}}}}]")

    body, moved = tmp_path / "body.npz", tmp_path / "moved.npz"
    np.savez(body, v_template=np.zeros(3))
    moved.write_bytes(body.read_bytes())
    first = keys(body)
    assert first == keys(moved)
    np.savez(body, v_template=np.ones(3))
    assert not set(keys(body).values()) & set(first.values())


def test_the_bundled_body_leaves_keys_as_they_are():
    assert cache_material(pve.Options()) == {"body": "", "alignment": "pelvis"}


def test_a_body_that_is_missing_is_refused_where_the_experiment_is_planned(monkeypatch, tmp_path):
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path / "home"))
    with pytest.raises(DataError, match=r"pve: expected option `body` to be an SMPL file .*, got .*absent\.pkl"):
        plan(*BODY, f"metrics=[{{name: pve, options: {{body: {tmp_path / 'absent.pkl'}}}}}]")
