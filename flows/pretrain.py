"""Rebuild the small bundled base model from procedural images; it never sees events.

python flows/pretrain.py [--set training.num_steps=...] [--set max_seconds=null] [--dry-run]
"""

from __future__ import annotations

import functools
import sys

from ctlev_core.diffusion.pretraining.pretraining import PretrainingOptions
from data_contracts.manifest import ManifestRef
from flows.command_line import PRESETS, load_preset, main
from flows.settings import flow
from tasks.pretrain import pretrain as pretrain_stage


@flow(name="pretrain")
def pretrain(options: PretrainingOptions) -> ManifestRef:
    """Draw people and objects, train the small latent-diffusion base model on them and write a diffusers folder."""
    return pretrain_stage(options=options)


if __name__ == "__main__":
    sys.exit(
        main(
            pretrain,
            lambda made, _: (
                f"base model: {made.path / 'base_model'}\n"
                f"use it: --set generator.options.base_model={made.path / 'base_model'}"
            ),
            load=functools.partial(load_preset, PretrainingOptions, PRESETS / "pretraining"),
            default_preset="small",
        )
    )
