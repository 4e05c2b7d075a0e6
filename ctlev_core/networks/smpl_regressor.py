"""From images to SMPL bodies: a residual network, a recurrent unit over time if wanted, and a head.

Source: Kanazawa et al., HMR, CVPR 2018 (regression of SMPL from pooled features); Zhou et al., CVPR 2019 (6D
rotations); Cho et al., EMNLP 2014 (the gated recurrent unit); Event-HPE (Zou et al., ICCV 2021), whose network this is
without its optical flow. Event-HPE is told the body before the first frame and predicts how it goes on; here each
body is predicted whole, for nobody tells it what to start from.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import nn
from torch.nn.utils.rnn import pad_sequence

from ctlev_core.body.torch_rotations import matrix_from_rotation_6d, rotation_6d_from_matrix
from ctlev_core.networks.grid_pool import GridPool
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
        shape: as in `ctlev_core.networks.resnet_files.ARCHITECTURES`.
        grid: the last feature map is averaged over grid x grid cells; 1 is the usual global mean, which forgets where
            in the image a body is.
        head_width: hidden units of the head; 0 makes it linear.
        recurrent: add what a gated recurrent unit as wide as the features makes of them and of earlier ones, starting
            from zero, as Event-HPE does.
    """

    def __init__(self, shape: dict[str, Any], grid: int, head_width: int, recurrent: bool = False) -> None:
        super().__init__()
        self.network = ResNetClassifier(shape, num_classes=1, head_width=0)
        self.network.head = nn.Identity()
        features = shape["hidden_sizes"][-1] * grid**2
        self.pool = GridPool(grid)
        hidden = [nn.Linear(features, head_width), nn.ReLU()] if head_width else []
        self.head = nn.Sequential(*hidden, nn.Linear(head_width or features, NUM_OUTPUTS))
        self.recurrent = nn.GRU(features, features, batch_first=True) if recurrent else None
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

    def features(self, images: torch.Tensor) -> torch.Tensor:
        """Features [N, F] of images, each by itself."""
        backbone = self.network.backbone
        maps = backbone((images - self.network.mean) / self.network.std).last_hidden_state
        return self.pool(maps).flatten(1)

    def over_time(self, features: torch.Tensor, lengths: torch.Tensor) -> torch.Tensor:
        """Features that know the earlier ones of their sequence.

        Args:
            features: [M, F] of S sequences, one after the other.
            lengths: [S] of the sequences, at least 1 each.
        Returns:
            [M, F]; the features themselves without a recurrent unit.
        """
        if self.recurrent is None:
            return features
        # What fills short sequences up comes after their end, and the unit never looks ahead.
        sequences = pad_sequence(list(features.split(lengths.tolist())), batch_first=True)
        states, _ = self.recurrent(sequences)
        present = torch.arange(sequences.shape[1], device=features.device) < lengths.to(features.device)[:, None]
        return features + states[present]

    def bodies(self, features: torch.Tensor) -> SmplBodies:
        """Bodies of features [N, F]."""
        values = self.mean + self.head(features)
        rotations, betas, transl = values.split([6 * NUM_JOINTS, NUM_BETAS, 3], dim=1)
        return SmplBodies(matrix_from_rotation_6d(rotations.reshape(-1, NUM_JOINTS, 6)), betas, transl)

    def forward(self, images: torch.Tensor, lengths: torch.Tensor) -> SmplBodies:
        """Bodies of the images of S sequences, one after the other, of the lengths [S]."""
        return self.bodies(self.over_time(self.features(images), lengths))
