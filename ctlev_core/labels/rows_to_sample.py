"""Labels to sample from: which moments, and from which side they are seen."""

# pyarrow.compute makes its functions when it is imported, where a type checker cannot see them.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from ctlev_core import plugins
from ctlev_core.events.windows import spread
from ctlev_core.labels.label_sampling import balanced_choice, choose_stretches, surrounded
from ctlev_core.labels.labelling import labels_in_image
from ctlev_core.labels.sources import (
    LabelledRows,
    as_different_as_training,
    half_window_us,
    image_size_of,
    rows_of_frames,
    sensor_size_of,
)
from ctlev_core.supervised.frame_sequences import training_interval_us
from data_contracts import tables
from data_contracts.config import EncodingChoice, Windows
from data_contracts.errors import DataError
from data_contracts.events import SensorSize
from data_contracts.experiment import LabelOrder, View
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest, concat_labels, labels_of

VIEW_STREAM = 30


def choose_rows_to_sample(
    poses: Manifest,
    recordings: Manifest,
    frames: Manifest,
    *,
    encoding: EncodingChoice,
    windows: Windows,
    count: int,
    order: LabelOrder,
    views: View,
    needs_pictures: bool,
    seed: int,
    length: int = 1,
    chosen: np.ndarray | None = None,
) -> LabelledRows:
    """Choose labels to sample from.

    They come from the label-only recordings of `poses` (split `condition`: poses no frame was trained on) where it has
    such, and otherwise from the training frames. In random order classes take turns, and within a class recordings;
    moments nearer than half a window (the median of the training frames) to an end of their recording are left out
    where it has others. In order of time the recordings follow one another, `count` moments evenly spread over them.
    Stretches are `length` moments each, as far apart as training frames are, of recordings evenly spread over all.
    Bodies without 2D joints are seen by a virtual camera. New views turn each body, or in order of time each recording,
    to a camera of its own.

    Whatever the condition, the same moments are chosen, so that generators can be compared on the same poses. The
    window around a label-only moment, or before it where windows end at labels, is as long as the median one of
    training. For pictures in windows of equal `count` it is as long as it takes them to change as much as the pictures
    of training do.

    Args:
        poses: recordings to take labels from: those of the experiment, or of another dataset.
        recordings: of the experiment.
        frames: of the experiment.
        encoding: of the frames.
        windows: that the frames were cut by.
        count: of labels.
        order: of moments.
        views: `labelled`, or `new` ones.
        needs_pictures: whether the condition is made of the grey pictures at a window's ends.
        seed: of the choice and the views.
        length: moments of a stretch, where they are chosen so.
        chosen: [count] rows of `label_moments`, where they are chosen already.
    Raises:
        DataError: there is nothing to choose from, or no body to see from a new side.
    """
    half_us = half_window_us(frames)
    before_us, after_us = (2 * half_us, 0) if windows.end_at_labels else (half_us, half_us)
    moments = label_moments(poses)
    if moments.num_rows:
        if chosen is None:
            if order == "stretches":
                names, times = moments["recording_id"].to_pylist(), moments["t_us"].to_numpy()
                chosen = choose_stretches(names, times, count, length, training_interval_us(frames))
            else:
                allowed = inner_moments(moments, frames) if order == "random" else np.arange(moments.num_rows)
                chosen = choose_in_turn(moments, allowed, count, order, seed)
        asked = moments.take(chosen)
        names, times = asked["recording_id"].to_pylist(), asked["t_us"].to_numpy()
        together = np.arange(count) if order == "random" else np.unique(names, return_inverse=True)[1]
        turned = None if views == "labelled" else together
        labelled = labels_of(asked)
        rows = LabelledRows(
            source_ids=[f"{name}:{t}" for name, t in zip(names, times.tolist(), strict=True)],
            recordings=poses,
            recording_ids=names,
            subjects=asked["subject"].to_pylist(),
            t_start_us=np.maximum(times - before_us, 0),
            t_end_us=times + after_us,
            labelled=labelled,
            labels=_seen(labelled, _sensors(poses, names), recordings, frames, encoding, turned, seed),
        )
    elif poses.ref.key != recordings.ref.key:
        raise DataError(f"{poses.ref.path}: the dataset of poses has no recording in split 'condition'")
    else:
        learnt = frames.rows_where(split="train")
        if order == "stretches":
            names, times = frames.column("recording_id"), frames.table["t_end_us"].to_numpy()[learnt]
            own = [names[row] for row in learnt]
            learnt = learnt[choose_stretches(own, times, count, length, training_interval_us(frames))]
        else:
            learnt = choose_in_turn(frames.table, learnt, count, order, seed)
        rows = rows_of_frames(recordings, frames, learnt)
    if needs_pictures:
        if views == "new":
            raise DataError("conditions of pictures show them as they were; set view to 'labelled'")
        if windows.method == "count" and moments.num_rows:
            rows = as_different_as_training(rows, recordings, frames)
    return rows


def choose_in_turn(table: pa.Table, rows: np.ndarray, count: int, order: LabelOrder, seed: int) -> np.ndarray:
    """`count` of the given rows of a table of labels: classes and recordings in turn, or evenly spread in time."""
    if order == "in_time":
        return rows[np.sort(np.resize(spread(len(rows), count), count))]
    classes, recordings = (np.array(table[name].to_pylist())[rows].tolist() for name in ("class_name", "recording_id"))
    return rows[balanced_choice(classes, recordings, count, seed)]


def label_moments(poses: Manifest) -> pa.Table:
    """Every label moment of the recordings of `poses` in split `condition`, in the order of recordings and times."""
    wanted = np.array(poses.column("recording_id"))[poses.rows_where(splits="condition")]
    table = poses.attached(tables.LABELS)
    return table.filter(pc.is_in(table["recording_id"], pa.array(wanted, pa.string())))


def inner_moments(moments: pa.Table, frames: Manifest) -> np.ndarray:
    """The rows of moments half a window or more from both ends of their recording, where it has others."""
    names, times = moments["recording_id"].to_pylist(), moments["t_us"].to_numpy()
    return np.flatnonzero(surrounded(names, times, half_window_us(frames)))


def moments_in_image(
    moments: pa.Table, poses: Manifest, recordings: Manifest, frames: Manifest, encoding: EncodingChoice, seed: int
) -> Labels:
    """The labels of moments in image pixels, as their own camera, or a virtual one, sees them."""
    sensors = _sensors(poses, moments["recording_id"].to_pylist())
    return _seen(labels_of(moments), sensors, recordings, frames, encoding, None, seed)


def _sensors(poses: Manifest, names: list[str]) -> np.ndarray:
    """(width, height) [N, 2] px of the sensors that labels of recordings `names` are of, 0 where of none."""
    rows = {row["recording_id"]: row for row in poses.table.to_pylist()}
    return np.array([(rows[name]["sensor_width_px"], rows[name]["sensor_height_px"]) for name in names]).reshape(-1, 2)


def _seen(
    labels: Labels,
    sensors: np.ndarray,
    recordings: Manifest,
    frames: Manifest,
    encoding: EncodingChoice,
    turned: np.ndarray | None,
    seed: int,
) -> Labels:
    """Label-only rows as labels in image pixels.

    Labels of the experiment's own sensor stay where they are, those of another (`sensors` [N, 2] px) are scaled to fit
    into its middle. Bodies that no sensor saw, or in `turned` [N] all of one number from one new side, are seen by a
    virtual camera with the experiment's sensor.
    """
    from ctlev_core.labels.body_views import with_joints  # here, because a cached run needs no numba and no scipy

    size = sensor_size_of(recordings)
    labels = _on_sensor(labels, sensors, size) if turned is None else _from_new_sides(labels, turned, size, seed)
    if labels.joints2d is None and labels.smpl_pose is not None:
        labels = with_joints(labels, size, frames.labels.joint_set or "smpl")
    plugin = plugins.load_options(encoding)
    return labels_in_image(
        labels, lambda points: plugin.module.map_points(points, size, plugin.options), image_size_of(frames)
    )


def _on_sensor(labels: Labels, sensors: np.ndarray, size: SensorSize) -> Labels:
    """Labels in px of sensors [N, 2] as labels in px of one, as if it stood in the same place with the same view."""
    of_row = [size if min(sensor) == 0 else sensor for sensor in map(tuple, sensors.tolist())]
    if all(sensor == size for sensor in of_row):
        return labels
    groups = [np.array([own == sensor for own in of_row]).nonzero()[0] for sensor in dict.fromkeys(of_row)]
    moved = []
    for rows in groups:
        own = np.array(of_row[rows[0]])
        scale = (np.array(size) / own).min()
        border = (np.array(size) - scale * own) / 2
        moved.append(labels_in_image(labels.take(rows), lambda points, k=scale, b=border: k * points + b, size))
    return concat_labels(moved).take(np.argsort(np.concatenate(groups), kind="stable"))


def _from_new_sides(labels: Labels, turned: np.ndarray, sensor_size: SensorSize, seed: int) -> Labels:
    """Bodies before new cameras, one for each number in `turned` [N]; row order stays."""
    from ctlev_core.labels.body_views import from_new_side

    if labels.smpl_pose is None:
        raise DataError("view 'new' needs bodies (SMPL parameters) to turn; these labels have joints or classes")
    groups = [np.flatnonzero(turned == number) for number in np.unique(turned)]
    seen = [
        from_new_side(labels.take(rows), np.random.default_rng([seed, VIEW_STREAM, number]), sensor_size)
        for number, rows in enumerate(groups)
    ]
    return concat_labels(seen).take(np.argsort(np.concatenate(groups), kind="stable"))
