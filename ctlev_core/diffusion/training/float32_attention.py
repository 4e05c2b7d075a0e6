"""Attention in float32 within networks that train in bfloat16 on a CPU.

There torch's backward pass of attention takes ten times as long in bfloat16 as in float32: a tenth of a step of the
small base model. The products before and after it are too small to be faster in bfloat16, and are spared the casts.
"""

from __future__ import annotations

from typing import Any

import torch
from diffusers.models.attention_processor import Attention, AttnProcessor2_0
from torch import Tensor


class Float32Attention(AttnProcessor2_0):
    """diffusers' own attention, whatever precision the context asks for."""

    def __call__(
        self,
        attn: Attention,
        hidden_states: Tensor,
        encoder_hidden_states: Tensor | None = None,
        attention_mask: Tensor | None = None,
        temb: Tensor | None = None,
    ) -> Tensor:
        """States [B, N, D] or [B, D, H, W] come in any precision and go on in float32."""
        with torch.autocast("cpu", enabled=False):
            context = None if encoder_hidden_states is None else encoder_hidden_states.float()
            return super().__call__(attn, hidden_states.float(), context, attention_mask, temb)


def use_float32_attention(network: Any) -> None:
    """Let a U-Net or ControlNet attend so wherever it attends in diffusers' usual way."""
    processors = network.attn_processors.items()
    usual = {name for name, processor in processors if type(processor) is AttnProcessor2_0}
    network.set_attn_processor({name: Float32Attention() if name in usual else each for name, each in processors})
