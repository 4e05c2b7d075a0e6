"""From px of event images to px of the sensors behind them, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from ctlev_core import plugins
from ctlev_core.labels.labelling import scale_and_offset
from ctlev_core.labels.sources import sensor_size_of
from ctlev_core.plugin_contracts import MetricOnSensor
from ctlev_core.plugins import PluginError
from data_contracts.config import EncodingChoice, MetricChoice
from data_contracts.errors import DataError
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest


@dataclass(frozen=True)
class SensorSource:
    """What tells where sensor pixels lie in event images: `recordings` (a manifest, or its reference) and `encoding`.

    The recordings are those of the frames, or of the experiment that synthetic frames were asked for in; with `part`
    those of one dataset of a union.
    """

    recordings: Any
    encoding: EncodingChoice
    part: str | None = None


def is_on_sensor(metric: MetricChoice) -> bool:
    """Does the metric compare positions in px of the sensor?"""
    return isinstance(plugins.load("metrics", metric.name), MetricOnSensor)


def check_in_image(metric: MetricChoice, what: str) -> None:
    """Raise `PluginError` for a metric on the sensor where the sensor is not known.

    Args:
        metric: the first of an experiment.
        what: option that uses it.
    """
    if is_on_sensor(metric):
        raise PluginError(
            f"{what} goes by the first of metrics, expected one in px of the image, got {metric.name!r}; name another "
            "one before it"
        )


def sensor_sizes(data: Manifest, rows: np.ndarray, recordings: Manifest) -> np.ndarray:
    """(width, height) [N, 2] int64 px of the sensor that each frame shows.

    A recorded frame shows that of its recording; so does a synthetic one whose label is that of a recorded frame. Any
    other label was seen by the first sensor of the experiment (`ctlev_core.labels.rows_to_sample`).

    Raises:
        DataError: a recorded frame is of none of the recordings, or its sensor has no size.
    """
    names = ("recording_id", "sensor_width_px", "sensor_height_px")
    of_recording = {name: size for name, *size in zip(*map(recordings.column, names), strict=True)}
    synthetic = "source_id" in data.table.column_names
    own = data.column("source_id" if synthetic else "recording_id")
    of_experiment = cache(partial(sensor_size_of, recordings))
    sizes = []
    for row in rows.tolist():
        name, _, rest = own[row].partition(":")
        # The label of a frame is RECORDING:SPLIT:NUMBER, that of a moment RECORDING:MOMENT.
        size = of_experiment() if synthetic and ":" not in rest else of_recording.get(name, (0, 0))
        if min(size) <= 0:
            raise DataError(f"{data.ref.path}: row {row}: {name} has no sensor size in {recordings.ref.path}")
        sizes.append(size)
    return np.array(sizes, np.int64).reshape(-1, 2)


def on_sensor(
    prediction: Mapping[str, Any], labels: Labels, sizes: np.ndarray, encoding: EncodingChoice
) -> tuple[dict[str, Any], Labels]:
    """Predictions and labels with `joints2d` in px of the sensor; which are visible stays.

    Args:
        prediction: `joints2d` [N, J, 2] image px, perhaps others.
        labels: N, with `joints2d` in image px.
        sizes: [N, 2] px, the sensor of each row.
        encoding: that made the images.
    """
    plugin = plugins.load_options(encoding)
    scale, offset = np.empty((2, len(sizes), 1, 2))
    for size in np.unique(sizes, axis=0):
        width, height = size.tolist()
        found = scale_and_offset(lambda points, s=(width, height): plugin.module.map_points(points, s, plugin.options))
        scale[(sizes == size).all(axis=1), 0], offset[(sizes == size).all(axis=1), 0] = found
    moved = (np.asarray(prediction["joints2d"], np.float64) - offset) / scale
    true = None if labels.joints2d is None else ((labels.joints2d - offset) / scale).astype(np.float32)
    return {**prediction, "joints2d": moved}, replace(labels, joints2d=true)
