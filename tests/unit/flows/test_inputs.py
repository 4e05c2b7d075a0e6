"""What options ask for together and cannot have is said before anything runs."""

import pytest

from ctlev_core.plugins import PluginError
from data_contracts.errors import DataError
from data_contracts.experiment import Experiment
from flows.command_line import PRESETS, load_experiment, load_preset
from flows.inputs import CHECKS
from tasks.stage import planning


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["condition.name=moving_skeleton", "view=new"],
            "'moving_skeleton' shows the motion that the labelled view",
        ),
        (
            [
                "baselines={}",
                "condition.name=moving_skeleton",
                "poses={name: text_motion, options: {sentences: [a person walks]}}",
            ],
            "condition: 'moving_skeleton' needs joints2d, and dataset 'text_motion' has none",
        ),
        (["sampling.values=drawn"], "sampling.values=drawn needs a generator of the text route that learnt its values"),
        (
            ["baselines={copies: {sampling: {values: nearest}}}"],
            r"baselines.copies.sampling.values=nearest needs .*set baselines.copies.generator.options.values_at",
        ),
        (
            ["labels=hard", "dataset.options.num_condition_recordings=0", "temporal_order=false"],
            "labels 'hard': dataset 'studio' with these options has no recordings of split 'condition'",
        ),
        (
            ["baselines={b: {labels: coverage, poses: {name: studio_objects, options: {}}}}", "temporal_order=false"],
            "labels 'coverage': dataset 'studio_objects' with these options has no joints or bodies",
        ),
        (
            ["baselines={copies: {condition: {name: text}, generator: {name: augmentation}}}"],
            "baselines.copies: 'augmentation' makes frames of a class, whose joints2d are those of another frame",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(overrides, message):
    experiment = load_preset(Experiment, PRESETS, "smoke", overrides)
    with pytest.raises((DataError, PluginError), match=message):
        for check in CHECKS:
            check(experiment)


def test_classifiers_of_each_class_have_no_common_features():
    from flows.full_experiment import full_experiment

    experiment = load_experiment("smoke", ["feature_extractor.options.binary=all"])
    with planning(), pytest.raises(PluginError, match="the option binary is a classifier for each class"):
        full_experiment.fn(experiment)
