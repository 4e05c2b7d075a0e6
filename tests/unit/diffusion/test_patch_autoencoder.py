"""The patch code must lose nothing, whatever the image: what it loses no generator can put back."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.fft import dctn

from ctlev_core.diffusion.denoising import Denoiser
from ctlev_core.diffusion.patch_autoencoder import PatchAutoencoder, fit_patch_autoencoder, patch_basis
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.pretraining.architecture import build_base_model


def random_images(count=4, side=16, seed=0):
    return torch.rand((count, 3, side, side), generator=torch.Generator().manual_seed(seed)) * 2 - 1


def event_images(count=8, side=16, seed=0):
    """Isolated red and blue pixels on black, in [-1, 1]."""
    random = np.random.default_rng(seed)
    images = np.full((count, 3, side, side), -1.0, np.float32)
    for channel in (0, 2):
        images[:, channel][random.random((count, side, side)) < 0.05] = 1.0
    return torch.from_numpy(images)


@pytest.mark.parametrize("patch_px", [1, 2, 4])
def test_basis_is_orthonormal(patch_px):
    basis = patch_basis(patch_px)
    torch.testing.assert_close(basis @ basis.T, torch.eye(3 * patch_px**2, dtype=torch.float64), atol=1e-14, rtol=0)


@pytest.mark.parametrize("patch_px", [1, 2, 4])
def test_blocks_of_any_size_lose_nothing(patch_px, tmp_path):
    code = fit_patch_autoencoder(random_images(seed=1), patch_px)
    images = event_images()
    latents = code.encode(images)[0].mode()
    assert latents.shape == (8, 3 * patch_px**2, 16 // patch_px, 16 // patch_px)
    assert (code.decode(latents)[0] - images).abs().max() < 1e-5
    code.save_pretrained(tmp_path)
    assert torch.equal(PatchAutoencoder.from_pretrained(tmp_path).encode(images)[0].mode(), latents)


@pytest.mark.parametrize("patch_px", [1, 2, 4])
def test_networks_fit_the_latents(patch_px):
    code = fit_patch_autoencoder(random_images(seed=1), patch_px)
    base_model = build_base_model(
        ["a word"], code, seed=0, widths=(32, 32), image_size=16, prediction_type="v_prediction"
    )
    latents = code.encode(random_images())[0].mode()
    embeddings = encode_prompts(base_model, ["a word"] * 4)
    predicted = Denoiser(base_model.unet, base_model.controlnet).predict(
        latents, torch.full((4,), 500), embeddings, torch.rand(4, 3, 16, 16)
    )
    assert predicted.shape == latents.shape


def test_luminance_channels_are_the_dct_of_each_block():
    images = random_images(1, 8)
    latents = PatchAutoencoder().encode(images)[0].mode()[0].numpy()
    grey = images[0].sum(0).numpy() / np.sqrt(3)
    for row in range(2):
        for column in range(2):
            block = grey[4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
            expected = dctn(block, norm="ortho").ravel()
            np.testing.assert_allclose(latents[:16, row, column], expected, atol=1e-5)


@pytest.mark.parametrize("images", [random_images(), event_images(), -torch.ones(1, 3, 8, 8), torch.ones(1, 3, 8, 12)])
def test_reconstruction_is_exact(images):
    code = fit_patch_autoencoder(random_images(seed=1))
    assert (code(images) - images).abs().max() < 1e-5


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.01, 100.0))
def test_reconstruction_is_exact_for_any_mean(seed, scale):
    random = np.random.default_rng(seed)
    code = PatchAutoencoder(tuple((scale * random.normal(0, 1, 48)).tolist()))
    images = random_images(2, 8, seed)
    # Subtracting and adding a mean in single precision rounds in proportion to it.
    assert (code(images) - images).abs().max() < 1e-5 * max(1.0, scale)


def test_fitted_latents_have_unit_spread_about_a_mean_of_zero():
    images = torch.nn.functional.interpolate(random_images(64, 4), size=32, mode="bicubic")
    code = fit_patch_autoencoder(images)
    latents = code.encode(images)[0].mode() * code.config.scaling_factor
    assert abs(float(latents.square().mean().sqrt()) - 1) < 1e-3
    assert float(latents.mean(dim=(0, 2, 3)).abs().max()) < 1e-4


def test_distances_in_latents_are_distances_in_pixels():
    # No frequency weighs more in the loss, or drowns sooner in the noise, than in the image.
    code = fit_patch_autoencoder(random_images(seed=1))
    first, second = event_images(seed=2), event_images(seed=3)
    latents = [code.encode(images)[0].mode() for images in (first, second)]
    torch.testing.assert_close(
        (latents[0] - latents[1]).square().sum(), (first - second).square().sum(), rtol=1e-5, atol=0
    )


def test_images_all_alike_get_a_finite_scale():
    code = fit_patch_autoencoder(torch.zeros(3, 3, 8, 8))
    assert code.config.scaling_factor == pytest.approx(255 / 0.2)


def test_saved_and_loaded_code_is_the_same(tmp_path):
    code = fit_patch_autoencoder(random_images())
    code.save_pretrained(tmp_path)
    loaded = PatchAutoencoder.from_pretrained(tmp_path)
    assert loaded.config.scaling_factor == code.config.scaling_factor
    assert torch.equal(loaded.analysis, code.analysis) and torch.equal(loaded.offset, code.offset)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: PatchAutoencoder().encode(torch.zeros(1, 3, 10, 8)), "multiples of 4"),
        (lambda: PatchAutoencoder().encode(torch.zeros(1, 1, 8, 8)), r"\[N, 3, H, W\]"),
        (lambda: PatchAutoencoder(channel_mean=(1.0,)), "must hold 48"),
        (lambda: PatchAutoencoder(latent_channels=4), "48 channels"),
        (lambda: fit_patch_autoencoder(torch.zeros(0, 3, 8, 8)), "at least one image"),
    ],
)
def test_wrong_input_is_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()
