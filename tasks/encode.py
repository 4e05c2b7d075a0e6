"""Events to windows, windows to event histograms and images, label tracks to one label a window."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from tqdm import tqdm

from ctlev_core import event_files, plugins
from ctlev_core.camera import is_inside
from ctlev_core.image_resampling import resample_images
from ctlev_core.labelling import labels_at_windows
from ctlev_core.windows import cut
from data_contracts import tables
from data_contracts.config import EncodingChoice, Windows
from data_contracts.errors import DataError
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest, concat_labels, label_columns, labels_of
from tasks.stage import Output, stage


class _Samples(NamedTuple):
    """The windows of one part of a recording, encoded."""

    rows: list[dict[str, Any]]
    histograms: np.ndarray
    frames: np.ndarray
    labels: Labels


@stage(version=2, schema=tables.FRAMES)
def encode(out: Output, recordings: Manifest, *, encoding: EncodingChoice, windows: Windows) -> pa.Table:
    """Cut every recording into windows and encode each: arrays `histograms` (counts) and `frames` (8-bit RGB).

    Event images that come finished take the place of both: every image is a window, its grey values stand for counts.
    """
    plugin = plugins.load_options(encoding)
    parts = recordings.attached(tables.PARTS).to_pylist()
    tracks = _label_tracks(recordings)
    dataset_windows = _dataset_windows(recordings, windows)
    rows: list[dict[str, Any]] = []
    labels: list[Labels] = []
    with out.open_array("histograms") as histograms, out.open_array("frames") as frames:
        for recording in tqdm(recordings.table.to_pylist(), "encode", unit="recording", leave=False, disable=None):
            name = recording["recording_id"]
            own_parts = [part for part in parts if part["recording_id"] == name]
            if recording["events_file"]:
                ranges = dataset_windows.get(name)
                samples = _encode_events(recordings, recording, own_parts, tracks[name], plugin, windows, ranges)
            elif recording["event_images_file"]:
                samples = _encode_images(recordings, recording, own_parts, tracks[name], plugin, windows)
            else:
                continue
            for sample in samples:
                try:
                    histograms.append(sample.histograms)
                except DataError as error:
                    raise DataError(
                        f"encode: sensors differ in size, {name} does; set encoding.options.image_size ({error})"
                    ) from error
                frames.append(sample.frames)
                rows += sample.rows
                labels.append(sample.labels)
    for split in ("train", "test"):
        if not any(row["split"] == split for row in rows):
            raise DataError(f"encode: no window in split {split!r}; the recordings are too short for {windows!r}")
    stacked = concat_labels(labels)
    table = pa.Table.from_pylist(rows).append_column("class_name", pa.array(stacked.class_names, pa.string()))
    for name, column in label_columns(stacked).items():
        table = table.append_column(name, column)
    return table


def _dataset_windows(recordings: Manifest, windows: Windows) -> dict[str, np.ndarray]:
    """Ranges [W, 2] of each recording that the dataset's authors cut, for the method `dataset`."""
    if windows.method != "dataset":
        return {}
    table = recordings.attached(tables.WINDOWS)
    ranges = np.stack([table["event_start"].to_numpy(), table["event_stop"].to_numpy()], axis=1)
    names = np.array(table["recording_id"].to_pylist())
    found = {name: ranges[names == name] for name in dict.fromkeys(names.tolist())}
    for name, events_file in zip(recordings.column("recording_id"), recordings.column("events_file"), strict=True):
        if events_file and name not in found:
            raise DataError(
                f"windows.method 'dataset': {name} comes without windows of its own; choose count, duration or whole"
            )
    return found


def _encode_events(
    recordings: Manifest,
    recording: dict[str, Any],
    parts: list[dict[str, Any]],
    track: Labels,
    plugin: plugins.Plugin,
    windows: Windows,
    dataset_ranges: np.ndarray | None,
) -> Iterator[_Samples]:
    events = event_files.read_events_file(recordings.path(recording["events_file"]))
    for part in parts:
        start, stop = part["event_start"], part["event_stop"]
        if dataset_ranges is None:
            ranges = cut(events.slice(start, stop), windows) + start
        else:
            inside = (dataset_ranges[:, 0] >= start) & (dataset_ranges[:, 1] <= stop)
            full = dataset_ranges[:, 1] - dataset_ranges[:, 0] >= windows.min_events
            ranges = dataset_ranges[inside & full]
            ranges = ranges[_spread(len(ranges), windows.max_windows)]
        if len(ranges) == 0:
            continue
        counts = plugin.module.encode(events, ranges, plugin.options)
        t_start, t_end = events.t[ranges[:, 0]], events.t[ranges[:, 1] - 1]
        labels = _to_image(labels_at_windows(track, t_start, t_end), events.sensor_size, plugin, counts.shape[:1:-1])
        rows = _rows(recording, part["split"], t_start, t_end, ranges[:, 1] - ranges[:, 0])
        yield _Samples(rows, counts, plugin.module.render_image(counts, plugin.options), labels)


def _encode_images(
    recordings: Manifest,
    recording: dict[str, Any],
    parts: list[dict[str, Any]],
    track: Labels,
    plugin: plugins.Plugin,
    windows: Windows,
) -> Iterator[_Samples]:
    if getattr(plugin.options, "polarity", False):
        raise DataError(
            f"{recording['recording_id']} comes as grey event images, which have no polarity; "
            "set encoding.options.polarity=false"
        )
    images = recordings.array(recording["event_images_file"].removesuffix(".npy"))
    t_us = recordings.array(recording["event_images_file"].removesuffix(".npy") + ".t_us")
    sensor_size = (recording["sensor_width_px"], recording["sensor_height_px"])
    image_size = getattr(plugin.options, "image_size", None) or sensor_size
    if len(parts) != 1:
        raise DataError(f"{recording['recording_id']}: finished event images cannot be split in time")
    for part in parts:
        chosen = _spread(len(images), windows.max_windows)
        grey = resample_images(
            images[chosen], lambda p: plugin.module.map_points(p, sensor_size, plugin.options), image_size
        )
        times = np.asarray(t_us[chosen])
        labels = _to_image(labels_at_windows(track, times, times), sensor_size, plugin, image_size)
        rows = _rows(recording, part["split"], times, times, np.zeros(len(times), np.int64))
        yield _Samples(rows, grey[:, None].astype(np.uint16), np.repeat(grey[..., None], 3, axis=3), labels)


def _spread(count: int, wanted: int | None) -> np.ndarray:
    """Indices of at most `wanted` of `count`, the middle of each of as many equal stretches."""
    if wanted is None or count <= wanted:
        return np.arange(count)
    return (2 * np.arange(wanted, dtype=np.int64) + 1) * count // (2 * wanted)


def _rows(
    recording: dict[str, Any], split: str, t_start: np.ndarray, t_end: np.ndarray, num_events: np.ndarray
) -> list[dict[str, Any]]:
    return [
        {
            "sample_id": f"{recording['recording_id']}:{split}:{number:05d}",
            "recording_id": recording["recording_id"],
            "subject": recording["subject"],
            "split": split,
            "t_start_us": start,
            "t_end_us": end,
            "num_events": count,
        }
        for number, (start, end, count) in enumerate(
            zip(t_start.tolist(), t_end.tolist(), num_events.tolist(), strict=True)
        )
    ]


def _label_tracks(recordings: Manifest) -> dict[str, Labels]:
    table = recordings.attached(tables.LABELS)
    names = np.array(table["recording_id"].to_pylist())
    return {name: labels_of(table.filter(pa.array(names == name))) for name in dict.fromkeys(names.tolist())}


def _to_image(
    labels: Labels, sensor_size: tuple[int, int], plugin: plugins.Plugin, image_size: tuple[int, ...]
) -> Labels:
    """Joints from sensor pixels to image pixels; one that the crop or the border cut off is not visible."""
    if labels.joints2d is None or labels.visible is None:
        return labels
    joints = plugin.module.map_points(labels.joints2d, sensor_size, plugin.options).astype(np.float32)
    return replace(labels, joints2d=joints, visible=labels.visible & is_inside(joints, (image_size[0], image_size[1])))
