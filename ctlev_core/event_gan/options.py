"""Options of Event-GAN. Imports nothing heavy.

"Published" is what the authors' released code does by default with the commands of its README; their training ran for
100 epochs of MVSEC and recordings of their own on GPUs.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from data_contracts.config import RUN_SETTING, Frozen


class TrainingOptions(Frozen):
    """Networks, losses and budget. The default 1,000 steps take six minutes on one core at 64 x 64 px."""

    base_channels: int = Field(
        default=16, ge=1, description="channels of the U-Net at full resolution, doubled per encoder; published: 32"
    )
    num_encoders: int = Field(default=4, ge=1, le=7, description="halvings of the resolution in the U-Net; published")
    num_residual_blocks: int = Field(default=2, ge=0, description="at the bottleneck; published")
    norm: Literal["batch", "instance"] = Field(
        default="batch", description="normalisation in the U-Net; published: batch, its statistics fixed for sampling"
    )
    generator_spectral_norm: bool = Field(
        default=True, description="spectral norm in residual blocks and decoders, as published"
    )
    discriminator_channels: int = Field(
        default=32, ge=1, description="channels of the discriminator's first layer; published: 64"
    )
    discriminator_layers: int = Field(
        default=2,
        ge=1,
        le=5,
        description="strided layers of the discriminator: 2 judge patches of 34 px, 3 of 70, 4 of 142; published: 4 at "
        "256 x 320 px, patches of half the height, as here at 64 px",
    )
    discriminator_spectral_norm: bool = Field(
        default=True,
        description="spectral norm in the discriminator, usual with the hinge loss; the released code: none",
    )
    reconstruction_weight: float = Field(
        default=10.0,
        ge=0,
        description="of the mean absolute difference to the real event images; published: cycle losses in its place. "
        "With neither, the adversary needs far more steps to teach where the events are",
    )
    label_flip: float = Field(
        default=0.1, ge=0, lt=0.5, description="share of patches the discriminator sees as the other kind; published"
    )
    num_steps: int = Field(default=1000, ge=1, description="steps of the generator; published: 100 epochs")
    discriminator_steps: int = Field(
        default=2,
        ge=1,
        description="steps of the discriminator per step of the generator, each on a batch of its own; published",
    )
    batch_size: int = Field(
        default=8, ge=2, description="pairs a step; the discriminator sees half as generated, half as real; published"
    )
    generator_learning_rate: float = Field(
        default=1e-3, gt=0, description="of RAdam with beta_1 = 0; published: 2e-4, for a far longer training"
    )
    discriminator_learning_rate: float = Field(
        default=1e-3,
        gt=0,
        description="of RAdam with beta_1 = 0; published: 5e-5, at which a discriminator with spectral norm stays "
        "undecided for hundreds of steps",
    )
    beta2: float = Field(
        default=0.99,
        gt=0,
        lt=1,
        description="RAdam's decay of squared gradients; published: 0.999, which warms up over the first 1,000 steps",
    )
    flip: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="share mirrored in x, and independently in y, pair and events alike; published",
    )
    appearance: float = Field(
        default=0.2,
        ge=0,
        lt=1,
        description="gain and gamma of the generator's pair are drawn from 1 +- this; published",
    )
    ema_decay: float = Field(
        default=0.99,
        ge=0,
        lt=1,
        description="of the averaged generator that is kept; 0 = the last weights, as published",
    )
    validation_fraction: float = Field(
        default=0.1,
        ge=0,
        lt=1,
        description="share of the training pairs, at most 128, held back to choose a checkpoint; 0 = the last is kept",
    )
    validation_every: int = Field(default=100, ge=1, description="steps between two checkpoints to choose from")
    log_every: int = Field(default=20, ge=1, description="steps a row of the loss history, the mean since the last row")
    checkpoint_every_s: float = Field(
        default=60.0, gt=0, json_schema_extra=RUN_SETTING, description="seconds between two saves of the training state"
    )
    device: str = Field(default="auto", json_schema_extra=RUN_SETTING, description="auto, cpu, cuda, cuda:1 ...")


class SamplingOptions(Frozen):
    """How the network's real-valued output becomes a sparse event image."""

    rounding: Literal["threshold", "stochastic", "none"] = Field(
        default="threshold",
        description="threshold: values below `threshold` become no event; stochastic: a value below one event's "
        "becomes one event with the probability that keeps the mean, drawn from the seed; none: values as published",
    )
    threshold: float = Field(
        default=0.5, ge=0, description="in events: 0.5 rounds what is nearer to no event than to one"
    )
    device: str = Field(default="auto", json_schema_extra=RUN_SETTING, description="auto, cpu, cuda, cuda:1 ...")
