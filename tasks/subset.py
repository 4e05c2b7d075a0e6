"""Parts of a set of frames: so many recorded ones, the first synthetic ones, or those that show their labels best."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.labels.label_sampling import spread_choice
from ctlev_core.plugin_contracts import MetricOfRows
from ctlev_core.plugin_outputs import predict_frames
from ctlev_core.scoring.score_info import lower_is_better
from data_contracts import tables
from data_contracts.config import DownstreamChoice, MetricChoice
from data_contracts.errors import DataError
from data_contracts.image_rows import image_chunks
from data_contracts.manifest import Manifest
from tasks.stage import Output, stage


@stage(version=2, schema=tables.FRAMES)
def take_recorded(out: Output, frames: Manifest, *, count: int, seed: int) -> pa.Table:
    """`count` training frames, spread evenly over subjects and classes and their recordings; all other splits whole.

    Raises:
        DataError: there are fewer training frames.
    """
    splits, learnt = np.array(frames.column("split")), frames.rows_where(split="train")
    if len(learnt) < count:
        raise DataError(
            f"num_recorded: {count} training frames were asked for, the recordings give {len(learnt)}; lower it, or "
            f"raise windows.max_windows"
        )
    columns = [np.array(frames.column(name))[learnt].tolist() for name in ("subject", "class_name", "recording_id")]
    groups = [f"{subject}/{class_name}" for subject, class_name in zip(*columns[:2], strict=True)]
    chosen = learnt[spread_choice(groups, columns[2], count, seed)]
    rows = np.sort(np.concatenate([chosen, np.flatnonzero(splits != "train")]))
    for name in ("histograms", "frames"):
        _copy_rows(out, frames, rows, name)
    return frames.table.take(rows)


@stage(version=1, schema=tables.FRAMES)
def take_fold(out: Output, frames: Manifest, *, fold: int, num_folds: int, seed: int) -> pa.Table:
    """The training frames alone, those of every `num_folds`-th recording held out as split `validation`.

    Recordings are in random order, the same for all folds: each training frame is held out in one of them.

    Raises:
        DataError: there are fewer recordings than folds.
    """
    rows = frames.rows_where(split="train")
    names = np.array(frames.column("recording_id"))[rows]
    recordings = np.random.default_rng(seed).permutation(np.unique(names))
    if len(recordings) < num_folds:
        raise DataError(f"{frames.ref.path}: {num_folds} folds need as many recordings, got {len(recordings)}")
    held_out = np.isin(names, recordings[fold::num_folds])
    for name in ("histograms", "frames"):
        _copy_rows(out, frames, rows, name)
    table = frames.table.take(rows)
    splits = pa.array(np.where(held_out, "validation", "train"), pa.string())
    return table.set_column(table.column_names.index("split"), table.schema.field("split"), splits)


@stage(version=2, schema=tables.SYNTHETIC)
def take_share(out: Output, synthetic: Manifest, *, share: float) -> pa.Table:
    """The first rows, one at least: classes and recordings took turns when the labels were chosen."""
    return _take(out, synthetic, np.arange(max(round(share * len(synthetic)), 1)))


@stage(version=3, schema=tables.SYNTHETIC)
def take_label_consistent(
    out: Output,
    model: Manifest,
    synthetic: Manifest,
    *,
    downstream: DownstreamChoice,
    metric: MetricChoice,
    share: float,
) -> pa.Table:
    """The share of each class whose labels a model trained on recorded frames finds best.

    It chooses within classes, so that the mixture of classes, and with it what is easy, stays as it was. Rows that the
    metric has no score for are left out first.

    Raises:
        DataError: the metric has no score of single rows.
    """
    plugin, scorer = plugins.load_options(downstream), plugins.load_options(metric)
    if not isinstance(scorer.module, MetricOfRows):
        raise DataError(f"keep_fraction: metric {metric.name!r} has no score of single frames to choose by")
    prediction = predict_frames(plugin, model.ref.path / "model", synthetic.images(np.arange(len(synthetic))))
    scores = scorer.module.compute_rows(prediction, synthetic.labels, scorer.options)
    # As elsewhere the name of the score decides, which need not be that of the plug-in.
    first = next(iter(scorer.module.compute(prediction, synthetic.labels, scorer.options)))
    errors = scores if lower_is_better(first) else -scores
    errors = np.where(np.isnan(errors), np.inf, errors)
    names = np.array(synthetic.labels.class_names)
    kept = []
    for name in np.unique(names):
        members = np.flatnonzero(names == name)
        best = members[np.argsort(errors[members], kind="stable")]
        kept.append(best[: max(round(share * len(members)), 1)])
    return _take(out, synthetic, np.sort(np.concatenate(kept)))


def _take(out: Output, synthetic: Manifest, rows: np.ndarray) -> pa.Table:
    _copy_rows(out, synthetic, rows, "frames")
    return synthetic.table.take(rows)


def _copy_rows(out: Output, source: Manifest, rows: np.ndarray, name: str) -> None:
    with out.open_array(name) as written:
        for images in image_chunks(source.images(rows, name)):
            written.append(images)
