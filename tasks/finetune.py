"""Fine-tune a generator on labelled event images."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.pictures.labelled_pictures import READING, picture_files
from data_contracts import tables
from data_contracts.config import GeneratorChoice
from data_contracts.file_lists import files_of
from data_contracts.manifest import Manifest, conditions_of, history_table, matching_rows
from tasks.stage import Output, stage


def _base_model_files(arguments: dict[str, Any]) -> list[tuple[str, Path]]:
    plugin = plugins.load_options(arguments["generator"])
    # A base model is an artefact, and its key is part of ours.
    places = [] if arguments["base_model"] is not None else plugin.module.base_model_folders(plugin.options)
    shown = [] if not getattr(plugin.options, "rehearsal_share", 0) else picture_files(plugin.options.rehearsal)
    return files_of(places) + [(f"rehearsal/{READING}/{name}", path) for name, path in files_of(shown)]


@stage(version=1, schema=tables.TRAINING, raw_files=_base_model_files, aside=("latents",))
def finetune(
    out: Output,
    frames: Manifest,
    conditions: Manifest,
    base_model: Manifest | None = None,
    latents: Manifest | None = None,
    *,
    generator: GeneratorChoice,
    seed: int,
) -> pa.Table:
    """Tune the base model on the training frames; the artefact's `checkpoint/` is an ordinary diffusers folder.

    With `base_model`, an artefact of pre-training, that is the base model. With `latents`, those of the training frames
    from its autoencoder, the frames are not encoded again; weights are the same.
    """
    plugin = plugins.load_options(generator)
    rows = matching_rows(frames, conditions)
    options = plugin.options
    if base_model is not None:
        options = options.model_copy(update={"base_model": base_model.ref.path / "base_model"})
    train = plugin.module.train
    if latents is not None:
        from ctlev_core.diffusion.training.latent_files import stored_latents

        stored = stored_latents(latents, conditions.column("sample_id"), options.num_turns)
        train = partial(plugin.module.train_from_latents, latents=stored)
    history = train(
        frames.images(rows),
        conditions_of(conditions),
        options,
        seed=seed,
        out=out.folder / "checkpoint",
        work=out.work,
    )
    return history_table(history)
