"""Train a downstream model on recorded frames, synthetic frames, or both."""

from __future__ import annotations

from functools import partial

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.plugin_contracts import DownstreamOfSequences
from ctlev_core.supervised.frame_sequences import name_recordings
from data_contracts import tables
from data_contracts.config import DownstreamChoice
from data_contracts.errors import DataError
from data_contracts.manifest import Manifest, concat_labels, history_table, image_rows
from tasks.stage import Output, input_files_of, stage


@stage(version=1, schema=tables.TRAINING, raw_files=input_files_of("downstream"))
def train_downstream(
    out: Output, training_sets: list[Manifest], *, downstream: DownstreamChoice, seed: int
) -> pa.Table:
    """Train on the rows of split `train` of all given sets; the artefact's `model/` holds the weights.

    The number of optimiser steps is an option of the model, so that it is the same for every training_set. A model that
    can look at several frames at once (`train_sequences`) is told which follow one another.
    """
    plugin = plugins.load_options(downstream)
    rows = [manifest.rows_where(split="train") for manifest in training_sets]
    if not any(len(chosen) for chosen in rows):
        folders = ", ".join(str(manifest.ref.path) for manifest in training_sets)
        raise DataError(f"{folders}: no rows in split 'train' to learn from")
    frames = image_rows(list(zip(training_sets, rows, strict=True)))
    # Bodies of another dataset may carry more labels than the frames do.
    labels = concat_labels([m.labels.take(r) for m, r in zip(training_sets, rows, strict=True)], common=True)
    train = plugin.module.train
    if isinstance(plugin.module, DownstreamOfSequences):
        named = [name_recordings(m, r) for m, r in zip(training_sets, rows, strict=True)]
        train = partial(plugin.module.train_sequences, recordings=[name for names in named for name in names])
    history = train(
        frames,
        labels,
        plugin.options,
        seed=seed,
        out=out.folder / "model",
        work=out.work,
        parts=[len(chosen) for chosen in rows],
        groups=_groups(training_sets, rows),
    )
    return history_table(history)


def _groups(training_sets: list[Manifest], rows: list[np.ndarray]) -> list[str]:
    """Who is on each row, or, where the first set with rows shows one subject alone, in what recording.

    Frames of one recording resemble one another: held back one by one they would show nothing.
    """
    first = next(number for number, chosen in enumerate(rows) if len(chosen))
    subjects = np.array(training_sets[first].column("subject"))[rows[first]]
    column = "subject" if len(set(subjects.tolist())) > 1 else "recording_id"
    columns = [np.array(manifest.column(column)) for manifest in training_sets]
    return [name for names, chosen in zip(columns, rows, strict=True) for name in names[chosen].tolist()]
