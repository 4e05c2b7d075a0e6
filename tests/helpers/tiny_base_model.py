"""A base model small enough to train in a test: 16 px images, 4 x 4 latents, random weights."""

from functools import cache

import numpy as np
import torch

from ctlev_core.diffusion.patch_autoencoder import fit_patch_autoencoder
from ctlev_core.diffusion.pretraining.architecture import build_base_model
from data_contracts.labels import Conditions

SIDE = 16
CORPUS = ("a moving human", "a photo of a cup", "a photo of a ball") * 4


def make_base_model(seed=0):
    images = torch.rand((8, 3, SIDE, SIDE), generator=torch.Generator().manual_seed(seed)) * 2 - 1
    return build_base_model(CORPUS, fit_patch_autoencoder(images), seed=seed, widths=(32, 32), image_size=SIDE)


@cache
def shared_base_model():
    """For tests that only read it."""
    base_model = make_base_model()
    for model in (base_model.unet, base_model.controlnet, base_model.text_encoder):
        model.eval().requires_grad_(False)
    return base_model


def make_data(count=12, seed=0, *, with_images=True):
    """Frames with a bright bar and, as condition, the same bar: something there is to learn."""
    random = np.random.default_rng(seed)
    frames = np.zeros((count, SIDE, SIDE, 3), np.uint8)
    for frame in frames:
        column = random.integers(0, SIDE - 4)
        frame[:, column : column + 4] = 255
    prompts = tuple(("a photo of a cup", "a photo of a ball")[row % 2] for row in range(count))
    return frames, Conditions(prompts, frames.copy() if with_images else None)
