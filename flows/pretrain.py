"""Rebuild the small bundled base model from procedural images; it never sees events.

python flows/pretrain.py [--set training.num_steps=...] [--set max_seconds=null] [--dry-run]
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from data_contracts.manifest import ManifestRef
from flows.cli import script
from flows.command_line import PRESETS, Command, load_preset
from flows.settings import flow
from tasks.pretrain import pretrain as pretrain_stage

if TYPE_CHECKING:  # torch and diffusers, which read the environment when they are imported
    from ctlev_core.diffusion.pretraining.pretraining import PretrainingOptions


@flow(name="pretrain")
def pretrain(options: PretrainingOptions) -> ManifestRef:
    """Draw people and objects, train the small latent-diffusion base model on them and write a diffusers folder."""
    return pretrain_stage(options=options)


def load_pretraining(preset: str, overrides: list[str]) -> PretrainingOptions:
    """The options that a preset of `flows/presets/pretraining` describes.

    Raises:
        DataError: the base model to go on from is of another shape.
    """
    from ctlev_core.diffusion.pretraining.pretraining import PretrainingOptions, check_start

    options = load_preset(PretrainingOptions, PRESETS / "pretraining", preset, overrides)
    check_start(options)
    return options


COMMAND = Command(
    pretrain,
    lambda made, _: (
        f"base model: {made.path / 'base_model'}\nuse it: --set generator.options.base_model={made.path / 'base_model'}"
    ),
    load=load_pretraining,
)


if __name__ == "__main__":
    sys.exit(script("pretrain"))
