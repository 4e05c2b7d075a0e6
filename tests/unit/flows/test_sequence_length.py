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


def test_only_its_stage_and_the_report_are_new(monkeypatch, tmp_path):
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    assert "sequence_length" not in json.loads(smoke(*IN_TIME).model_dump_json())
    without, with_it = plan(*IN_TIME), plan(*IN_TIME, "sequence_length=8")
    assert sorted(with_it[key] for key in set(with_it) - set(without)) == ["report", "sequence_realism"]
    assert [without[key] for key in set(without) - set(with_it)] == ["report"]
    assert len(set(plan(*IN_TIME, "sequence_length=4")) - set(with_it)) == 2
