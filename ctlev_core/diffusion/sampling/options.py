"""Options of sampling that both diffusion generators share. Imports nothing heavy."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from typing import Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from ctlev_core.diffusion.compilation import Compile
from data_contracts.config import ADDED_LATER, RUN_SETTING, Frozen

Scheduler = Literal["unipc", "dpmpp_2m", "dpmpp_3m", "dpmpp_sde", "deis", "sa_solver", "ddim", "ddpm", "tcd"]
Spacing = Literal["karras", "lu", "linspace", "trailing"]

_ANY: tuple[Spacing, ...] = ("karras", "lu", "linspace", "trailing")
SPACINGS: dict[str, tuple[Spacing, ...]] = {
    "unipc": _ANY,
    "dpmpp_2m": _ANY,
    "dpmpp_3m": _ANY,
    "dpmpp_sde": _ANY,
    "deis": _ANY,
    "sa_solver": _ANY,
    "ddim": _ANY,
    "ddpm": ("linspace", "trailing"),
    "tcd": ("trailing",),
}
"""The spacings each solver supports; the first is what it gets where none is asked for."""

STOCHASTIC = ("ddpm", "dpmpp_sde", "sa_solver")
"""Solvers that draw noise at every step, from each image's own stream."""

OF_STUDENTS = "tcd"
"""Samples distilled checkpoints, at the time steps they were distilled for, and no others."""

_DEVICE = re.compile(r"auto|all|(cpu|mps|cuda(:\d+)?)(,(cpu|mps|cuda(:\d+)?))*")


class SamplingOptions(Frozen):
    """How frames are drawn from a checkpoint."""

    scheduler: Scheduler = Field(
        default="unipc",
        description="solver; the paper's is ddpm with 1000 steps, unipc (Karras) matches it in 20; tcd is for "
        "distilled checkpoints (`student`)",
    )
    num_inference_steps: int = Field(
        default=20, gt=0, le=1000, description="evaluations of the network an image; paper: 1000"
    )
    timestep_spacing: Spacing = Field(
        default="karras",
        description="where the steps lie: karras = dense at little noise, lu = even in log signal-to-noise ratio, "
        "linspace and trailing = even in time; ddpm has no karras and takes linspace where nothing is said",
    )
    guidance_scale: float = Field(default=1.0, ge=1, description="classifier-free guidance; 1 = none, twice as fast")
    guidance_interval: tuple[float, float] = Field(
        default=(0.0, 1.0),
        description="time steps with guidance, as shares of the schedule, 0 = no noise; the others take half the work "
        "(Kynkaanniemi et al., NeurIPS 2024)",
    )
    autoguidance_scale: float = Field(
        default=1.0,
        ge=1,
        json_schema_extra=ADDED_LATER,
        description="guidance away from the same network without some attention blocks, within guidance_interval; 1 = "
        "none, twice as fast (Karras et al., NeurIPS 2024)",
    )
    autoguidance_layers: Literal["middle", "all"] = Field(
        default="middle",
        json_schema_extra=ADDED_LATER,
        description="which attention blocks of the U-Net are left out for that",
    )
    controlnet_every: int = Field(
        default=1, gt=0, description="the ControlNet is evaluated at every k-th step, its residuals reused between"
    )
    noise: Literal["independent", "shared", "stretches"] = Field(
        default="independent",
        description="independent = each row's own seed; stretches = the first seed of each stretch of consecutive "
        "frames for all of it, so that they agree; shared = the first row's seed for all rows",
    )
    palette: Literal["rgb", "red_blue", "grey"] = Field(
        default="rgb",
        description="colours event images have: red_blue = no green, grey = channels averaged (no polarity)",
    )
    black_threshold: int = Field(
        default=20,
        ge=0,
        le=255,
        description="channel values below become 0: a decoder never gives the exact black of no event",
    )
    values: Literal["expected", "nearest", "drawn"] = Field(
        default="expected",
        description="expected = what the network gives; nearest = the nearest value that training frames have, such as "
        "that of a whole count; drawn = as their values scatter about what is expected. The latter two need a "
        "generator trained with values_at",
    )
    precision: Literal["float32", "bfloat16", "float16"] = Field(
        default="float32", description="of the networks; the state of the solver stays float32"
    )
    batch_size: int = Field(
        default=32,
        gt=0,
        json_schema_extra=RUN_SETTING,
        description="images in memory at a time; halved where memory runs out",
    )
    compile_networks: Compile = Field(
        default="auto",
        json_schema_extra=RUN_SETTING,
        description="torch.compile; takes minutes before the first image. auto = on a GPU, from 5,000 batches times "
        "steps",
    )
    device: str = Field(
        default="auto",
        json_schema_extra=RUN_SETTING,
        description="auto, cpu, cuda, cuda:1 ...; several, as in cuda:0,cuda:1, or all: one process for each",
    )

    @property
    def passes_a_step(self) -> int:
        """Of the networks, in a step with guidance."""
        return 1 + (self.guidance_scale > 1) + (self.autoguidance_scale > 1)

    @model_validator(mode="before")
    @classmethod
    def _take_the_spacing_of_the_solver(cls, values: Any) -> Any:
        if isinstance(values, dict) and "timestep_spacing" not in values:
            supported = SPACINGS.get(values.get("scheduler", ""), ("karras",))
            return {**values, "timestep_spacing": supported[0]}
        return values

    @model_validator(mode="after")
    def _check_spacing(self) -> Self:
        check_spacing(self.scheduler, self.timestep_spacing)
        return self

    @model_validator(mode="after")
    def _students_are_sampled_plainly(self) -> Self:
        if self.scheduler != OF_STUDENTS:
            return self
        if self.guidance_scale > 1:
            raise ValueError("scheduler tcd takes no guidance_scale: that of the teacher is distilled")
        if self.autoguidance_scale > 1:
            raise ValueError("scheduler tcd takes no autoguidance_scale: a student is not trained for it")
        if self.controlnet_every > 1:
            raise ValueError("scheduler tcd takes no controlnet_every: the few evaluations lie far apart")
        return self

    @field_validator("guidance_interval")
    @classmethod
    def _check_interval(cls, interval: tuple[float, float]) -> tuple[float, float]:
        if not 0 <= interval[0] <= interval[1] <= 1:
            raise ValueError(f"guidance_interval must be (low, high) with 0 <= low <= high <= 1, got {interval}")
        return interval

    @field_validator("device")
    @classmethod
    def _check_device(cls, device: str) -> str:
        if not _DEVICE.fullmatch(device):
            raise ValueError(f"device must be auto, all, or a list such as cpu or cuda:0,cuda:1; got {device!r}")
        return device


def check_spacing(scheduler: str, timestep_spacing: str) -> None:
    """Raise unless the solver supports the spacing.

    Raises:
        ValueError: it does not, or there is no such solver.
    """
    if scheduler not in SPACINGS:
        raise ValueError(f"unknown scheduler {scheduler!r}; known: {', '.join(SPACINGS)}")
    if timestep_spacing not in SPACINGS[scheduler]:
        raise ValueError(
            f"scheduler {scheduler!r} does not support timestep_spacing {timestep_spacing!r}; "
            f"it supports {', '.join(SPACINGS[scheduler])}"
        )


def noise_seeds(seeds: Sequence[int], options: SamplingOptions, lengths: Sequence[int] | None = None) -> list[int]:
    """The seeds that noise is drawn from: the rows' own, or the first one of all rows or of each stretch.

    A frame depends on its condition and on this seed alone: sampled again by itself with this seed, a row of a call
    with shared noise is the same. Without the `lengths` of stretches, which together are all rows, each row is one.
    """
    own = [int(seed) for seed in seeds]
    if options.noise == "shared":
        return own[:1] * len(own)
    if options.noise == "independent" or lengths is None:
        return own
    starts = itertools.accumulate(lengths, initial=0)
    return [own[start] for start, length in zip(starts, lengths, strict=False) for _ in range(length)]
