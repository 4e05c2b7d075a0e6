"""Make labelled synthetic frames: sampled from a fine-tuned generator, or simulated by one that learns nothing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa
from tqdm import tqdm

from ctlev_core import plugins
from ctlev_core.condition_sources import sensor_size_of
from ctlev_core.row_seeds import row_seeds
from ctlev_core.windows import window_around
from data_contracts import tables
from data_contracts.config import EncodingChoice, SamplingChoice, Windows
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.manifest import LABEL_COLUMNS, Manifest, conditions_of
from tasks.stage import Output, input_files_of, stage

SHARD_ROWS = 64


@stage(version=2, schema=tables.SYNTHETIC)
def sample(out: Output, checkpoint: Manifest, conditions: Manifest, *, sampling: SamplingChoice, seed: int) -> pa.Table:
    """One frame per condition row, each from a seed of its own; the labels come along unchanged."""
    plugin = plugins.load_options(sampling)
    seeds = row_seeds(seed, len(conditions))
    folder = checkpoint.ref.path / "checkpoint"
    frames = plugin.module.sample(folder, conditions_of(conditions), plugin.options, seeds=seeds, work=out.work)
    out.write_array("frames", frames)
    return _table(conditions, plugin, checkpoint.ref.digest, seeds)


@stage(version=1, schema=tables.SYNTHETIC, raw_files=input_files_of("sampling"))
def simulate(
    out: Output,
    recordings: Manifest,
    conditions: Manifest,
    *,
    sampling: SamplingChoice,
    encoding: EncodingChoice,
    windows: Windows,
    seed: int,
) -> pa.Table:
    """The events of each condition row on a sensor like that of `recordings`, encoded as those are.

    A frame is the window around the labelled moment; a row without events becomes an empty frame.
    """
    plugin, encoder = plugins.load_options(sampling), plugins.load_options(encoding)
    asked, seeds = conditions_of(conditions), row_seeds(seed, len(conditions))
    if asked.motions is None:
        raise DataError(
            f"{conditions.ref.path}: generator {plugin.name!r} needs body motions; use condition 'body_motion'"
        )
    sensor_size = sensor_size_of(recordings)
    durations_us = conditions.table["t_end_us"].to_numpy() - conditions.table["t_start_us"].to_numpy()
    shards: list[np.ndarray] = []
    with tqdm(total=len(seeds), desc=plugin.name, unit="frame", leave=False, disable=None) as progress:
        for start in range(0, len(seeds), SHARD_ROWS):
            rows = slice(start, start + SHARD_ROWS)
            path = out.work / f"frames_{start:07d}.npy"
            if not path.exists():  # else by an earlier run that was interrupted
                simulated = plugin.module.sample_events(
                    asked.take(rows), sensor_size, plugin.options, seeds=seeds[rows]
                )
                moments_us = asked.motions.moment_us[rows]
                frames = _encode(simulated, moments_us, durations_us[rows], windows, encoder)
                temporary = path.with_suffix(".tmp")
                with temporary.open("wb") as file:
                    np.save(file, frames, allow_pickle=False)
                temporary.replace(path)
            shards.append(np.load(path, allow_pickle=False))
            progress.update(len(shards[-1]))
    out.write_array("frames", np.concatenate(shards))
    return _table(conditions, plugin, "", seeds)


def _encode(
    simulated: Iterator[Events],
    moments_us: np.ndarray,
    durations_us: np.ndarray,
    windows: Windows,
    encoder: plugins.Plugin,
) -> np.ndarray:
    """The frames [N, H, W, 3] of N simulations, each of the window around its moment."""
    frames = []
    for events, moment_us, duration_us in zip(simulated, moments_us, durations_us, strict=True):
        window = np.array([window_around(events.t, int(moment_us), int(duration_us), windows)])
        counts = encoder.module.encode(events, window, encoder.options)
        frames.append(encoder.module.render_image(counts, encoder.options)[0])
    return np.stack(frames)


def _table(conditions: Manifest, plugin: plugins.Plugin, checkpoint_digest: str, seeds: list[int]) -> pa.Table:
    # Generators that are no diffusion models make an image in one step, without scheduler or guidance.
    options: dict[str, Any] = plugin.options.model_dump()
    count = len(seeds)
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
            "seed": pa.array(seeds, pa.int64()),
        }
    )
