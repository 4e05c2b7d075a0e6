"""Fine-tune one generator on labelled event images."""

from __future__ import annotations

import sys

from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef
from flows.command_line import main
from flows.prepare_dataset import PreparedDataset, prepare_dataset
from flows.settings import flow
from tasks.finetune import finetune
from tasks.stage import call_flow, numbered


@flow(name="train-generator")
def train_generator(experiment: Experiment, dataset: PreparedDataset | None = None, number: int = 0) -> ManifestRef:
    """Fine-tune the experiment's generator, the `number`-th of several; the dataset is prepared unless it is given."""
    if dataset is None:
        dataset = call_flow(prepare_dataset, experiment)
    return finetune(
        dataset.frames,
        dataset.frame_conditions,
        generator=experiment.generator,
        seed=experiment.seed + number,
        label=numbered(experiment.generator.name, number),
    )


if __name__ == "__main__":
    sys.exit(main(train_generator, lambda checkpoint, _: f"checkpoint: {checkpoint.path / 'checkpoint'}"))
