"""Train the layers that make consecutive frames from one another, in a generator that was fine-tuned on single ones."""

from __future__ import annotations

from dataclasses import replace

import pyarrow as pa

from ctlev_core.diffusion.training.options import MotionOptions
from ctlev_core.supervised.frame_sequences import frame_interval_us, name_stretches
from data_contracts import tables
from data_contracts.errors import DataError
from data_contracts.manifest import Manifest, conditions_of, history_table, matching_rows
from tasks.stage import Output, stage


@stage(version=1, schema=tables.TRAINING)
def train_motion_layers(
    out: Output,
    checkpoint: Manifest,
    frames: Manifest,
    conditions: Manifest,
    *,
    options: MotionOptions,
    seed: int,
) -> pa.Table:
    """The generator with motion layers that have learnt from stretches of training frames.

    The artefact's `checkpoint/` is that of the generator, whose files it shares, with diffusers' `motion_adapter/`.

    Args:
        out: of the stage.
        checkpoint: the fine-tuned generator.
        frames: recorded ones.
        conditions: of the training frames among them; rows join on `sample_id`.
        options: of the training.
        seed: of weights, order and noise.
    Raises:
        DataError: the generator is no diffusion model, or no stretch is as long as the context.
    """
    from ctlev_core.diffusion.training.motion_training import train_motion_layers as train

    folder = checkpoint.ref.path / "checkpoint"
    if not (folder / "model_index.json").is_file():
        raise DataError(f"{folder}: motion layers need a diffusion generator that was trained whole, without lora_rank")
    rows = matching_rows(frames, conditions)
    interval_us = frame_interval_us(frames.table, rows, frames.ref.path)
    asked = replace(conditions_of(conditions), stretches=name_stretches(frames.table, rows, interval_us))
    history = train(
        folder,
        frames.images(rows),
        asked,
        options,
        interval_us=interval_us,
        seed=seed,
        out=out.folder / "checkpoint",
        work=out.work,
    )
    return history_table(history)
