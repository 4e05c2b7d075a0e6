"""Rebuild the small bundled prior from procedural images; it never sees events.

python flows/pretrain_prior.py [--set training.num_steps=...] [--set max_seconds=null] [--dry-run]
"""

from __future__ import annotations

import functools
import sys

from ctlev_core.diffusion.pretraining.pretraining import PretrainingOptions
from data_contracts.manifest import ManifestRef
from flows.command_line import PRESETS, load_preset, main
from flows.settings import flow
from tasks.pretrain import pretrain_prior as pretrain_stage


@flow(name="pretrain-prior")
def pretrain_prior(options: PretrainingOptions) -> ManifestRef:
    """Draw people and objects, train the small latent-diffusion prior on them and write it as a diffusers folder."""
    return pretrain_stage(options=options)


if __name__ == "__main__":
    sys.exit(
        main(
            pretrain_prior,
            lambda made, _: (
                f"prior: {made.path / 'prior'}\nuse it: --set generator.options.prior={made.path / 'prior'}"
            ),
            load=functools.partial(load_preset, PretrainingOptions, PRESETS / "pretraining"),
            default_preset="small_prior",
        )
    )
