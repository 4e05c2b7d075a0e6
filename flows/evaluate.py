"""Train downstream models on real, synthetic and mixed data, and score them on held-out real frames."""

from __future__ import annotations

import sys
from functools import partial

from data_contracts.config import DownstreamChoice, Frozen
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef
from flows.baselines import BaselineFrames, baselines
from flows.command_line import main
from flows.prepare_dataset import PreparedDataset, prepare_dataset
from flows.settings import flow
from flows.synthesize import synthesize
from tasks.downstream import train_downstream
from tasks.evaluate import LABELS_OF, score_distance, score_model
from tasks.stage import call_flow, call_together


class Evaluation(Frozen):
    """Scores, and the models behind them; `extractor` is the model in whose features frames are compared."""

    extractor: ManifestRef | None
    scores: list[ManifestRef]
    models: list[ManifestRef]
    model_names: list[str]


@flow(name="evaluate")
def evaluate(
    experiment: Experiment,
    dataset: PreparedDataset | None = None,
    synthetic: ManifestRef | None = None,
    compared: dict[str, BaselineFrames] | None = None,
) -> Evaluation:
    """Train and score every setting and seed; what is not given is made first."""
    if dataset is None:
        dataset = call_flow(prepare_dataset, experiment)
    if synthetic is None:
        synthetic = call_flow(synthesize, experiment, dataset)
    if compared is None:
        compared = call_flow(baselines, experiment, dataset)
    generated = {"synthetic": synthetic} | {name: frames.synthetic for name, frames in compared.items()}
    trained = [(setting, seed) for setting in experiment.trained_settings for seed in experiment.downstream_seeds]
    frames = dataset.frames
    calls = [partial(_train_and_score, experiment, frames, generated, setting, seed) for setting, seed in trained]
    if experiment.feature_extractor is not None:
        calls.append(partial(_distances, experiment.feature_extractor, experiment.seed, frames, generated))
    found = call_together(*calls)
    return Evaluation(
        extractor=found[-1][0] if experiment.feature_extractor is not None else None,
        scores=[score for _, scores in found for score in scores],
        models=[model for model, _ in found[: len(trained)]],
        model_names=[f"{setting}, seed {seed}" for setting, seed in trained],
    )


def _train_and_score(
    experiment: Experiment, frames: ManifestRef, generated: dict[str, ManifestRef], setting: str, seed: int
) -> tuple[ManifestRef, list[ManifestRef]]:
    """A model of one setting and seed, and its scores."""
    training_set = [frames if part == "real" else generated[part] for part in setting.split("+")]
    label = f"{experiment.downstream.name} on {setting}, seed {seed}"
    model = train_downstream(training_set, downstream=experiment.downstream, seed=seed, label=label)
    tested = [(frames, "test", setting)]
    if setting == "real":
        # Do the synthetic frames show what their labels say? The real row's error is the floor.
        tested += [(made, "train", f"{LABELS_OF} {name}") for name, made in generated.items()]
    scores = [
        score_model(
            model,
            data,
            training_set,
            downstream=experiment.downstream,
            metrics=list(experiment.metrics),
            setting=row,
            split=split,
            seed=seed,
            label=f"{label}: {row}",
        )
        for data, split, row in tested
    ]
    return model, scores


def _distances(
    feature_extractor: DownstreamChoice, seed: int, frames: ManifestRef, generated: dict[str, ManifestRef]
) -> tuple[ManifestRef, list[ManifestRef]]:
    """The feature extractor, and how far held-out real and generated frames are from the real training frames."""
    extractor = train_downstream([frames], downstream=feature_extractor, seed=seed, label="feature extractor")
    compared = [(frames, "test", "held-out real"), *((made, "train", name) for name, made in generated.items())]
    scores = [
        score_distance(extractor, frames, data, downstream=feature_extractor, setting=row, split=split, label=row)
        for data, split, row in compared
    ]
    return extractor, scores


if __name__ == "__main__":
    sys.exit(main(evaluate, lambda evaluation, _: "\n".join(f"scores: {ref.path}" for ref in evaluation.scores)))
