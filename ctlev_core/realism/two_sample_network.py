"""The small convolutional network of the two-sample test: learns which of two sets a frame is from.

Three times convolution, maximum over 2 x 2 px, batch normalisation and ReLU, a mean over 4 x 4 parts of the image and a
linear layer. The first convolution takes steps of more than one pixel where images are larger than 32 px, with a
kernel that leaves none out: the finest noise is still seen, at the same cost.

Training has a fixed length, half of each batch from either set, in frames moved by up to a pixel. Nothing is chosen by
looking at other frames, so that no frames are lost to validation; a network that has learnt its frames by heart is no
better than chance on others where there is nothing to tell.

All on the CPU in one thread: sums keep their order, and with it the result, on a machine with however many cores.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import nn
from torch.nn.utils import skip_init

WIDTHS = (32, 32, 32)
FULL_SIDE_PX = 32
NUM_STEPS, BATCH_SIZE = 120, 32
LEARNING_RATE, WEIGHT_DECAY = 3e-3, 1e-2
_PREDICTED_TOGETHER = 64


def learn_and_score(
    first: np.ndarray, second: np.ndarray, held_out: tuple[np.ndarray, np.ndarray], seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Train on some frames of two sets, and score others.

    Args:
        first: [N, H, W, C] uint8, N > 0.
        second: [M, H, W, C] uint8, M > 0.
        held_out: [K, H, W, C] and [L, H, W, C] uint8 of the first and the second set.
        seed: of weights, order and shifts.
    Returns:
        [K] and [L] float64: logits that a frame is from the first set.
    """
    with _one_thread():
        generator = np.random.default_rng(seed)
        network = _train(_build(first.shape[1:], generator), (_planes(first), _planes(second)), generator)
        known, other = (_score(network, _planes(frames)) for frames in held_out)
    return known, other


@contextmanager
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _planes(frames: np.ndarray) -> torch.Tensor:
    """[N, C, H, W] uint8, the channels of a pixel still side by side in memory: twice as fast."""
    return torch.from_numpy(np.ascontiguousarray(frames)).permute(0, 3, 1, 2)


def _build(shape: tuple[int, ...], generator: np.random.Generator) -> nn.Sequential:
    layers: list[nn.Module] = []
    height, width, channels = shape
    step = max(1, -(-max(height, width) // FULL_SIDE_PX))
    for number, features in enumerate(WIDTHS):
        stride = step if number == 0 else 1
        kernel = {"kernel_size": 2 * stride + 1, "stride": stride, "padding": stride, "bias": False}
        layers.append(skip_init(nn.Conv2d, channels, features, **kernel))
        layers += [nn.MaxPool2d(2, ceil_mode=True), nn.BatchNorm2d(features), nn.ReLU()]
        channels = features
    network = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(4), nn.Flatten(), skip_init(nn.Linear, 16 * channels, 1))
    with torch.no_grad():
        for layer in network:
            if isinstance(layer, nn.Conv2d | nn.Linear):
                # He et al., Delving Deep into Rectifiers, ICCV 2015; drawn by NumPy, which no other thread draws from.
                weight = layer.weight
                deviation = (2 / weight[0].numel()) ** 0.5
                drawn = generator.normal(0, deviation, tuple(weight.shape)).astype(np.float32)
                weight.copy_(torch.from_numpy(drawn))
                if layer.bias is not None:
                    layer.bias.zero_()
    return network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def _train(
    network: nn.Sequential, sets: tuple[torch.Tensor, torch.Tensor], generator: np.random.Generator
) -> nn.Sequential:
    optimizer = torch.optim.AdamW(network.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=NUM_STEPS)
    half = BATCH_SIZE // 2
    orders = [_endless_order(len(frames), generator) for frames in sets]
    target = torch.cat([torch.ones(half), torch.zeros(half)])
    network.train()
    for _ in range(NUM_STEPS):
        rows = [[next(order) for _ in range(half)] for order in orders]
        batch = torch.cat([frames[chosen] for frames, chosen in zip(sets, rows, strict=True)])
        shift = tuple(int(by) for by in generator.integers(-1, 2, 2))
        logits = network(batch.roll(shift, (2, 3)).float() / 255)[:, 0]
        loss = nn.functional.binary_cross_entropy_with_logits(logits, target)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network.eval()


def _endless_order(count: int, generator: np.random.Generator) -> Iterator[int]:
    """Every row once, in random order, before any comes again."""
    while True:
        yield from generator.permutation(count).tolist()


def _score(network: nn.Sequential, frames: torch.Tensor) -> np.ndarray:
    with torch.no_grad():
        found = [network(part.float() / 255)[:, 0].numpy() for part in frames.split(_PREDICTED_TOGETHER)]
    return np.concatenate(found).astype(np.float64)
