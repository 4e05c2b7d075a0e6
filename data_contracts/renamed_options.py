"""Options that had other names before version 0.1.0: an old preset is told the new ones."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

RENAMED_OPTIONS = {
    "block_passes": "chunk_passes",
    "block_scenes": "chunk_scenes",
    "dark_level": "black_threshold",
    "diet": "data_mixture",
    "film_conditions": "record_conditions",
    "keep_faithful": "keep_fraction",
    "max_copies_share": "max_memorised_share",
    "max_refused_share": "max_rejected_share",
    "max_sample_weight": "max_loss_weight",
    "max_tries": "max_attempts",
    "more_real": "oracle",
    "pose_order": "temporal_order",
    "pose_views": "view",
    "prior": "base_model",
    "round_to_counts": "stochastic_rounding",
    "settings": "training_sets",
    "shot_rate_bright": "shot_noise_rate_bright",
    "shot_rate_hz": "shot_noise_rate_hz",
    "spacing": "timestep_spacing",
    "together": "mixtures",
    "turned_share": "rot90_probability",
}
RENAMED_VALUES = {
    "dpm++": "dpmpp_2m",
    "dpm++_3m": "dpmpp_3m",
    "dpm++_sde": "dpmpp_sde",
    "even": "linspace",
    "filmed_pictures": "picture_simulator",
    "real": "recorded",
    "real+synthetic": "recorded+synthetic",
    "prior_over_training": "base_model_over_training",
    "small_prior": "small",
}
"""Of options, and names of plug-ins and presets."""


def name_hint(name: str, known: Iterable[str], renamed: dict[str, str] = RENAMED_OPTIONS) -> str:
    """The end of a message: what an unknown name is now called, or which known one is meant; empty where unknown."""
    known = list(known)
    if renamed.get(name) in known:
        return f"; {name!r} is now {renamed[name]!r}"
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.7)
    return f"; did you mean {near[0]!r}?" if near else ""
