"""Options of sampling that both diffusion generators share. Imports nothing heavy."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from data_contracts.config import RUN_SETTING, Frozen


class SamplingOptions(Frozen):
    """How frames are drawn from a checkpoint."""

    scheduler: Literal["unipc", "dpm++", "ddim", "ddpm"] = Field(
        default="unipc", description="solver; the paper's is ddpm with 1000 steps, unipc (Karras) matches it in 20"
    )
    num_inference_steps: int = Field(
        default=20, gt=0, le=1000, description="evaluations of the network an image; paper: 1000"
    )
    guidance_scale: float = Field(default=1.0, ge=1, description="classifier-free guidance; 1 = none, twice as fast")
    palette: Literal["rgb", "red_blue", "grey"] = Field(
        default="rgb",
        description="colours event images have: red_blue = no green, grey = channels averaged (no polarity)",
    )
    dark_level: int = Field(
        default=20,
        ge=0,
        le=255,
        description="channel values below become 0: a decoder never gives the exact black of no event",
    )
    precision: Literal["float32", "bfloat16"] = Field(
        default="float32", description="of the networks; the state of the solver stays float32"
    )
    batch_size: int = Field(default=32, gt=0, json_schema_extra=RUN_SETTING, description="images in memory at a time")
    device: str = Field(default="auto", json_schema_extra=RUN_SETTING, description="auto, cpu, cuda, cuda:1 ...")
