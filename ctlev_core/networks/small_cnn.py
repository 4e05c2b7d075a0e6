"""A small convolutional classifier for images of some 32 px, whose last feature map a ResNet would shrink to one pixel.

Three times convolution, batch normalisation, ReLU and a maximum over 2 x 2 px, then one more convolution, a mean over
quarters of the image, dropout and a linear head: what one writes first for MNIST or CIFAR.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from ctlev_core.networks.grid_pool import GridPool

QUARTERS = 2
"""Rows and columns of the last feature map that the head sees."""


class SmallCNN(nn.Module):
    """See the head of this file.

    Args:
        shape: `widths`, the channels of the four convolutions, and `dropout`, a share.
        num_classes: logits.
        head_width: hidden units of the head; 0 makes the head linear.
    """

    def __init__(self, shape: dict[str, Any], num_classes: int, head_width: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for number, width in enumerate(shape["widths"]):
            layers += [nn.Conv2d(channels, width, 3, padding=1, bias=False), nn.BatchNorm2d(width), nn.ReLU()]
            layers += [nn.MaxPool2d(2)] if number < len(shape["widths"]) - 1 else [GridPool(QUARTERS)]
            channels = width
        self.backbone = nn.Sequential(*layers, nn.Flatten())
        count = num_features(shape)
        head: nn.Module = nn.Linear(count, num_classes)
        if head_width:
            head = nn.Sequential(nn.Linear(count, head_width), nn.ReLU(), nn.Linear(head_width, num_classes))
        self.head = nn.Sequential(nn.Dropout(shape["dropout"]), head)

    def features(self, images: torch.Tensor) -> torch.Tensor:
        """Features [N, D] of images [N, 3, H, W] in [0, 1], H and W at least 8 px."""
        return self.backbone(images)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Logits [N, num_classes] of images [N, 3, H, W] in [0, 1]."""
        return self.head(self.features(images))


def num_features(shape: dict[str, Any]) -> int:
    """D of `features`."""
    return shape["widths"][-1] * QUARTERS**2
