"""Score downstream models on held-out recorded frames, and synthetic frames against recorded ones."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.plugin_contracts import (
    DownstreamOfRecordings,
    DownstreamOfSequences,
    MetricOfRows,
)
from ctlev_core.plugin_outputs import features_of_frames, predict_frames
from ctlev_core.scoring.checks import check_distances, check_frames, check_metrics
from ctlev_core.scoring.scored_rows import RowScores
from ctlev_core.scoring.sensor_pixels import SensorSource, is_on_sensor, on_sensor, sensor_sizes
from ctlev_core.scoring.subsets import Group, class_groups, origin_groups, part_groups, subject_groups
from ctlev_core.statistics.feature_distances import (
    DISTANCE_ESTIMATES,
    DistanceEstimate,
    estimate_distances,
    estimates_table,
    name_distance,
)
from ctlev_core.supervised.frame_sequences import name_recordings
from data_contracts import tables
from data_contracts.config import DownstreamChoice, MetricChoice
from data_contracts.errors import DataError
from data_contracts.manifest import Manifest
from data_contracts.parts import only_part
from data_contracts.training_sets import LabelAgreement
from tasks.stage import Output, Stage

SHUFFLE_STREAM = 40
logger = logging.getLogger(__name__)


class _ModelScores(Stage):
    """A stage that scores a model, and is refused where it is planned if a metric does not fit the model."""

    def check(self, arguments: dict[str, Any]) -> None:
        check_metrics(arguments["downstream"], arguments["metrics"])
        check_frames(arguments["metrics"], arguments["data"].path)
        if arguments["sensor"] is None and any(map(is_on_sensor, arguments["metrics"])):
            raise DataError("score_model: a metric in px of the sensor needs the argument `sensor`")


class _DistanceScores(Stage):
    """A stage that compares sets of frames, and is refused where it is planned if it has nothing to do so with."""

    def check(self, arguments: dict[str, Any]) -> None:
        check_distances(arguments["downstream"], arguments["distances"])


@partial(_ModelScores, version=13, schema=tables.SCORES, raw_files=None, optional=("sensor",))
def score_model(
    out: Output,
    model: Manifest,
    data: Manifest,
    training_sets: list[Manifest],
    poses: list[Manifest],
    *,
    downstream: DownstreamChoice,
    metrics: list[MetricChoice],
    subject: str,
    split: str,
    seed: int,
    sensor: SensorSource | None = None,
) -> pa.Table:
    """Every metric on one split, for all rows and for each class, with an interval over recordings.

    Classes that recorded training frames show, those that only the label-only recordings of `poses` have, and those
    that neither has are groups of their own: what synthetic data adds is in the second. So are subjects of whom there
    is nothing to learn from, beside others, and each of a few subjects (`ctlev_core.scoring.subsets`). Beside the table
    lie the scores of the single samples, from which two models can be compared in pairs. The subject of
    shuffled label agreement gives every frame the labels of another. Metrics on the sensor need `sensor`.

    Raises:
        DataError: the split has no rows, or a recording is both learnt from and tested on.
    """
    plugin = plugins.load_options(downstream)
    rows = data.rows_where(split=split)
    if len(rows) == 0:
        raise DataError(f"{data.ref.path}: no rows in split {split!r} to score on")
    _refuse_overlap(data, rows, training_sets, split)
    predict = _predict_of(plugin.module, data, rows)
    prediction = predict_frames(plugin, model.ref.path / "model", data.images(rows), predict)
    labels = data.labels.take(rows)
    of_labels = LabelAgreement.parse(subject)
    if of_labels is not None and of_labels.shuffled:
        labels = labels.take(_others(len(rows), seed))
    recordings = np.array(data.column("recording_id"))[rows]
    num_train = sum(len(training_set.rows_where(split="train")) for training_set in training_sets)
    same = {
        "task": plugin.name,
        "subject": subject,
        "seed": seed,
        "num_train": num_train,
        "model_digest": model.ref.digest,
        "data_digest": data.ref.digest,
    }
    found: list[dict[str, Any]] = []
    sample_scores: list[pa.Table] = []
    sample_ids = np.array(data.column("sample_id"))[rows].tolist()
    groups = _groups(labels.class_names, data, rows, poses, split)
    for choice in metrics:
        metric = plugins.load_options(choice)
        predicted, true = prediction, labels
        if sensor is not None and is_on_sensor(choice):
            sizes = sensor_sizes(data, rows, only_part(sensor.recordings, sensor.part))
            predicted, true = on_sensor(prediction, labels, sizes, sensor.encoding)
        scored = RowScores(metric, predicted, true, recordings)
        for group, members in groups:
            try:
                scores, low, high = scored.of(members)
            except ValueError:
                if group == "all":
                    raise
                continue  # a class without a visible joint, for example, has no score of its own
            if group == "all" and isinstance(metric.module, MetricOfRows):
                columns = {"sample_id": sample_ids, "recording_id": recordings}
                sample_scores.append(pa.table(columns | scored.each_row(scores)))
            _refuse_twice(metric, scores, {row["metric"] for row in found if row["group"] == group})
            found += [
                {
                    **same,
                    "group": group,
                    "metric": name,
                    "value": value,
                    "low": low.get(name),
                    "high": high.get(name),
                    "num_samples": len(members),
                }
                for name, value in scores.items()
            ]
    if sample_scores:
        out.write_table(pa.concat_tables(sample_scores), tables.SAMPLE_SCORES)
    return pa.Table.from_pylist(found, schema=tables.SCORES.arrow())


def _refuse_twice(metric: plugins.Plugin, scores: Iterable[str], known: Collection[str]) -> None:
    """Raise `DataError` where options that a score's name does not hold give two scores of one name."""
    if twice := sorted(set(scores) & set(known)):
        raise DataError(
            f"{metric.kind} {metric.name!r} is asked for twice, and both give a score {twice[0]!r}: leave one out"
        )


def _predict_of(module: Any, data: Manifest, rows: np.ndarray) -> Any:
    """The function that predicts for frames: told which of them follow one another, or belong together, if it asks."""
    if isinstance(module, DownstreamOfSequences):
        return partial(module.predict_sequences, recordings=name_recordings(data, rows))
    if isinstance(module, DownstreamOfRecordings):
        return partial(module.predict_recordings, recordings=np.array(data.column("recording_id"))[rows].tolist())
    return module.predict


def _groups(
    class_names: Sequence[str], data: Manifest, rows: np.ndarray, poses: list[Manifest], split: str
) -> list[Group]:
    """All groups of the given rows; of frames that are not held out, none by subject."""
    recordings = np.array(data.column("recording_id"))[rows].tolist()
    groups = class_groups(class_names) + part_groups(recordings) + _groups_by_origin(class_names, data, poses)
    return groups if split == "train" else groups + _groups_by_subject(data, rows, poses)


def _groups_by_origin(class_names: Sequence[str], data: Manifest, poses: list[Manifest]) -> list[Group]:
    """Rows by where their class was to be learnt from."""
    return origin_groups(class_names, _trained(data, "class_name"), _sampled(poses, "class_name"))


def _groups_by_subject(data: Manifest, rows: np.ndarray, poses: list[Manifest]) -> list[Group]:
    """Rows by whether their subject was to be learnt from."""
    subjects, recordings = (np.array(data.column(name))[rows].tolist() for name in ("subject", "recording_id"))
    return subject_groups(subjects, recordings, _trained(data, "subject") | _sampled(poses, "subject"))


def _trained(data: Manifest, column: str) -> set[str]:
    return set(np.array(data.column(column))[data.rows_where(split="train")].tolist())


def _sampled(poses: list[Manifest], column: str) -> set[str]:
    return {name for m in poses for name in np.array(m.column(column))[m.rows_where(splits="condition")].tolist()}


def _others(count: int, seed: int) -> np.ndarray:
    """For each row another one (but for a single row), all of them once."""
    order = np.random.default_rng([seed, SHUFFLE_STREAM]).permutation(count)
    other = np.empty(count, np.int64)
    other[order] = np.roll(order, 1)
    return other


def _refuse_overlap(data: Manifest, rows: np.ndarray, training_sets: list[Manifest], split: str) -> None:
    """No recording may be both learnt from and tested on, but for those that the dataset splits in time.

    That no subject of the dataset itself is, `ingest` has made sure of. Of another dataset, to sample from or to learn
    from, a subject of the same name may be someone else, which nothing here can tell: that is a warning.
    """
    if split == "train":
        return
    sample_ids, recordings, subjects = (
        np.array(data.column(name))[rows] for name in ("sample_id", "recording_id", "subject")
    )
    whole = ~np.isin(recordings, list(_trained(data, "recording_id")))
    tested = set(zip(recordings[whole].tolist(), subjects[whole].tolist(), strict=True))
    for training_set in training_sets:
        learnt = training_set.rows_where(split="train")
        where = f"is in the training data {training_set.ref.path} and in split {split!r}"
        if shared := sorted(set(sample_ids.tolist()) & set(np.array(training_set.column("sample_id"))[learnt])):
            raise DataError(f"{data.ref.path}: sample {shared[0]!r} {where}")
        # Of a synthetic frame it counts whose pose it shows; what lies behind it is RECORDING:MOMENT.
        behind = "source_id" if "source_id" in training_set.table.column_names else "recording_id"
        origins = [name.partition(":")[0] for name in np.array(training_set.column(behind))[learnt].tolist()]
        people = np.array(training_set.column("subject"))[learnt].tolist()
        if shared := sorted(tested & set(zip(origins, people, strict=True))):
            raise DataError(f"{data.ref.path}: recording {shared[0][0]!r} {where}")
        if shared := sorted(set(subjects[whole].tolist()) & set(people) - _trained(data, "subject")):
            text = "%s: subject %r %s; if both are one person, scores are not those of an unseen one"
            logger.warning(text, data.ref.path, shared[0], where)


@partial(_DistanceScores, version=5, schema=tables.SCORES, raw_files=None)
def score_distance(
    out: Output,
    extractor: Manifest,
    real: Manifest,
    other: Manifest,
    *,
    downstream: DownstreamChoice,
    distances: list[MetricChoice],
    subject: str,
    split: str,
    seed: int,
) -> pa.Table:
    """Distances between the features of recorded training frames and of another set of frames.

    A score is named after the classifier trained on recorded events whose features are compared, or as a ready-made
    extractor asks: `fid` is that of the verified network alone. Values depend on the number of samples: compare rows of
    equal `num_samples` only, and read them against the row of held-out recorded frames. Intervals come from halves by
    recording, for a bootstrap is biased. `seed` is that of the generator. Beside the scores lies the table
    `distance_estimates`: the number of features, and what recorded training frames score against one another.
    """
    plugin = plugins.load_options(downstream)
    folder = extractor.ref.path / "model"
    compared, learnt = (other, other.rows_where(split=split)), (real, real.rows_where(split="train"))
    features, groups = [], []
    for data, rows in (compared, learnt):
        if len(rows) == 0:
            raise DataError(f"{data.ref.path}: no rows in split {split if data is other else 'train'!r} to compare")
        features.append(features_of_frames(plugin, folder, data.images(rows)))
        groups.append(np.array(data.column("recording_id"))[rows])
    named: dict[str, DistanceEstimate] = {}
    for choice in distances:
        metric = plugins.load_options(choice)
        estimates = estimate_distances(
            partial(metric.module.compute, options=metric.options),
            *features,
            predicted_groups=groups[0],
            target_groups=groups[1],
        )
        of_metric = {name_distance(plugin, folder, extractor.ref.digest, name): one for name, one in estimates.items()}
        _refuse_twice(metric, of_metric, named.keys())
        named |= of_metric
    out.write_table(estimates_table(subject, named), DISTANCE_ESTIMATES)
    found = [
        {
            "task": "distance",
            "subject": subject,
            "seed": seed,
            "group": "all",
            "metric": name,
            "value": estimate.value,
            "low": None if np.isnan(estimate.low) else estimate.low,
            "high": None if np.isnan(estimate.high) else estimate.high,
            "num_samples": estimate.num_predicted,
            "num_train": estimate.num_target,
            "model_digest": extractor.ref.digest,
            "data_digest": other.ref.digest,
        }
        for name, estimate in named.items()
    ]
    return pa.Table.from_pylist(found, schema=tables.SCORES.arrow())
