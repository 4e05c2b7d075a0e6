"""Several values of an option become experiments of one study; commas that belong to a value do not."""

from __future__ import annotations

import pytest

from ctlev_core.plugins import PluginError
from data_contracts.experiment import Experiment
from data_contracts.study import Study
from flows.studies import load_study
from flows.sweeps import split_values


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("200,400, 800", ["200", "400", "800"]),
        ("[64, 64]", ["[64, 64]"]),
        ("[0],[0, 1]", ["[0]", "[0, 1]"]),
        ("{a: 1, b: [2, 3]},{}", ["{a: 1, b: [2, 3]}", "{}"]),
        ("'a,b',c", ["'a,b'", "c"]),
        ("5,", ["5,"]),
        ("", [""]),
        ("3", ["3"]),
    ],
)
def test_commas_outside_of_brackets_and_quotes_part_values(text, parts):
    assert split_values(text) == parts


def test_all_combinations_are_experiments_of_one_study():
    study = load_study(
        "smoke", ["num_synthetic=9,12", "sampling.scheduler=ddim,unipc", "seed=3", "downstream_seeds=[0],[0,1]"]
    )
    assert isinstance(study, Study)
    found = {(one.num_synthetic, one.sampling["scheduler"], one.downstream_seeds) for one in study.experiments.values()}
    expected = {(n, s, d) for n in (9, 12) for s in ("ddim", "unipc") for d in ((0,), (0, 1))}
    assert len(study.experiments) == 8 and found == expected
    assert {one.seed for one in study.experiments.values()} == {3}
    assert "num_synthetic_9-sampling_scheduler_ddim-downstream_seeds_0" in study.experiments


def test_options_of_other_parts_have_other_names():
    names = {
        load_study("smoke", [f"{part}.options.num_steps=6,7"]).name
        for part in ("generator", "downstream", "feature_extractor")
    }
    assert names == {f"smoke_{part}_num_steps_6_7" for part in ("generator", "downstream", "feature_extractor")}


def test_the_last_word_on_an_option_counts():
    assert load_study("smoke", ["seed=1,2", "seed=5"]).seed == 5
    assert len(load_study("smoke", ["seed=5", "seed=1,2"]).experiments) == 2


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("data_notice=one, two", "one, two"),
        ("condition.options.prompt=a hand, moving", "a hand, moving"),
        ("encoding.options.image_size=[64, 64]", [64, 64]),
    ],
)
def test_text_and_lists_keep_their_commas(option, value):
    experiment = load_study("smoke", [option])
    assert isinstance(experiment, Experiment)
    found = experiment.model_dump()
    for part in option.partition("=")[0].split("."):
        found = found[part]
    assert found == value


def test_plug_ins_can_be_several_and_options_of_the_one_that_is_asked_for_are_known():
    study = load_study("smoke", ["condition.options.drawing=smooth,openpose", "downstream_seeds=[1]"])
    assert isinstance(study, Study)
    assert {one.condition.options["drawing"] for one in study.experiments.values()} == {"smooth", "openpose"}
    study = load_study("smoke", ["baselines.event_gan.generator.options.num_steps=5,7"])
    assert isinstance(study, Study) and len(study.experiments) == 2


@pytest.mark.parametrize(
    ("preset", "option", "message"),
    [
        ("smoke", "generator.options.num_stepz=5,7", "unknown option 'num_stepz'; did you mean 'num_steps'"),
        ("smoke", "num_synthetic=5,5", "values must differ"),
        ("smoke", "num_synthetic=5,many", "option 'experiments.num_synthetic_many.num_synthetic'"),
        ("demo", "experiments.pose.num_synthetic=5,7", "is a study; several values are for presets of one experiment"),
    ],
)
def test_what_cannot_be_is_refused(preset, option, message):
    with pytest.raises(PluginError, match=message):
        load_study(preset, [option])
