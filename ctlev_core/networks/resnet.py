"""Residual image classifiers, built from the implementation in transformers.

Source: He et al., Deep Residual Learning for Image Recognition, CVPR 2016.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import nn

from ctlev_core.networks.resnet_files import WEIGHTS_NAME
from data_contracts.errors import DataError

# ImageNet's channel statistics, so that published ResNets see the input they were trained with.
CHANNEL_MEAN = (0.485, 0.456, 0.406)
CHANNEL_STD = (0.229, 0.224, 0.225)


class ResNetClassifier(nn.Module):
    """A ResNet without its own head, global average pooling, and a linear or one-hidden-layer head.

    Args:
        shape: `depths`, `hidden_sizes`, `embedding_size` and, unless basic, `layer_type`, as in
            `ctlev_core.networks.resnet_files.ARCHITECTURES`.
        num_classes: logits.
        head_width: hidden units of the head; 0 makes the head linear.
    """

    def __init__(self, shape: dict[str, Any], num_classes: int, head_width: int) -> None:
        from transformers import ResNetConfig, ResNetForImageClassification

        super().__init__()
        network = ResNetForImageClassification(
            ResNetConfig.from_dict({"layer_type": "basic", **shape, "num_labels": num_classes})
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
    """Take over the weights of a ResNet saved by transformers; a classification head, if there, is not used.

    Args:
        network: what to put them into.
        folder: as `ctlev_core.networks.resnet_files.check_resnet_folder` accepts it.
    Raises:
        DataError: the file cannot be read, or lacks a tensor of the network, or has one of another shape.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    path = folder / WEIGHTS_NAME
    try:
        saved = load_file(path)
    except (OSError, SafetensorError) as error:
        raise DataError(f"{path}: cannot be read as safetensors: {error}") from error
    saved = {name.removeprefix("resnet."): tensor for name, tensor in saved.items()}
    expected = network.backbone.state_dict()
    # Files written before PyTorch 0.4.1 do not count batches; the count changes nothing.
    missing = [name for name in expected if name not in saved and not name.endswith("num_batches_tracked")]
    if missing:
        raise DataError(f"{path}: lacks {len(missing)} of {len(expected)} tensors, the first {missing[0]}")
    found = expected | {name: saved[name] for name in expected if name in saved}
    for name, tensor in found.items():
        wanted = expected[name].shape
        if tensor.shape != wanted:
            raise DataError(
                f"{path}: {name} must be of shape {list(wanted)}, got {list(tensor.shape)}; "
                "is it of another architecture than its config.json says?"
            )
        if not torch.isfinite(tensor).all():
            raise DataError(f"{path}: {name} has values that are not finite")
    network.backbone.load_state_dict(found)
