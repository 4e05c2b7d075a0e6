"""Train downstream models on recorded, synthetic and mixed data, and score them on held-out recorded frames."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from ctlev_core.scoring.sensor_pixels import SensorSource, check_in_image, is_on_sensor
from data_contracts.config import DownstreamChoice, Frozen
from data_contracts.experiment import Experiment
from data_contracts.manifest import ManifestRef, read_manifest
from data_contracts.training_sets import (
    HELD_OUT,
    LABEL_CONSISTENT,
    ORACLE,
    RECORDED,
    SYNTHETIC,
    LabelAgreement,
    TrainingSet,
    TrainingSource,
)
from flows.baselines import BaselineFrames, baselines
from flows.cli import script
from flows.command_line import Command
from flows.inputs import check_num_classes
from flows.prepare_dataset import PreparedDataset, prepare_dataset
from flows.settings import flow
from flows.synthesize import synthesize
from tasks.downstream import train_downstream
from tasks.evaluate import score_distance, score_model
from tasks.openings import note_opening, test_set_digest
from tasks.stage import call_flow, call_together, is_planning, numbered
from tasks.store import Store, home_folder
from tasks.subset import take_label_consistent, take_share

Generated = dict[str, list[ManifestRef]]
"""The sets of frames of each generator, one a fine-tuning."""


class Evaluation(Frozen):
    """Scores, and the models behind them; `openings` is how many experiments were scored on the same test frames."""

    scores: list[ManifestRef]
    models: list[ManifestRef]
    model_names: list[str]
    openings: int | None = None


@flow(name="evaluate")
def evaluate(
    experiment: Experiment,
    dataset: PreparedDataset | None = None,
    synthetic: list[ManifestRef] | None = None,
    compared: dict[str, list[BaselineFrames]] | None = None,
) -> Evaluation:
    """Train and score every training set and seed; what is not given is made first."""
    if is_planning():  # which every run begins with; listing a large dataset takes a while
        check_num_classes(experiment)
    if dataset is None:
        dataset = call_flow(prepare_dataset, experiment)
    if synthetic is None:
        synthetic = [call_flow(synthesize, experiment, dataset, number=n) for n in range(experiment.num_generators)]
    if compared is None:
        compared = call_flow(baselines, experiment, dataset)
    generated: Generated = {SYNTHETIC: synthetic}
    generated |= {name: [frames.synthetic for frames in made] for name, made in compared.items()}
    trained = list(itertools.product(experiment.all_training_sets, experiment.downstream_seeds))
    calls: list[Callable[[], Any]] = [
        partial(_train_and_score, experiment, dataset, generated, training_set, seed) for training_set, seed in trained
    ]
    if experiment.feature_extractor is not None:
        calls.append(partial(_distances, experiment, experiment.feature_extractor, dataset, generated))
    found = call_together(*calls)
    distances = [] if experiment.feature_extractor is None else found.pop()
    openings = None
    if experiment.evaluate_on == "test" and not is_planning():
        frames = read_manifest(Store().here(dataset.tested_frames))
        openings = note_opening(home_folder(), test_set_digest(frames), experiment)
    return Evaluation(
        scores=[score for _, scores in found for score in scores] + distances,
        models=[model for model, _ in found],
        model_names=[f"{training_set}, seed {seed}" for training_set, seed in trained],
        openings=openings,
    )


def train_without_synthetic(experiment: Experiment, dataset: PreparedDataset) -> ManifestRef | None:
    """Train what needs no generator, so that it can begin before those have ended; `evaluate` finds it in the store.

    Returns:
        The feature extractor, if one is asked for.
    """
    extractor = experiment.feature_extractor
    calls: list[Callable[[], Any]] = [
        partial(_train, experiment, dataset, {}, training_set, seed)
        for training_set, seed in itertools.product(experiment.all_training_sets, experiment.downstream_seeds)
        if {source.name for source in training_set.sources} <= {RECORDED, ORACLE}
    ]
    if extractor is not None:
        calls.append(partial(_train_extractor, experiment, dataset, extractor))
    trained = call_together(*calls)
    return None if extractor is None else trained[-1]


def _train_and_score(
    experiment: Experiment, dataset: PreparedDataset, generated: Generated, training_set: TrainingSet, seed: int
) -> tuple[ManifestRef, list[ManifestRef]]:
    """A model of one training set and seed, and its scores."""
    model, frames, label = _train(experiment, dataset, generated, training_set, seed)
    sensor = partial(sensor_of, experiment, dataset.recordings)
    own = sensor_of(experiment, dataset.tested_recordings)
    tested = [(dataset.tested_frames, experiment.evaluate_on, str(training_set), [dataset.poses], own)]
    if training_set == TrainingSet.of(RECORDED):
        # Do the synthetic frames show what their labels say? The recorded row is the best they can do, labels of other
        # frames the worst.
        for name, sets in generated.items():
            made = _of_seed(experiment, sets, seed)
            part = experiment.baselines[name].part if name in experiment.baselines else None
            tested += [(made, "train", str(LabelAgreement(name)), [], sensor(part))]
            if name == SYNTHETIC:
                tested += [(made, "train", str(LabelAgreement(name, shuffled=True)), [], sensor(part))]
    scores = [
        score_model(
            model,
            data,
            frames,
            poses,
            downstream=experiment.downstream,
            metrics=list(experiment.metrics),
            subject=row,
            split=split,
            seed=seed,
            sensor=seen_by,
            label=f"{label}: {row}",
        )
        for data, split, row, poses, seen_by in tested
    ]
    return model, scores


def _train(
    experiment: Experiment, dataset: PreparedDataset, generated: Generated, training_set: TrainingSet, seed: int
) -> tuple[ManifestRef, list[ManifestRef], str]:
    """A model, the frames it learnt from, and what it is called."""
    frames = [_frames_of(experiment, dataset, generated, source, seed) for source in training_set.sources]
    label = f"{experiment.downstream.name} on {training_set}, seed {seed}"
    return train_downstream(frames, downstream=experiment.downstream, seed=seed, label=label), frames, label


def _train_extractor(
    experiment: Experiment, dataset: PreparedDataset, feature_extractor: DownstreamChoice
) -> ManifestRef:
    return train_downstream(
        [dataset.frames], downstream=feature_extractor, seed=experiment.seed, label="feature extractor"
    )


def sensor_of(experiment: Experiment, recordings: ManifestRef, part: str | None = None) -> SensorSource | None:
    """What metrics on the sensor need; None where the experiment has none, whose scores then keep their keys."""
    if not any(map(is_on_sensor, experiment.metrics)):
        return None
    return SensorSource(recordings, experiment.encoding, part)


def _frames_of(
    experiment: Experiment, dataset: PreparedDataset, generated: Generated, source: TrainingSource, seed: int
) -> ManifestRef:
    """The training frames of a source."""
    if source.name == RECORDED:
        return dataset.tested_frames
    if source.name == ORACLE and dataset.more_frames is not None:
        return dataset.more_frames
    if source.name == LABEL_CONSISTENT:
        check_in_image(experiment.metrics[0], "keep_fraction")
        synthetic = _of_seed(experiment, generated[SYNTHETIC], seed)
        real = [dataset.tested_frames]
        judge = train_downstream(real, downstream=experiment.downstream, seed=seed, label="judge of labels")
        return take_label_consistent(
            judge,
            synthetic,
            downstream=experiment.downstream,
            metric=experiment.metrics[0],
            share=experiment.keep_fraction,
            label=f"label-consistent frames, seed {seed}",
        )
    made = _of_seed(experiment, generated[source.name], seed)
    return made if source.share == 1 else take_share(made, share=source.share, label=str(source))


def _of_seed(experiment: Experiment, sets: list[ManifestRef], seed: int) -> ManifestRef:
    """Downstream seeds take turns with the fine-tunings, so that their spread is that of both."""
    return sets[experiment.downstream_seeds.index(seed) % len(sets)]


def _distances(
    experiment: Experiment, feature_extractor: DownstreamChoice, dataset: PreparedDataset, generated: Generated
) -> list[ManifestRef]:
    """How far held-out and generated frames are from the training frames, in the features of the extractor."""
    extractor = _train_extractor(experiment, dataset, feature_extractor)
    frames = dataset.tested_frames
    compared = [(frames, experiment.evaluate_on, HELD_OUT, 0)]
    compared += [(made, "train", name, number) for name, sets in generated.items() for number, made in enumerate(sets)]
    return [
        score_distance(
            extractor,
            frames,
            data,
            downstream=feature_extractor,
            distances=list(experiment.distances),
            subject=row,
            split=split,
            seed=number,
            label=numbered(row, number),
        )
        for data, split, row, number in compared
    ]


COMMAND = Command(evaluate, lambda evaluation, _: "\n".join(f"scores: {ref.path}" for ref in evaluation.scores))


if __name__ == "__main__":
    sys.exit(script("evaluate"))
