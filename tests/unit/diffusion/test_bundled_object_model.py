"""The base model of the text route knows what things are called."""

import numpy as np
import pytest
import torch

from ctlev_core.diffusion.denoising import NoiseSchedule, generator_for
from ctlev_core.diffusion.pretrained.loading import load_base_model
from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL, BUNDLED_OBJECT_MODEL
from ctlev_core.diffusion.pretraining import picture_styles, procedural_images
from ctlev_core.diffusion.pretraining.pretraining import Row, make_batch
from ctlev_core.generators import stable_diffusion
from ctlev_core.studio.object_drawing import draw_object
from ctlev_core.studio.objects import NAMES, OBJECTS

LINES = picture_styles.DataMixture(styles={"lines": 1.0})
NOUNS = tuple(NAMES)


@pytest.fixture(scope="module")
def base_model():
    return load_base_model(BUNDLED_OBJECT_MODEL)


def drawings(seed):
    """Line drawings of every noun that has several names, two each."""
    rows = []
    for index, noun in enumerate(2 * NOUNS):
        rng = np.random.default_rng([seed, index])
        picture = draw_object(noun, "white", np.full((64, 64, 3), 8, np.uint8), rng, procedural_images.THING_SIZE)
        scene = picture_styles.Scene(picture, None, noun, f"white {noun}")
        rows.append(picture_styles.apply_style(scene, rng, LINES)[0])
    return rows


def errors(base_model, pictures, captions, timestep):
    """Squared error of each picture's latents as the U-Net finds them under noise."""
    batch = make_batch(
        base_model, [Row(picture, caption, None) for picture, caption in zip(pictures, captions, strict=True)]
    )
    noise = torch.randn(batch.latents.shape, generator=generator_for(7))
    timesteps = torch.full((len(pictures),), timestep)
    noisy, latents = NoiseSchedule(base_model.scheduler_config).noised(batch.latents, noise, timesteps)
    with torch.no_grad():
        found = base_model.unet(noisy, timesteps, encoder_hidden_states=batch.embeddings).sample
    return (found - latents).square().mean(dim=(1, 2, 3)).numpy()


def test_the_text_route_starts_from_it_and_it_is_small(base_model):
    assert stable_diffusion.base_model_folders(stable_diffusion.Options()) == [BUNDLED_OBJECT_MODEL]
    assert base_model.controlnet is None and base_model.image_size == (64, 64)
    sizes = [path.stat().st_size for place in (BUNDLED_BASE_MODEL, BUNDLED_OBJECT_MODEL) for path in place.rglob("*")]
    assert sum(sizes) < 40e6


@pytest.mark.parametrize("timestep", [500, 650, 999])
def test_own_names_help_and_others_do_not(base_model, timestep):
    """Of 48 drawings: far fewer could have smaller errors with another's name if names said nothing."""
    pictures = drawings(3)
    own = errors(base_model, pictures, [f"A photo of {noun}" for noun in 2 * NOUNS], timestep)
    other = errors(base_model, pictures, [f"A photo of {noun}" for noun in 2 * (NOUNS[5:] + NOUNS[:5])], timestep)
    assert other.mean() > 1.02 * own.mean()
    assert (own < other).mean() > 0.75


def test_all_names_of_a_thing_are_known(base_model):
    pictures = drawings(4)
    own = errors(base_model, pictures, [f"A photo of {NAMES[noun][-1]}" for noun in 2 * NOUNS], 650)
    other = errors(base_model, pictures, [f"A photo of {NAMES[noun][-1]}" for noun in 2 * (NOUNS[5:] + NOUNS[:5])], 650)
    assert (own < other).mean() > 0.65


def test_names_belong_to_one_thing_each():
    names = [name for several in NAMES.values() for name in several]
    assert len(set(names)) == len(names)
    assert all(several[0] == noun and noun in OBJECTS for noun, several in NAMES.items())
    assert not {name for noun, several in NAMES.items() for name in several[1:]} & set(OBJECTS)
