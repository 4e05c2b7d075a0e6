"""Networks of random weights with the architectures of published ones, as files in the published layouts.

    stable_diffusion/       Stable Diffusion v1, a diffusers folder: U-Net of 860 M weights, autoencoder 84 M, text
                            encoder 123 M; 2.1 GB in float16. The tokenizer is the bundled one.
    controlnet/             ControlNet v1.0, 361 M weights, 0.7 GB
    resnet34/               a ResNet-34, a folder of transformers, 0.1 GB
    inception.pt            Inception v3 as a TorchScript file, 0.1 GB

With the size `tiny` they have the same layers, fewer channels and images of 64 px.
"""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path
from typing import Any, Literal

import torch

from ctlev_core.diffusion.pretrained.components import read_json
from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL
from ctlev_core.diffusion.pretrained.single_file import CONFIGS
from ctlev_core.networks.resnet_files import ARCHITECTURES, CONFIG_NAME, WEIGHTS_NAME

Size = Literal["full", "tiny"]
IMAGE_SIZE: dict[str, int] = {"full": 512, "tiny": 64}
"""px of the images that Stable Diffusion of each size takes."""
TINY: dict[str, dict[str, Any]] = {
    "unet": {"block_out_channels": [32, 32, 64, 64], "cross_attention_dim": 32, "attention_head_dim": 2},
    "controlnet": {
        "block_out_channels": [32, 32, 64, 64],
        "cross_attention_dim": 32,
        "attention_head_dim": 2,
        "conditioning_embedding_out_channels": [8, 8, 16, 16],
    },
    "vae": {"block_out_channels": [32, 32, 32, 32]},
    "text_encoder": {
        "hidden_size": 32,
        "intermediate_size": 64,
        "projection_dim": 32,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
    },
}
"""What the size `tiny` changes of the configs of Stable Diffusion v1."""
_HALF = torch.float16


def stable_diffusion_configs(size: Size, image_size: int) -> dict[str, dict[str, Any]]:
    """The configs of Stable Diffusion v1 and ControlNet by network, for images of `image_size` px."""
    configs = read_json(CONFIGS)
    for name, changes in TINY.items() if size == "tiny" else ():
        configs[name] = {**configs[name], **changes}
    configs["unet"]["sample_size"] = image_size // 8
    return configs


def build_network(part: str, config: dict[str, Any]) -> Any:
    """A network of Stable Diffusion v1 with random weights, in torch's default type.

    Args:
        part: `unet`, `vae`, `text_encoder` or `controlnet`.
        config: as diffusers and transformers read it.
    """
    from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
    from diffusers.models.controlnets.controlnet import ControlNetModel
    from diffusers.models.unets.unet_2d_condition import UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel

    if part == "text_encoder":
        return CLIPTextModel(CLIPTextConfig.from_dict(config))
    classes: dict[str, Any] = {"unet": UNet2DConditionModel, "vae": AutoencoderKL, "controlnet": ControlNetModel}
    return classes[part].from_config(config)


def write_stable_diffusion(folder: Path, size: Size, seed: int = 0) -> None:
    """A diffusers folder of Stable Diffusion v1 without ControlNet, random weights in float16."""
    configs = stable_diffusion_configs(size, IMAGE_SIZE[size])
    torch.manual_seed(seed)
    for part in ("unet", "vae", "text_encoder"):
        _save(_build_in_half(part, configs[part]), folder / part)
    shutil.copytree(BUNDLED_BASE_MODEL / "tokenizer", folder / "tokenizer")
    (folder / "scheduler").mkdir()
    (folder / "scheduler" / "scheduler_config.json").write_text(json.dumps(configs["scheduler"], indent=2) + "\n")


def write_controlnet(folder: Path, size: Size, seed: int = 0) -> None:
    """A folder of ControlNet v1.0; where a new ControlNet has zeros it has small random weights, as a trained one."""
    from ctlev_core.diffusion.pretraining.architecture import break_zeros

    torch.manual_seed(seed)
    controlnet = _build_in_half("controlnet", stable_diffusion_configs(size, IMAGE_SIZE[size])["controlnet"])
    break_zeros(controlnet)
    _save(controlnet, folder)


def write_resnet34(folder: Path, seed: int = 0) -> None:
    """A folder as `microsoft/resnet-34` is published, 1,000 classes."""
    from transformers import ResNetConfig, ResNetForImageClassification

    torch.manual_seed(seed)
    config = ResNetConfig.from_dict({"layer_type": "basic", **ARCHITECTURES["resnet34"], "num_labels": 1000})
    _save(ResNetForImageClassification(config), folder)
    written = read_json(folder / CONFIG_NAME)
    (folder / CONFIG_NAME).write_text(json.dumps({**written, "downsample_in_first_stage": False}, indent=2) + "\n")


def write_inception(path: Path, size: Size, seed: int = 0) -> None:
    """A TorchScript program: images [N, 3, H, W] of 0..255 to features [N, 2048], as the file of FID.

    It was traced, and takes images of `IMAGE_SIZE` alone. The size `tiny` has two layers and 64 features.
    """
    torch.manual_seed(seed)
    side = IMAGE_SIZE[size]
    network = _FixedSizeInception(side) if size == "full" else _SmallFeatures()
    network.eval().requires_grad_(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # shapes are constant in what was traced, as they may be; and tracing is old
        torch.jit.save(torch.jit.trace(network, torch.zeros(2, 3, side, side)), path)


def _build_in_half(part: str, config: dict[str, Any]) -> Any:
    before = torch.get_default_dtype()
    torch.set_default_dtype(_HALF)  # half the memory, and time
    try:
        network = build_network(part, config).eval()
    finally:
        torch.set_default_dtype(before)
    for weight in network.parameters():  # some are made as float32 whatever the default
        weight.data = weight.data.to(_HALF)
    return network


def _save(network: Any, folder: Path) -> None:
    if hasattr(network, "save_config"):  # of diffusers
        network.save_pretrained(folder, safe_serialization=True)
        return
    from safetensors.torch import save_file

    network.config.save_pretrained(folder)  # without the progress bar of transformers' save_pretrained
    save_file(network.state_dict(), folder / WEIGHTS_NAME, metadata={"format": "pt"})


class _FixedSizeInception(torch.nn.Module):
    """Resizes by a weight matrix that it holds: one that is made while tracing would stay on the CPU for good."""

    resize: torch.Tensor

    def __init__(self, side: int) -> None:
        from ctlev_core.networks.inception import INPUT_SIZE, InceptionFeatures, resize_weights

        super().__init__()
        self.network = InceptionFeatures()
        self.register_buffer("resize", resize_weights(side, INPUT_SIZE).float())

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.network.of_resized(self.resize @ images @ self.resize.T)


class _SmallFeatures(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layers = torch.nn.Sequential(
            torch.nn.Conv2d(3, 32, 5, stride=4), torch.nn.ReLU(), torch.nn.Conv2d(32, 64, 3, stride=2), torch.nn.ReLU()
        )

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.layers((images - 128) / 128).mean(dim=(2, 3))
