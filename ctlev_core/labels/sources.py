"""What conditions are rendered from: labelled rows, the grey pictures of their windows, the motions around them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctlev_core import plugins
from ctlev_core.events.image_resampling import resample_images
from ctlev_core.labels import label_windows
from ctlev_core.labels.labelling import scale_and_offset
from data_contracts import tables
from data_contracts.array_rows import Images
from data_contracts.arrays import load_array, times_file
from data_contracts.config import EncodingChoice
from data_contracts.errors import DataError
from data_contracts.events import SensorSize
from data_contracts.labels import BodyMotions, Labels
from data_contracts.manifest import Manifest, by_recording, labels_of


@dataclass(frozen=True, eq=False)
class LabelledRows:
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

    def take(self, rows: np.ndarray) -> LabelledRows:
        """Some of the rows, by their numbers."""
        return LabelledRows(
            source_ids=[self.source_ids[row] for row in rows],
            recordings=self.recordings,
            recording_ids=[self.recording_ids[row] for row in rows],
            subjects=[self.subjects[row] for row in rows],
            t_start_us=self.t_start_us[rows],
            t_end_us=self.t_end_us[rows],
            labelled=self.labelled.take(rows),
            labels=self.labels.take(rows),
        )


def half_window_us(frames: Manifest) -> int:
    """Half of the median training window."""
    rows = frames.rows_where(split="train")
    durations = frames.table["t_end_us"].to_numpy()[rows] - frames.table["t_start_us"].to_numpy()[rows]
    return int(np.median(durations)) // 2


def rows_of_frames(recordings: Manifest, frames: Manifest, rows: np.ndarray) -> LabelledRows:
    """Frames by their numbers [N], with the windows and labels that they have."""
    table = frames.table.take(rows)
    labels = frames.labels.take(rows)
    return LabelledRows(
        source_ids=table["sample_id"].to_pylist(),
        recordings=recordings,
        recording_ids=table["recording_id"].to_pylist(),
        subjects=table["subject"].to_pylist(),
        t_start_us=table["t_start_us"].to_numpy(),
        t_end_us=table["t_end_us"].to_numpy(),
        labelled=labels,
        labels=labels,
    )


def read_pairs(rows: LabelledRows, frames: Manifest, encoding: EncodingChoice) -> np.ndarray:
    """The grey pictures [N, H, W, 2] uint8 at start and end of each row's window, in image pixels.

    Raises:
        DataError: a recording has no intensity frames, or none that show a window.
    """
    plugin = plugins.load_options(encoding)
    width, height = image_size = image_size_of(frames)
    pairs = np.empty((len(rows.labels), height, width, 2), np.uint8)
    for name, members, images, t_us in _tracks(rows):
        used, places = np.unique(_nearest(rows, members, t_us, name), return_inverse=True)
        size = (images.shape[2], images.shape[1])
        resampled = resample_images(
            np.asarray(images[used]),
            lambda points, size=size: plugin.module.map_points(points, size, plugin.options),
            image_size,
        )
        pictures = np.rint(resampled).astype(np.uint8)
        pairs[members] = np.moveaxis(pictures[places.reshape(-1, 2)], 1, -1)
    return pairs


def as_different_as_training(rows: LabelledRows, recordings: Manifest, frames: Manifest) -> LabelledRows:
    """The same rows with windows over which their pictures change as much as those of the median training window.

    Raises:
        DataError: as `read_pairs`.
    """
    learnt = rows_of_frames(recordings, frames, frames.rows_where(split="train"))
    differences = [
        label_windows.picture_difference(images[first], images[last])
        for name, members, images, t_us in _tracks(learnt)
        for first, last in _nearest(learnt, members, t_us, name)
    ]
    wanted, reach_us = float(np.median(differences)), int((learnt.t_end_us - learnt.t_start_us).max())
    ends = np.empty((len(rows.labels), 2), np.int64)
    for name, members, images, t_us in _tracks(rows):
        for row in members:
            moment_us = int(rows.labelled.t_us[row])
            ends[row] = label_windows.equally_different_window(images, t_us, moment_us, reach_us, wanted, name)
    return replace(rows, t_start_us=ends[:, 0], t_end_us=ends[:, 1])


def read_motions(rows: LabelledRows, recordings: Manifest, frames: Manifest, encoding: EncodingChoice) -> BodyMotions:
    """What each body does around its labelled moment, as far to either side as the longest training window lasts."""
    learnt = frames.rows_where(split="train")
    reach_us = int((frames.table["t_end_us"].to_numpy() - frames.table["t_start_us"].to_numpy())[learnt].max())
    where = f"{rows.recordings.ref.path}: condition of body motions"
    tracks = by_recording(rows.recordings.attached(tables.LABELS))
    found: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    moments_us = rows.labelled.t_us.copy()
    for name, members in _by_name(rows.recording_ids).items():
        track = labels_of(tracks[name])
        for row in members.tolist():
            # A window may end a little after the last label, which is then the nearest.
            moments_us[row] = np.clip(moments_us[row], track.t_us[0], track.t_us[-1])
            found[row] = label_windows.motion_around(track, int(moments_us[row]), reach_us, f"{where}, {name}")
    labelled = replace(rows.labelled, t_us=moments_us)
    motions = label_windows.body_motions([found[row] for row in range(len(found))], labelled, rows.labels, where)
    # Simulated events are encoded as the real ones are, so they come from a sensor of the real one's size.
    plugin, size = plugins.load_options(encoding), sensor_size_of(recordings)
    scale, offset = scale_and_offset(lambda points: plugin.module.map_points(points, size, plugin.options))
    on_sensor = (motions.intrinsics - np.array([0.0, 0.0, *offset])) / np.tile(scale, 2)
    return replace(motions, intrinsics=on_sensor.astype(np.float32))


def _tracks(rows: LabelledRows) -> Iterator[tuple[str, np.ndarray, Images, np.ndarray]]:
    """Of each recording: its name, the rows that are of it, its grey pictures and their times."""
    files = dict(zip(rows.recordings.column("recording_id"), rows.recordings.column("intensity_file"), strict=True))
    for name, members in _by_name(rows.recording_ids).items():
        if not files[name]:
            raise DataError(f"{rows.recordings.ref.path}: {name} has no intensity frames, which this condition needs")
        images, times = (rows.recordings.path(file) for file in (files[name], times_file(files[name])))
        yield name, members, load_array(images), np.asarray(load_array(times))


def _nearest(rows: LabelledRows, members: np.ndarray, t_us: np.ndarray, name: str) -> np.ndarray:
    """The pictures [M, 2] at the ends of the windows of some rows."""
    spans = zip(rows.t_start_us[members].tolist(), rows.t_end_us[members].tolist(), strict=True)
    return np.array([label_windows.nearest_pair(t_us, start, end, name) for start, end in spans])


def _by_name(names: Sequence[str]) -> dict[str, np.ndarray]:
    """The rows of each name, in the order of first rows."""
    array = np.array(names)
    return {name: np.flatnonzero(array == name) for name in dict.fromkeys(names)}


def sensor_size_of(recordings: Manifest) -> SensorSize:
    """(width, height) px of the first recording that was recorded, and is not labels alone."""
    rows = [row for row in recordings.table.to_pylist() if row["sensor_width_px"]]
    row = next((row for row in rows if row["splits"] != "condition"), rows[0])
    return row["sensor_width_px"], row["sensor_height_px"]


def image_size_of(frames: Manifest) -> tuple[int, int]:
    """(width, height) px of event images."""
    _, height, width, _ = frames.array("frames").shape
    return width, height
