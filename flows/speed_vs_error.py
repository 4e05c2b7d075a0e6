"""Sampler and number of steps against error, for the tuned generator of an experiment.

python flows/speed_vs_error.py [--preset NAME] [--set key=value ...] [--dry-run]
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

from pydantic import BaseModel, ConfigDict

from ctlev_core import plugins
from ctlev_core.diffusion.sampling.options import OF_STUDENTS, STOCHASTIC, SamplingOptions
from ctlev_core.plugins import PluginError, validate_options
from ctlev_core.report.studies.measurement_charts import CONVERGED_LINE, REFERENCE_LINE
from ctlev_core.scoring.sensor_pixels import check_in_image
from data_contracts.config import DownstreamChoice, SamplingChoice
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef
from data_contracts.speed_vs_error import KEEP_PRECISION, SamplerLine, SamplerSetting, SpeedVsErrorOptions
from data_contracts.study import Study
from flows.cli import script
from flows.command_line import PRESETS, Command, load_experiment, load_preset
from flows.prepare_dataset import PreparedDataset, prepare_dataset
from flows.settings import flow
from flows.train_generator import train_generator, without_student
from tasks.downstream import train_downstream
from tasks.speed_report import publish_speed_report, speed_report
from tasks.speed_vs_error import exact_score_errors, precision_errors, sample_timed, sampling_errors
from tasks.stage import call_flow
from tasks.store import home_folder

_OF_EXPERIMENT = "experiment."


class SpeedVsError(BaseModel):
    """What to measure, and the experiment whose generator it is measured on."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    options: SpeedVsErrorOptions
    experiment: Experiment
    feature_extractor: DownstreamChoice
    title: str

    @property
    def name(self) -> str:
        """Names the file of the page."""
        return f"{self.experiment.name}_speed_vs_error"

    def sampling(self, line: SamplerLine, steps: int) -> SamplingChoice:
        """The experiment's sampling, changed by a line."""
        choice = self.experiment.sampling_choice
        return choice.model_copy(update={"options": line.over(choice.options, steps)})

    def points(self) -> Iterator[tuple[SamplerSetting, SamplingChoice]]:
        """Reference, converged solution, then every point of every line."""
        named = {REFERENCE_LINE: self.options.reference, CONVERGED_LINE: self.options.converged} | self.options.lines
        for name, line in named.items():
            for steps in line.steps:
                sampling = self.sampling(line, steps)
                scheduler = plugins.load_options(sampling).options.scheduler
                setting = SamplerSetting(
                    line=name, num_inference_steps=steps, is_deterministic=scheduler not in STOCHASTIC
                )
                yield setting, sampling


def load_speed_vs_error(preset: str, overrides: list[str]) -> SpeedVsError:
    """The measurement a preset describes; overrides that start with `experiment.` are those of the experiment.

    Raises:
        PluginError: unknown preset or option, a generator that is no diffusion model, or no feature extractor.
    """
    own = [override for override in overrides if not override.startswith(_OF_EXPERIMENT)]
    of_experiment = [override.removeprefix(_OF_EXPERIMENT) for override in overrides if override not in own]
    options = load_preset(SpeedVsErrorOptions, PRESETS / "speed_vs_error", preset, own)
    experiment = load_experiment(options.experiment, of_experiment)
    return _checked(options, experiment, experiment.name)


def speed_vs_error_of(study: Study) -> SpeedVsError | None:
    """The measurement that is part of a study, if one is.

    Raises:
        PluginError: no such experiment, or as `load_speed_vs_error`.
    """
    options = study.speed_vs_error
    if options is None:
        return None
    experiment = study.experiments.get(options.experiment)
    if experiment is None:
        raise PluginError(
            f"speed_vs_error.experiment: expected an experiment of the study, {', '.join(study.experiments)}; "
            f"got {options.experiment!r}"
        )
    return _checked(options, experiment, options.experiment)


def _checked(options: SpeedVsErrorOptions, experiment: Experiment, title: str) -> SpeedVsError:
    if not isinstance(plugins.load_options(experiment.sampling_choice).options, SamplingOptions):
        raise PluginError(f"{options.experiment}: generator {experiment.generator.name!r} has no sampler to compare")
    if experiment.feature_extractor is None:
        raise PluginError(f"{options.experiment}: frames are compared in features, and feature_extractor is null")
    extractor = experiment.feature_extractor
    loaded = SpeedVsError(options=options, experiment=experiment, feature_extractor=extractor, title=title)
    for setting, choice in loaded.points():  # every sampler's options are valid
        if plugins.load_options(choice).options.scheduler == OF_STUDENTS:
            raise PluginError(f"lines.{setting.line}: expected a solver, got {OF_STUDENTS!r}, which samples students")
    for name, study in (("exact_score", options.exact_score), ("precision", options.precision)):
        for line in study.lines.values() if study is not None else ():
            checked = validate_options(SamplingOptions, line.options, f"{name}.lines")
            if name == "precision" and checked.scheduler not in KEEP_PRECISION:
                raise PluginError(
                    f"precision.lines: expected a scheduler of {', '.join(KEEP_PRECISION)}, got {checked.scheduler!r}"
                )
    return loaded


@flow(name="speed-vs-error")
def speed_vs_error(measured: SpeedVsError) -> ManifestRef:
    """Sample with every setting under a stopwatch, measure errors, and write the page with the plots."""
    experiment, options = measured.experiment, measured.options
    dataset = call_flow(prepare_dataset, experiment)
    checkpoint = call_flow(train_generator, without_student(experiment), dataset).tuned
    conditions, sampling = dataset.sample_conditions, experiment.sampling_choice
    extractor = train_downstream(
        [dataset.frames], downstream=measured.feature_extractor, seed=experiment.seed, label="feature extractor"
    )
    points = list(measured.points())
    settings = [setting for setting, _ in points]
    runs = [_timed(measured, checkpoint, conditions, setting, choice) for setting, choice in points]
    tables = [_errors(measured, dataset, extractor, settings, runs)]
    if options.exact_score is not None:
        solvers = SamplingChoice(name=sampling.name)
        tables.append(exact_score_errors(checkpoint, sampling=solvers, options=options.exact_score))
    if options.precision is not None:
        tables.append(
            precision_errors(checkpoint, conditions, sampling=sampling, options=options.precision, seed=experiment.seed)
        )
    own = plugins.load_options(sampling).options
    return speed_report(
        extractor,
        conditions,
        tables,
        runs[0][0],
        [of_setting[0] for of_setting in runs[2:]],
        settings=settings[2:],
        own=next((setting for setting, choice in points[2:] if plugins.load_options(choice).options == own), None),
        title=measured.title,
        notice=experiment.data_notice,
        reference_name=_name(points[0][1]),
        converged_name=_name(points[1][1]),
        feature_extractor=measured.feature_extractor.name,
        label=experiment.name,
    )


def _timed(
    measured: SpeedVsError,
    checkpoint: ManifestRef,
    conditions: ManifestRef,
    setting: SamplerSetting,
    sampling: SamplingChoice,
) -> list[ManifestRef]:
    """Timed samples of a setting, one artefact a seed; of the converged solution the first seed alone.

    One after the other: side by side they would slow one another, and the times would say so.
    """
    options = measured.options
    return [
        sample_timed(
            checkpoint,
            conditions,
            sampling=sampling,
            num_images=options.num_images,
            seed=seed,
            label=f"{setting.line}, {setting.num_inference_steps} steps, seed {seed}",
        )
        for seed in (options.seeds[:1] if setting.line == CONVERGED_LINE else options.seeds)
    ]


def _errors(
    measured: SpeedVsError,
    dataset: PreparedDataset,
    extractor: ManifestRef,
    settings: list[SamplerSetting],
    runs: list[list[ManifestRef]],
) -> ManifestRef:
    """Errors of all settings; with label errors by the model that `evaluate` trains on recorded frames."""
    experiment, model = measured.experiment, None
    if measured.options.label_errors:
        check_in_image(experiment.metrics[0], "label_errors")
        seed = experiment.downstream_seeds[0]
        label = f"{experiment.downstream.name} on recorded, seed {seed}"
        model = train_downstream([dataset.tested_frames], downstream=experiment.downstream, seed=seed, label=label)
    return sampling_errors(
        extractor,
        dataset.frames,
        dataset.sample_conditions,
        model,
        runs[0],
        runs[1],
        [run for of_setting in runs[2:] for run in of_setting],
        feature_extractor=measured.feature_extractor,
        downstream=experiment.downstream,
        metric=experiment.metrics[0],
        settings=settings,
        label=experiment.name,
    )


def _name(sampling: SamplingChoice) -> str:
    options = plugins.load_options(sampling).options
    return f"{options.scheduler} in {options.num_inference_steps} steps"


COMMAND = Command(
    speed_vs_error,
    lambda made, measured: publish_speed_report(made, home_folder(), measured.name),
    load=load_speed_vs_error,
)


if __name__ == "__main__":
    sys.exit(script("speed-vs-error"))
