"""Labels to conditions: what the generator learns from, and what it is then asked for."""

# pyarrow.compute makes its functions when it is imported, where a type checker cannot see them.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from ctlev_core import moments as around
from ctlev_core import plugins
from ctlev_core.body_views import from_new_side, with_joints
from ctlev_core.image_resampling import resample_images
from ctlev_core.labelling import labels_in_image
from ctlev_core.plugins import Plugin
from ctlev_core.pose_choice import balanced_choice, surrounded
from ctlev_core.windows import spread
from data_contracts import tables
from data_contracts.config import ConditionChoice, EncodingChoice
from data_contracts.errors import DataError
from data_contracts.events import SensorSize
from data_contracts.experiment import PoseOrder, PoseViews
from data_contracts.labels import BodyMotions, Labels
from data_contracts.manifest import Manifest, concat_labels, condition_arrays, label_columns, labels_of
from tasks.stage import Output, stage

VIEW_STREAM = 30


def _input_files(arguments: dict[str, Any]) -> list[tuple[str, Path]]:
    plugin = plugins.load_options(arguments["condition"])
    files = plugin.module.input_files(plugin.options) if hasattr(plugin.module, "input_files") else []
    return [(path.name, path) for path in files]


@dataclass(frozen=True, eq=False)
class _Rows:
    """What conditions are rendered from, N rows.

    Attributes:
        source_ids: N frames or label moments.
        recordings: the manifest of their recordings.
        recording_ids: N, of `recordings`.
        subjects: N.
        t_start_us: [N] int64, first event of the row's window, or where it would be.
        t_end_us: [N] int64, its last event.
        labelled: N labels as their recordings have them, but for the image that they are in.
        labels: the same in image pixels, seen from the side that was asked for.
    """

    source_ids: list[str]
    recordings: Manifest
    recording_ids: list[str]
    subjects: list[str]
    t_start_us: np.ndarray
    t_end_us: np.ndarray
    labelled: Labels
    labels: Labels


@stage(version=4, schema=tables.CONDITIONS, raw_files=_input_files)
def condition_frames(
    out: Output,
    recordings: Manifest,
    frames: Manifest,
    *,
    condition: ConditionChoice,
    encoding: EncodingChoice,
    seed: int,
) -> pa.Table:
    """Render the condition of every training frame; rows join the frames on `sample_id`."""
    rows = _of_frames(recordings, frames, frames.rows_where(split="train"))
    return _render(out, rows.source_ids, rows, condition, recordings, frames, encoding, seed)


@stage(version=5, schema=tables.CONDITIONS, raw_files=_input_files)
def condition_samples(
    out: Output,
    poses: Manifest,
    recordings: Manifest,
    frames: Manifest,
    *,
    condition: ConditionChoice,
    encoding: EncodingChoice,
    count: int,
    order: PoseOrder,
    views: PoseViews,
    seed: int,
) -> pa.Table:
    """Choose `count` labels to sample from and render them.

    They come from the label-only recordings of `poses` (split `condition`: poses no frame was trained on) where it has
    such, and otherwise from the training frames. In random order classes take turns, and within a class recordings;
    moments nearer than half a window (the median of the training frames) to an end of their recording are left out
    where it has others. In order of time the recordings follow one another, `count` moments evenly spread over them.
    `poses` are the recordings of the experiment or those of another dataset; bodies without 2D joints are seen by a
    virtual camera. New views turn each body, or in order of time each recording, to a camera of its own.

    Whatever the condition, the same moments are chosen, so that generators can be compared on the same poses.
    """
    half_us = _half_window_us(frames)
    moments = _label_only(poses)
    if moments.num_rows:
        inner = surrounded(moments["recording_id"].to_pylist(), moments["t_us"].to_numpy(), half_us)
        allowed = np.flatnonzero(inner) if order == "random" else np.arange(moments.num_rows)
        chosen = moments.take(_choose(moments, allowed, count, order, seed))
        names, times = chosen["recording_id"].to_pylist(), chosen["t_us"].to_numpy()
        together = np.arange(count) if order == "random" else np.unique(names, return_inverse=True)[1]
        turned = None if views == "labelled" else together
        labelled = labels_of(chosen)
        rows = _Rows(
            source_ids=[f"{name}:{t}" for name, t in zip(names, times.tolist(), strict=True)],
            recordings=poses,
            recording_ids=names,
            subjects=chosen["subject"].to_pylist(),
            t_start_us=np.maximum(times - half_us, 0),
            t_end_us=times + half_us,
            labelled=labelled,
            labels=_seen(labelled, recordings, frames, encoding, turned, seed),
        )
    elif poses.ref.key != recordings.ref.key:
        raise DataError(f"{poses.ref.path}: the dataset of poses has no recording in split 'condition'")
    else:
        learnt = frames.rows_where(split="train")
        rows = _of_frames(recordings, frames, _choose(frames.table, learnt, count, order, seed))
    if views == "new" and getattr(plugins.load_options(condition).module, "NEEDS", "") == "intensity":
        raise DataError(f"condition {condition.name!r} shows pictures as they were taken; set pose_views to 'labelled'")
    sample_ids = [f"condition/{number:06d}" for number in range(count)]
    return _render(out, sample_ids, rows, condition, recordings, frames, encoding, seed)


def _choose(table: pa.Table, rows: np.ndarray, count: int, order: PoseOrder, seed: int) -> np.ndarray:
    """`count` of the given rows of a table of labels."""
    if order == "in_time":
        return rows[np.sort(np.resize(spread(len(rows), count), count))]
    classes, recordings = (np.array(table[name].to_pylist())[rows].tolist() for name in ("class_name", "recording_id"))
    return rows[balanced_choice(classes, recordings, count, seed)]


def _label_only(poses: Manifest) -> pa.Table:
    """Every label moment of the recordings of `poses` in split `condition`, in the order of recordings and times."""
    wanted = np.array(poses.column("recording_id"))[poses.rows_where(splits="condition")]
    table = poses.attached(tables.LABELS)
    return table.filter(pc.is_in(table["recording_id"], pa.array(wanted, pa.string())))


def _half_window_us(frames: Manifest) -> int:
    rows = frames.rows_where(split="train")
    durations = frames.table["t_end_us"].to_numpy()[rows] - frames.table["t_start_us"].to_numpy()[rows]
    return int(np.median(durations)) // 2


def _of_frames(recordings: Manifest, frames: Manifest, rows: np.ndarray) -> _Rows:
    table = frames.table.take(rows)
    labels = frames.labels.take(rows)
    return _Rows(
        source_ids=table["sample_id"].to_pylist(),
        recordings=recordings,
        recording_ids=table["recording_id"].to_pylist(),
        subjects=table["subject"].to_pylist(),
        t_start_us=table["t_start_us"].to_numpy(),
        t_end_us=table["t_end_us"].to_numpy(),
        labelled=labels,
        labels=labels,
    )


def _pairs(rows: _Rows, frames: Manifest, encoding: EncodingChoice) -> np.ndarray:
    """The grey pictures [N, H, W, 2] uint8 at start and end of each row's window, in image pixels."""
    plugin = plugins.load_options(encoding)
    width, height = image_size = _image_size(frames)
    files = dict(zip(rows.recordings.column("recording_id"), rows.recordings.column("intensity_file"), strict=True))
    pairs = np.empty((len(rows.labels), height, width, 2), np.uint8)
    for name, members in _by_name(rows.recording_ids).items():
        if not files[name]:
            raise DataError(f"{rows.recordings.ref.path}: {name} has no intensity frames, which this condition needs")
        array = files[name].removesuffix(".npy")
        images, t_us = rows.recordings.array(array), np.asarray(rows.recordings.array(array + ".t_us"))
        chosen = [
            around.nearest_pair(t_us, int(rows.t_start_us[row]), int(rows.t_end_us[row]), name) for row in members
        ]
        used, places = np.unique(np.array(chosen), return_inverse=True)
        size = (images.shape[2], images.shape[1])
        resampled = resample_images(
            np.asarray(images[used]),
            lambda points, size=size: plugin.module.map_points(points, size, plugin.options),
            image_size,
        )
        pictures = np.rint(resampled).astype(np.uint8)
        pairs[members] = np.moveaxis(pictures[places.reshape(-1, 2)], 1, -1)
    return pairs


def _motions(rows: _Rows, recordings: Manifest, frames: Manifest, encoding: EncodingChoice) -> BodyMotions:
    """What each body does around its labelled moment, as far to either side as the longest training window lasts."""
    learnt = frames.rows_where(split="train")
    reach_us = int((frames.table["t_end_us"].to_numpy() - frames.table["t_start_us"].to_numpy())[learnt].max())
    where = f"{rows.recordings.ref.path}: condition of body motions"
    table = rows.recordings.attached(tables.LABELS)
    found: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    for name, members in _by_name(rows.recording_ids).items():
        track = labels_of(table.filter(pc.equal(table["recording_id"], name)))
        for row in members.tolist():
            moment_us = int(rows.labelled.t_us[row])
            found[row] = around.motion_around(track, moment_us, reach_us, f"{where}, {name}")
    motions = around.body_motions([found[row] for row in range(len(found))], rows.labelled, rows.labels, where)
    # Simulated events are encoded as the real ones are, so they come from a sensor of the real one's size.
    plugin, size = plugins.load_options(encoding), _sensor_size(recordings)
    offset, unit = plugin.module.map_points(np.array([[0.0, 0.0], [1.0, 1.0]]), size, plugin.options)
    scale = np.tile(unit - offset, 2)
    on_sensor = (motions.intrinsics - np.array([0.0, 0.0, *offset])) / scale
    return replace(motions, intrinsics=on_sensor.astype(np.float32))


def _by_name(names: Sequence[str]) -> dict[str, np.ndarray]:
    """The rows of each name, in the order of first rows."""
    array = np.array(names)
    return {name: np.flatnonzero(array == name) for name in dict.fromkeys(names)}


def _seen(
    labels: Labels,
    recordings: Manifest,
    frames: Manifest,
    encoding: EncodingChoice,
    turned: np.ndarray | None,
    seed: int,
) -> Labels:
    """Label-only rows as labels in image pixels.

    A label-only recording has no sensor of its own: its labels are in the frame of the dataset's sensor, or a virtual
    camera with that sensor looks at its bodies; at those of one number in `turned` [N] from one new side.
    """
    size = _sensor_size(recordings)
    if turned is not None:
        labels = _from_new_sides(labels, turned, size, seed)
    if labels.joints2d is None and labels.smpl_pose is not None:
        labels = with_joints(labels, size, frames.labels.joint_set or "smpl")
    plugin = plugins.load_options(encoding)
    return labels_in_image(
        labels, lambda points: plugin.module.map_points(points, size, plugin.options), _image_size(frames)
    )


def _sensor_size(recordings: Manifest) -> SensorSize:
    rows = recordings.table.to_pylist()
    return next((row["sensor_width_px"], row["sensor_height_px"]) for row in rows if row["sensor_width_px"])


def _from_new_sides(labels: Labels, turned: np.ndarray, sensor_size: SensorSize, seed: int) -> Labels:
    """Bodies before new cameras, one for each number in `turned` [N]; row order stays."""
    if labels.smpl_pose is None:
        raise DataError("pose_views 'new' needs bodies (SMPL parameters) to turn; these labels have joints or classes")
    groups = [np.flatnonzero(turned == number) for number in np.unique(turned)]
    seen = [
        from_new_side(labels.take(rows), np.random.default_rng([seed, VIEW_STREAM, number]), sensor_size)
        for number, rows in enumerate(groups)
    ]
    return concat_labels(seen).take(np.argsort(np.concatenate(groups), kind="stable"))


def _load_condition(condition: ConditionChoice, recordings: Manifest) -> Plugin:
    """The condition plug-in; one that takes synonyms also gets the dataset's own, the user's before them."""
    plugin = plugins.load_options(condition)
    own = getattr(plugin.options, "synonyms", None)
    if own is None:
        return plugin
    of_dataset = {row["class_name"]: row["names"] for row in recordings.attached(tables.SYNONYMS).to_pylist()}
    return replace(plugin, options=plugin.options.model_copy(update={"synonyms": {**of_dataset, **own}}))


def _image_size(frames: Manifest) -> tuple[int, int]:
    _, height, width, _ = frames.array("frames").shape
    return width, height


def _render(
    out: Output,
    sample_ids: list[str],
    rows: _Rows,
    condition: ConditionChoice,
    recordings: Manifest,
    frames: Manifest,
    encoding: EncodingChoice,
    seed: int,
) -> pa.Table:
    plugin = _load_condition(condition, recordings)
    labels = rows.labels
    seeds = [int(np.random.SeedSequence([seed, row]).generate_state(1)[0]) for row in range(len(labels))]
    asked = (labels, _image_size(frames), plugin.options, seeds)
    needs = getattr(plugin.module, "NEEDS", None)
    if needs == "intensity":
        rendered = plugin.module.render(*asked, _pairs(rows, frames, encoding))
    elif needs == "motion":
        rendered = plugin.module.render(*asked, _motions(rows, recordings, frames, encoding))
    else:
        rendered = plugin.module.render(*asked)
    for name, array in condition_arrays(rendered).items():
        out.write_array(name, array)
    return pa.table(
        {
            "sample_id": sample_ids,
            "source_id": rows.source_ids,
            "subject": rows.subjects,
            "class_name": pa.array(labels.class_names, pa.string()),
            "prompt": pa.array(rendered.prompts, pa.string()),
            "t_start_us": rows.t_start_us,
            "t_end_us": rows.t_end_us,
            **label_columns(labels),
        }
    )
