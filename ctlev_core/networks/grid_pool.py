"""Means of a feature map over the cells of a grid."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn


class GridPool(nn.AdaptiveAvgPool2d):
    """`AdaptiveAvgPool2d`, whose gradient a GPU adds up in no fixed order, in a way that is the same each time there.

    Where cells are not all of one size, a GPU does as torch does.
    """

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """Means [N, C, rows, columns] of [N, C, H, W]."""
        size: Any = self.output_size
        rows, columns = (size, size) if isinstance(size, int) else size
        height, width = input.shape[-2:]
        if input.device.type != "cuda" or not rows or not columns or height % rows or width % columns:
            return super().forward(input)
        return nn.functional.avg_pool2d(input, (height // rows, width // columns))
