"""Labels to conditions: what the generator learns from, and what it is then asked for."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.labels.displacements import read_displacements
from ctlev_core.labels.rows_to_sample import choose_rows_to_sample
from ctlev_core.labels.sources import LabelledRows, image_size_of, read_motions, read_pairs, rows_of_frames
from ctlev_core.plugins import Plugin
from ctlev_core.realism.two_sample import choose_rows
from ctlev_core.seeds import sample_seeds
from data_contracts import tables
from data_contracts.compressed_arrays import CompressedArrayWriter
from data_contracts.config import ConditionChoice, EncodingChoice, Windows
from data_contracts.errors import DataError
from data_contracts.experiment import LabelOrder, View
from data_contracts.labels import BodyMotions
from data_contracts.manifest import Manifest, condition_arrays, label_columns
from data_contracts.parts import only_part
from tasks.stage import Output, input_files_of, stage

BLOCK_ROWS = 256
"""Rows rendered at a time; pictures of 512 x 512 px take 0.2 GiB."""


@stage(version=6, schema=tables.CONDITIONS, raw_files=input_files_of("condition"), optional=("part",))
def condition_frames(
    out: Output,
    recordings: Manifest,
    frames: Manifest,
    *,
    condition: ConditionChoice,
    encoding: EncodingChoice,
    seed: int,
    part: str | None = None,
) -> pa.Table:
    """Render the condition of every training frame, or those of one `part`; rows join the frames on `sample_id`."""
    recordings, frames = only_part(recordings, part), only_part(frames, part)
    rows = rows_of_frames(recordings, frames, frames.rows_where(split="train"))
    return _render(out, rows.source_ids, rows, condition, recordings, frames, encoding, seed)


@stage(version=2, schema=tables.CONDITIONS, raw_files=input_files_of("condition"))
def condition_some_frames(
    out: Output,
    recordings: Manifest,
    frames: Manifest,
    *,
    condition: ConditionChoice,
    encoding: EncodingChoice,
    split: str,
    count: int,
    seed: int,
) -> pa.Table:
    """Render the conditions of at most `count` frames of a split, held out ones too; rows join on `sample_id`.

    Raises:
        DataError: the split has no frame.
    """
    rows = frames.rows_where(split=split)
    if not len(rows):
        raise DataError(f"{frames.ref.path}: expected frames of split {split!r}, got none")
    chosen = rows_of_frames(recordings, frames, rows[choose_rows(len(rows), count, seed)])
    return _render(out, chosen.source_ids, chosen, condition, recordings, frames, encoding, seed)


@stage(
    version=9, schema=tables.CONDITIONS, raw_files=input_files_of("condition"), optional=("part", "choice", "length")
)
def condition_samples(
    out: Output,
    poses: Manifest,
    recordings: Manifest,
    frames: Manifest,
    choice: Manifest | None = None,
    *,
    condition: ConditionChoice,
    encoding: EncodingChoice,
    windows: Windows,
    count: int,
    order: LabelOrder,
    views: View,
    seed: int,
    part: str | None = None,
    length: int | None = None,
) -> pa.Table:
    """Choose `count` labels to sample from, as `choose_rows_to_sample` says, and render them.

    With a `part` of a union they are chosen as if it were all there is. With a `choice` they are its moments. `length`
    is that of stretches.
    """
    poses, recordings, frames = (only_part(one, part) for one in (poses, recordings, frames))
    rows = choose_rows_to_sample(
        poses,
        recordings,
        frames,
        encoding=encoding,
        windows=windows,
        count=count,
        order=order,
        views=views,
        needs_pictures=plugins.load("conditions", condition.name).NEEDS == "intensity",
        seed=seed,
        length=length or 1,
        chosen=None if choice is None else choice.table["moment"].to_numpy(),
    )
    sample_ids = [f"condition/{number:06d}" for number in range(count)]
    return _render(out, sample_ids, rows, condition, recordings, frames, encoding, seed)


def _load_condition(condition: ConditionChoice, recordings: Manifest) -> Plugin:
    """The condition plug-in; one that takes synonyms also gets the dataset's own, the user's before them."""
    plugin = plugins.load_options(condition)
    own = getattr(plugin.options, "synonyms", None)
    if own is None:
        return plugin
    of_dataset = {row["class_name"]: row["names"] for row in recordings.attached(tables.SYNONYMS).to_pylist()}
    return replace(plugin, options=plugin.options.model_copy(update={"synonyms": {**of_dataset, **own}}))


def _render(
    out: Output,
    sample_ids: list[str],
    rows: LabelledRows,
    condition: ConditionChoice,
    recordings: Manifest,
    frames: Manifest,
    encoding: EncodingChoice,
    seed: int,
) -> pa.Table:
    plugin = _load_condition(condition, recordings)
    labels, seeds = rows.labels, sample_seeds(seed, len(rows.labels))
    needs = plugin.module.NEEDS
    motions = read_motions(rows, recordings, frames, encoding) if needs == "motion" else None
    moved = None
    if needs == "displacement":
        moved = read_displacements(rows, recordings, encoding, plugin.options.reach_us)
    prompts: list[str] = []
    with ExitStack() as opened:
        written: dict[str, CompressedArrayWriter] = {}
        for start in range(0, max(len(labels), 1), BLOCK_ROWS):
            some = np.arange(start, min(start + BLOCK_ROWS, len(labels)))
            further: list[np.ndarray | BodyMotions] = []
            if needs == "intensity":
                further = [read_pairs(rows.take(some), frames, encoding)]
            elif motions is not None:
                further = [motions.take(some)]
            elif moved is not None:
                further = [moved[some]]
            own = seeds[start : start + BLOCK_ROWS]
            rendered = plugin.module.render(labels.take(some), image_size_of(frames), plugin.options, own, *further)
            prompts += rendered.prompts
            for name, array in condition_arrays(rendered).items():
                if name not in written:
                    written[name] = opened.enter_context(out.open_array(name))
                written[name].append(array)
    return pa.table(
        {
            "sample_id": sample_ids,
            "source_id": rows.source_ids,
            "subject": rows.subjects,
            "class_name": pa.array(labels.class_names, pa.string()),
            "prompt": pa.array(prompts, pa.string()),
            "t_start_us": rows.t_start_us,
            "t_end_us": rows.t_end_us,
            **label_columns(labels),
        }
    )
