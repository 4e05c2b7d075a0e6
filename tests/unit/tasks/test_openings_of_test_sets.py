"""Test frames are counted as often as experiments with other options are scored on them."""

import json
from concurrent.futures import ThreadPoolExecutor

import pytest

from ctlev_core.downstream import pose2d
from data_contracts.experiment import Experiment
from flows.command_line import PRESETS, load_preset
from tasks.openings import FOLDER, note_opening
from tasks.stage import planning


@pytest.fixture
def experiments():
    return lambda *overrides: load_preset(Experiment, PRESETS, "smoke", list(overrides))


def test_other_options_and_seeds_count_and_the_same_again_does_not(home, experiments):
    smoke = experiments()
    assert note_opening(home, "a", smoke) == 1
    assert note_opening(home, "a", smoke) == 1
    assert note_opening(home, "a", experiments("name=other")) == 1, "a name changes no score"
    assert note_opening(home, "a", experiments("seed=5")) == 2
    assert note_opening(home, "b", experiments("seed=5")) == 1, "other frames, another count"
    for changed in ("downstream.options.device=cpu", "downstream.options.checkpoint_every_s=30", "sampling.device=cpu"):
        assert note_opening(home, "a", experiments(changed)) == 2, "where and how it runs changes no score"
    default = pose2d.Options().weight_decay
    assert "weight_decay" not in smoke.downstream.options
    assert note_opening(home, "a", experiments(f"downstream.options.weight_decay={default}")) == 2
    lines = [json.loads(line) for line in (home / FOLDER / "a.jsonl").read_text().splitlines()]
    assert [line["experiment"] for line in lines] == ["smoke", "smoke"] and lines[0]["options"] != lines[1]["options"]


def test_a_plan_opens_nothing(home, experiments):
    with planning():
        assert note_opening(home, "a", experiments()) is None
    assert not (home / FOLDER).exists()


@pytest.mark.parametrize("end", [b"", b"\n"])
def test_a_line_cut_short_loses_nothing_else(home, experiments, end):
    note_opening(home, "a", experiments())
    file = home / FOLDER / "a.jsonl"
    file.write_bytes(file.read_bytes() + b'{"options": "\xff' + end)
    assert note_opening(home, "a", experiments("seed=5")) == 2
    assert note_opening(home, "a", experiments("seed=6")) == 3


def test_experiments_side_by_side_are_all_counted(home, experiments):
    asked = [experiments(f"seed={seed}") for seed in range(24)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda one: note_opening(home, "a", one), asked))
    assert note_opening(home, "a", asked[0]) == 24
