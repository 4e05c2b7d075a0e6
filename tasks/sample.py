"""Make labelled synthetic frames: sampled from a fine-tuned generator, or simulated by one that learns nothing."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.diffusion.motion_files import has_motion_layers, read_settings
from ctlev_core.diffusion.sampling.options import SamplingOptions, noise_seeds
from ctlev_core.diffusion.sampling.shards import SHARD, whole_stretches
from ctlev_core.events.windows import spread, window_around
from ctlev_core.labels.sources import sensor_size_of
from ctlev_core.plugin_contracts import CalibratedEventGenerator
from ctlev_core.plugin_outputs import check_samples
from ctlev_core.postprocessing.quality_filter import (
    QualityFilter,
    find_causes,
    fit_quality_filter,
    sample_until_accepted,
)
from ctlev_core.postprocessing.stochastic_rounding import round_frames, training_counts
from ctlev_core.progress import ProgressBar
from ctlev_core.recordings.stored_events import StoredEvents, stored_events
from ctlev_core.seeds import distinct_seeds, sample_seeds
from ctlev_core.supervised.frame_sequences import name_followed, stretch_lengths, training_interval_us
from data_contracts import tables
from data_contracts.arrays import load_array, save_compressed
from data_contracts.compressed_arrays import SUFFIX
from data_contracts.config import EncodingChoice, SamplingChoice, Windows
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize
from data_contracts.labels import Conditions
from data_contracts.manifest import LABEL_COLUMNS, Manifest, ManifestRef, by_recording, conditions_of, read_manifest
from data_contracts.parts import only_part
from tasks.spread_sampling import Chunk, Sampling, deal_out, is_dealt_out
from tasks.stage import Output, input_files_of, stage
from tasks.workers import map_shards

SHARD_ROWS = 64
BLOCK_BYTES = 1 << 30
"""Frames held at a time. For each chunk the generator reads its checkpoint again, so it is no smaller."""
CALIBRATION_FILE = "calibration.json"
MAX_CALIBRATION, MAX_CALIBRATION_EVENTS = 64, 1 << 22
"""Training recordings that a simulator is fitted to, evenly spread over all, and events that are read of each."""
MAX_FILTER_FRAMES = 2_000
"""Training frames the quality filter is fitted to, evenly spread: the quantiles of more hardly move."""


@stage(version=7, schema=tables.SYNTHETIC, optional=("part",), spreads=is_dealt_out)
def sample(
    out: Output,
    checkpoint: Manifest,
    frames: Manifest,
    conditions: Manifest,
    *,
    sampling: SamplingChoice,
    max_attempts: int,
    seed: int,
    rounding: EncodingChoice | None = None,
    part: str | None = None,
) -> pa.Table:
    """One frame per condition row, each from a seed of its own; the labels come along unchanged.

    A row whose frame cannot be an event image, beside the training frames among `frames`, is sampled again, in all
    `max_attempts` times. If the last is rejected too it is kept, and says why. Where the checkpoint has motion layers,
    or the noise is that of stretches, rows that follow one another in time are made together, and none again.

    With `rounding`, the encoding of the training frames, each frame becomes the rendering of event counts that it is
    the expectation of. Training frames are those of one `part` of a union where one is named.
    """
    frames = only_part(frames, part)
    plugin, asked = plugins.load_options(sampling), conditions_of(conditions)
    num_events = None if rounding is None else training_counts(frames)
    folder, seeds = checkpoint.ref.path / "checkpoint", sample_seeds(seed, len(asked))
    stretches = _stretches(folder, frames, conditions, plugin.options)
    if stretches is not None:
        max_attempts = 1  # a frame that was made anew would be of another stretch
    if has_motion_layers(folder):
        asked = replace(asked, stretches=stretches)
    if isinstance(plugin.options, SamplingOptions):
        # Here, so that every row is told the seed it was made from.
        seeds = noise_seeds(seeds, plugin.options, None if stretches is None else stretch_lengths(stretches))

    chunks = [Chunk(np.arange(len(seeds))[rows], seeds[rows]) for rows in whole_stretches(asked, _chunk_rows(frames))]
    deal = None
    if is_dealt_out({"sampling": sampling}):
        deal = partial(deal_out, Sampling(folder, conditions.ref, asked.stretches, sampling, out.work))
        deal(chunks)

    def sample_rows(chunk: Chunk, members: np.ndarray, seeds: Sequence[int]) -> np.ndarray:
        rows = chunk.rows[members]
        if deal is not None and seeds != chunk.seeds:
            deal([Chunk(rows, seeds)])  # of those that were rejected
        made = plugin.module.sample(folder, asked.take(rows), plugin.options, seeds=seeds, work=out.work)
        return check_samples(plugin, made, len(rows))

    quality_filter, told = quality_filter_of(frames), SampleLog([], [], [])
    with out.open_array("frames") as written:
        for chunk in chunks:
            made = sample_until_accepted(
                partial(sample_rows, chunk), chunk.seeds, quality_filter, max_attempts=max_attempts
            )
            told.add(made.seeds, made.num_attempts, made.causes)
            if rounding is None or num_events is None:
                written.append(made.frames)
            else:
                own = distinct_seeds(told.seeds)[chunk.rows[0] :]
                written.append(round_frames(made.frames, num_events, plugins.load_options(rounding), own))
    return _table(conditions, plugin, checkpoint.ref.digest, told)


def _stretches(folder: Path, frames: Manifest, conditions: Manifest, options: Any) -> tuple[str, ...] | None:
    """Names of the stretches of conditions that follow one another as frames do; None where frames are single ones.

    Raises:
        DataError: no two do.
    """
    if has_motion_layers(folder):
        interval_us = read_settings(folder).interval_us
    elif isinstance(options, SamplingOptions) and options.noise == "stretches":
        interval_us = training_interval_us(frames)
    else:
        return None
    return name_followed(conditions.table, interval_us, conditions.ref.path)


class SampleLog(NamedTuple):
    """What the table says of each row, as in `FilteredImages`."""

    seeds: list[int]
    num_attempts: list[int]
    causes: list[str]

    def add(self, seeds: Sequence[int], num_attempts: Sequence[int], causes: Sequence[str]) -> None:
        """Note further rows."""
        self.seeds.extend(seeds)
        self.num_attempts.extend(num_attempts)
        self.causes.extend(causes)


def _chunk_rows(frames: Manifest) -> int:
    """Rows that are sampled before their frames are written: whole shards, so that batches are what they were."""
    return max(BLOCK_BYTES // math.prod(frames.array("frames").shape[1:]) // SHARD, 1) * SHARD


def quality_filter_of(frames: Manifest) -> QualityFilter:
    """Fitted to the training frames. Red and blue images have no green; grey ones have as much of it as of red."""
    rows = frames.rows_where(split="train")
    real = np.asarray(frames.array("frames")[rows[spread(len(rows), MAX_FILTER_FRAMES)]])
    return fit_quality_filter(real, polarity=not real[..., 1].any())


@stage(version=3, schema=tables.SYNTHETIC, raw_files=input_files_of("sampling"), optional=("part",), spreads=True)
def simulate(
    out: Output,
    recordings: Manifest,
    frames: Manifest,
    conditions: Manifest,
    *,
    sampling: SamplingChoice,
    encoding: EncodingChoice,
    windows: Windows,
    seed: int,
    part: str | None = None,
) -> pa.Table:
    """The events of each condition row on a sensor like that of `recordings`, encoded as those are.

    A frame is the window around the labelled moment, or, where conditions have no motions and so no moment, around the
    middle of the recording that is simulated: all of it with the method `whole`. A row without events becomes an empty
    frame. What the quality filter of `sample` would reject says so, but is not simulated again: a body that keeps still
    would send no events then either.

    A generator that can be calibrated is, on the training recordings; `calibration.json` says with what result. With a
    `part` of a union the sensor is the first of that part, and training recordings are those of it.
    """
    recordings, frames = only_part(recordings, part), only_part(frames, part)
    plugin, size = plugins.load_options(sampling), sensor_size_of(recordings)
    try:
        plugin.module.sample_events(conditions_of(conditions).take(slice(0, 1)), size, plugin.options, seeds=[0])
    except ValueError as error:  # the conditions are of another kind: said before anything is simulated
        raise DataError(f"{conditions.ref.path}: {error}") from error
    plugin = _calibrated(plugin, recordings, conditions, out)
    asked = _Simulation(conditions.ref, size, sampling, plugin.options, encoding, windows, out.work)
    quality_filter, count = quality_filter_of(frames), len(conditions)
    seeds, causes = sample_seeds(seed, count), []
    shards = [_Shard(start, seeds[start : start + SHARD_ROWS]) for start in range(0, count, SHARD_ROWS)]
    paths = map_shards(partial(_simulate_shard, asked), shards)
    with (
        out.open_array("frames") as written,
        ProgressBar(total=count, desc=plugin.name, unit="frame") as progress,
    ):
        for path in paths:
            made = load_array(path)[:]
            written.append(made)
            causes += find_causes(made, quality_filter)
            progress.update(len(made))
    return _table(conditions, plugin, "", SampleLog(seeds, [1] * count, causes))


def _calibrated(plugin: plugins.Plugin, recordings: Manifest, conditions: Manifest, out: Output) -> plugins.Plugin:
    """The simulator with its options fitted to training recordings, where it has something to fit."""
    if not isinstance(plugin.module, CalibratedEventGenerator):
        return plugin
    ranges = _training_ranges(recordings)
    if not ranges:
        raise DataError(f"{recordings.ref.path}: no training recording with events, which {plugin.name!r} is fitted to")
    chosen = [ranges[number] for number in spread(len(ranges), MAX_CALIBRATION)]
    read = (stored.read(start, stop) for _, stored, start, stop in chosen)
    names = [class_name for class_name, *_ in chosen]
    options, measured = plugin.module.calibrate(read, names, conditions_of(conditions), plugin.options)
    found = {"options": options.model_dump(mode="json"), "measured": measured}
    (out.folder / CALIBRATION_FILE).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return replace(plugin, options=options)


def _training_ranges(recordings: Manifest) -> list[tuple[str, StoredEvents, int, int]]:
    """Class, events, first event and one past the last of what each recording has for training, if not too long."""
    parts = by_recording(recordings.attached(tables.PARTS))
    found = []
    for row in recordings.table.to_pylist():
        for part in parts[row["recording_id"]].to_pylist() if row["events_file"] else []:
            start, stop = part["event_start"], min(part["event_stop"], part["event_start"] + MAX_CALIBRATION_EVENTS)
            if part["split"] == "train" and stop > start:
                found.append((row["class_name"], stored_events(recordings, row), start, stop))
    return found


@dataclass(frozen=True)
class _Simulation:
    """What a shard of `simulate` needs, small enough to travel with every shard; `options` are the calibrated ones."""

    conditions: ManifestRef
    sensor_size: SensorSize
    sampling: SamplingChoice
    options: Any
    encoding: EncodingChoice
    windows: Windows
    work: Path


class _Shard(NamedTuple):
    """Consecutive rows from `start`, one seed each."""

    start: int
    seeds: list[int]


def _simulate_shard(asked: _Simulation, shard: _Shard) -> Path:
    """The file of the frames of some rows, made unless an interrupted run has left it."""
    path = asked.work / f"frames_{shard.start:07d}{SUFFIX}"
    if path.exists():
        return path
    plugin, encoder = plugins.load_options(asked.sampling), plugins.load_options(asked.encoding)
    conditions, durations_us = _conditions_with_durations(asked.conditions.path, asked.conditions.digest)
    rows = slice(shard.start, shard.start + len(shard.seeds))
    part = conditions.take(rows)
    simulated = plugin.module.sample_events(part, asked.sensor_size, asked.options, seeds=shard.seeds)
    moments_us = None if part.motions is None else part.motions.moment_us
    frames = _encode(simulated, moments_us, durations_us[rows], asked.windows, encoder)
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    save_compressed(temporary, frames)
    temporary.replace(path)
    return path


@lru_cache(maxsize=1)
def _conditions_with_durations(folder: Path, digest: str) -> tuple[Conditions, np.ndarray]:
    """Conditions, and the lengths [N] of their windows; read once a process rather than once a shard."""
    manifest = read_manifest(ManifestRef(key=folder.name, path=folder, digest=digest))
    return conditions_of(manifest), manifest.table["t_end_us"].to_numpy() - manifest.table["t_start_us"].to_numpy()


def _encode(
    simulated: Iterator[Events],
    moments_us: np.ndarray | None,
    durations_us: np.ndarray,
    windows: Windows,
    encoder: plugins.Plugin,
) -> np.ndarray:
    """The frames [N, H, W, 3] of N simulations, each of the window around its moment, else around its middle."""
    frames = []
    for row, (events, duration_us) in enumerate(zip(simulated, durations_us, strict=True)):
        moment_us = _middle_us(events) if moments_us is None else int(moments_us[row])
        whole = moments_us is None and windows.method == "whole"
        window = (0, len(events)) if whole else window_around(events.t, moment_us, int(duration_us), windows)
        window = np.array([window])
        counts = encoder.module.encode(events, window, encoder.options)
        frames.append(encoder.module.render_image(counts, encoder.options)[0])
    return np.stack(frames)


def _middle_us(events: Events) -> int:
    return int(events.t[0] + events.t[-1]) // 2 if len(events) else 0


def _table(conditions: Manifest, plugin: plugins.Plugin, checkpoint_digest: str, made: SampleLog) -> pa.Table:
    # Generators that are no diffusion models make an image in one step, without scheduler or guidance.
    options: dict[str, Any] = plugin.options.model_dump()
    count = len(made.seeds)
    same = {
        "split": "train",
        "generator": f"{plugin.name} {plugin.version}",
        "checkpoint_digest": checkpoint_digest,
        "scheduler": options.get("scheduler", ""),
    }
    names = [f"synthetic/{row:06d}" for row in range(count)]
    carried = ("source_id", "subject", "class_name", "prompt", "joint_set", *LABEL_COLUMNS.values())
    return pa.table(
        {
            "sample_id": names,
            "recording_id": names,
            "condition_id": conditions.table["sample_id"],
            **{name: conditions.table[name] for name in carried},
            **{name: pa.array([value] * count, pa.string()) for name, value in same.items()},
            "num_inference_steps": pa.array([options.get("num_inference_steps", 1)] * count, pa.int32()),
            "guidance_scale": pa.array([float(options.get("guidance_scale", 1.0))] * count, pa.float64()),
            "seed": pa.array(made.seeds, pa.int64()),
            "num_attempts": pa.array(made.num_attempts, pa.int32()),
            "rejected": pa.array(made.causes, pa.string()),
        }
    )
