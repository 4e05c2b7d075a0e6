"""Make the small prior."""

from __future__ import annotations

import pyarrow as pa

from ctlev_core.diffusion.pretraining import PretrainingOptions, pretrain
from data_contracts import tables
from data_contracts.manifest import history_table
from tasks.stage import Output, stage


@stage(version=1, schema=tables.TRAINING)
def pretrain_prior(out: Output, *, options: PretrainingOptions) -> pa.Table:
    """Train the small prior on procedural images; the artefact's `prior/` is an ordinary diffusers folder."""
    return history_table(pretrain(options, out.folder / "prior", out.work))
