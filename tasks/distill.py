"""Distil a fine-tuned generator into a student that needs few evaluations of the network."""

from __future__ import annotations

import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.diffusion.motion_files import has_motion_layers
from ctlev_core.diffusion.training.options import StudentOptions
from data_contracts import tables
from data_contracts.config import SamplingChoice
from data_contracts.errors import DataError
from data_contracts.manifest import Manifest, conditions_of, history_table
from tasks.stage import Output, stage


@stage(version=1, schema=tables.TRAINING)
def distill(
    out: Output,
    checkpoint: Manifest,
    conditions: Manifest,
    *,
    sampling: SamplingChoice,
    options: StudentOptions,
    seed: int,
) -> pa.Table:
    """The student of a generator; the artefact's `checkpoint/` is an ordinary diffusers folder with a `TCDScheduler`.

    Args:
        out: of the stage.
        checkpoint: the fine-tuned generator.
        conditions: of the training frames.
        sampling: the generator's guidance, which is distilled.
        options: of the distillation.
        seed: of order and noise.
    Raises:
        DataError: the generator has motion layers, or is no diffusion model.
    """
    from ctlev_core.diffusion.pretrained.adapters import is_adapter
    from ctlev_core.diffusion.training.distillation import distil

    folder = checkpoint.ref.path / "checkpoint"
    if has_motion_layers(folder):
        raise DataError(f"{folder}: a generator with motion layers cannot be distilled")
    if not (folder / "model_index.json").is_file() and not is_adapter(folder):
        raise DataError(f"{folder}: only a diffusion generator can be distilled")
    history = distil(
        folder,
        conditions_of(conditions),
        options,
        guidance=plugins.load_options(sampling).options,
        seed=seed,
        out=out.folder / "checkpoint",
        work=out.work,
    )
    return history_table(history)
