"""A network made worse, which another is guided away from.

Where a network and a worse one disagree, the better one is right more often than not, and goes farther in its
direction. The worse one is the same network without some of its attention blocks: it costs no training and no memory.

Source: Karras et al., Guiding a Diffusion Model with a Bad Version of Itself, NeurIPS 2024, eq. 3, whose worse network
is a smaller one or one of less training; blocks are left out as in diffusers' `AutoGuidance` with a dropout of 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from torch import nn

from ctlev_core.diffusion.pretrained.model_kinds import is_transformer
from data_contracts.errors import DataError


def attention_blocks(unet: Any, layers: str) -> list[nn.Module]:
    """The attention blocks of the middle of a U-Net, or all.

    Args:
        unet: a `UNet2DConditionModel`.
        layers: `middle` or `all`.
    Raises:
        DataError: it has none there.
    """
    from diffusers.models.attention import BasicTransformerBlock

    if is_transformer(unet):
        raise DataError("autoguidance_scale is made for U-Nets; this base model is a transformer: leave it at 1")
    part = unet.mid_block if layers == "middle" else unet
    found: list[nn.Module] = [module for module in part.modules() if isinstance(module, BasicTransformerBlock)]
    if not found:
        raise DataError(f"autoguidance_layers {layers!r}: this U-Net has no attention blocks there")
    return found


@contextmanager
def without_blocks(blocks: list[nn.Module]) -> Iterator[None]:
    """Within the context blocks hand on what they are given."""
    with ExitStack() as stack:
        for block in blocks:
            handle = block.register_forward_hook(_given, with_kwargs=True)
            stack.callback(handle.remove)
        # What was compiled knows nothing of hooks.
        stack.enter_context(torch.compiler.set_stance("force_eager"))
        yield


def _given(module: nn.Module, arguments: tuple[Any, ...], named: dict[str, Any], made: Any) -> Any:
    return arguments[0] if arguments else named["hidden_states"]
