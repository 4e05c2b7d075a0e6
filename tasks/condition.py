"""Labels to conditions: what the generator learns from, and what it is then asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.body.virtual_camera import with_joints
from ctlev_core.plugins import Plugin
from data_contracts import tables
from data_contracts.config import ConditionChoice, EncodingChoice
from data_contracts.errors import DataError
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest, label_columns, labels_of
from tasks.stage import Output, stage


@stage(version=2, schema=tables.CONDITIONS)
def condition_frames(
    out: Output, recordings: Manifest, frames: Manifest, *, condition: ConditionChoice, seed: int
) -> pa.Table:
    """Render the condition of every training frame; rows join the frames on `sample_id`."""
    rows = frames.rows_where(split="train")
    names = [frames.column("sample_id")[row] for row in rows]
    subjects = [frames.column("subject")[row] for row in rows]
    plugin = _load_condition(condition, recordings)
    return _render(out, names, names, subjects, frames.labels.take(rows), plugin, _image_size(frames), seed)


@stage(version=2, schema=tables.CONDITIONS)
def condition_samples(
    out: Output,
    poses: Manifest,
    recordings: Manifest,
    frames: Manifest,
    *,
    condition: ConditionChoice,
    encoding: EncodingChoice,
    count: int,
    seed: int,
) -> pa.Table:
    """Choose `count` labels to sample from and render them.

    They come from the label-only recordings of `poses` (split `condition`: poses no frame was trained on) where it has
    such, and otherwise from the training frames. Classes take turns; within a class the order is random, and starts
    over when it is used up. `poses` are the recordings of the experiment or those of another dataset; bodies without 2D
    joints are seen by a virtual camera.
    """
    names, subjects, labels = _label_only(poses, recordings, frames, encoding)
    if not names and poses.ref.key != recordings.ref.key:
        raise DataError(f"{poses.ref.path}: the dataset of poses has no recording in split 'condition'")
    if not names:
        rows = frames.rows_where(split="train")
        names = [frames.column("sample_id")[row] for row in rows]
        subjects = [frames.column("subject")[row] for row in rows]
        labels = frames.labels.take(rows)
    chosen = balanced_choice(labels.class_names, count, seed)
    sample_ids = [f"condition/{number:06d}" for number in range(count)]
    source_ids, subjects = [names[row] for row in chosen], [subjects[row] for row in chosen]
    plugin = _load_condition(condition, recordings)
    return _render(out, sample_ids, source_ids, subjects, labels.take(chosen), plugin, _image_size(frames), seed)


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


def _label_only(
    poses: Manifest, recordings: Manifest, frames: Manifest, encoding: EncodingChoice
) -> tuple[list[str], list[str], Labels]:
    """Every label moment of the recordings of `poses` in split `condition`, in image pixels."""
    wanted = set(np.array(poses.column("recording_id"))[poses.rows_where(splits="condition")].tolist())
    table = poses.attached(tables.LABELS)
    table = table.filter(pa.array([name in wanted for name in table["recording_id"].to_pylist()], pa.bool_()))
    times = table["t_us"].to_pylist()
    names = [f"{name}:{t_us}" for name, t_us in zip(table["recording_id"].to_pylist(), times, strict=True)]
    labels = labels_of(table)
    # A label-only recording has no sensor of its own: its labels are in the frame of the dataset's sensor.
    with_events = recordings.table.to_pylist()
    size = next((r["sensor_width_px"], r["sensor_height_px"]) for r in with_events if r["sensor_width_px"])
    joint_set = frames.labels.joint_set
    if names and joint_set and labels.joints2d is None:
        labels = with_joints(labels, size, joint_set)
    if labels.joints2d is not None:
        plugin = plugins.load_options(encoding)
        mapped = plugin.module.map_points(labels.joints2d, size, plugin.options).astype(np.float32)
        labels = replace(labels, joints2d=mapped)
    return names, table["subject"].to_pylist(), labels


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
