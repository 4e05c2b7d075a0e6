"""Labels to conditions: what the generator learns from, and what it is then asked for."""

# pyarrow.compute makes its functions when it is imported, where a type checker cannot see them.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from ctlev_core import plugins
from ctlev_core.body_views import from_new_side, with_joints
from ctlev_core.labelling import labels_in_image
from ctlev_core.plugins import Plugin
from ctlev_core.windows import spread
from data_contracts import tables
from data_contracts.config import ConditionChoice, EncodingChoice
from data_contracts.errors import DataError
from data_contracts.events import SensorSize
from data_contracts.experiment import PoseOrder, PoseViews
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest, concat_labels, label_columns, labels_of
from tasks.stage import Output, stage

VIEW_STREAM = 30


def _input_files(arguments: dict[str, Any]) -> list[tuple[str, Path]]:
    plugin = plugins.load_options(arguments["condition"])
    files = plugin.module.input_files(plugin.options) if hasattr(plugin.module, "input_files") else []
    return [(path.name, path) for path in files]


@stage(version=3, schema=tables.CONDITIONS, raw_files=_input_files)
def condition_frames(
    out: Output, recordings: Manifest, frames: Manifest, *, condition: ConditionChoice, seed: int
) -> pa.Table:
    """Render the condition of every training frame; rows join the frames on `sample_id`."""
    rows = frames.rows_where(split="train")
    names = [frames.column("sample_id")[row] for row in rows]
    subjects = [frames.column("subject")[row] for row in rows]
    plugin = _load_condition(condition, recordings)
    return _render(out, names, names, subjects, frames.labels.take(rows), plugin, _image_size(frames), seed)


@stage(version=4, schema=tables.CONDITIONS, raw_files=_input_files)
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
    such, and otherwise from the training frames. In random order classes take turns; within a class the order is
    random, and starts over when it is used up. In order of time the recordings follow one another, `count` moments
    evenly spread over them. `poses` are the recordings of the experiment or those of another dataset; bodies without 2D
    joints are seen by a virtual camera. New views turn each body, or in order of time each recording, to a camera of
    its own.
    """
    moments = _label_only(poses)
    if moments.num_rows:
        chosen = _choose(moments, count, order, seed)
        names, times = chosen["recording_id"].to_pylist(), chosen["t_us"].to_pylist()
        together = np.arange(count) if order == "random" else np.unique(names, return_inverse=True)[1]
        turned = None if views == "labelled" else together
        labels = _seen(labels_of(chosen), recordings, frames, encoding, turned, seed)
        source_ids = [f"{name}:{t}" for name, t in zip(names, times, strict=True)]
    elif poses.ref.key != recordings.ref.key:
        raise DataError(f"{poses.ref.path}: the dataset of poses has no recording in split 'condition'")
    else:
        learnt = frames.table.take(frames.rows_where(split="train"))
        chosen = _choose(learnt, count, order, seed)
        labels, source_ids = labels_of(chosen), chosen["sample_id"].to_pylist()
    sample_ids = [f"condition/{number:06d}" for number in range(count)]
    plugin = _load_condition(condition, recordings)
    subjects = chosen["subject"].to_pylist()
    return _render(out, sample_ids, source_ids, subjects, labels, plugin, _image_size(frames), seed)


def balanced_choice(class_names: tuple[str, ...], count: int, seed: int) -> np.ndarray:
    """`count` row indices in which the classes take turns, each class in a random order of its own."""
    classes = sorted(set(class_names))
    names = np.array(class_names)
    queues: list[np.ndarray] = []
    for number, name in enumerate(classes):
        rows = np.flatnonzero(names == name)
        rounds = -(-count // (len(classes) * len(rows)))
        random = np.random.default_rng([seed, number])
        queues.append(np.concatenate([random.permutation(rows) for _ in range(rounds)]))
    return np.array([queues[i % len(classes)][i // len(classes)] for i in range(count)], dtype=np.int64)


def _choose(moments: pa.Table, count: int, order: PoseOrder, seed: int) -> pa.Table:
    """`count` rows of the moments that could be asked for."""
    if order == "random":
        return moments.take(balanced_choice(tuple(moments["class_name"].to_pylist()), count, seed))
    return moments.take(np.sort(np.resize(spread(moments.num_rows, count), count)))


def _label_only(poses: Manifest) -> pa.Table:
    """Every label moment of the recordings of `poses` in split `condition`, in the order of recordings and times."""
    wanted = np.array(poses.column("recording_id"))[poses.rows_where(splits="condition")]
    table = poses.attached(tables.LABELS)
    return table.filter(pc.is_in(table["recording_id"], pa.array(wanted, pa.string())))


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
    with_events = recordings.table.to_pylist()
    size = next((r["sensor_width_px"], r["sensor_height_px"]) for r in with_events if r["sensor_width_px"])
    if turned is not None:
        labels = _from_new_sides(labels, turned, size, seed)
    if labels.joints2d is None and labels.smpl_pose is not None:
        labels = with_joints(labels, size, frames.labels.joint_set or "smpl")
    plugin = plugins.load_options(encoding)
    return labels_in_image(
        labels, lambda points: plugin.module.map_points(points, size, plugin.options), _image_size(frames)
    )


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
    source_ids: list[str],
    subjects: list[str],
    labels: Labels,
    plugin: Plugin,
    image_size: tuple[int, int],
    seed: int,
) -> pa.Table:
    seeds = [int(np.random.SeedSequence([seed, row]).generate_state(1)[0]) for row in range(len(labels))]
    rendered = plugin.module.render(labels, image_size, plugin.options, seeds)
    if rendered.images is not None:
        out.write_array("images", rendered.images)
    return pa.table(
        {
            "sample_id": sample_ids,
            "source_id": source_ids,
            "subject": subjects,
            "class_name": pa.array(labels.class_names, pa.string()),
            "prompt": pa.array(rendered.prompts, pa.string()),
            **label_columns(labels),
        }
    )
