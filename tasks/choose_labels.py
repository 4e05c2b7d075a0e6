"""Which labels to sample from, where they are not chosen at random: a stage of its own, for every condition."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.events.windows import spread
from ctlev_core.labels.pose_choice import farthest_points, hardest, pose_vectors, predict_errors
from ctlev_core.labels.rows_to_sample import choose_in_turn, inner_moments, label_moments, moments_in_image
from ctlev_core.labels.sources import image_size_of
from ctlev_core.plugin_contracts import MetricOfRows
from ctlev_core.plugin_outputs import predict_frames
from ctlev_core.scoring.score_info import lower_is_better
from data_contracts import tables
from data_contracts.config import DownstreamChoice, EncodingChoice, MetricChoice
from data_contracts.errors import DataError
from data_contracts.manifest import Manifest, concat_labels
from tasks.stage import Output, stage

MAX_MOMENTS = 20_000
"""Of more label moments so many, evenly spread, are to choose from."""
HARD_SHARE = 0.25
"""Of the moments to choose from, those with the largest errors to expect."""


@stage(version=1, schema=tables.LABEL_CHOICE)
def cover_labels(
    out: Output,
    poses: Manifest,
    recordings: Manifest,
    frames: Manifest,
    *,
    encoding: EncodingChoice,
    count: int,
    seed: int,
) -> pa.Table:
    """`count` label-only moments, each the farthest from the recorded training poses and those chosen before.

    Where there are fewer they come again in the same order. `seed` is that of virtual cameras; nothing else is random.

    Raises:
        DataError: there are no label-only recordings, or no 2D joints.
    """
    moments, rows, vectors = _candidates(poses, recordings, frames, encoding, seed)
    recorded = frames.rows_where(split="train")
    recorded = recorded[spread(len(recorded), MAX_MOMENTS)]
    learnt = pose_vectors(frames.labels.take(recorded), image_size_of(frames))
    covered = learnt[~np.isnan(learnt).any(axis=1)]
    chosen, distances = farthest_points(vectors, covered, min(count, len(vectors)))
    return _table(moments, rows[np.resize(chosen, count)], np.resize(distances, count))


@stage(version=1, schema=tables.LABEL_CHOICE)
def find_hard_labels(
    out: Output,
    models: list[Manifest],
    folds: list[Manifest],
    poses: Manifest,
    recordings: Manifest,
    frames: Manifest,
    *,
    downstream: DownstreamChoice,
    metric: MetricChoice,
    encoding: EncodingChoice,
    count: int,
    seed: int,
) -> pa.Table:
    """`count` of the quarter of label-only moments whose poses a model has the largest errors to expect of.

    Each of `models` learnt from the training frames of one of `folds` and is scored on those held out there, so that
    every training frame has an error of a model that has not seen its recording. The error to expect of a pose is the
    mean of those of the nearest recorded ones. In the hardest quarter classes and recordings take turns at random.

    Raises:
        DataError: there are no label-only recordings or 2D joints, the metric has no score of single rows, or no frame
            has one.
    """
    moments, rows, vectors = _candidates(poses, recordings, frames, encoding, seed)
    plugin, scorer = plugins.load_options(downstream), plugins.load_options(metric)
    if not isinstance(scorer.module, MetricOfRows):
        raise DataError(f"labels 'hard': metric {metric.name!r} has no score of single frames to choose by")
    errors, known = [], []
    for model, fold in zip(models, folds, strict=True):
        held_out = fold.rows_where(split="validation")
        labels = fold.labels.take(held_out)
        prediction = predict_frames(plugin, model.ref.path / "model", fold.images(held_out))
        scores = scorer.module.compute_rows(prediction, labels, scorer.options)
        first = next(iter(scorer.module.compute(prediction, labels, scorer.options)))
        errors.append(scores if lower_is_better(first) else -scores)
        known.append(labels)
    of_frames = np.concatenate(errors)
    of_poses = pose_vectors(concat_labels(known), image_size_of(frames))
    scored = ~(np.isnan(of_frames) | np.isnan(of_poses).any(axis=1))
    if not scored.any():
        raise DataError(f"{frames.ref.path}: no training frame has a score of {metric.name!r} to choose by")
    expected = predict_errors(vectors, of_poses[scored], of_frames[scored])
    hard = hardest(expected, HARD_SHARE)
    chosen = choose_in_turn(moments, rows[hard], count, "random", seed)
    return _table(moments, chosen, expected[np.searchsorted(rows, chosen)])


def _candidates(
    poses: Manifest, recordings: Manifest, frames: Manifest, encoding: EncodingChoice, seed: int
) -> tuple[pa.Table, np.ndarray, np.ndarray]:
    """All label moments, the rows [N] of those to choose from, ascending, and their poses [N, D]."""
    moments = label_moments(poses)
    if not moments.num_rows:
        raise DataError(
            f"{poses.ref.path}: labels 'coverage' and 'hard' are chosen from recordings of split 'condition', got none"
        )
    rows = inner_moments(moments, frames)
    rows = rows[spread(len(rows), MAX_MOMENTS)]
    labels = moments_in_image(moments.take(rows), poses, recordings, frames, encoding, seed)
    if labels.joint_set != frames.labels.joint_set:
        raise DataError(
            f"{poses.ref.path}: poses to choose from are compared with recorded ones, expected their joints "
            f"{frames.labels.joint_set!r}, got {labels.joint_set!r}"
        )
    vectors = pose_vectors(labels, image_size_of(frames))
    known = ~np.isnan(vectors).any(axis=1)
    if not known.any():
        raise DataError(f"{poses.ref.path}: no label to choose from has a joint that is known")
    return moments, rows[known], vectors[known]


def _table(moments: pa.Table, chosen: np.ndarray, values: np.ndarray) -> pa.Table:
    of_chosen = moments.take(chosen)
    return pa.table(
        {
            "moment": pa.array(chosen, pa.int64()),
            "recording_id": of_chosen["recording_id"],
            "t_us": of_chosen["t_us"],
            "value": pa.array(values, pa.float64()),
        }
    )
