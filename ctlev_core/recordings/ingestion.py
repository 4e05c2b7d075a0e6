"""One recording of a dataset: read, checked and written in the project's own form."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ctlev_core.events import files as event_files
from ctlev_core.events.decoding import event_chunks
from ctlev_core.plugin_contracts import DatasetWithChunks, DatasetWithWindowLabels, DatasetWithWindows
from ctlev_core.plugins import Plugin
from ctlev_core.progress import ProgressBar
from ctlev_core.recordings.stored_events import SharedEventsWriter
from data_contracts.arrays import save_compressed, times_file
from data_contracts.compressed_arrays import SUFFIX
from data_contracts.errors import DataError
from data_contracts.events import Events, check_events
from data_contracts.labels import Labels, Recording, check_image_track, check_labels

MAX_SHARED_US = 1_000_000
"""Recordings of under a second share files; longer ones have their own, of which parts can be read."""
MAX_SHARED_EVENTS = 1 << 20
"""Events of a recording that shares a file at most, for it is read and written as a whole: 13 MiB."""


class IngestedRecording(NamedTuple):
    """What is known of a recording after reading it.

    Attributes:
        row: of the table of recordings (`data_contracts.tables.RECORDINGS`).
        parts: rows of the table of parts (`PARTS`).
        labels: its label track.
        windows: [W, 2] int64 index ranges into its events, where the dataset cuts windows of its own.
        window_labels: one row for each of them, where the dataset has a rule for that too.
    """

    row: dict[str, Any]
    parts: list[dict[str, Any]]
    labels: Labels
    windows: np.ndarray | None
    window_labels: Labels | None


def list_recordings(plugin: Plugin) -> list[Recording]:
    """The dataset's recordings, refused when two have one id or a subject is in two of training, validation and test.

    Raises:
        DataError: these, none at all, or as the dataset's own `list_recordings`.
    """
    recordings = plugin.module.list_recordings(plugin.options)
    if not recordings:
        raise DataError(f"dataset {plugin.name!r} has no recordings with options {plugin.options!r}")
    named: dict[str, Recording] = {}
    for recording in recordings:
        if recording.recording_id in named:
            alike = (named[recording.recording_id], recording)
            files = " and ".join(str(one.files[0]) if one.files else "no file" for one in alike)
            raise DataError(f"dataset {plugin.name!r}: two recordings are called {recording.recording_id!r}: {files}")
        named[recording.recording_id] = recording
    subjects: dict[str, set[str]] = {}
    for recording in recordings:
        if len(recording.parts) == 1:  # a recording split in time shares its subject by the user's own choice
            subjects.setdefault(recording.parts[0].split, set()).add(recording.subject)
    for first, second in itertools.combinations(("train", "validation", "test"), 2):
        shared = subjects.get(first, set()) & subjects.get(second, set())
        if shared:
            raise DataError(f"dataset {plugin.name!r}: subjects {sorted(shared)} are in both {first} and {second}")
    return recordings


def check_track(labels: Labels, recording: Recording, where: str) -> Labels:
    """As `check_labels`; and times must ascend, and what was recorded must have a label."""
    check_labels(labels, where)
    if (np.diff(labels.t_us) < 0).any():
        first = int(np.argmax(np.diff(labels.t_us) < 0))
        raise DataError(f"{where}: times of labels must ascend, got {labels.t_us[first : first + 2].tolist()} us")
    if not len(labels) and (recording.has_events or recording.has_event_images):
        raise DataError(f"{where}: expected one label at least, got none")
    return labels


def ingest_recording(
    plugin: Plugin, recording: Recording, folder: Path, shared: tuple[str, SharedEventsWriter] | None
) -> IngestedRecording:
    """Read a recording, check it, and write its events and pictures.

    Args:
        plugin: the dataset.
        recording: one of `list_recordings`.
        folder: to write to: `events/<id>.parquet`, `event_images/<id>.npy.zst`, `intensity/<id>.npy.zst`. Long events
            that an interrupted run has left there are not read again.
        shared: name and writer of the file for events of under `MAX_SHARED_US`; None = all have a file of their own.
    Raises:
        DataError: the recording cannot be read or breaks the contract.
    """
    where = f"{plugin.name} {recording.recording_id}"
    labels = check_track(plugin.module.read_labels(recording, plugin.options), recording, where)
    row: dict[str, Any] = {
        "recording_id": recording.recording_id,
        "subject": recording.subject,
        "class_name": recording.class_name,
        "splits": "+".join(part.split for part in recording.parts),
        **dict.fromkeys(("events_file", "event_images_file", "intensity_file"), ""),
        "events_batch": None,
        **dict(zip(("sensor_width_px", "sensor_height_px"), recording.sensor_size or (0, 0), strict=True)),
        **dict.fromkeys(("num_events", "num_positive", "num_negative"), 0),
        **dict.fromkeys(("t_first_us", "t_last_us", "duration_us"), 0),
        "num_windows": None,
    }
    if recording.has_events:
        row |= _ingest_events(plugin, recording, folder, shared, where)
    for kind, wanted in (("event_images", recording.has_event_images), ("intensity", recording.has_intensity)):
        if wanted:
            row |= _ingest_images(plugin, recording, folder, kind, where)
    count, name = row["num_events"], recording.recording_id
    parts = [(part.split, round(part.start * count), round(part.stop * count)) for part in recording.parts]
    windows, window_labels = _dataset_windows(plugin, recording, count, where)
    if windows is not None:
        row["num_windows"] = len(windows)
    rows = [{"recording_id": name, "split": split, "event_start": a, "event_stop": b} for split, a, b in parts]
    return IngestedRecording(row, rows, labels, windows, window_labels)


def _ingest_events(
    plugin: Plugin, recording: Recording, folder: Path, shared: tuple[str, SharedEventsWriter] | None, where: str
) -> dict[str, Any]:
    """Events into the shared file where they are short, else into Parquet, chunk by chunk where they come so."""
    name, batch = f"events/{recording.recording_id}.parquet", None
    finished = folder / name

    def watched(chunks: Iterable[Events]) -> Iterator[Events]:
        # Only a recording that takes long gets a bar of its own.
        label = recording.recording_id
        with ProgressBar(desc=label, unit="event", unit_scale=True, delay=5) as bar:
            for chunk in chunks:
                yield chunk
                bar.update(len(chunk))

    if finished.exists():  # by an earlier run that was interrupted
        summary = event_files.Summary()
        for chunk in watched(event_files.read_event_chunks(finished)):
            summary.add(chunk)
    else:
        if isinstance(plugin.module, DatasetWithChunks):
            chunks = plugin.module.read_event_chunks(recording, plugin.options)
        else:
            chunks = [check_events(plugin.module.read_events(recording, plugin.options), where)]
        short, chunks = _all_if_short(chunks, where) if shared is not None else (None, chunks)
        if short is not None and shared is not None:
            name, writer = shared
            summary = event_files.Summary()
            summary.add(short)
            batch = writer.append(short, where)
        else:
            finished.parent.mkdir(parents=True, exist_ok=True)
            summary = event_files.write_event_chunks_parquet(finished, watched(chunks))
    if summary.num_events == 0 or summary.sensor_size is None:
        raise DataError(f"{where}: the recording holds no events")
    width, height = summary.sensor_size
    return {
        "events_file": name,
        "events_batch": batch,
        "sensor_width_px": width,
        "sensor_height_px": height,
        **summary.result(),
    }


def _all_if_short(chunks: Iterable[Events], where: str) -> tuple[Events | None, Iterable[Events]]:
    """All events of a recording that is short, else None and its chunks, of which no more are read than it takes."""
    chunks = iter(chunks)
    read: list[Events] = []
    num_events = 0
    for chunk in chunks:
        read.append(chunk)
        num_events += len(chunk)
        stamps = [part.t for part in read if len(part)]
        if num_events > MAX_SHARED_EVENTS or (stamps and stamps[-1][-1] - stamps[0][0] >= MAX_SHARED_US):
            return None, itertools.chain(read, chunks)
    if not num_events:
        return None, read
    return event_chunks.concatenate(event_chunks.check_joints(read, where)), ()


def _ingest_images(plugin: Plugin, recording: Recording, folder: Path, kind: str, where: str) -> dict[str, Any]:
    """Event images or intensity frames as arrays: pictures, and their times beside them."""
    name = f"{kind}/{recording.recording_id}{SUFFIX}"
    read = plugin.module.read_event_images if kind == "event_images" else plugin.module.read_intensity_frames
    track = check_image_track(read(recording, plugin.options), f"{where}, {kind.replace('_', ' ')}")
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    save_compressed(path, track.images)
    times_us = track.t_us
    if track.window_us:  # first and last microsecond of each window
        times_us = np.stack([np.maximum(track.t_us - track.window_us + 1, 0), track.t_us])
    np.save(folder / times_file(name), times_us, allow_pickle=False)
    if kind == "intensity":
        return {"intensity_file": name}
    _, height, width = track.images.shape
    return {
        "event_images_file": name,
        "sensor_width_px": width,
        "sensor_height_px": height,
        "t_first_us": int(track.t_us[0]),
        "t_last_us": int(track.t_us[-1]),
        "duration_us": int(track.t_us[-1] - track.t_us[0]),
    }


def _dataset_windows(
    plugin: Plugin, recording: Recording, count: int, where: str
) -> tuple[np.ndarray | None, Labels | None]:
    """Ranges [W, 2] and, where the authors have a rule for them too, their W labels."""
    if not recording.has_events or not isinstance(plugin.module, DatasetWithWindows):
        return None, None
    found = plugin.module.read_windows(recording, plugin.options)
    if found is None:
        return None, None
    ranges = np.asarray(found)
    if ranges.ndim != 2 or ranges.shape[1] != 2 or ranges.dtype != np.int64:
        raise DataError(f"{where}: windows must be [W, 2] int64, got {ranges.shape} {ranges.dtype}")
    flat = ranges.reshape(-1)
    if len(flat) and (flat[0] < 0 or flat[-1] > count or (np.diff(flat) < 0).any()):
        raise DataError(
            f"{where}: windows must be ascending ranges within {count} events, got {ranges.tolist()[:4]} ..."
        )
    if not isinstance(plugin.module, DatasetWithWindowLabels):
        return ranges, None
    labels = plugin.module.read_window_labels(recording, plugin.options)
    if labels is None:
        return ranges, None
    check_labels(labels, f"{where}, windows")
    if len(labels) != len(ranges):
        raise DataError(f"{where}: {len(ranges)} windows but {len(labels)} window labels")
    return ranges, labels
