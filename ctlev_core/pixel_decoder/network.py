"""The network of the pixel decoder, and the noise that it takes pixel values out of.

    noisy values, sampled image, condition image, noise level, values of the frame before
    -> half the resolution: residual blocks, which see some 40 px around
    -> full resolution: two convolutions beside the inputs themselves
    -> for each pixel and plane (polarity, or colour) a logit a class of values

To the logits is added what the noisy value of a pixel says about its own value, the logarithm of a Gaussian: with
hardly any noise left the values follow exactly, and the network only has to learn what the surroundings say.

Source: Dieleman et al., Continuous diffusion for categorical data, 2022: noise on embeddings, cross-entropy at all
noise levels. We add the Gaussian term, and draw whole classes between the passes in place of a mean (Austin et al.,
Structured denoising diffusion models in discrete state-spaces, NeurIPS 2021): the number of events then stays right
however few passes there are.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

MAX_NOISE, MIN_NOISE = 8.0, 0.2
"""First and last noise level of drawing, in steps from no event to the median of active pixels: all hidden, and hardly
anything."""
TRAINED_NOISE, TRAINED_SPREAD = 0.8, 1.0
"""Median of the noise levels that are trained, likewise, and standard deviation of their logarithm."""
_DETAIL = 24
_GROUPS = 8


class _ResidualBlock(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.first_norm, self.second_norm = nn.GroupNorm(_GROUPS, width), nn.GroupNorm(_GROUPS, width)
        self.first, self.second = (nn.Conv2d(width, width, 3, padding=1) for _ in range(2))
        with torch.no_grad():  # at first a block changes nothing
            for parameter in self.second.parameters():
                parameter.zero_()

    def forward(self, x: Tensor) -> Tensor:
        hidden = self.first(nn.functional.silu(self.first_norm(x)))
        return x + self.second(nn.functional.silu(self.second_norm(hidden)))


class PixelNetwork(nn.Module):
    """Logits of the classes of every pixel.

    Args:
        embeddings: [K] float32 of the classes, see `ValueClasses.embeddings`.
        num_planes: of an image, 1 to 3.
        condition_channels: of the condition image; 0 = there is none.
        width: channels at half the resolution.
        depth: residual blocks.
        sees_previous: whether it takes the values of the frame before.
    """

    embeddings: Tensor

    def __init__(
        self,
        embeddings: Tensor,
        num_planes: int,
        condition_channels: int,
        width: int,
        depth: int,
        sees_previous: bool = False,
    ) -> None:
        super().__init__()
        self.num_planes, self.sees_previous = num_planes, sees_previous
        self.register_buffer("embeddings", embeddings)
        inputs = 2 * num_planes + condition_channels + 1 + (num_planes + 1 if sees_previous else 0)
        self.first = nn.Conv2d(4 * inputs, width, 3, padding=1)
        self.blocks = nn.Sequential(*(_ResidualBlock(width) for _ in range(depth)))
        self.up = nn.Conv2d(width, 4 * _DETAIL, 1)
        self.detail = nn.Sequential(
            nn.Conv2d(_DETAIL + inputs, 2 * _DETAIL, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(2 * _DETAIL, 2 * _DETAIL, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(2 * _DETAIL, num_planes * len(embeddings), 1),
        )

    def forward(
        self,
        noisy: Tensor,
        noise_level: Tensor,
        images: Tensor,
        conditions: Tensor | None,
        previous: Tensor | None = None,
    ) -> Tensor:
        """Unnormalised log-probabilities.

        Args:
            noisy: [B, P, H, W] embeddings of the values with noise; H and W even.
            noise_level: [B] its standard deviation.
            images: [B, P, H, W] sampled images in [-1, 1].
            conditions: [B, C, H, W] in [0, 1], or None.
            previous: [B, P, H, W] int64 classes of the frame before, -1 where there is none, of a network that sees it.
        Returns:
            [B, P, K, H, W] float32.
        """
        level = noise_level[:, None, None, None]
        planes = [noisy / torch.sqrt(level**2 + 1), images]
        planes += [] if conditions is None else [conditions]
        if previous is not None:
            known = previous >= 0
            planes += [self.embeddings[previous.clamp(min=0)] * known, known[:, :1].to(noisy)]
        planes.append((level.log() / 2).expand(-1, 1, *noisy.shape[2:]))
        inputs = torch.cat(planes, dim=1).contiguous(memory_format=torch.channels_last)
        hidden = self.blocks(self.first(nn.functional.pixel_unshuffle(inputs, 2)))
        detail = nn.functional.pixel_shuffle(self.up(nn.functional.silu(hidden)), 2)
        logits = self.detail(torch.cat([detail, inputs.to(detail)], dim=1)).float()
        logits = logits.unflatten(1, (self.num_planes, len(self.embeddings)))
        distances = noisy.float()[:, :, None] - self.embeddings[:, None, None]
        return logits - distances.square() / (2 * level[:, None] ** 2)
