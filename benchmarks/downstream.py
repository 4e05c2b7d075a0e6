"""How fast the downstream models train, beside the plainest loop that PyTorch's tutorials teach.

    python benchmarks/downstream.py
    python benchmarks/downstream.py --steps 40 --rounds 5 --threads 2
    python benchmarks/downstream.py --device cuda --steps 200 --batch 64 --size 128

Both train the same networks on the same frames for the same number of steps, in turn, because a machine's speed drifts.
The plain loop is a `Dataset` that turns one image into float tensors and mirrors it in Python, a shuffling
`DataLoader`, Adam and `loss.backward()`; for poses it draws the target heatmaps of one image at a time. Ours does the
same to whole batches and also looks whether loss and gradient are finite, keeps a history and can be resumed.

Seconds are those of the process on a CPU and of the wall on a GPU; building the network and writing it are part of
both. Read the ratios.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from interleaved import Comparison, describe_machine, measure, print_comparisons
from safetensors.torch import save_file
from torch import nn
from torch.utils.data import DataLoader, Dataset

from ctlev_core.downstream import classifier, pose2d
from ctlev_core.networks.dhp19 import DHP19Network
from ctlev_core.networks.resnet import CHANNEL_MEAN, CHANNEL_STD
from ctlev_core.networks.resnet_files import ARCHITECTURES
from data_contracts.labels import Labels

NUM_FRAMES, NUM_CLASSES, NUM_JOINTS = 512, 10, 13


def main() -> None:
    """Print one line a network."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=12, help="optimiser steps a round")
    parser.add_argument("--rounds", type=int, default=3, help="measured rounds, after one that is not")
    parser.add_argument("--batch", type=int, default=16, help="images a step")
    parser.add_argument("--size", type=int, default=64, help="px a side")
    parser.add_argument("--threads", type=int, default=1, help="of PyTorch")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    device = torch.device(arguments.device)
    print(f"{describe_machine(device)}\n{arguments.steps} steps of {arguments.batch} images of {arguments.size} px")
    comparisons = [compare(name, *case, arguments, device) for name, case in cases(arguments, device).items()]
    print_comparisons("training", "plain loop", comparisons)


def compare(
    name: str, ours: Callable[[Path], object], plain: Callable[[Path], object], arguments: Any, device: torch.device
) -> Comparison:
    """Both loops in turn; the first round warms up and does not count."""
    comparison = Comparison(name, arguments.steps * arguments.batch)
    for number in range(arguments.rounds + 1):
        with tempfile.TemporaryDirectory() as folder:
            seconds = [measure(lambda run=run: run(Path(folder)), device) for run in (ours, plain)]
        if number:
            comparison.ours.append(seconds[0])
            comparison.peer.append(seconds[1])
    return comparison


def cases(arguments: Any, device: torch.device) -> dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]]:
    """Ours and the plain loop for each network."""
    random = np.random.default_rng(0)
    size = arguments.size
    # A tenth of the pixels have events, as in event images.
    frames = random.integers(0, 256, (NUM_FRAMES, size, size, 3)) * (random.random((NUM_FRAMES, size, size, 1)) < 0.1)
    frames = frames.astype(np.uint8)
    classes = random.integers(0, NUM_CLASSES, NUM_FRAMES)
    joints = random.uniform(0, size, (NUM_FRAMES, NUM_JOINTS, 2)).astype(np.float32)
    nothing = np.zeros(NUM_FRAMES, np.int64)
    named = Labels(tuple(str(number) for number in classes), nothing)
    seen = np.ones((NUM_FRAMES, NUM_JOINTS), bool)
    posed = Labels(("",) * NUM_FRAMES, nothing, joints, seen, "dhp19")
    budget = {"num_steps": arguments.steps, "batch_size": arguments.batch, "device": str(device), "flip": True}

    def ours(module: Any, labels: Labels, options: dict[str, Any]) -> Callable[[Path], object]:
        chosen = module.Options(**budget, **options)
        return lambda folder: module.train(frames, labels, chosen, seed=0, out=folder / "model", work=folder / "work")

    def plain(
        build: Callable[[], nn.Module], data: Dataset, loss: Callable[..., torch.Tensor]
    ) -> Callable[[Path], object]:
        return lambda folder: train_plainly(build().to(device), data, loss, arguments, folder, device)

    images, heatmaps = ClassImages(frames, classes), PoseImages(frames, joints)
    return {
        "classifier, ResNet-10 quarter": (
            ours(classifier, named, {}),
            plain(lambda: build_resnet("resnet10-quarter"), images, nn.CrossEntropyLoss()),
        ),
        "pose network, half width, batch norm": (
            ours(pose2d, posed, {"width": 0.5, "batch_norm": True}),
            plain(lambda: DHP19Network(NUM_JOINTS, 0.5, batch_norm=True), heatmaps, nn.MSELoss()),
        ),
        "the same, channels_last": (
            ours(pose2d, posed, {"width": 0.5, "batch_norm": True, "channels_last": True}),
            plain(lambda: DHP19Network(NUM_JOINTS, 0.5, batch_norm=True), heatmaps, nn.MSELoss()),
        ),
        "DHP19's CNN": (ours(pose2d, posed, {}), plain(lambda: DHP19Network(NUM_JOINTS), heatmaps, nn.MSELoss())),
    }


def train_plainly(
    model: nn.Module, data: Dataset, loss_of: Callable[..., torch.Tensor], arguments: Any, folder: Path, device: Any
) -> None:
    """The loop of PyTorch's tutorials, with Adam."""
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    model.train()
    step = 0
    while step < arguments.steps:
        for images, targets in DataLoader(data, batch_size=arguments.batch, shuffle=True, drop_last=True):
            optimizer.zero_grad()
            found = model(images.to(device))
            loss = loss_of(getattr(found, "logits", found), targets.to(device))
            loss.backward()
            optimizer.step()
            loss.item()
            step += 1
            if step == arguments.steps:
                break
    save_file(model.state_dict(), folder / "plain.safetensors")


def build_resnet(architecture: str) -> nn.Module:
    """The ResNet of transformers, as it comes."""
    from transformers import ResNetConfig, ResNetForImageClassification

    shape = {**ARCHITECTURES[architecture], "layer_type": "basic", "num_labels": NUM_CLASSES}
    return ResNetForImageClassification(ResNetConfig.from_dict(shape))


class ClassImages(Dataset):
    """One image and its class at a time, mirrored half of the time, as ImageNet's networks want it."""

    def __init__(self, frames: np.ndarray, classes: np.ndarray) -> None:
        self.frames, self.classes = frames, classes

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, row: int) -> tuple[torch.Tensor, int]:
        frame = self.frames[row]
        if torch.rand(()) < 0.5:
            frame = frame[:, ::-1].copy()
        image = torch.from_numpy(frame).permute(2, 0, 1).float() / 255
        mean, std = torch.tensor(CHANNEL_MEAN), torch.tensor(CHANNEL_STD)
        return (image - mean[:, None, None]) / std[:, None, None], int(self.classes[row])


class PoseImages(Dataset):
    """One grey image and a heatmap a joint, a Gaussian of height 1 and 4 px, mirrored half of the time."""

    def __init__(self, frames: np.ndarray, joints: np.ndarray) -> None:
        self.frames, self.joints = frames, joints

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, row: int) -> tuple[torch.Tensor, torch.Tensor]:
        frame, joints = self.frames[row].max(axis=-1), self.joints[row]
        if torch.rand(()) < 0.5:
            frame = frame[:, ::-1].copy()
            joints = np.stack([frame.shape[1] - joints[:, 0], joints[:, 1]], axis=-1)
        y, x = np.mgrid[: frame.shape[0], : frame.shape[1]] + 0.5
        heatmaps = [np.exp(-((x - joint[0]) ** 2 + (y - joint[1]) ** 2) / (2 * 4.0**2)) for joint in joints]
        return torch.from_numpy(frame)[None].float() / 255, torch.from_numpy(np.stack(heatmaps)).float()


if __name__ == "__main__":
    main()
