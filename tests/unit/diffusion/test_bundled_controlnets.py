"""The ControlNets of the bundled base model heed the conditions that this code draws, and are found by name."""

from functools import partial
from pathlib import Path

import pytest

from ctlev_core.diffusion.denoising import Denoiser, NoiseSchedule, validation_losses
from ctlev_core.diffusion.pretrained.loading import load_base_model
from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL
from ctlev_core.diffusion.pretraining import pretraining, procedural_images
from ctlev_core.generators import controlnet
from data_contracts.errors import DataError


def losses(name, kind, change=None):
    """Loss of people with their own and with another's condition, over the same noise."""
    base_model = load_base_model(controlnet=Path(name))
    options = pretraining.PretrainingOptions(condition=kind)
    rows = pretraining.draw_validation_rows(options, partial(procedural_images.draw_person, condition=kind))[:48]
    if change is not None:
        rows = [pretraining.Row(row.image, row.caption, change(row.condition)) for row in rows]
    batch = pretraining.make_batch(base_model, rows)
    schedule = NoiseSchedule(base_model.scheduler_config)
    return validation_losses(Denoiser(base_model.unet, base_model.controlnet), schedule, batch, seed=0, batch_size=24)


@pytest.mark.parametrize(
    ("name", "kind", "gap"), [("controlnet", "skeleton", 0.01), ("controlnet_normals", "normals", 0.016)]
)
def test_own_conditions_help_and_others_do_not(name, kind, gap):
    # The gaps of the whole validation sets are .017 and .023; drawings in another convention would close them.
    own, another = losses(name, kind)
    assert another - own > gap


def test_normals_in_another_convention_are_worse_than_ones_own():
    own, _ = losses("controlnet_normals", "normals")
    reversed_channels, _ = losses("controlnet_normals", "normals", lambda image: image[..., ::-1].copy())
    assert reversed_channels > own + 0.002


def test_a_controlnet_is_chosen_by_its_name_in_the_base_model():
    folders = controlnet.base_model_folders(controlnet.Options(controlnet=Path("controlnet_normals")))
    assert folders == [BUNDLED_BASE_MODEL, BUNDLED_BASE_MODEL / "controlnet_normals"]
    assert controlnet.base_model_folders(controlnet.Options()) == [BUNDLED_BASE_MODEL]
    with pytest.raises(DataError, match=r"no such folder; those of the base model: controlnet, controlnet_normals"):
        controlnet.base_model_folders(controlnet.Options(controlnet=Path("controlnet_depth")))
