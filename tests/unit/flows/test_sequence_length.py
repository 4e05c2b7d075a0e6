"""The option `sequence_length`: where it is refused, what it adds to a plan, and that it leaves other keys alone."""

import json

import pytest

from ctlev_core.plugins import PluginError
from data_contracts.experiment import Experiment
from flows.command_line import PRESETS, load_preset
from flows.full_experiment import full_experiment
from tasks.stage import call_flow, planning

IN_TIME = ("temporal_order=true", "windows={method: duration, duration_us: 20000}")


def smoke(*overrides):
    return load_preset(Experiment, PRESETS, "smoke", overrides)


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (("temporal_order=false", IN_TIME[1]), "temporal_order must be true"),
        ((IN_TIME[0],), "windows.method must be 'duration', windows.max_windows must be null"),
        ((IN_TIME[0], "windows={method: duration, max_windows: 5}"), "windows.max_windows must be null"),
        ((IN_TIME[0], "windows={method: duration, anchor: labels}"), "windows.anchor must be 'first_event'"),
        ((*IN_TIME, "num_recorded=3"), "num_recorded must be null"),
    ],
)
def test_frames_that_do_not_follow_one_another_are_refused(overrides, told):
    smoke(*overrides)
    with pytest.raises(PluginError, match="sequence_length compares consecutive frames") as error:
        smoke(*overrides, "sequence_length=8")
    assert told in str(error.value)


@pytest.mark.parametrize("length", [2, 65, -1])
def test_stretches_are_neither_pairs_nor_endless(length):
    with pytest.raises(PluginError, match="sequence_length"):
        smoke(*IN_TIME, f"sequence_length={length}")


def plan(*overrides):
    with planning() as rows:
        call_flow(full_experiment, smoke(*overrides))
    return {row.key: row.stage for row in rows}


def test_a_baseline_may_be_asked_for_labels_that_do_not_follow_one_another(monkeypatch, tmp_path):
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    own = (*IN_TIME, "sampling.noise=stretches", "stretch_length=4", "sequence_length=4")
    apart = "baselines={apart: {temporal_order: false, sampling: {noise: independent}}}"
    experiment = smoke(*own, apart)
    assert experiment.in_temporal_order(None) and not experiment.in_temporal_order("apart")
    with_it, without = plan(*own, apart), plan(*own, "baselines={}")
    stages = [with_it[key] for key in set(with_it) - set(without)]
    assert stages.count("condition_samples") == 1 and "finetune" not in stages
    in_time = "baselines={in_time: {sampling: {noise: independent}}}"
    assert "condition_samples" not in [stage for key, stage in plan(*own, in_time).items() if key not in without]
    # Keys of what was stored before there was a choice stay.
    assert "temporal_order" not in smoke(*own, in_time).model_dump(mode="json")["baselines"]["in_time"]


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        ((*IN_TIME, "baselines={a: {temporal_order: true}}"), "baselines.a.temporal_order"),
        (("temporal_order=false", "baselines={a: {temporal_order: false}}"), "that of the experiment is false"),
        (
            (*IN_TIME, "sampling.noise=stretches", "baselines={a: {temporal_order: false}}"),
            "baselines.a.sampling.noise 'stretches' is for frames that follow one another",
        ),
        (
            (*IN_TIME, "baselines={a: {temporal_order: false, motion_layers: {}}}"),
            "baselines.a.motion_layers make frames that follow",
        ),
    ],
)
def test_labels_without_an_order_in_time_are_told_by_name(overrides, told):
    with pytest.raises(PluginError, match=told):
        smoke(*overrides)


def test_only_its_stage_and_the_report_are_new(monkeypatch, tmp_path):
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    assert "sequence_length" not in json.loads(smoke(*IN_TIME).model_dump_json())
    without, with_it = plan(*IN_TIME), plan(*IN_TIME, "sequence_length=8")
    assert sorted(with_it[key] for key in set(with_it) - set(without)) == ["report", "sequence_realism"]
    assert [without[key] for key in set(without) - set(with_it)] == ["report"]
    assert len(set(plan(*IN_TIME, "sequence_length=4")) - set(with_it)) == 2
