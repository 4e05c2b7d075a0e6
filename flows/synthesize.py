"""Sample labelled synthetic event images from a fine-tuned generator."""

from __future__ import annotations

import sys

from ctlev_core.report.refusals import count_refusals
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef, read_manifest
from flows.command_line import main
from flows.prepare_dataset import PreparedDataset, prepare_dataset
from flows.settings import flow
from flows.train_generator import train_generator
from tasks.sample import sample
from tasks.stage import call_flow, numbered


@flow(name="synthesize")
def synthesize(
    experiment: Experiment,
    dataset: PreparedDataset | None = None,
    checkpoint: ManifestRef | None = None,
    number: int = 0,
) -> ManifestRef:
    """Sample the frames of the `number`-th generator; dataset and checkpoint are made unless they are given."""
    if dataset is None:
        dataset = call_flow(prepare_dataset, experiment)
    if checkpoint is None:
        checkpoint = call_flow(train_generator, experiment, dataset, number)
    return sample(
        checkpoint,
        dataset.frames,
        dataset.sample_conditions,
        sampling=experiment.sampling_choice,
        max_tries=experiment.max_tries,
        rounding=experiment.rounding,
        seed=experiment.seed + number,
        label=numbered(experiment.generator.name, number),
    )


if __name__ == "__main__":
    sys.exit(
        main(synthesize, lambda made, _: f"synthetic: {count_refusals(read_manifest(made))}\nframes: {made.path}"),
    )
