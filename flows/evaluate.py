"""Train downstream models on real, synthetic and mixed data, and score them on held-out real frames."""

from __future__ import annotations

import sys

from data_contracts.config import Frozen
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef
from flows.command_line import main
from flows.prepare_dataset import PreparedDataset, prepare_dataset
from flows.settings import flow
from flows.synthesize import synthesize
from tasks.downstream import train_downstream
from tasks.evaluate import score_distance, score_model
from tasks.stage import call_flow


class Evaluation(Frozen):
    """Scores, and the models behind them."""

    scores: list[ManifestRef]
    models: list[ManifestRef]
    model_names: list[str]


@flow(name="evaluate")
def evaluate(
    experiment: Experiment, dataset: PreparedDataset | None = None, synthetic: ManifestRef | None = None
) -> Evaluation:
    """Train and score every setting and seed; dataset and synthetic frames are made first unless they are given."""
    if dataset is None:
        dataset = call_flow(prepare_dataset, experiment)
    if synthetic is None:
        synthetic = call_flow(synthesize, experiment, dataset)
    training_sets = {
        "real": [dataset.frames],
        "synthetic": [synthetic],
        "real+synthetic": [dataset.frames, synthetic],
    }
    scores: list[ManifestRef] = []
    models: list[ManifestRef] = []
    model_names: list[str] = []
    for setting in experiment.settings:
        for seed in experiment.downstream_seeds:
            label = f"{experiment.downstream.name} on {setting}, seed {seed}"
            model = train_downstream(training_sets[setting], downstream=experiment.downstream, seed=seed, label=label)
            models.append(model)
            model_names.append(f"{setting}, seed {seed}")
            tested = [(dataset.frames, "test", setting)]
            if setting == "real":
                # Do the synthetic frames show what their labels say? The real row's error is the floor.
                tested.append((synthetic, "train", "labels of synthetic"))
            for data, split, row in tested:
                scores.append(
                    score_model(
                        model,
                        data,
                        training_sets[setting],
                        downstream=experiment.downstream,
                        metrics=list(experiment.metrics),
                        setting=row,
                        split=split,
                        seed=seed,
                        label=f"{label}: {row}",
                    )
                )
    if experiment.feature_extractor is not None:
        extractor = train_downstream(
            [dataset.frames], downstream=experiment.feature_extractor, seed=experiment.seed, label="feature extractor"
        )
        for data, split, row in ((dataset.frames, "test", "held-out real"), (synthetic, "train", "synthetic")):
            scores.append(
                score_distance(
                    extractor,
                    dataset.frames,
                    data,
                    downstream=experiment.feature_extractor,
                    setting=row,
                    split=split,
                    label=row,
                )
            )
    return Evaluation(scores=scores, models=models, model_names=model_names)


if __name__ == "__main__":
    sys.exit(main(evaluate, lambda evaluation, _: "\n".join(f"scores: {ref.path}" for ref in evaluation.scores)))
