"""Old and misspelt names of options, plug-ins and presets: errors say what they are called now."""

import pytest

from ctlev_core.datasets import studio
from ctlev_core.diffusion.pretraining.pretraining import PretrainingOptions
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.training.options import FineTuningOptions
from ctlev_core.plugins import PluginError, load_options
from ctlev_core.sensor.options import SensorOptions
from data_contracts.experiment import Experiment
from data_contracts.regeneration import Gates
from data_contracts.renamed_options import RENAMED_OPTIONS
from flows.command_line import PRESETS, load_preset


def smoke(*overrides):
    return load_preset(Experiment, PRESETS, "smoke", list(overrides))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("more_real=null", r"unknown option 'more_real'; 'more_real' is now 'oracle'; known"),
        ("together=[]", r"'together' is now 'mixtures'"),
        ("generator.options.turned_share=0.2", r"'turned_share' is now 'rot90_probability'"),
        ("generator.options.prior=here", r"'prior' is now 'base_model'"),
        ("generator.options.num_step=3", r"unknown option 'num_step'; did you mean 'num_steps'\?"),
        ("sampling.spacing=karras", r"'spacing' is now 'timestep_spacing'"),
        ("sampling.timestep_spacing=even", r"'even' is now 'linspace'"),
        ("sampling.scheduler=dpm++_3m", r"'dpm\+\+_3m' is now 'dpmpp_3m'"),
        ("baselines.gan.generator.name=filmed_pictures", r"'filmed_pictures' is now 'picture_simulator'"),
        ("baselines.gan.generator.name=event_gun", r"did you mean 'event_gan'\?"),
        ("generator.options.nothing_like_it=3", r"unknown option 'nothing_like_it'; known"),
    ],
)
def test_renamed_and_misspelt_options_are_told_their_names(override, message):
    with pytest.raises(PluginError, match=message):
        for choice in smoke(override).choices:
            load_options(choice)


def test_renamed_options_exist():
    """Whatever an old name leads to is an option of something today."""
    models = [
        Experiment, Gates, PretrainingOptions, FineTuningOptions, SamplingOptions, SensorOptions, studio.Options
    ]  # fmt: skip
    known = {name for model in models for name in model.model_fields}
    assert set(RENAMED_OPTIONS.values()) <= known
