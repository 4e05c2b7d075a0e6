"""What of a ControlNet's work need not be done at every step of a trajectory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from ctlev_core.diffusion.pretrained.model_kinds import is_transformer


class _CachedEmbedding(torch.nn.Module):
    """Stands in for a ControlNet's condition embedding, whose output does not depend on the time step.

    Conditions that come twice, as with classifier-free guidance, get its value twice.
    """

    def __init__(self, value: Tensor) -> None:
        super().__init__()
        self.value = value

    def forward(self, conditioning: Tensor) -> Tensor:
        times = len(conditioning) // len(self.value)
        return self.value if times == 1 else self.value.repeat(times, 1, 1, 1)


@contextmanager
def cached_condition_embedding(controlnet: Any | None, conditions: Tensor | None) -> Iterator[None]:
    """Within the context the condition embedding is computed once; exact, and most of a tiny ControlNet's time.

    Red and blue are exchanged where the ControlNet's config asks for it: its own forward pass does so with what it is
    handed, which is too late for what is computed here. Transformers take latents, and have no such embedding.
    """
    if controlnet is None or conditions is None or is_transformer(controlnet):
        yield
        return
    original = controlnet.controlnet_cond_embedding
    if getattr(controlnet.config, "controlnet_conditioning_channel_order", "rgb") == "bgr":
        conditions = conditions.flip(1)
    controlnet.controlnet_cond_embedding = _CachedEmbedding(original(conditions))
    try:
        yield
    finally:
        controlnet.controlnet_cond_embedding = original


class EveryKthStep:
    """Stands in for a ControlNet, of whose calls it makes every k-th; between them the last residuals serve again.

    Source: Li et al., Faster Diffusion, 2023: features of the encoder, which a ControlNet copies, hardly change from
    one step to the next. Approximate; with k = 1 exact. Another number of rows, where guidance begins or ends, makes
    a call that counts as the first.
    """

    def __init__(self, network: Any, k: int) -> None:
        self._network, self._k, self._calls, self._num_rows = network, k, 0, 0
        self._residuals: Any = None
        self.config = network.config

    def __call__(self, noisy: Tensor, *arguments: Any, **named: Any) -> Any:
        """As the ControlNet's call: the residuals of the down blocks and of the middle one."""
        if len(noisy) != self._num_rows:
            self._calls, self._num_rows = 0, len(noisy)
        if self._calls % self._k == 0:
            self._residuals = self._network(noisy, *arguments, **named)
        self._calls += 1
        return self._residuals
