"""From an image to an SMPL body: a residual network, and one linear step from its features to the parameters.

Source: Kanazawa et al., HMR, CVPR 2018 (regression of SMPL from pooled features); Zhou et al., CVPR 2019 (6D
rotations); Event-HPE (Zou et al., ICCV 2021), whose network this is without its recurrent unit and optical flow.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import nn

from ctlev_core.body.torch_rotations import matrix_from_rotation_6d, rotation_6d_from_matrix
from ctlev_core.networks.resnet import ResNetClassifier

NUM_JOINTS, NUM_BETAS = 24, 10
NUM_OUTPUTS = 6 * NUM_JOINTS + NUM_BETAS + 3


class SmplBodies(NamedTuple):
    """N bodies: rotations [N, 24, 3, 3] relative to the parent, betas [N, 10], transl [N, 3] m, camera frame."""

    rotations: torch.Tensor
    betas: torch.Tensor
    transl: torch.Tensor


class SmplRegressor(nn.Module):
    """Images [N, 3, H, W] in [0, 1] to SMPL bodies in the camera frame.

    Args:
        shape: `depths`, `hidden_sizes`, `embedding_size` as in `ctlev_core.networks.resnet_files.ARCHITECTURES`.
        grid: the last feature map is averaged over grid x grid cells; 1 is the usual global mean, which forgets where
            in the image a body is.
        head_width: hidden units of the head; 0 makes it linear.
    """

    def __init__(self, shape: dict[str, Any], grid: int, head_width: int) -> None:
        super().__init__()
        self.network = ResNetClassifier(shape, num_classes=1, head_width=0)
        self.network.head = nn.Identity()
        features = shape["hidden_sizes"][-1] * grid**2
        self.pool = nn.AdaptiveAvgPool2d(grid)
        hidden = [nn.Linear(features, head_width), nn.ReLU()] if head_width else []
        self.head = nn.Sequential(*hidden, nn.Linear(head_width or features, NUM_OUTPUTS))
        self.mean: torch.Tensor
        self.register_buffer("mean", torch.zeros(NUM_OUTPUTS))

    @torch.no_grad()
    def start_from(self, rotations: torch.Tensor, betas: torch.Tensor, transl: torch.Tensor) -> None:
        """Let the untrained network predict the mean of the training bodies; arguments as in `SmplBodies`."""
        mean = rotation_6d_from_matrix(rotations).mean(dim=0).flatten()
        self.mean.copy_(torch.cat([mean, betas.mean(dim=0), transl.mean(dim=0)]))
        last = self.head[-1]
        assert isinstance(last, nn.Linear)
        last.weight.mul_(0.1)
        last.bias.zero_()

    def forward(self, images: torch.Tensor) -> SmplBodies:
        """Bodies of images."""
        backbone = self.network.backbone
        maps = backbone((images - self.network.mean) / self.network.std).last_hidden_state
        values = self.mean + self.head(self.pool(maps).flatten(1))
        rotations, betas, transl = values.split([6 * NUM_JOINTS, NUM_BETAS, 3], dim=1)
        return SmplBodies(matrix_from_rotation_6d(rotations.reshape(-1, NUM_JOINTS, 6)), betas, transl)
