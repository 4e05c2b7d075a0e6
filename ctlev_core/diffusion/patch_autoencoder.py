"""A fixed, lossless autoencoder for small latent-diffusion base models: it drops into any diffusers pipeline as `vae`.

Event images are mostly isolated single pixels on a flat background. Autoencoders trained for minutes blur them away
(with 8 channels a learned one kept 14 % of a single pixel's brightness), and what the code loses no generator can put
back. This code loses nothing: each block of 4 x 4 pixels (or 2 x 2, or 1) goes through an orthonormal colour transform
and an orthonormal two-dimensional DCT, which gives 48 latent channels at a quarter of the resolution (12 at half of it,
3 at the whole). All channels have one scale, so that errors and noise weigh as much in latents as in pixels. Channels
whitened half-way over the pre-training images were worse: event images are sharper than pictures, and in grey ones the
highest frequency then had five times the variance of the mean brightness, which left the U-Net with noise to learn
before shapes.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from diffusers.configuration_utils import ConfigMixin, register_to_config
from diffusers.models.autoencoders.vae import DecoderOutput
from diffusers.models.modeling_outputs import AutoencoderKLOutput
from diffusers.models.modeling_utils import ModelMixin

PATCH_PX = 4
"""Edge of a block of the bundled models."""
LATENT_CHANNELS = 3 * PATCH_PX**2

# Rows: luminance, red - blue, (red + blue) - 2 green. Red and blue are the two polarities of an event image.
_OPPONENT = (
    (1 / math.sqrt(3), 1 / math.sqrt(3), 1 / math.sqrt(3)),
    (1 / math.sqrt(2), 0.0, -1 / math.sqrt(2)),
    (1 / math.sqrt(6), -2 / math.sqrt(6), 1 / math.sqrt(6)),
)


def dct_matrix(size: int) -> torch.Tensor:
    """Orthonormal DCT-II matrix [size, size] float64; row k is the k-th frequency."""
    k = torch.arange(size, dtype=torch.float64)[:, None]
    n = torch.arange(size, dtype=torch.float64)[None, :]
    matrix = math.sqrt(2 / size) * torch.cos(math.pi * (n + 0.5) * k / size)
    matrix[0] /= math.sqrt(2)
    return matrix


def patch_basis(patch_px: int = PATCH_PX) -> torch.Tensor:
    """Orthonormal analysis matrix [3 p^2, 3 p^2] float64 of blocks of p x p pixels.

    Input order is that of `pixel_unshuffle` (colour, row, column); output order is (opponent colour, vertical
    frequency, horizontal frequency).
    """
    dct = dct_matrix(patch_px)
    colour = torch.tensor(_OPPONENT, dtype=torch.float64)
    return torch.kron(colour, torch.kron(dct, dct))


class DeltaDistribution:
    """The posterior of a code without noise: all mass on the mean. The interface of diffusers' Gaussian posterior."""

    def __init__(self, mean: torch.Tensor) -> None:
        self.mean = mean

    def mode(self) -> torch.Tensor:
        """The mean, [N, C, h, w]."""
        return self.mean

    def sample(self, generator: torch.Generator | None = None) -> torch.Tensor:
        """The mean again; `generator` is accepted because pipelines pass it."""
        return self.mean


class PatchAutoencoder(ModelMixin, ConfigMixin):
    """Orthonormal DCT of blocks of p x p pixels in opponent colours; nothing is trained, nothing is lost.

    Args:
        channel_mean: 3 p^2 means of the coefficients over the pre-training images; empty = zeros.
        scaling_factor: multiplies the latents in the pipeline so that their overall standard deviation is 1.
        latent_channels: 3 p^2; in the config because pipelines and checks read it there.
        block_out_channels: only the length matters: pipelines take 2 ** (length - 1), here p, as the down-sampling
            factor.
    """

    @register_to_config
    def __init__(
        self,
        channel_mean: tuple[float, ...] = (),
        scaling_factor: float = 1.0,
        latent_channels: int = LATENT_CHANNELS,
        block_out_channels: tuple[int, ...] = (LATENT_CHANNELS,) * 3,
        shift_factor: float | None = None,
        force_upcast: bool = False,
    ) -> None:
        super().__init__()
        self.patch_px = 2 ** max(len(block_out_channels) - 1, 0)
        if latent_channels != 3 * self.patch_px**2:
            raise ValueError(
                f"a patch code of factor {self.patch_px}, as {len(block_out_channels)} block_out_channels say, has "
                f"{3 * self.patch_px**2} channels, got latent_channels {latent_channels}"
            )
        mean = torch.tensor(channel_mean or (0.0,) * latent_channels, dtype=torch.float64)
        if mean.shape != (latent_channels,) or not bool(torch.isfinite(mean).all()):
            raise ValueError(f"channel_mean must hold {latent_channels} finite numbers, got {mean.tolist()}")
        basis = patch_basis(self.patch_px)
        # Persistent, although derived from the config: a weights file without tensors cannot be loaded.
        self.register_buffer("analysis", basis.float())
        self.register_buffer("offset", mean.float())

    def encode(self, x: torch.Tensor, return_dict: bool = True) -> AutoencoderKLOutput | tuple[DeltaDistribution]:
        """Latents of images.

        Args:
            x: [N, 3, H, W] in [-1, 1]; H and W multiples of p.
            return_dict: False returns a tuple, as in diffusers.
        Returns:
            An object whose `latent_dist.mean` is [N, 3 p^2, H / p, W / p], not yet multiplied by `scaling_factor`.
        Raises:
            ValueError: wrong shape.
        """
        if x.ndim != 4 or x.shape[1] != 3 or x.shape[2] % self.patch_px or x.shape[3] % self.patch_px:
            raise ValueError(
                f"images must be [N, 3, H, W] with H and W multiples of {self.patch_px}, got {tuple(x.shape)}"
            )
        patches = torch.nn.functional.pixel_unshuffle(x, self.patch_px)
        mean = torch.einsum("kc,nchw->nkhw", self.analysis, patches) - self.offset[:, None, None]
        posterior = DeltaDistribution(mean)
        return AutoencoderKLOutput(latent_dist=posterior) if return_dict else (posterior,)  # pyright: ignore[reportArgumentType]

    def decode(
        self, z: torch.Tensor, return_dict: bool = True, generator: torch.Generator | None = None
    ) -> DecoderOutput | tuple[torch.Tensor]:
        """Images [N, 3, H, W] of latents [N, 3 p^2, H / p, W / p]; the exact inverse of `encode`, not clipped."""
        patches = torch.einsum("kc,nkhw->nchw", self.analysis, z + self.offset[:, None, None])
        sample = torch.nn.functional.pixel_shuffle(patches, self.patch_px)
        return DecoderOutput(sample=sample) if return_dict else (sample,)

    def forward(self, sample: torch.Tensor) -> torch.Tensor:
        """Encode and decode."""
        return self.decode(self.encode(sample)[0].mode())[0]

    @property
    def dtype(self) -> torch.dtype:
        """Data type of the code's matrices; pipelines cast images to it."""
        return self.analysis.dtype


def fit_patch_autoencoder(images: torch.Tensor, patch_px: int = PATCH_PX) -> PatchAutoencoder:
    """Measure mean and spread of the coefficients of images and return the code.

    Args:
        images: [N, 3, H, W] in [-1, 1], a few hundred of the images the base model will be trained on.
        patch_px: edge of a block: 1, 2, 4, ...
    Returns:
        A code whose latents have standard deviation 1 after `scaling_factor`.
    Raises:
        ValueError: no image, or wrong shape.
    """
    if len(images) == 0:
        raise ValueError("the patch code needs at least one image to measure its scale, got none")
    channels = 3 * patch_px**2
    shape: dict[str, Any] = {
        "latent_channels": channels,
        "block_out_channels": (channels,) * patch_px.bit_length(),
    }
    raw = PatchAutoencoder(**shape).encode(images)[0].mode().double()
    variance, mean = torch.var_mean(raw, dim=(0, 2, 3))
    # Images all alike need a finite scale: no quieter than a tenth of a grey level of one pixel.
    spread = max(float(variance.mean().sqrt()), 0.1 * 2 / 255)
    return PatchAutoencoder(tuple(mean.tolist()), 1 / spread, **shape)
