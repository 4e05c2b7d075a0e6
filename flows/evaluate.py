"""Train downstream models on real, synthetic and mixed data, and score them on held-out real frames."""

from __future__ import annotations

import sys
from functools import partial

from data_contracts.config import DownstreamChoice, Frozen
from data_contracts.experiment import LABELS_OF, SHUFFLED, Experiment, share_name
from data_contracts.manifest import ManifestRef
from flows.baselines import BaselineFrames, baselines
from flows.command_line import main
from flows.prepare_dataset import PreparedDataset, prepare_dataset
from flows.settings import flow
from flows.synthesize import synthesize
from tasks.downstream import train_downstream
from tasks.evaluate import score_distance, score_model
from tasks.stage import call_flow, call_together, numbered
from tasks.subset import take_faithful, take_share

Generated = dict[str, list[ManifestRef]]
"""The sets of frames of each generator, one a fine-tuning."""


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
    synthetic: list[ManifestRef] | None = None,
    compared: dict[str, list[BaselineFrames]] | None = None,
) -> Evaluation:
    """Train and score every setting and seed; what is not given is made first."""
    if dataset is None:
        dataset = call_flow(prepare_dataset, experiment)
    if synthetic is None:
        synthetic = [call_flow(synthesize, experiment, dataset, number=n) for n in range(experiment.num_generators)]
    if compared is None:
        compared = call_flow(baselines, experiment, dataset)
    generated: Generated = {"synthetic": synthetic}
    generated |= {name: [frames.synthetic for frames in made] for name, made in compared.items()}
    trained = [(setting, seed) for setting in experiment.trained_settings for seed in experiment.downstream_seeds]
    calls = [partial(_train_and_score, experiment, dataset, generated, setting, seed) for setting, seed in trained]
    if experiment.feature_extractor is not None:
        calls.append(partial(_distances, experiment, experiment.feature_extractor, dataset, generated))
    found = call_together(*calls)
    return Evaluation(
        extractor=found[-1][0] if experiment.feature_extractor is not None else None,
        scores=[score for _, scores in found for score in scores],
        models=[model for model, _ in found[: len(trained)]],
        model_names=[f"{setting}, seed {seed}" for setting, seed in trained],
    )


def _train_and_score(
    experiment: Experiment, dataset: PreparedDataset, generated: Generated, setting: str, seed: int
) -> tuple[ManifestRef, list[ManifestRef]]:
    """A model of one setting and seed, and its scores."""
    training_set = [_frames_of(experiment, dataset, generated, part, seed) for part in setting.split("+")]
    label = f"{experiment.downstream.name} on {setting}, seed {seed}"
    model = train_downstream(training_set, downstream=experiment.downstream, seed=seed, label=label)
    tested = [(dataset.tested_frames, "test", setting, [dataset.poses])]
    if setting == "real":
        # Do the synthetic frames show what their labels say? The real row's error is the floor, other frames' labels
        # are the ceiling.
        for name, sets in generated.items():
            made = _of_seed(experiment, sets, seed)
            tested += [(made, "train", f"{LABELS_OF} {name}", [])]
            tested += [(made, "train", f"{SHUFFLED} {name}", [])] * (name == "synthetic")
    scores = [
        score_model(
            model,
            data,
            training_set,
            poses,
            downstream=experiment.downstream,
            metrics=list(experiment.metrics),
            setting=row,
            split=split,
            seed=seed,
            label=f"{label}: {row}",
        )
        for data, split, row, poses in tested
    ]
    return model, scores


def _frames_of(
    experiment: Experiment, dataset: PreparedDataset, generated: Generated, part: str, seed: int
) -> ManifestRef:
    """The training frames that a part of a setting's name stands for."""
    if part == "real":
        return dataset.tested_frames
    if part == "more_real" and dataset.more_frames is not None:
        return dataset.more_frames
    if part in generated:
        return _of_seed(experiment, generated[part], seed)
    synthetic = _of_seed(experiment, generated["synthetic"], seed)
    if part == "faithful":
        real = [dataset.tested_frames]
        judge = train_downstream(real, downstream=experiment.downstream, seed=seed, label="judge of labels")
        return take_faithful(
            judge,
            synthetic,
            downstream=experiment.downstream,
            metric=experiment.metrics[0],
            share=experiment.keep_faithful,
            label=f"faithful frames, seed {seed}",
        )
    share = next(share for share in experiment.scaling if share_name(share) == part)
    return take_share(synthetic, share=share, label=part)


def _of_seed(experiment: Experiment, sets: list[ManifestRef], seed: int) -> ManifestRef:
    """Downstream seeds take turns with the fine-tunings, so that their spread is that of both."""
    return sets[experiment.downstream_seeds.index(seed) % len(sets)]


def _distances(
    experiment: Experiment, feature_extractor: DownstreamChoice, dataset: PreparedDataset, generated: Generated
) -> tuple[ManifestRef, list[ManifestRef]]:
    """The feature extractor, and how far held-out real and generated frames are from the real training frames."""
    extractor = train_downstream(
        [dataset.frames], downstream=feature_extractor, seed=experiment.seed, label="feature extractor"
    )
    frames = dataset.tested_frames
    compared = [(frames, "test", "held-out real", 0)]
    compared += [(made, "train", name, number) for name, sets in generated.items() for number, made in enumerate(sets)]
    scores = [
        score_distance(
            extractor,
            frames,
            data,
            downstream=feature_extractor,
            distances=list(experiment.distances),
            setting=row,
            split=split,
            seed=number,
            label=numbered(row, number),
        )
        for data, split, row, number in compared
    ]
    return extractor, scores


if __name__ == "__main__":
    sys.exit(main(evaluate, lambda evaluation, _: "\n".join(f"scores: {ref.path}" for ref in evaluation.scores)))
