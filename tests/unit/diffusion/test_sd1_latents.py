"""Real frames of 512 px in Stable Diffusion v1's latent space: scaled, cached, learnt and decoded as it needs.

All networks but the autoencoder are tiny and random. The autoencoder is small, and made for photographs: what it loses
bounds these tests, not what Stable Diffusion's own loses.
"""

from __future__ import annotations

import dataclasses
import logging

import cv2
import numpy as np
import pytest
import torch
from sd1_latent_tiny import REAL_DATA, SCALING_FACTOR, tiny_autoencoder
from tiny_stable_diffusion import make_models, tiny_changes, write_folder

from ctlev_core import plugins
from ctlev_core.diffusion.pretrained.loading import decode_latents, images_to_tensor, load_base_model
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.sampling import sample_frames
from ctlev_core.diffusion.training.finetuning import fine_tune
from ctlev_core.diffusion.training.latent_cache import cache_latents, check_cache
from ctlev_core.diffusion.training.options import FineTuningOptions
from ctlev_core.events import files as event_files
from ctlev_core.events.image_resampling import resample_images
from data_contracts.config import EncodingChoice
from data_contracts.labels import Conditions

SIDE = 512
PICTURES = {"office": "frames/000.png", "body": "dhp19_frames/frame_cam2.png", "body3": "dhp19_frames/frame_cam3.png"}
RECORDINGS = {
    "digit": ("nmnist/three", 1_500),
    "person": ("events/person", 7_500),
    "street": ("events/street", 50_000),
    "spot": ("events/spot", 20_000),
}
"""Folder, and how many events from the middle of its first recording."""
SPARSE = ("person", "street", "spot")
FEW = ("body", "digit")
"""Where two say enough: decoding one takes a second or two."""


def onto_512_px(images: np.ndarray) -> np.ndarray:
    """[N, H, W, 3] whole and in the middle of [512, 512, 3], of the first."""
    height, width = images.shape[1:3]
    scale = SIDE / max(height, width)
    offset = (SIDE - scale * np.array([width, height])) / 2
    channels = [resample_images(images[:1, ..., c], lambda p: p * scale + offset, (SIDE, SIDE)) for c in range(3)]
    return np.rint(np.stack(channels, axis=-1)[0]).astype(np.uint8)


def drawn(folder: str, num_events: int) -> np.ndarray:
    encoding = plugins.load_options(EncodingChoice(name="event_histogram"))
    events = event_files.read_events_file(min((REAL_DATA / folder).iterdir()))
    first = (len(events) - num_events) // 2
    window = np.array([[first, first + num_events]])
    return encoding.module.render_image(encoding.module.encode(events, window, encoding.options), encoding.options)


@pytest.fixture(scope="module")
def frames() -> dict[str, np.ndarray]:
    """[512, 512, 3] uint8 by name: a grey picture, two bodies of DHP19, a digit, three recordings of sparse events."""
    for place in (*PICTURES.values(), *(folder for folder, _ in RECORDINGS.values())):
        if not (REAL_DATA / place).exists():
            pytest.skip(f"{place} of the real data is not beside this checkout")
    images = {name: cv2.imread(str(REAL_DATA / place))[None] for name, place in PICTURES.items()}
    images |= {name: drawn(*recording) for name, recording in RECORDINGS.items()}
    return {name: onto_512_px(image) for name, image in images.items()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    changes = tiny_changes()
    changes = {**changes, "unet": {**changes["unet"], "sample_size": SIDE // 8}}
    return write_folder(make_models(changes), tmp_path_factory.mktemp("base_model") / "sd")


@pytest.fixture(scope="module")
def base_model_of(folder):
    """A base model of the given scaling factor; its networks but the autoencoder are the same ones."""
    loaded = load_base_model(folder)

    def make(scaling_factor=SCALING_FACTOR):
        base_model = dataclasses.replace(loaded, vae=tiny_autoencoder(scaling_factor))
        assert base_model.image_size == (SIDE, SIDE)
        return base_model

    return make


@pytest.fixture(scope="module")
def latents(frames):
    """[4, 64, 64] by name, not scaled."""
    with torch.no_grad():
        encoded = tiny_autoencoder().encode(images_to_tensor(np.stack(list(frames.values())))).latent_dist.mean
    return dict(zip(frames, encoded, strict=True))


@pytest.fixture(scope="module")
def cache(frames, base_model_of):
    """All frames, encoded by a base model of the right factor."""
    conditions = Conditions(tuple(f"a {name}" for name in frames))
    return cache_latents(base_model_of(), np.stack(list(frames.values())), conditions)


@pytest.fixture(scope="module")
def images(latents, base_model_of):
    """[3, 512, 512] by name, as decoded with the right factor."""
    base_model = base_model_of()
    return {name: decode_latents(base_model, values[None] * SCALING_FACTOR)[0] for name, values in latents.items()}


def psnr(image: torch.Tensor, frame: np.ndarray) -> float:
    """dB, of an image as decoded: clipping would hide what is blacker than black."""
    return float(10 * torch.log10(4 / (image - images_to_tensor(frame[None])[0]).square().mean()))


def test_scaled_latents_have_a_deviation_near_one_and_others_have_not(latents, base_model_of):
    for name, values in latents.items():
        assert values.shape == (4, SIDE // 8, SIDE // 8)
        # 7.3 of the picture; 7.7 to 9.2 of event images, most of which is how far black lies from the middle.
        assert 5 < values.std() < 10, name
        assert 0.5 < values.std() * base_model_of().scaling_factor < 2, name


def test_round_trip_keeps_frames_as_far_as_the_tiny_autoencoder_can(frames, images):
    for name, frame in frames.items():
        image = images[name]
        # 22.7 (street) to 25.6 dB (spot) of event images. It draws black as a grey of .045: black alone has 25.7 dB.
        assert psnr(image, frame) > 21.5, name
        alike = np.corrcoef(image.numpy().ravel(), images_to_tensor(frame[None]).numpy().ravel())[0, 1]
        # Bodies .90 and .91, digit .96, picture .99. Of isolated events, each spread over four pixels at half its
        # height, only the mean of their neighbourhood is left: spot .65, person .44, street .29.
        assert alike > (0.15 if name in SPARSE else 0.85), name
        if name not in SPARSE:
            assert psnr(image, frame) > psnr(-torch.ones(3, SIDE, SIDE), frame) + 1, f"{name}: no nearer than black"


@pytest.mark.parametrize(
    ("encoded", "decoded", "loss_db"),
    # Not scaled back; not scaled at first; twice of what it should be.
    [(SCALING_FACTOR, 1.0, 10), (1.0, SCALING_FACTOR, 10), (SCALING_FACTOR, 2 * SCALING_FACTOR, 5)],
)
def test_another_factor_on_the_way_back_draws_worse(frames, images, latents, base_model_of, encoded, decoded, loss_db):
    """14, 19 and 9 dB worse. A factor a little too small even gains, as black then is darker than it draws it."""
    for name in FEW:
        (wrong,) = decode_latents(base_model_of(decoded), latents[name][None] * encoded)
        assert psnr(wrong, frames[name]) < psnr(images[name], frames[name]) - loss_db, name


def test_cached_latents_are_those_of_a_direct_call(cache, latents, base_model_of):
    base_model = base_model_of()
    direct = torch.stack(list(latents.values()))
    assert cache.latents.std is None
    torch.testing.assert_close(torch.from_numpy(cache.latents.mean), direct, rtol=0, atol=0)
    rows = np.array([5, 0, 3])
    batch = cache.batch(rows, torch.Generator().manual_seed(0), 0.0, torch.device("cpu"))
    torch.testing.assert_close(batch.latents, direct[rows] * SCALING_FACTOR)
    decoded = base_model.vae.decode(direct[rows[:1]]).sample
    torch.testing.assert_close(decode_latents(base_model, batch.latents[:1]), decoded, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("scaling_factor", [SCALING_FACTOR, 1.0, SCALING_FACTOR**2])
def test_a_wrong_factor_in_a_folder_is_noticed_before_training(frames, cache, base_model_of, caplog, scaling_factor):
    conditions = Conditions(("an event image",) * len(frames))
    # Of latents that are not scaled, which are those of any factor.
    images, base_model = np.stack(list(frames.values())), base_model_of(scaling_factor)
    cache = cache_latents(base_model, images, conditions, latents=cache.latents)
    with caplog.at_level(logging.WARNING):
        check_cache(cache, conditions)
    messages = [record.getMessage() for record in caplog.records]
    if scaling_factor == SCALING_FACTOR:
        assert not messages
    else:
        (message,) = messages
        assert f"after scaling by {scaling_factor:g}" in message and "Stable Diffusion v1: 0.18215" in message


@pytest.mark.slow
def test_the_whole_route_learns_from_and_draws_frames_of_512_px(frames, base_model_of, tmp_path):
    base_model = base_model_of()
    conditions = Conditions(("an event image",) * 2)
    options = FineTuningOptions(num_steps=2, batch_size=2, warmup_steps=1, log_every=1, num_validation=0)
    images = np.stack([frames[name] for name in FEW])
    history = fine_tune(base_model, images, conditions, options, tune="unet", seed=0, work=tmp_path / "training")
    assert np.isfinite(history.loss).all()
    sampling = SamplingOptions(num_inference_steps=2, batch_size=2)
    drawn_frames = sample_frames(base_model, conditions, sampling, seeds=[0, 1], work=tmp_path / "sampling")
    assert drawn_frames.shape == (2, SIDE, SIDE, 3) and drawn_frames.dtype == np.uint8
