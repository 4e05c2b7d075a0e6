"""Scores that do not fit the model are refused in the plan; what a body file holds is in the key."""

import numpy as np
import pytest

from ctlev_core import plugins
from ctlev_core.metrics import pve
from ctlev_core.plugins import PluginError
from ctlev_core.score_requirements import check_distances, check_metrics
from data_contracts.config import DownstreamChoice, MetricChoice, cache_material
from data_contracts.errors import DataError
from data_contracts.experiment import Experiment
from flows.command_line import PRESETS, load_preset, preset_names
from flows.full_experiment import full_experiment
from tasks.stage import call_flow, planning

FITTING = {
    "classifier": {"classification", "zero_shot"},
    "pose2d": {"mpjpe2d", "oks", "pck2d"},
    "smpl_regressor": {"mpjpe2d", "oks", "pck2d", "mpjpe3d", "pck3d", "pve"},
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


def test_a_model_that_says_nothing_is_not_checked(monkeypatch):
    monkeypatch.delattr(plugins.load("downstream", "pose2d"), "PREDICTS")
    check_metrics(DownstreamChoice(name="pose2d"), [MetricChoice(name="pve")])


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
        ("downstream={name: torchscript, options: {file: FILE}}", r"got 'torchscript', which predicts nothing but"),
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
        if name == "ablations":
            continue  # extends another
        experiment = load_preset(Experiment, PRESETS, name, [])
        check_metrics(experiment.downstream, experiment.metrics)
        if experiment.feature_extractor is not None:
            check_distances(experiment.feature_extractor, experiment.distances)


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
