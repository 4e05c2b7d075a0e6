"""A tiny autoencoder of Stable Diffusion v1's latent space, in the place of the 84 million weights of its own.

Graphnull/VAElight (Apache-2.0) has published the weights: 200,544 to encode, 266,780 to decode. How they go together
was told from their shapes, and the rest from what brings a photograph and a grey picture of 256 px back best: leaky
ReLU, the mean of 8 x 8 pixels for the coarse path, the sum of both paths give 23.1 and 26.8 dB. Plain ReLU gives 19.5
and 21.3, one pixel of 8 x 8 22.4 and 25.8, the fine path alone 20.6 and 24.1, the coarse one 12.9 and 11.2.
"""

import types
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch.nn import functional

REAL_DATA = Path(__file__).resolve().parents[2].parent / "shared" / "real"
FOLDER = REAL_DATA / "sd1_latent_tiny"
SCALING_FACTOR = 0.18215
"""Of Stable Diffusion v1."""
DECODED_AT = (("c2v", 4), ("c3v", 5), ("c4v", 8), ("cv", 11))
"""Paths of the decoder and their layers; they draw the picture at 1, 2, 4 and 8 times the size of the latents."""


class TinyAutoencoder:
    """What the project asks of an `AutoencoderKL`: config, dtype, device, weights, encode, decode.

    Without noise: no `std`.
    """

    def __init__(self, scaling_factor: float = SCALING_FACTOR) -> None:
        self.encoder = load_file(FOLDER / "vaelight_encoder.safetensors")
        self.decoder = load_file(FOLDER / "vaelight_decoder.safetensors")
        self.config = types.SimpleNamespace(
            scaling_factor=scaling_factor, latent_channels=4, block_out_channels=(128, 256, 512, 512)
        )
        self.dtype, self.device = torch.float32, torch.device("cpu")

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The weights by name."""
        return {f"encoder.{name}": value for name, value in self.encoder.items()} | self.decoder

    def encode(self, images: torch.Tensor) -> types.SimpleNamespace:
        """Latents [N, 4, H / 8, W / 8], not scaled, of images [N, 3, H, W] in [-1, 1], as `latent_dist.mean`."""
        fine, coarse = images, functional.avg_pool2d(images, 8)
        for number in range(1, 7):
            fine = _activate(_convolve(self.encoder, f"cv{number}", fine), last=number == 6)
        for number in range(14, 19):
            coarse = _activate(_convolve(self.encoder, f"cv{number}", coarse), last=number == 18)
        return types.SimpleNamespace(latent_dist=types.SimpleNamespace(mean=fine + coarse))

    def decode(self, latents: torch.Tensor) -> types.SimpleNamespace:
        """Images [N, 3, 8 h, 8 w], not clipped, of latents [N, 4, h, w] that are not scaled, as `sample`."""
        size = [8 * side for side in latents.shape[-2:]]
        images = torch.zeros(len(latents), 3, *size)
        for path, count in DECODED_AT:
            x = latents
            for number in range(1, count + 1):
                x = _activate(_convolve(self.decoder, f"{path}{number}", x, grow=True), last=number == count)
            images += functional.interpolate(x, size=size, mode="bilinear")
        return types.SimpleNamespace(sample=images)


def tiny_autoencoder(scaling_factor: float = SCALING_FACTOR) -> TinyAutoencoder:
    """Skips the test where the weights are not at hand."""
    if not FOLDER.is_dir():
        pytest.skip("the tiny autoencoder of Stable Diffusion's latent space is not part of the repository")
    return TinyAutoencoder(scaling_factor)


def _convolve(weights: dict[str, torch.Tensor], name: str, x: torch.Tensor, *, grow: bool = False) -> torch.Tensor:
    """Kernels of 3 x 3 keep the size; those of 2 x 2 halve it, or double it in the decoder."""
    kernel, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
    if kernel.shape[-1] == 3:
        return functional.conv2d(x, kernel, bias, padding=1)
    return (functional.conv_transpose2d if grow else functional.conv2d)(x, kernel, bias, stride=2)


def _activate(x: torch.Tensor, *, last: bool) -> torch.Tensor:
    return x if last else functional.leaky_relu(x, 0.01)
