"""Train a downstream model on real frames, synthetic frames, or both."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from data_contracts import tables
from data_contracts.config import DownstreamChoice
from data_contracts.manifest import Manifest, concat_labels, history_table
from tasks.stage import Output, stage


@stage(version=1, schema=tables.TRAINING)
def train_downstream(
    out: Output, training_sets: list[Manifest], *, downstream: DownstreamChoice, seed: int
) -> pa.Table:
    """Train on the rows of split `train` of all given sets; the artefact's `model/` holds the weights.

    The number of optimiser steps is an option of the model, so that it is the same for every setting.
    """
    plugin = plugins.load_options(downstream)
    rows = [manifest.rows_where(split="train") for manifest in training_sets]
    frames = np.concatenate([m.array("frames")[r] for m, r in zip(training_sets, rows, strict=True)])
    # Bodies of another dataset may carry more labels than the frames do.
    labels = concat_labels([m.labels.take(r) for m, r in zip(training_sets, rows, strict=True)], common=True)
    history = plugin.module.train(frames, labels, plugin.options, seed=seed, out=out.folder / "model", work=out.work)
    return history_table(history)
