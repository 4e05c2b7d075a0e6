"""Test frames are counted as often as experiments with other options are scored on them."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef
from flows.command_line import PRESETS, load_preset
from tasks.openings import FOLDER, note_opening
from tasks.stage import planning


@pytest.fixture
def experiments():
    return lambda *overrides: load_preset(Experiment, PRESETS, "smoke", list(overrides))


def frames(digest):
    return ManifestRef(key="k", path=Path(), digest=digest)


def test_other_options_and_seeds_count_and_the_same_again_does_not(home, experiments):
    smoke = experiments()
    assert note_opening(home, frames("a"), smoke) == 1
    assert note_opening(home, frames("a"), smoke) == 1
    assert note_opening(home, frames("a"), experiments("name=other")) == 1, "a name changes no score"
    assert note_opening(home, frames("a"), experiments("seed=5")) == 2
    assert note_opening(home, frames("b"), experiments("seed=5")) == 1, "other frames, another count"
    lines = [json.loads(line) for line in (home / FOLDER / "a.jsonl").read_text().splitlines()]
    assert [line["experiment"] for line in lines] == ["smoke", "smoke"] and lines[0]["options"] != lines[1]["options"]


def test_a_plan_opens_nothing(home, experiments):
    with planning():
        assert note_opening(home, frames("a"), experiments()) is None
    assert not (home / FOLDER).exists()


def test_a_line_cut_short_loses_nothing_else(home, experiments):
    note_opening(home, frames("a"), experiments())
    file = home / FOLDER / "a.jsonl"
    file.write_text(file.read_text() + '{"options": "12\n')
    assert note_opening(home, frames("a"), experiments("seed=5")) == 2


def test_experiments_side_by_side_are_all_counted(home, experiments):
    asked = [experiments(f"seed={seed}") for seed in range(24)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda one: note_opening(home, frames("a"), one), asked))
    assert note_opening(home, frames("a"), asked[0]) == 24
