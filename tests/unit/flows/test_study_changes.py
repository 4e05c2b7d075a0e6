"""Single options of a study's experiments, of one or of all, and paths that stand-ins fill."""

from __future__ import annotations

import pytest

from ctlev_core.plugins import PluginError
from ctlev_core.stand_ins import making
from flows.command_line import apply_override
from flows.stand_ins import make_missing
from flows.studies import load_study

STUDY = """
name: pair
experiments:
  one: {extends: smoke, name: one}
  other: {extends: smoke, name: other, num_synthetic: 9}
set: %s
"""


def study(tmp_path, changes, *overrides):
    path = tmp_path / "pair.yaml"
    path.write_text(STUDY % changes)
    return load_study(str(path), list(overrides)).experiments


def test_one_name_stands_for_all_experiments(tmp_path):
    found = study(tmp_path, "[experiments.*.seed=4, experiments.other.generator.options.num_steps=2]")
    assert [one.seed for one in found.values()] == [4, 4]
    assert found["other"].generator.options["num_steps"] == 2 != found["one"].generator.options["num_steps"]
    assert found["other"].num_synthetic == 9


def test_what_is_asked_for_on_the_command_line_comes_last(tmp_path):
    found = study(tmp_path, "[experiments.*.seed=4]", "experiments.one.seed=5", "experiments.*.num_synthetic=3")
    assert [(one.seed, one.num_synthetic) for one in found.values()] == [(5, 3), (4, 3)]


@pytest.mark.parametrize("changes", ["[seed=4]", "[experiments.third.seed=4]", "[experiments.one]", "seed"])
def test_other_changes_are_refused(tmp_path, changes):
    with pytest.raises(PluginError, match=r"set (changes options of its experiments|must be a list)"):
        study(tmp_path, changes)


LEFT_OUT = """
name: mine
paths: {extra: null}
experiments:
  one: {extends: smoke, name: one}
  other: {extends: smoke, name: other, only_with: [extra]}
  third: {extends: smoke, name: third}
set: [experiments.other.num_synthetic=4, experiments.one.num_synthetic=5]
pooled: {group: [one, other, third]}
"""
REPEATED = """
name: mine
experiments:
  studio_{n}: {extends: smoke, name: "studio_{n}", for: {n: [1, 2]}}
set: ["experiments.studio_1.num_synthetic=4"]
"""


def test_what_is_left_out_is_neither_changed_nor_pooled(tmp_path):
    (tmp_path / "mine.yaml").write_text(LEFT_OUT)
    found = load_study(str(tmp_path / "mine.yaml"), [])
    assert list(found.experiments) == ["one", "third"] and found.pooled == {"group": ("one", "third")}
    assert found.experiments["one"].num_synthetic == 5 and "other" in found.data_notice


def test_a_change_names_an_experiment_as_it_is_called_in_the_end(tmp_path):
    (tmp_path / "mine.yaml").write_text(REPEATED)
    found = load_study(str(tmp_path / "mine.yaml"), []).experiments
    assert [one.num_synthetic for one in found.values()] == [4, 8]
    (tmp_path / "mine.yaml").write_text(REPEATED.replace("studio_1.num", "studio_{n}.num"))
    with pytest.raises(PluginError, match=r"with one of studio_1, studio_2 or \*"):
        load_study(str(tmp_path / "mine.yaml"), [])


def test_a_study_extends_another(tmp_path):
    study(tmp_path, "[experiments.*.seed=4]")
    path = tmp_path / "more.yaml"
    path.write_text(f"extends: {tmp_path / 'pair.yaml'}\nname: more\n")
    found = load_study(str(path), [])
    assert found.name == "more" and [one.seed for one in found.experiments.values()] == [4, 4]


def test_a_star_in_the_middle_reaches_each_group_that_is_there():
    values = {"a": {"x": {"n": 1}, "y": {"n": 2}}, "b": 3}
    apply_override(values, "a.*.n=5")
    assert values == {"a": {"x": {"n": 5}, "y": {"n": 5}}, "b": 3}
    with pytest.raises(PluginError, match=r"'\*' is not a group"):
        apply_override(values, "*.n=5")


def test_missing_paths_are_made_and_given_ones_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    paths = {"amass": None, "dhp19": "/my/own", "inception": None, "stable_diffusion": None}
    options = make_missing(paths, "tiny", "preset 'x'")
    folder = tmp_path / "stand_ins"
    assert paths["dhp19"] == "/my/own" and paths["amass"] == str(folder / f"amass-v{making.VERSION}")
    # A program of ours may run, and small networks take small images.
    assert options == ["feature_extractor.options.trusted=true", "encoding.options.image_size=[64, 64]"]
    assert capsys.readouterr().err.count("making a stand-in for") == 3
    again = dict.fromkeys(paths)
    again["dhp19"] = again["inception"] = "/my/own"
    assert make_missing(again, "tiny", "preset 'x'") == options[1:]
    assert capsys.readouterr().err == "" and again["amass"] == paths["amass"]


def test_a_path_that_nothing_stands_in_for_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    with pytest.raises(PluginError, match=r"preset 'x': nothing can stand in for paths.mine; known: stable_diffusion"):
        make_missing({"mine": None}, "tiny", "preset 'x'")
    with pytest.raises(PluginError, match="stand_ins must be one of full, tiny, got 'small'"):
        make_missing({}, "small", "preset 'x'")
