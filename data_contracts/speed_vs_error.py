"""What is measured of sampling on both axes, its cost and its error."""

from __future__ import annotations

from typing import Any

from pydantic import Field, model_validator

from data_contracts.config import Frozen

KEEP_PRECISION = ("unipc", "deis")
"""Solvers whose state has the precision it is given. Those of the DPM-Solver++ family compute each step in float32."""


class SamplerLine(Frozen):
    """One line of a plot: a solver with its settings, at several numbers of steps."""

    options: dict[str, Any] = Field(
        default_factory=dict, description="sampling options, over those of the experiment where there is one"
    )
    steps: tuple[int, ...] = Field(min_length=1, description="num_inference_steps, one measurement each")

    def over(self, options: dict[str, Any], num_inference_steps: int) -> dict[str, Any]:
        """Sampling options of one point, over others; their spacing is not kept where the line chooses a solver."""
        kept = {
            name: value
            for name, value in options.items()
            if name != "timestep_spacing" or "scheduler" not in self.options
        }
        return kept | self.options | {"num_inference_steps": num_inference_steps}


class SamplerSetting(Frozen):
    """One point of a line."""

    line: str
    num_inference_steps: int
    is_deterministic: bool = True


class ExactScoreOptions(Frozen):
    """Solvers with the exact denoiser of a one-dimensional mixture of Gaussians.

    The default is like the values of an event image: most are background, a narrow peak; a few are events.
    """

    lines: dict[str, SamplerLine] = Field(min_length=1)
    weights: tuple[float, ...] = Field((0.85, 0.15), min_length=1)
    means: tuple[float, ...] = (-0.6, 1.2)
    spreads: tuple[float, ...] = (0.05, 0.4)
    num_values: int = Field(20_000, ge=2, description="values that are sampled")
    seed: int = Field(0, ge=0)

    @model_validator(mode="after")
    def _sizes_agree(self) -> ExactScoreOptions:
        if not len(self.weights) == len(self.means) == len(self.spreads):
            raise ValueError("weights, means and spreads must have one value for each Gaussian")
        if min(self.weights) <= 0 or min(self.spreads) <= 0:
            raise ValueError("weights and spreads must be positive")
        return self


class PrecisionOptions(Frozen):
    """One trajectory of each line in several precisions, against float64; solvers of `KEEP_PRECISION` only."""

    lines: dict[str, SamplerLine] = Field(min_length=1)
    num_images: int = Field(4, ge=1)


class SpeedVsErrorOptions(Frozen):
    """Sampler and number of steps against error.

    The reference is what the other settings are compared with; the paper's is DDPM with 1,000 steps, and costs as much
    as all else together. `converged` is the solution of the probability-flow equation itself: solvers without noise of
    their own are compared with it image by image.
    """

    experiment: str = Field(
        description="whose tuned generator is sampled from: a preset or the path of a .yaml file; in a study the name "
        "of one of its experiments"
    )
    num_images: int = Field(48, ge=2, description="conditions of the experiment, evenly spread, to sample from")
    seeds: tuple[int, ...] = Field((0, 1), min_length=1, description="every condition is sampled with each")
    reference: SamplerLine
    converged: SamplerLine
    lines: dict[str, SamplerLine] = Field(min_length=1)
    label_errors: bool = Field(True, description="also ask the model trained on recorded frames for the labels it sees")
    exact_score: ExactScoreOptions | None = None
    precision: PrecisionOptions | None = None

    @model_validator(mode="after")
    def _references_are_points(self) -> SpeedVsErrorOptions:
        for name in ("reference", "converged"):
            if len(getattr(self, name).steps) != 1:
                raise ValueError(f"{name}: expected one number of steps, got {list(getattr(self, name).steps)}")
        if len(set(self.seeds)) != len(self.seeds):
            raise ValueError(f"seeds must differ, got {list(self.seeds)}")
        return self
