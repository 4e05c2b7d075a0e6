"""Hours and storage that a generator of Stable Diffusion's size would take, by calculation; latents are cached."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctlev_core import plugins
from data_contracts.experiment import Experiment
from flows.network_operations import Networks, learning, read_networks, stable_diffusion_v1

TRAINING_RATE = {"bfloat16": 168e12, "float16": 168e12, "float32": 50e12}
SAMPLING_RATE = {"bfloat16": 330e12, "float16": 330e12, "float32": 50e12}
"""Operations a second by precision: in bfloat16 as measured on one H200, 512 px, networks compiled, batches of 8 for
training and 32 for sampling (`benchmarks/RESULTS.md`); in float32, which was not measured, what it reaches at best."""
HOW_ESTIMATED = (
    "by calculation, at the rates measured on one H200 in bfloat16: 168 TFLOP/s for training and 330 for sampling; in "
    "float32 50, which is the best that can be:"
)
PIXELS = 3
COMPRESSION = 5
"""How many times smaller samples are stored. Of `benchmarks/arrays.py`, recorded frames of 512 px are 24 to 190 times
smaller; those sampled in the preset `smoke`, 64 px, 15. Sampled ones of 512 px were not measured: this is cautious."""


@dataclass(frozen=True)
class Costs:
    """Of one experiment's own generator, all fine-tunings and sets together.

    Attributes:
        images_trained: that training sees, repeated ones too.
        training_s: seconds on one GPU at `TRAINING_RATE`.
        num_samples: frames.
        num_steps: of the sampler.
        sampling_s: the same, at `SAMPLING_RATE`.
        frames_bytes: of the samples, as stored.
    """

    images_trained: int
    training_s: float
    num_samples: int
    num_steps: int
    sampling_s: float
    frames_bytes: int

    def __str__(self) -> str:
        return (
            f"train on {self.images_trained / 1e6:.1f} million images: {self.training_s / 3600:.1f} GPU hours; sample "
            f"{self.num_samples:,} in {self.num_steps} steps: {self.sampling_s / 3600:.1f}; "
            f"frames {self.frames_bytes / 1e9:.1f} GB"
        )


def estimate_costs(experiment: Experiment) -> Costs | None:
    """The costs of an experiment whose generator is fine-tuned from weights of Stable Diffusion's size, else None."""
    given, sampling = experiment.generator.options, experiment.sampling
    if experiment.generator.name not in ("stable_diffusion", "controlnet") or "base_model" not in given:
        return None
    # Read as they are: other options may still be wrong, or their files missing.
    options = _with_defaults(experiment.generator.name, "Options", given)
    sampled = _with_defaults(experiment.generator.name, "SampleOptions", sampling)
    width, height = experiment.encoding.options.get("image_size") or (512, 512)
    controlled = experiment.generator.name == "controlnet"
    per_step = options["batch_size"] * options["gradient_accumulation"]
    images = options["num_steps"] * per_step * experiment.num_generators
    networks = _networks(given, controlled)
    forward = networks.operations("denoising", width, height)
    backward = networks.operations(learning(options["tune"]), width, height)
    # As if guidance were at every step: where steps lie in its interval depends on the checkpoint's schedule.
    guided = sum(sampled.get(name, 1.0) > 1 for name in ("guidance_scale", "autoguidance_scale"))
    evaluations = sampled["num_inference_steps"] * (1 + guided)
    samples = experiment.num_synthetic * experiment.num_generators
    return Costs(
        images_trained=images,
        training_s=images * backward / TRAINING_RATE[options["precision"]],
        num_samples=samples,
        num_steps=sampled["num_inference_steps"],
        sampling_s=samples
        * (evaluations * forward + networks.operations("decoding", width, height))
        / SAMPLING_RATE[sampled["precision"]],
        frames_bytes=samples * width * height * PIXELS // COMPRESSION,
    )


def _with_defaults(generator: str, model: str, given: dict[str, Any]) -> dict[str, Any]:
    fields = getattr(plugins.load("generators", generator), model).model_fields
    return {name: given.get(name, field.default) for name, field in fields.items()}


def _networks(given: dict[str, Any], with_controlnet: bool) -> Networks:
    """Those of the base model asked for, or of Stable Diffusion v1 where its files are not there."""
    controlnet = given.get("controlnet") if with_controlnet else None
    place = None if controlnet is None else Path(controlnet)
    found = read_networks(Path(given["base_model"]), place, with_controlnet)
    if found is None or (with_controlnet and "controlnet" not in found.weights):
        return stable_diffusion_v1(with_controlnet)
    return found
