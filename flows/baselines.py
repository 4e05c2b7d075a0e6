"""Make the frames of the baselines: other generators asked for the same labels, or the same one for other labels."""

from __future__ import annotations

import sys
from functools import partial

from ctlev_core import plugins
from ctlev_core.plugin_contracts import EventGenerator
from ctlev_core.report.sections.rejections import count_rejections
from data_contracts.config import Frozen
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef, read_manifest
from flows.cli import script
from flows.command_line import Command
from flows.prepare_dataset import (
    PreparedDataset,
    condition_asked_samples,
    condition_training_frames,
    motion_options,
    prepare_dataset,
    student_options,
)
from flows.sampling import sample_generator
from flows.settings import flow
from flows.train_generator import fine_tuned, with_motion_layers, with_student
from tasks.ingest import ingest
from tasks.sample import simulate
from tasks.stage import call_flow, call_together, numbered


class BaselineFrames(Frozen):
    """What one baseline was asked for and made; no checkpoint where it learns nothing."""

    sample_conditions: ManifestRef
    checkpoint: ManifestRef | None
    synthetic: ManifestRef


@flow(name="baselines")
def baselines(experiment: Experiment, dataset: PreparedDataset | None = None) -> dict[str, list[BaselineFrames]]:
    """Train each baseline that learns, as often as the generator, and sample all; the dataset is prepared first."""
    if dataset is None:
        dataset = call_flow(prepare_dataset, experiment)
    prepared = dataset
    numbers = range(experiment.num_generators)
    calls = [partial(_make, experiment, prepared, name, number) for name in experiment.baselines for number in numbers]
    made = iter(call_together(*calls))
    return {name: [next(made) for _ in numbers] for name in experiment.baselines}


def _make(experiment: Experiment, dataset: PreparedDataset, name: str, number: int) -> BaselineFrames:
    baseline, seed, label = experiment.baselines[name], experiment.seed + number, numbered(name, number)
    part, student = baseline.part, student_options(experiment, name)
    poses = dataset.poses
    if baseline.poses is not None:
        poses = ingest(dataset=baseline.poses, label=f"{baseline.poses.name}, poses of {name}")
    asked = condition_asked_samples(
        experiment,
        poses,
        dataset.recordings,
        dataset.frames,
        baseline.condition,
        part,
        baseline=name,
    )
    if isinstance(plugins.load("generators", baseline.generator.name), EventGenerator):
        synthetic = simulate(
            dataset.recordings,
            dataset.frames,
            asked,
            sampling=baseline.sampling_choice,
            encoding=experiment.encoding,
            windows=experiment.windows,
            seed=seed,
            part=part,
            label=label,
        )
        return BaselineFrames(sample_conditions=asked, checkpoint=None, synthetic=synthetic)
    learnt = condition_training_frames(experiment, dataset.recordings, dataset.frames, baseline.condition, part)
    checkpoint = fine_tuned(
        experiment,
        dataset.frames,
        learnt,
        generator=baseline.generator,
        seed=seed,
        label=label,
        of_all=part is None,
    )
    motion = motion_options(experiment, name)
    checkpoint = with_motion_layers(checkpoint, dataset.frames, learnt, options=motion, seed=seed, label=label)
    generator = with_student(
        checkpoint, learnt, sampling=baseline.sampling_choice, options=student, seed=seed, label=label
    )
    synthetic = sample_generator(
        experiment,
        generator,
        dataset.frames,
        learnt,
        asked,
        sampling=baseline.sampling_choice,
        number=number,
        part=part,
        motion=motion is not None,
        label=label,
    )
    return BaselineFrames(sample_conditions=asked, checkpoint=generator.sampled, synthetic=synthetic)


COMMAND = Command(
    baselines,
    lambda made, _: "\n".join(
        f"{name}: {count_rejections(read_manifest(frames.synthetic))}, in {frames.synthetic.path}"
        for name, sets in made.items()
        for frames in sets
    ),
)


if __name__ == "__main__":
    sys.exit(script("baselines"))
