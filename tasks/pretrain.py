"""Make the small prior."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa

from ctlev_core.diffusion.pretraining import PretrainingOptions, pretrain, start_folder
from data_contracts import tables
from data_contracts.manifest import history_table
from tasks.stage import Output, files_of, stage


def _start_files(arguments: dict[str, Any]) -> list[tuple[str, Path]]:
    start = start_folder(arguments["options"])
    return [] if start is None else files_of([start])


@stage(version=3, schema=tables.TRAINING, raw_files=_start_files)
def pretrain_prior(out: Output, *, options: PretrainingOptions) -> pa.Table:
    """Train the small prior on procedural images; the artefact's `prior/` is an ordinary diffusers folder."""
    return history_table(pretrain(options, out.folder / "prior", out.work))
