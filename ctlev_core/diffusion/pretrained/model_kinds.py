"""What kind of network a base model denoises with, told by its config. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

TRANSFORMER = "SD3Transformer2DModel"
FLOW_SCHEDULER = "FlowMatchEulerDiscreteScheduler"


def is_transformer(network: Any) -> bool:
    """Is it Stable Diffusion 3's, whose parts and calls are other than a U-Net's?"""
    config = getattr(network, "config", None)
    return config is not None and "joint_attention_dim" in config


def is_flow(scheduler_config: Mapping[str, Any]) -> bool:
    """Was it trained with flow matching?"""
    return scheduler_config.get("_class_name") == FLOW_SCHEDULER
