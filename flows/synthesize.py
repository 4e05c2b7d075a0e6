"""Sample labelled synthetic event images from a fine-tuned generator."""

from __future__ import annotations

import sys

from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef
from flows.command_line import main
from flows.prepare_dataset import PreparedDataset, prepare_dataset
from flows.settings import flow
from flows.train_generator import train_generator
from tasks.sample import sample
from tasks.stage import call_flow


@flow(name="synthesize")
def synthesize(
    experiment: Experiment, dataset: PreparedDataset | None = None, checkpoint: ManifestRef | None = None
) -> ManifestRef:
    """Sample the experiment's synthetic frames; dataset and checkpoint are made first unless they are given."""
    if dataset is None:
        dataset = call_flow(prepare_dataset, experiment)
    if checkpoint is None:
        checkpoint = call_flow(train_generator, experiment, dataset)
    return sample(
        checkpoint,
        dataset.frames,
        dataset.sample_conditions,
        sampling=experiment.sampling_choice,
        max_tries=experiment.max_tries,
        seed=experiment.seed,
        label=experiment.generator.name,
    )


if __name__ == "__main__":
    sys.exit(main(synthesize, lambda synthetic, _: f"synthetic frames: {synthetic.rows} in {synthetic.path}"))
