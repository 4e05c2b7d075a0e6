"""Make labelled synthetic frames: sampled from a fine-tuned generator, or simulated by one that learns nothing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from tqdm import tqdm

from ctlev_core import plugins
from ctlev_core.condition_sources import sensor_size_of
from ctlev_core.diffusion.sampling_options import SamplingOptions, noise_seeds
from ctlev_core.dithering import dither_counts
from ctlev_core.image_gate import GatedImages, ImageGate, find_causes, fit_gate, sample_until_accepted
from ctlev_core.row_seeds import row_seeds
from ctlev_core.windows import spread, window_around
from data_contracts import tables
from data_contracts.config import EncodingChoice, SamplingChoice, Windows
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.manifest import LABEL_COLUMNS, Manifest, conditions_of
from tasks.stage import Output, input_files_of, stage

SHARD_ROWS = 64
MAX_GATE_FRAMES = 2_000
"""Training frames the gate is fitted to, evenly spread: the quantiles of more hardly move."""


@stage(version=3, schema=tables.SYNTHETIC)
def sample(
    out: Output,
    checkpoint: Manifest,
    frames: Manifest,
    conditions: Manifest,
    *,
    sampling: SamplingChoice,
    max_tries: int,
    seed: int,
    rounding: EncodingChoice | None = None,
) -> pa.Table:
    """One frame per condition row, each from a seed of its own; the labels come along unchanged.

    A row whose frame cannot be an event image, beside the training frames among `frames`, is sampled again, in all
    `max_tries` times. If the last is refused as well it is kept, and says why. With `rounding`, the encoding of the
    training frames, each frame becomes the rendering of event counts that it is the expectation of.
    """
    plugin, asked = plugins.load_options(sampling), conditions_of(conditions)
    folder = checkpoint.ref.path / "checkpoint"

    def sample_rows(rows: np.ndarray, seeds: Sequence[int]) -> np.ndarray:
        return plugin.module.sample(folder, asked.take(rows), plugin.options, seeds=seeds, work=out.work)

    seeds = row_seeds(seed, len(asked))
    if isinstance(plugin.options, SamplingOptions):
        seeds = noise_seeds(seeds, plugin.options)  # here, so that every row is told the seed it was made from
    made = sample_until_accepted(sample_rows, seeds, gate_of(frames), max_tries=max_tries)
    out.write_array("frames", made.frames if rounding is None else _rounded(made, frames, rounding))
    return _table(conditions, plugin, checkpoint.ref.digest, made)


def _rounded(made: GatedImages, frames: Manifest, encoding: EncodingChoice) -> np.ndarray:
    """The frames as renderings of whole event counts, as many as some window of training has."""
    encoder = plugins.load_options(encoding)
    learnt = frames.rows_where(split="train")
    histograms = frames.array("histograms")
    num_events = np.array([histograms[row].sum(dtype=np.int64) for row in learnt])
    counts = dither_counts(made.frames, num_events, polarity=encoder.options.polarity, seeds=made.seeds)
    return encoder.module.render_image(counts, encoder.options)


def gate_of(frames: Manifest) -> ImageGate:
    """The gate of the training frames. Red and blue images have no green; grey ones have as much of it as of red."""
    rows = frames.rows_where(split="train")
    real = np.asarray(frames.array("frames")[rows[spread(len(rows), MAX_GATE_FRAMES)]])
    return fit_gate(real, polarity=not real[..., 1].any())


@stage(version=2, schema=tables.SYNTHETIC, raw_files=input_files_of("sampling"))
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
) -> pa.Table:
    """The events of each condition row on a sensor like that of `recordings`, encoded as those are.

    A frame is the window around the labelled moment; a row without events becomes an empty frame. What the gate of
    `sample` would refuse says so, but is not simulated again: a body that keeps still would send no events then either.
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
                encoded = _encode(simulated, moments_us, durations_us[rows], windows, encoder)
                temporary = path.with_suffix(".tmp")
                with temporary.open("wb") as file:
                    np.save(file, encoded, allow_pickle=False)
                temporary.replace(path)
            shards.append(np.load(path, allow_pickle=False))
            progress.update(len(shards[-1]))
    made = np.concatenate(shards)
    out.write_array("frames", made)
    gated = GatedImages(made, seeds, [1] * len(seeds), find_causes(made, gate_of(frames)))
    return _table(conditions, plugin, "", gated)


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


def _table(conditions: Manifest, plugin: plugins.Plugin, checkpoint_digest: str, made: GatedImages) -> pa.Table:
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
            "num_tries": pa.array(made.num_tries, pa.int32()),
            "refused": pa.array(made.causes, pa.string()),
        }
    )
