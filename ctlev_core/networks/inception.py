"""The Inception network of the Frechet inception distance: TensorFlow's of 2015, from the state dictionary of its port.

Layers are Inception v3's, with three differences that the 2015 graph has: averages leave the border out, the last block
takes a maximum instead of its average, and there are 1,008 classes. Images are resized as TensorFlow 1 did, without
antialiasing and with corners that do not line up; other filters give another distance (Parmar et al., CVPR 2022).

Source: Szegedy et al., Rethinking the Inception Architecture, CVPR 2016, fig. 5-7 and table 1; the names are those of
`pt_inception-2015-12-05-6726825d.pth` (mseitzer/pytorch-fid).
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn
from torch.nn import functional

from data_contracts.errors import DataError

INPUT_SIZE = 299
NUM_FEATURES, NUM_CLASSES = 2048, 1008
Layer = tuple
"""Name, channels, kernel (one number or height and width) and, where it is not 1, stride."""
Branch = list
"""Layers one after the other; the name of a pooling; or a list of layers side by side, whose channels are joined."""

_STEM: list[Layer | str] = [
    ("Conv2d_1a_3x3", 32, 3, 2, 0), ("Conv2d_2a_3x3", 32, 3, 1, 0), ("Conv2d_2b_3x3", 64, 3), "reduce",
    ("Conv2d_3b_1x1", 80, 1), ("Conv2d_4a_3x3", 192, 3, 1, 0), "reduce",
]  # fmt: skip


def _grid_35(pool: int) -> list[Branch]:
    return [
        [("branch1x1", 64, 1)],
        [("branch5x5_1", 48, 1), ("branch5x5_2", 64, 5)],
        [("branch3x3dbl_1", 64, 1), ("branch3x3dbl_2", 96, 3), ("branch3x3dbl_3", 96, 3)],
        ["average", ("branch_pool", pool, 1)],
    ]


def _grid_17(width: int) -> list[Branch]:
    across, down = (1, 7), (7, 1)
    return [
        [("branch1x1", 192, 1)],
        [("branch7x7_1", width, 1), ("branch7x7_2", width, across), ("branch7x7_3", 192, down)],
        [
            ("branch7x7dbl_1", width, 1), ("branch7x7dbl_2", width, down), ("branch7x7dbl_3", width, across),
            ("branch7x7dbl_4", width, down), ("branch7x7dbl_5", 192, across),
        ],
        ["average", ("branch_pool", 192, 1)],
    ]  # fmt: skip


def _grid_8(pool: str) -> list[Branch]:
    across, down = (1, 3), (3, 1)
    return [
        [("branch1x1", 320, 1)],
        [("branch3x3_1", 384, 1), [("branch3x3_2a", 384, across), ("branch3x3_2b", 384, down)]],
        [
            ("branch3x3dbl_1", 448, 1), ("branch3x3dbl_2", 384, 3),
            [("branch3x3dbl_3a", 384, across), ("branch3x3dbl_3b", 384, down)],
        ],
        [pool, ("branch_pool", 192, 1)],
    ]  # fmt: skip


_BLOCKS: dict[str, list[Branch]] = {
    "Mixed_5b": _grid_35(32), "Mixed_5c": _grid_35(64), "Mixed_5d": _grid_35(64),
    "Mixed_6a": [
        [("branch3x3", 384, 3, 2, 0)],
        [("branch3x3dbl_1", 64, 1), ("branch3x3dbl_2", 96, 3), ("branch3x3dbl_3", 96, 3, 2, 0)],
        ["reduce"],
    ],
    "Mixed_6b": _grid_17(128), "Mixed_6c": _grid_17(160), "Mixed_6d": _grid_17(160), "Mixed_6e": _grid_17(192),
    "Mixed_7a": [
        [("branch3x3_1", 192, 1), ("branch3x3_2", 320, 3, 2, 0)],
        [
            ("branch7x7x3_1", 192, 1), ("branch7x7x3_2", 192, (1, 7)), ("branch7x7x3_3", 192, (7, 1)),
            ("branch7x7x3_4", 192, 3, 2, 0),
        ],
        ["reduce"],
    ],
    "Mixed_7b": _grid_8("average"), "Mixed_7c": _grid_8("maximum"),
}  # fmt: skip


class InceptionFeatures(nn.Module):
    """Images [B, 3, H, W] float32 in 0..255 to features [B, 2048]."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = _STEM
        channels = _add_layers(self, _STEM, 3)
        for name, branches in _BLOCKS.items():
            block = _Block(branches, channels)
            self.add_module(name, block)
            channels = block.channels
        self.fc = nn.Linear(channels, NUM_CLASSES)  # in the file, and not asked
        self.eval()

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Features [B, 2048]."""
        return self.of_resized(resize_as_tensorflow(images, INPUT_SIZE))

    def of_resized(self, images: torch.Tensor) -> torch.Tensor:
        """Features of images that have `INPUT_SIZE`."""
        x = _run(self, self.stem, (images - 128) / 128)
        for name in _BLOCKS:
            x = self.get_submodule(name)(x)
        return x.mean(dim=(2, 3))


class _Block(nn.Module):
    def __init__(self, branches: list[Branch], inputs: int) -> None:
        super().__init__()
        self.branches = branches
        self.channels = sum(_add_layers(self, branch, inputs) for branch in branches)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.cat([_run(self, branch, x) for branch in self.branches], dim=1)


class _Convolution(nn.Module):
    """Convolution, batch normalisation, ReLU; as large as the input unless a padding is given."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int | tuple[int, int], stride: int = 1, padding: int | None = None
    ) -> None:
        super().__init__()
        size = (kernel, kernel) if isinstance(kernel, int) else kernel
        around = (size[0] // 2, size[1] // 2) if padding is None else (padding, padding)
        self.conv = nn.Conv2d(inputs, outputs, size, stride, around, bias=False)
        self.bn = nn.BatchNorm2d(outputs, eps=1e-3)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return functional.relu(self.bn(self.conv(x)))


def _add_layers(module: nn.Module, layers: Branch, channels: int) -> int:
    """Make the layers children of `module`; returns the channels that come out."""
    for layer in layers:
        if isinstance(layer, list):
            channels = sum(_add_layers(module, [one], channels) for one in layer)
        elif not isinstance(layer, str):
            name, outputs, *shape = layer
            module.add_module(name, _Convolution(channels, outputs, *shape))
            channels = outputs
    return channels


def _run(module: nn.Module, layers: Branch, x: torch.Tensor) -> torch.Tensor:
    for layer in layers:
        if isinstance(layer, list):
            x = torch.cat([_run(module, [one], x) for one in layer], dim=1)
        elif layer == "average":
            x = functional.avg_pool2d(x, 3, stride=1, padding=1, count_include_pad=False)
        elif layer == "maximum":
            x = functional.max_pool2d(x, 3, stride=1, padding=1)
        elif layer == "reduce":
            x = functional.max_pool2d(x, 3, stride=2)
        else:
            x = module.get_submodule(layer[0])(x)
    return x


def resize_as_tensorflow(images: torch.Tensor, size: int) -> torch.Tensor:
    """Images [B, C, H, W] to [B, C, size, size]: bilinear, output pixel i at i times input size / output size."""
    rows, columns = (resize_weights(length, size).to(images) for length in images.shape[-2:])
    return rows @ images @ columns.T


def resize_weights(inputs: int, outputs: int) -> torch.Tensor:
    """[outputs, inputs] float64; each row has one number other than 0, or two that sum to 1."""
    place = torch.arange(outputs, dtype=torch.float64) * (inputs / outputs)
    low = place.floor().long()
    share, row = place - low, torch.arange(outputs)
    weights = torch.zeros(outputs, inputs, dtype=torch.float64)
    weights[row, low] += 1 - share
    weights[row, (low + 1).clamp(max=inputs - 1)] += share
    return weights


def load_inception(path: Path) -> InceptionFeatures:
    """The network with the weights of a state dictionary; the caller has compared its checksum.

    Raises:
        DataError: the file holds no such weights.
    """
    network = InceptionFeatures()
    try:
        network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # a damaged file can raise nearly any error
        raise DataError(f"{path}: expected the state dictionary of the 2015 Inception network: {error}") from error
    return network.eval()
