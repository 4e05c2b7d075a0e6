"""Residual image classifiers, built from the implementation in transformers.

Source: He et al., Deep Residual Learning for Image Recognition, CVPR 2016.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import nn

from data_contracts.errors import DataError

# Name -> blocks per stage, channels per stage, channels of the first convolution; basic (two-convolution) blocks.
ARCHITECTURES: dict[str, dict[str, Any]] = {
    "resnet10-quarter": {"depths": [1, 1, 1, 1], "hidden_sizes": [16, 32, 64, 128], "embedding_size": 16},
    "resnet10-half": {"depths": [1, 1, 1, 1], "hidden_sizes": [32, 64, 128, 256], "embedding_size": 32},
    "resnet18": {"depths": [2, 2, 2, 2], "hidden_sizes": [64, 128, 256, 512], "embedding_size": 64},
    "resnet34": {"depths": [3, 4, 6, 3], "hidden_sizes": [64, 128, 256, 512], "embedding_size": 64},
}
# ImageNet's channel statistics, so that published ResNets see the input they were trained with.
CHANNEL_MEAN = (0.485, 0.456, 0.406)
CHANNEL_STD = (0.229, 0.224, 0.225)


class ResNetClassifier(nn.Module):
    """A ResNet without its own head, global average pooling, and a linear or one-hidden-layer head.

    Args:
        shape: `depths`, `hidden_sizes`, `embedding_size` as in `ARCHITECTURES`.
        num_classes: logits.
        head_width: hidden units of the head; 0 makes the head linear.
    """

    def __init__(self, shape: dict[str, Any], num_classes: int, head_width: int) -> None:
        from transformers import ResNetConfig, ResNetForImageClassification

        super().__init__()
        network = ResNetForImageClassification(
            ResNetConfig.from_dict({**shape, "layer_type": "basic", "num_labels": num_classes})
        )
        self.backbone = network.resnet
        self.head: nn.Module = network.classifier[1]
        if head_width:
            feature_count = shape["hidden_sizes"][-1]
            self.head = nn.Sequential(
                nn.Linear(feature_count, head_width), nn.ReLU(), nn.Linear(head_width, num_classes)
            )
        self.mean: torch.Tensor
        self.std: torch.Tensor
        self.register_buffer("mean", torch.tensor(CHANNEL_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(CHANNEL_STD).view(1, 3, 1, 1), persistent=False)

    def features(self, images: torch.Tensor) -> torch.Tensor:
        """Pooled features [N, D] of images [N, 3, H, W] in [0, 1]."""
        return self.backbone((images - self.mean) / self.std).pooler_output.flatten(1)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Logits [N, num_classes] of images [N, 3, H, W] in [0, 1]."""
        return self.head(self.features(images))


def load_backbone(network: ResNetClassifier, folder: Path) -> None:
    """Take over the weights of a ResNet saved by transformers; its own classification head is not used.

    Raises:
        DataError: the folder holds no ResNet, or one of another shape.
    """
    from transformers import ResNetConfig, ResNetModel

    if not (folder / "config.json").is_file():
        raise DataError(f"pretrained ResNet {folder}: expected a folder with config.json, found none")
    config = ResNetConfig.from_pretrained(folder, local_files_only=True)
    expected = network.backbone.config
    for name in ("layer_type", "depths", "hidden_sizes", "embedding_size"):
        if getattr(config, name) != getattr(expected, name):
            raise DataError(
                f"pretrained ResNet {folder}: expected {name} {getattr(expected, name)}, got {getattr(config, name)}"
            )
    network.backbone.load_state_dict(ResNetModel.from_pretrained(folder, local_files_only=True).state_dict())
