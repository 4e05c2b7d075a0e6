"""Where a generator loses realism: recorded frames are sent through its parts, one after another."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from data_contracts.config import Frozen
from data_contracts.experiment import Experiment

LinkKind = Literal["autoencoder", "values", "counts", "denoised", "sampled"]


class Link(Frozen):
    """What frames go through: one row of the table."""

    kind: LinkKind
    amount: int = Field(
        default=0, ge=0, description="time step that is denoised from, or steps of sampling; 0 = neither"
    )
    max_evaluations: int = Field(default=0, ge=0, description="of the network on the way back from a time step")


class ChainOptions(Frozen):
    """Which frames, how far they are noised, and in how many steps others are sampled.

    Frames of split `test` are held out, or with `evaluate_on: validation` those of validation: the network has not
    learnt them by heart.
    """

    split: Literal["train", "test"] = Field(default="test", description="of the recorded frames that are sent through")
    num_frames: int = Field(default=500, ge=2, description="so many of a larger split, chosen by `seed`")
    time_steps: tuple[int, ...] = Field(
        default=(20, 50, 100, 200, 400, 700), description="of the noise that recorded frames get and are denoised from"
    )
    max_evaluations: int = Field(default=50, ge=2, description="of the network on the way back from a time step")
    num_inference_steps: tuple[int, ...] = Field(default=(20, 100, 1000), description="of whole sampling, one row each")
    seed: int = Field(default=0, ge=0, description="of the choice of frames, and of all noise")

    @field_validator("time_steps", "num_inference_steps")
    @classmethod
    def _are_different(cls, numbers: tuple[int, ...]) -> tuple[int, ...]:
        if any(not 0 <= number <= 1000 for number in numbers) or len(set(numbers)) < len(numbers):
            raise ValueError(f"expected different numbers of 0 to 1000, got {list(numbers)}")
        return tuple(sorted(numbers))


class RealismChain(Experiment):
    """An experiment, and how its generator is taken apart."""

    chain: ChainOptions = ChainOptions()

    @property
    def links(self) -> list[Link]:
        """The rows of the table below that of the recorded frames, in order."""
        options = self.chain
        return [
            Link(kind="autoencoder"),
            Link(kind="values"),
            *([Link(kind="counts")] if self.stochastic_rounding or self.pixel_decoder is not None else []),
            *(
                Link(kind="denoised", amount=step, max_evaluations=options.max_evaluations)
                for step in options.time_steps
            ),
            *(Link(kind="sampled", amount=steps) for steps in options.num_inference_steps),
        ]
