"""The convolutional pose network of DHP19; options are width, batch normalisation, a half-size output and recurrence.

Source: Calabrese et al., DHP19, CVPR Workshops 2019. The layers are those of the published Keras file DHP_CNN.model:
seventeen 3 x 3 convolutions without bias, ReLU after every one of them, the last included.
"""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

import torch
from torch import nn
from torch.nn import functional

from ctlev_core.networks.conv_gru import ConvGRU
from ctlev_core.networks.dhp19_weights import read_keras_weights
from data_contracts.errors import DataError

# Name, channels at width 1, dilation. `pool` halves the image, `up` doubles it by a transposed convolution.
LAYERS: tuple[tuple[str, int, int], ...] = (
    ("conv1", 16, 1),
    ("pool1", 0, 0),
    ("conv2a", 32, 1), ("conv2b", 32, 1), ("conv2d", 32, 1),
    ("pool2", 0, 0),
    ("conv3a", 64, 2), ("conv3b", 64, 2), ("conv3c", 64, 2), ("conv3d", 64, 2),
    ("conv3_up", 32, 1),
    ("conv4a", 32, 2), ("conv4b", 32, 2), ("conv4c", 32, 2), ("conv4d", 32, 2),
    ("conv4_up", 16, 1),
    ("conv5a", 16, 1), ("conv5d", 16, 1),
)  # fmt: skip
DOWNSAMPLING = 4
"""Height and width inside the network are padded to a multiple of this."""
DECODER = "conv3_up"
"""The first layer that a recurrent unit lies before, where the feature maps are smallest."""


class SameTransposedConvolution(nn.ConvTranspose2d):
    """3 x 3, stride 2, as Keras computes it with padding "same": no padding, then the last row and column dropped.

    PyTorch's `padding=1, output_padding=1` also doubles the size but shifts the result by one pixel.
    """

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__(channels_in, channels_out, 3, stride=2, bias=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[N, C, H, W] -> [N, channels_out, 2H, 2W]."""
        return super().forward(x)[..., :-1, :-1]


class DHP19Network(nn.Module):
    """One heatmap a joint from one grey image.

    Args:
        num_joints: heatmaps to predict; 13 in DHP19.
        width: factor on all channel counts; 1 is DHP19 (218,592 parameters with 13 joints).
        batch_norm: normalise after every convolution but the last. The heatmaps are then unbounded (no last ReLU).
        output_stride: 1 as DHP19; 2 leaves out the last upsampling and predicts heatmaps of half the size.
        recurrent: add what a convolutional recurrent unit makes of the smallest feature maps and of those of earlier
            frames; nothing before it is trained.
    """

    def __init__(
        self,
        num_joints: int = 13,
        width: float = 1.0,
        batch_norm: bool = False,
        output_stride: int = 1,
        recurrent: bool = False,
    ) -> None:
        super().__init__()
        self.output_stride = output_stride
        layers: OrderedDict[str, nn.Module] = OrderedDict()
        channels, num_features = 1, 0
        for name, base, dilation in LAYERS:
            if name == DECODER:
                self.encoder_depth, num_features = len(layers), channels
            if name.startswith("pool"):
                layers[name] = nn.MaxPool2d(2)
                continue
            if name == "conv4_up" and output_stride == 2:
                continue
            channels_out = max(1, round(base * width))
            if name.endswith("up"):
                layers[name] = SameTransposedConvolution(channels, channels_out)
            else:
                layers[name] = nn.Conv2d(channels, channels_out, 3, padding=dilation, dilation=dilation, bias=False)
            if batch_norm:
                layers[f"{name}_norm"] = nn.BatchNorm2d(channels_out)
            layers[f"{name}_relu"] = nn.ReLU(inplace=True)
            channels = channels_out
        layers["pred_cube"] = nn.Conv2d(channels, num_joints, 3, padding=1, bias=False)
        if not batch_norm:
            layers["pred_cube_relu"] = nn.ReLU()
        self.layers = nn.Sequential(layers)
        self._initialise()
        self.recurrent = ConvGRU(num_features) if recurrent else None

    def _initialise(self) -> None:
        # He initialisation: PyTorch's own default would shrink the signal by sqrt(6) in each of the 17 layers.
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                fan_in = module.in_channels * 9 / (module.stride[0] ** 2 if module.transposed else 1)
                nn.init.normal_(module.weight, std=(2 / fan_in) ** 0.5)

    def features(self, images: torch.Tensor) -> torch.Tensor:
        """Feature maps [N, C, ceil(H / 4), ceil(W / 4)] of images [N, 1, H, W] in [0, 1], each by itself."""
        height, width = images.shape[-2:]
        return self.layers[: self.encoder_depth](
            functional.pad(images, (0, -width % DOWNSAMPLING, 0, -height % DOWNSAMPLING))
        )

    def over_time(self, features: torch.Tensor, firsts: torch.Tensor, lengths: torch.Tensor) -> torch.Tensor:
        """Feature maps [S, C, H, W] of the last frames of S sequences, which know the earlier ones.

        Arguments as in `ConvGRU.forward`; without a recurrent unit the feature maps of the last frames themselves.
        """
        last = features[firsts + lengths - 1]
        return last if self.recurrent is None else last + self.recurrent(features, firsts, lengths)

    def heatmaps(self, features: torch.Tensor, image_size: tuple[int, int]) -> torch.Tensor:
        """Heatmaps as `forward` gives them, of feature maps of images of (height, width)."""
        height, width = (-(-side // self.output_stride) for side in image_size)
        return self.layers[self.encoder_depth :](features)[..., :height, :width]

    def forward(self, images: torch.Tensor, ages: torch.Tensor | None = None) -> torch.Tensor:
        """One heatmap a joint.

        Args:
            images: [N, 1, H, W] in [0, 1], those of a sequence one after another.
            ages: [N] int64, on the CPU: how many images of its sequence are before each; None = none.
        Returns:
            [N, J, ceil(H / output_stride), ceil(W / output_stride)].
        """
        features, (height, width) = self.features(images), images.shape[-2:]
        if self.recurrent is not None:
            ages = torch.zeros(len(images), dtype=torch.int64) if ages is None else ages
            features = self.over_time(features, torch.arange(len(images)) - ages, ages + 1)
        return self.heatmaps(features, (height, width))


def load_published(network: DHP19Network, path: Path) -> None:
    """Take over the weights of the published Keras file; a recurrent unit keeps its own.

    Raises:
        DataError: the file cannot be read, or its layers are not those of `network`.
    """
    found = {f"layers.{name}.weight": torch.from_numpy(kernel) for name, kernel in read_keras_weights(path).items()}
    expected = {name: tensor for name, tensor in network.state_dict().items() if name.startswith("layers.")}
    if set(found) != set(expected):
        odd = sorted(set(found) ^ set(expected))
        raise DataError(f"{path}: expected the layers of DHP19's network, differs in {', '.join(odd[:3])}")
    for name, tensor in expected.items():
        if found[name].shape != tensor.shape:
            raise DataError(f"{path}: {name} must be {list(tensor.shape)}, got {list(found[name].shape)}")
    network.load_state_dict(found, strict=False)
