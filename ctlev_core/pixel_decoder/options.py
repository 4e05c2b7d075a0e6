"""Options of the pixel decoder. Imports nothing heavy."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from data_contracts.config import ADDED_LATER, RUN_SETTING, Frozen

DECODER_FOLDER = "decoder"
"""In the artefact of a trained decoder."""


class PixelDecoderOptions(Frozen):
    """How the pixel decoder is trained, and how it draws."""

    num_steps: int = Field(default=600, ge=1, description="optimiser steps")
    batch_size: int = Field(default=16, ge=1, description="crops a step")
    crop_px: int = Field(
        default=64, ge=8, multiple_of=2, description="edge of the square crops that are learnt from; at most the image"
    )
    learning_rate: float = Field(
        default=5e-4, gt=0, description="peak for vectors; Muon takes 20 times as much for matrices"
    )
    width: int = Field(default=64, ge=16, multiple_of=8, description="channels of the network at half the resolution")
    depth: int = Field(default=5, ge=1, description="residual blocks")
    time_steps: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        default=(300, 500, 700),
        min_length=1,
        description="training frames are noised to each of these time steps of the generator's schedule and denoised, "
        "which gives images that are as smooth as sampled ones but show the frame whose counts are known",
    )
    evaluations: int = Field(default=8, ge=2, description="of the generator's network on the way back")
    max_frames: int = Field(default=1000, ge=1, description="training frames, evenly chosen where there are more")
    num_passes: int = Field(
        default=4, ge=1, description="of the network when counts are drawn; 1 draws every pixel by itself"
    )
    previous_frame: bool = Field(
        default=False,
        json_schema_extra=ADDED_LATER,
        description="the decoder also sees what it drew for the frame before, as it learnt from consecutive recorded "
        "frames; of stretches of frames that are made together, elsewhere it changes nothing",
    )
    moving_noise: bool = Field(
        default=False,
        json_schema_extra=ADDED_LATER,
        description="of stretches, with `previous_frame`: where the picture moves, the noise that values are drawn "
        "from moves along with it, so that they move with an edge in place of being drawn anew along it",
    )
    precision: Literal["float32", "bfloat16"] = Field(
        default="bfloat16", description="of the convolutions; weights, probabilities and losses stay float32"
    )
    log_every: int = Field(default=20, ge=1, description="steps between two points of the loss curve")
    validation_every: int = Field(default=200, ge=1, description="steps between two points of the validation curve")
    checkpoint_every_s: float = Field(
        default=60.0, gt=0, json_schema_extra=RUN_SETTING, description="seconds between two saves of the training state"
    )
    device: str = Field(
        default="auto", json_schema_extra=RUN_SETTING, description="torch device; auto = CUDA where present"
    )

    @property
    def of_training(self) -> PixelDecoderOptions:
        """What the trained decoder depends on: not how it will draw."""
        drawing = ("num_passes", "moving_noise")
        return self.model_copy(update={name: PixelDecoderOptions.model_fields[name].default for name in drawing})

    @model_validator(mode="after")
    def _moves_in_stretches(self) -> PixelDecoderOptions:
        if self.moving_noise and not self.previous_frame:
            raise ValueError("moving_noise needs previous_frame: true; only such a decoder knows what follows what")
        return self
