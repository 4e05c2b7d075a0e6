"""Are latents encoded by a stage of their own? Imports nothing heavy: the plan calls it."""

from __future__ import annotations

from ctlev_core.diffusion.pretrained.paths import learned_autoencoder
from ctlev_core.diffusion.training.options import FineTuningOptions, LatentOptions


def choose_latents(options: FineTuningOptions) -> LatentOptions | None:
    """How the frames of a fine-tuning are encoded before it; None where each training does so itself.

    It does with the patch code of the bundled models, which costs next to nothing, and where frames are moved whenever
    they are shown, for then hardly any is seen as it is. What is wrong with a base model is said where its files are
    looked for.
    """
    base_model = options.base_model
    if base_model is None or not base_model.exists() or options.moves.moves_anything:
        return None
    if learned_autoencoder(base_model) is None:
        return None
    return LatentOptions(base_model=base_model, device=options.device, num_turns=options.num_turns)
