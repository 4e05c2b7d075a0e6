"""How far the joints of labelled rows have come, and will go, in a given time."""

from __future__ import annotations

import numpy as np

from ctlev_core import plugins
from ctlev_core.labels.labelling import scale_and_offset
from ctlev_core.labels.sources import LabelledRows, sensor_size_of
from data_contracts import tables
from data_contracts.config import EncodingChoice
from data_contracts.errors import DataError
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest, by_recording, labels_of


def read_displacements(rows: LabelledRows, recordings: Manifest, encoding: EncodingChoice, reach_us: int) -> np.ndarray:
    """Displacements [N, 2, J, 2] in image px: from the middle of each row's window to `reach_us` before, and after.

    Args:
        rows: N rows with joints in 2D.
        recordings: of the experiment, whose first sensor the image is of.
        encoding: of the frames.
        reach_us: how long before and after.
    Returns:
        NaN for joints whose labels are NaN at either end.
    Raises:
        DataError: a recording has no joints in 2D, or one label alone.
    """
    if rows.labels.joints2d is None:
        raise DataError(f"{rows.recordings.ref.path}: the labels have no joints2d, whose displacement is asked for")
    plugin, size = plugins.load_options(encoding), sensor_size_of(recordings)
    scale, _ = scale_and_offset(lambda points: plugin.module.map_points(points, size, plugin.options))
    sensors = {row["recording_id"]: row for row in rows.recordings.table.to_pylist()}
    tracks = by_recording(rows.recordings.attached(tables.LABELS))
    moments_us = (rows.t_start_us + rows.t_end_us) // 2
    found = np.empty((len(rows.labels), 2, rows.labels.joints2d.shape[1], 2), np.float64)
    names = np.array(rows.recording_ids)
    for name in dict.fromkeys(rows.recording_ids):
        members = np.flatnonzero(names == name)
        own = sensors[name]["sensor_width_px"], sensors[name]["sensor_height_px"]
        # As where labels of another sensor are seen by this one (`rows_to_sample`): the view is the same.
        fit = 1.0 if min(own) == 0 else (np.array(size) / own).min()
        where = f"{rows.recordings.ref.path}, {name}"
        moved = displacements(labels_of(tracks[name]), moments_us[members], reach_us, where)
        found[members] = moved * fit * scale
    return found


def displacements(track: Labels, moments_us: np.ndarray, reach_us: int, where: str) -> np.ndarray:
    """Displacements [N, 2, J, 2] px of the joints of a track, from N moments to `reach_us` before and after.

    Between labels joints move on straight lines; beyond the first and last label as fast as over `reach_us` within.
    Of labels of one time the first counts.

    Raises:
        DataError: the track has no joints in 2D, or fewer than two labels of different times.
    """
    track = track.take(np.unique(track.t_us, return_index=True)[1])
    if track.joints2d is None or len(track) < 2:
        got = "no joints2d" if track.joints2d is None else f"{len(track)} label"
        raise DataError(f"{where}: displacements need two labels with joints2d, got {got}")
    joints = track.joints2d.astype(np.float64)
    first, last = track.t_us[0], track.t_us[-1]
    reach_us = min(reach_us, int(last - first))
    # Of a moment too near to an end the displacement is that of the nearest moment that is not.
    early = np.clip(moments_us - reach_us, first, last - reach_us)
    late = np.clip(moments_us, first, last - reach_us)
    before = _joints_at(joints, track.t_us, early) - _joints_at(joints, track.t_us, early + reach_us)
    after = _joints_at(joints, track.t_us, late + reach_us) - _joints_at(joints, track.t_us, late)
    return np.stack([before, after], axis=1)


def _joints_at(joints: np.ndarray, t_us: np.ndarray, times: np.ndarray) -> np.ndarray:
    right = np.clip(np.searchsorted(t_us, times, side="right"), 1, len(t_us) - 1)
    share = ((times - t_us[right - 1]) / (t_us[right] - t_us[right - 1]))[:, None, None]
    return (1 - share) * joints[right - 1] + share * joints[right]
