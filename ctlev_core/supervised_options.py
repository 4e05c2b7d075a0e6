"""Budget and step sizes that all downstream models share. Imports nothing heavy."""

from __future__ import annotations

from pydantic import Field

from data_contracts.config import RUN_SETTING, Frozen


class SupervisedOptions(Frozen):
    """How long and how fast to train: linear warm-up to the peak learning rate, then a linear fall to nearly zero."""

    num_steps: int = Field(default=600, ge=1, description="optimiser steps; the paper does not state them")
    batch_size: int = Field(default=32, ge=1, description="images a step")
    learning_rate: float = Field(default=1e-3, gt=0, description="peak of AdamW's learning rate")
    warmup_steps: int = Field(default=40, ge=0, description="steps to the peak")
    weight_decay: float = Field(default=1e-2, ge=0, description="of AdamW, on every parameter")
    log_every: int = Field(default=10, ge=1, description="steps a row of the loss history, the mean since the last row")
    checkpoint_every: int = Field(
        default=200, ge=1, description="steps between checkpoints", json_schema_extra=RUN_SETTING
    )
    device: str = Field(
        default="auto", description="torch device; auto = CUDA where present", json_schema_extra=RUN_SETTING
    )
