"""Events to windows, windows to event histograms and images, label tracks to one label a window."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
from tqdm import tqdm

from ctlev_core import event_files, plugins
from ctlev_core.labelling import labels_at_windows
from ctlev_core.windows import cut
from data_contracts import tables
from data_contracts.config import EncodingChoice, Windows
from data_contracts.errors import DataError
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest, concat_labels, label_columns, labels_of
from tasks.stage import Output, stage


@stage(version=1, schema=tables.FRAMES)
def encode(out: Output, recordings: Manifest, *, encoding: EncodingChoice, windows: Windows) -> pa.Table:
    """Cut every recording into windows and encode each: arrays `histograms` (counts) and `frames` (8-bit RGB)."""
    plugin = plugins.load_options(encoding)
    parts = recordings.attached(tables.PARTS).to_pylist()
    tracks = _label_tracks(recordings)
    rows: list[dict[str, Any]] = []
    labels: list[Labels] = []
    histograms: list[np.ndarray] = []
    for recording in tqdm(recordings.table.to_pylist(), "encode", unit="recording", leave=False, disable=None):
        name = recording["recording_id"]
        if not recording["events_file"]:
            continue
        events = event_files.read_events_file(recordings.path(recording["events_file"]))
        for part in (part for part in parts if part["recording_id"] == name):
            ranges = cut(events.slice(part["event_start"], part["event_stop"]), windows) + part["event_start"]
            if len(ranges) == 0:
                continue
            histograms.append(plugin.module.encode(events, ranges, plugin.options))
            t_start, t_end = events.t[ranges[:, 0]], events.t[ranges[:, 1] - 1]
            labels.append(_to_image(labels_at_windows(tracks[name], t_start, t_end), events.sensor_size, plugin))
            image_size = histograms[-1].shape[:1:-1]
            labels[-1] = _visible_inside(labels[-1], image_size)
            rows += [
                {
                    "sample_id": f"{name}:{part['split']}:{number:05d}",
                    "recording_id": name,
                    "subject": recording["subject"],
                    "split": part["split"],
                    "t_start_us": int(t_start[number]),
                    "t_end_us": int(t_end[number]),
                    "num_events": int(stop - start),
                }
                for number, (start, stop) in enumerate(ranges)
            ]
    _check_frames(rows, histograms, windows)
    counts = np.concatenate(histograms)
    out.write_array("histograms", counts)
    out.write_array("frames", plugin.module.render_image(counts, plugin.options))
    stacked = concat_labels(labels)
    table = pa.Table.from_pylist(rows).append_column("class_name", pa.array(stacked.class_names, pa.string()))
    for name, column in label_columns(stacked).items():
        table = table.append_column(name, column)
    return table


def _label_tracks(recordings: Manifest) -> dict[str, Labels]:
    table = recordings.attached(tables.LABELS)
    names = np.array(table["recording_id"].to_pylist())
    return {name: labels_of(table.filter(pa.array(names == name))) for name in dict.fromkeys(names.tolist())}


def _to_image(labels: Labels, sensor_size: tuple[int, int], plugin: plugins.Plugin) -> Labels:
    """Joints from sensor pixels to image pixels."""
    if labels.joints2d is None:
        return labels
    mapped = plugin.module.map_points(labels.joints2d, sensor_size, plugin.options)
    return replace(labels, joints2d=mapped.astype(np.float32))


def _visible_inside(labels: Labels, image_size: tuple[int, ...]) -> Labels:
    """A joint that the crop or the border cut off is not visible."""
    if labels.joints2d is None or labels.visible is None:
        return labels
    width, height = image_size
    x, y = labels.joints2d[..., 0], labels.joints2d[..., 1]
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    return replace(labels, visible=labels.visible & inside)


def _check_frames(rows: list[dict[str, Any]], histograms: list[np.ndarray], windows: Windows) -> None:
    for split in ("train", "test"):
        if not any(row["split"] == split for row in rows):
            raise DataError(f"encode: no window in split {split!r}; the recordings are too short for {windows!r}")
    sizes = sorted({histogram.shape[1:] for histogram in histograms})
    if len(sizes) != 1:
        raise DataError(f"encode: sensors differ in size, {sizes}; set encoding.options.image_size")
