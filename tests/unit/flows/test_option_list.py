"""Every option of the models is listed, with its type, its default and what a preset says."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import pytest

from ctlev_core import plugins
from data_contracts.config import Windows
from data_contracts.experiment import Experiment
from flows.option_list import options_of, print_options, type_text
from flows.preset_list import PRESETS, preset_heads, preset_names


def listed(name: str) -> dict[str, Any]:
    return {option.name: option for _, options in options_of(name) for option in options}


def test_a_preset_lists_its_own_options_and_those_of_its_plug_ins():
    options = listed("pose")
    assert (options["num_synthetic"].type, options["num_synthetic"].default) == ("int > 0", "(required)")
    assert options["seed"].default == "0" and options["seed"].value is None
    assert options["generator.name"].value == "controlnet" and "stable_diffusion" in options["generator.name"].type
    assert options["windows.num_events"].value == "700"
    assert {f"windows.{name}" for name in Windows.model_fields} <= options.keys()
    generator: Any = plugins.load("generators", "controlnet")
    groups = {name for name in generator.Options.model_fields if f"generator.options.{name}" not in options}
    assert groups == {name for name in groups if any(o.startswith(f"generator.options.{name}.") for o in options)}
    assert {f"sampling.{name}" for name in generator.SampleOptions.model_fields} <= options.keys()
    further = {"export_folder", "gates.max_distance_ratio", "baselines.event_gan.generator.options.num_steps"}
    assert further <= options.keys()
    described = Experiment.model_fields["num_synthetic"].description
    assert options["num_synthetic"].description == described


@pytest.mark.parametrize("name", [*preset_names(), "pretraining/small", "speed_vs_error/smoke"])
def test_every_preset_can_be_listed_though_its_files_are_missing(name):
    assert listed(name)


@pytest.mark.parametrize("name", preset_names(PRESETS / "pretraining"))
def test_presets_of_pretraining_are_found_by_the_name_that_is_listed(name):
    assert listed(name) == listed(f"pretraining/{name}")


@pytest.mark.parametrize("kind", plugins.KINDS)
def test_every_plug_in_can_be_listed(kind, capsys):
    for name in plugins.names(kind):
        assert print_options(f"{kind}/{name}") == 0
        assert f"{kind}/{name}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("annotation", "text"),
    [
        (int, "int"),
        (float | None, "float or null"),
        (Literal["a", "b"] | None, "one of a, b or null"),
        (tuple[int, ...], "list of int"),
        (tuple[float, float], "[float, float]"),
        (dict[str, float], "mapping of float"),
        (Path, "path"),
    ],
)
def test_types_are_told_in_words(annotation, text):
    assert type_text(annotation) == text


@pytest.mark.parametrize(
    ("name", "message"),
    [("posee", "did you mean 'pose'?"), ("controlnt", "did you mean 'controlnet'?"), ("datasets/foldr", "'folder'?")],
)
def test_a_misspelt_name_is_answered_with_the_nearest(name, message, capsys):
    assert print_options(name) == 2
    assert message in capsys.readouterr().err


def test_every_preset_says_what_it_does_and_how_long_it_takes():
    assert [head.name for head in preset_heads()] == preset_names()
    assert all(head.summary and head.time for head in preset_heads())
    for folder in ("pretraining", "speed_vs_error"):
        assert all(head.summary for head in preset_heads(PRESETS / folder))
