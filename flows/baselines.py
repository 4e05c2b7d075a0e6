"""Make the frames of the baselines: other generators, asked for the same labels as the experiment's own."""

from __future__ import annotations

import sys
from functools import partial

from ctlev_core import plugins
from data_contracts.config import Frozen
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef
from flows.command_line import main
from flows.prepare_dataset import (
    PreparedDataset,
    condition_asked_samples,
    condition_training_frames,
    prepare_dataset,
)
from flows.settings import flow
from tasks.finetune import finetune
from tasks.sample import sample, simulate
from tasks.stage import call_flow, call_together


class BaselineFrames(Frozen):
    """What one baseline was asked for and made; no checkpoint where it learns nothing."""

    sample_conditions: ManifestRef
    checkpoint: ManifestRef | None
    synthetic: ManifestRef


@flow(name="baselines")
def baselines(experiment: Experiment, dataset: PreparedDataset | None = None) -> dict[str, BaselineFrames]:
    """Train each baseline that learns, and sample all; the dataset is prepared first unless it is given."""
    if dataset is None:
        dataset = call_flow(prepare_dataset, experiment)
    prepared = dataset
    calls = [partial(_make, experiment, prepared, name) for name in experiment.baselines]
    return dict(zip(experiment.baselines, call_together(*calls), strict=True))


def _make(experiment: Experiment, dataset: PreparedDataset, name: str) -> BaselineFrames:
    baseline = experiment.baselines[name]
    asked = condition_asked_samples(experiment, dataset.poses, dataset.recordings, dataset.frames, baseline.condition)
    if hasattr(plugins.load("generators", baseline.generator.name), "sample_events"):
        synthetic = simulate(
            dataset.recordings,
            dataset.frames,
            asked,
            sampling=baseline.sampling_choice,
            encoding=experiment.encoding,
            windows=experiment.windows,
            seed=experiment.seed,
            label=name,
        )
        return BaselineFrames(sample_conditions=asked, checkpoint=None, synthetic=synthetic)
    learnt = condition_training_frames(experiment, dataset.recordings, dataset.frames, baseline.condition)
    checkpoint = finetune(dataset.frames, learnt, generator=baseline.generator, seed=experiment.seed, label=name)
    synthetic = sample(
        checkpoint,
        dataset.frames,
        asked,
        sampling=baseline.sampling_choice,
        max_tries=experiment.max_tries,
        seed=experiment.seed,
        label=name,
    )
    return BaselineFrames(sample_conditions=asked, checkpoint=checkpoint, synthetic=synthetic)


if __name__ == "__main__":
    sys.exit(
        main(
            baselines,
            lambda made, _: "\n".join(
                f"{name}: {frames.synthetic.rows} frames in {frames.synthetic.path}" for name, frames in made.items()
            ),
        )
    )
