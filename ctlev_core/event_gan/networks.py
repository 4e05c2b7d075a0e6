"""The networks of Event-GAN: a U-Net from two intensity frames to an event volume, and a patch discriminator.

Source: Zhu et al., EventGAN: Leveraging Large Scale Image Datasets for Event Cameras, ICCP 2021, and the authors'
released code where the paper leaves a choice open. U-Net after Ronneberger et al., MICCAI 2015; PatchGAN after Isola
et al., CVPR 2017; spectral norm after Miyato et al., ICLR 2018.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate
from torch.nn.utils import parametrizations, parametrize

from ctlev_core.event_gan.options import TrainingOptions

NUM_FRAMES = 2
NORMS: dict[str, type[nn.Module]] = {"batch": nn.BatchNorm2d, "instance": nn.InstanceNorm2d}
# The authors draw first weights as if the slope of the leaky ReLU were 10, seven times smaller than usual.
INIT_SLOPE = 10.0


def _convolution(
    num_inputs: int, num_outputs: int, *, kernel: int = 3, stride: int = 1, norm: str = "", spectral: bool = False
) -> nn.Sequential:
    """Convolution, with spectral norm or without, and its normalisation layer; no activation."""
    layer = nn.Conv2d(num_inputs, num_outputs, kernel, stride, padding=kernel // 2, bias=norm != "batch")
    nn.init.kaiming_normal_(layer.weight, INIT_SLOPE)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    convolution = parametrizations.spectral_norm(layer) if spectral else layer
    return nn.Sequential(convolution, NORMS[norm](num_outputs)) if norm else nn.Sequential(convolution)


class RevivableReLU(torch.autograd.Function):
    """ReLU whose gradient also reaches values at or below 0 where it would raise them.

    Most pixels of an event image are 0. With plain ReLU a network of one or two output channels can die within a few
    steps of the absolute difference: no pixel is above 0, and none gets a gradient any more. The function is the same.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        """max(0, values)."""
        ctx.save_for_backward(values > 0)
        return values.clamp(min=0)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """The gradient where a value is positive or where descending on it makes the value grow."""
        (is_positive,) = ctx.saved_tensors
        return torch.where(is_positive | (gradient < 0), gradient, 0.0)


class ResidualBlock(nn.Module):
    """Two convolutions beside an identity; ReLU after each."""

    def __init__(self, num_channels: int, norm: str, spectral: bool) -> None:
        super().__init__()
        self.first = _convolution(num_channels, num_channels, norm=norm, spectral=spectral)
        self.second = _convolution(num_channels, num_channels, norm=norm, spectral=spectral)

    def forward(self, features: Tensor) -> Tensor:
        """[B, C, H, W] to the same shape."""
        return torch.relu(features + self.second(torch.relu(self.first(features))))


class EventVolumeUNet(nn.Module):
    """Two intensity frames to a non-negative event volume.

    The head keeps the resolution, each encoder halves it and doubles the channels, residual blocks follow; each decoder
    enlarges to the size of its skip connection (nearest neighbour), concatenates and convolves; a 1 x 1 convolution
    with ReLU (see `RevivableReLU`) predicts. Any image size works that leaves 2 px at the bottleneck.

    Args:
        num_volume_channels: channels of the volume, one a polarity. Published: 9 temporal bins a polarity.
        base_channels: of the head.
        num_encoders: halvings.
        num_residual_blocks: at the bottleneck.
        norm: a key of `NORMS`; none in head and prediction, as published.
        spectral_norm: in residual blocks and decoders, as published.
    """

    def __init__(
        self,
        num_volume_channels: int,
        *,
        base_channels: int,
        num_encoders: int,
        num_residual_blocks: int,
        norm: str,
        spectral_norm: bool,
    ) -> None:
        super().__init__()
        widths = [base_channels * 2**level for level in range(num_encoders + 1)]
        self.head = _convolution(NUM_FRAMES, base_channels)
        self.encoders = nn.ModuleList(
            _convolution(widths[level], widths[level + 1], stride=2, norm=norm) for level in range(num_encoders)
        )
        self.residual_blocks = nn.Sequential(
            *(ResidualBlock(widths[-1], norm, spectral_norm) for _ in range(num_residual_blocks))
        )
        self.decoders = nn.ModuleList(
            _convolution(widths[level + 1] + widths[level], widths[level], norm=norm, spectral=spectral_norm)
            for level in reversed(range(num_encoders))
        )
        self.prediction = _convolution(base_channels, num_volume_channels, kernel=1)

    def forward(self, pairs: Tensor) -> Tensor:
        """Volumes [B, C, H, W], at least 0, of pairs [B, 2, H, W] in [-1, 1]."""
        features = nn.functional.leaky_relu(self.head(pairs))
        skips = []
        for encoder in self.encoders:
            skips.append(features)
            features = nn.functional.leaky_relu(encoder(features))
        features = self.residual_blocks(features)
        for decoder, skip in zip(self.decoders, reversed(skips), strict=True):
            enlarged = interpolate(features, size=skip.shape[-2:], mode="nearest")
            features = nn.functional.leaky_relu(decoder(torch.cat([enlarged, skip], dim=1)))
        return RevivableReLU.apply(self.prediction(features))


class PatchDiscriminator(nn.Module):
    """One logit a patch of (event volume, intensity pair): positive = real.

    Args:
        num_volume_channels: channels of the volume.
        channels: of the first layer, doubled per layer up to eight times.
        num_layers: strided layers; two more of stride 1 follow. Patches are 34 px wide with 2, 70 with 3, 142 with 4.
        spectral_norm: in every layer; bounds each layer's gain by its number of overlapping taps.
    """

    def __init__(self, num_volume_channels: int, *, channels: int, num_layers: int, spectral_norm: bool) -> None:
        super().__init__()
        widths = [channels * min(2**level, 8) for level in range(num_layers + 1)]
        layers: list[nn.Module] = []
        for level, num_inputs in enumerate([num_volume_channels + NUM_FRAMES, *widths[:-1]]):
            layers += [nn.Conv2d(num_inputs, widths[level], 4, 2 if level < num_layers else 1, 1), nn.LeakyReLU(0.2)]
        layers.append(nn.Conv2d(widths[-1], 1, 4, 1, 1))
        if spectral_norm:
            layers = [
                parametrizations.spectral_norm(layer) if isinstance(layer, nn.Conv2d) else layer for layer in layers
            ]
        self.layers = nn.Sequential(*layers)

    def forward(self, volumes: Tensor, pairs: Tensor) -> Tensor:
        """Logits [B, 1, h, w] of volumes [B, C, H, W] and pairs [B, 2, H, W]."""
        return self.layers(torch.cat([volumes, pairs], dim=1))


def generator_arguments(options: TrainingOptions) -> dict[str, Any]:
    """What `EventVolumeUNet` is built with, apart from the channels of the volume."""
    return {
        "base_channels": options.base_channels,
        "num_encoders": options.num_encoders,
        "num_residual_blocks": options.num_residual_blocks,
        "norm": options.norm,
        "spectral_norm": options.generator_spectral_norm,
    }


def build_discriminator(num_volume_channels: int, options: TrainingOptions) -> PatchDiscriminator:
    """The discriminator that `options` describe."""
    return PatchDiscriminator(
        num_volume_channels,
        channels=options.discriminator_channels,
        num_layers=options.discriminator_layers,
        spectral_norm=options.discriminator_spectral_norm,
    )


def check_image_size(height: int, width: int, options: TrainingOptions) -> None:
    """Raise `ValueError` unless both networks have something left to look at after all their halvings."""
    side = min(height, width)
    smallest = max(2**options.num_encoders + 1, 3 * 2**options.discriminator_layers)
    if side < smallest:
        raise ValueError(
            f"Event-GAN with {options.num_encoders} encoders and {options.discriminator_layers} discriminator layers "
            f"needs images of at least {smallest} px a side, got {width} x {height} px; lower num_encoders or "
            "discriminator_layers, or set a larger image size in the encoding"
        )


def without_spectral_norm(network: nn.Module) -> nn.Module:
    """`network`, changed in place to hold its normalised weights as plain ones: the same function, ready to store."""
    network.eval()  # else every look at a weight would move its estimate of the largest singular value
    for module in network.modules():
        if parametrize.is_parametrized(module, "weight"):
            parametrize.remove_parametrizations(module, "weight", leave_parametrized=True)
    return network
