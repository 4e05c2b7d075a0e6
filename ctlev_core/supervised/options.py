"""Budget and step sizes that all downstream models share. Imports nothing heavy."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from data_contracts.config import ADDED_LATER, RUN_SETTING, Frozen


class SupervisedOptions(Frozen):
    """How long and how fast to train: linear warm-up to the peak learning rate, then a linear fall to nearly zero."""

    num_steps: int = Field(default=600, ge=1, description="optimiser steps; the paper does not state them")
    batch_size: int = Field(default=32, ge=1, description="images a step")
    mixing: float | None = Field(
        default=None,
        gt=0,
        lt=1,
        description="share of each batch that comes from the first of several training sets (recorded + synthetic: the "
        "recorded one); null = all rows alike",
    )
    learning_rate: float = Field(default=1e-3, gt=0, description="peak of AdamW's learning rate")
    warmup_steps: int = Field(default=40, ge=0, description="steps to the peak")
    weight_decay: float = Field(default=1e-2, ge=0, description="of AdamW, on every parameter")
    precision: Literal["float32", "bfloat16"] = Field(
        default="float32", description="of the network's forward pass; weights and losses stay float32"
    )
    channels_last: bool = Field(
        default=False,
        description="keep the channels of a pixel side by side in training: the pose network is about 1.3 times as "
        "fast on a CPU; sums are rounded in another order",
    )
    validation_share: float = Field(
        default=0.0,
        ge=0,
        le=0.5,
        description="share of the first training set to hold back, by whole subjects or recordings; the weights that "
        "are best on it are kept; 0 = none, and the last weights",
    )
    validation_every: int = Field(default=50, ge=1, description="steps between two looks at the rows held back")
    patience: int = Field(
        default=0, ge=0, description="stop after so many looks without a better one; 0 = always train num_steps"
    )
    log_every: int = Field(default=10, ge=1, description="steps a row of the loss history, the mean since the last row")
    checkpoint_every_s: float = Field(
        default=60.0, ge=0, json_schema_extra=RUN_SETTING, description="seconds between two saves of the training state"
    )
    device: str = Field(
        default="auto", description="torch device; auto = CUDA where present", json_schema_extra=RUN_SETTING
    )

    def batch_size_at(self, step: int) -> int:
        """Rows of a step's batch."""
        return self.batch_size

    @model_validator(mode="after")
    def _patience_needs_rows_held_back(self) -> Self:
        if self.patience and not self.validation_share:
            raise ValueError("patience needs a validation_share above 0: without rows held back nothing can get better")
        return self


class SequenceOptions(SupervisedOptions):
    """Of models that can look at several frames of a recording, one after another."""

    sequence_length: int = Field(
        default=1,
        ge=1,
        json_schema_extra=ADDED_LATER,
        description="frames of a recording, one after another, that a recurrent unit looks back over; batch_size then "
        "counts sequences; 1 = no such unit; Event-HPE: 8",
    )
    single_frame_share: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        json_schema_extra=ADDED_LATER,
        description="share of the steps, the first ones, that learn from single frames before sequences are looked at; "
        "a batch then has sequence_length times as many, which are less alike than those of sequences",
    )

    def batch_size_at(self, step: int) -> int:
        """Rows of a step's batch: more than `batch_size` are single frames."""
        is_single = step < round(self.single_frame_share * self.num_steps)
        return self.batch_size * (self.sequence_length if is_single else 1)
