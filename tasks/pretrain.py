"""Make a small base model: the bundled ones, or a base model of a user's own pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from data_contracts import tables
from data_contracts.file_lists import files_of
from data_contracts.manifest import history_table
from tasks.stage import Output, stage

if TYPE_CHECKING:  # torch, which flows that pre-train nothing need not wait for
    from ctlev_core.diffusion.pretraining.pretraining import PretrainingOptions


def _raw_files(arguments: dict[str, Any]) -> list[tuple[str, Path]]:
    from ctlev_core.diffusion.pretraining.pretraining import start_folder
    from ctlev_core.pictures.labelled_pictures import READING, picture_files

    options: PretrainingOptions = arguments["options"]
    start = start_folder(options)
    pictures = [(f"pictures/{READING}/{name}", path) for name, path in files_of(picture_files(options.pictures))]
    return ([] if start is None else files_of([start])) + pictures


@stage(version=5, schema=tables.TRAINING, raw_files=_raw_files)
def pretrain(out: Output, *, options: PretrainingOptions) -> pa.Table:
    """Train the small base model on pictures; the artefact's `base_model/` is an ordinary diffusers folder."""
    from ctlev_core.diffusion.pretraining.pretraining import pretrain

    return history_table(pretrain(options, out.folder / "base_model", out.work))
