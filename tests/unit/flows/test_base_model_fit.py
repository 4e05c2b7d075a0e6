"""A base model that does not fit images or conditions is refused where a run is planned, not hours later."""

import json
import shutil

import pytest

from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL
from flows.command_line import load_experiment
from flows.inputs import InputsMissing


def copy_of_base_model(folder, controlnet, **changed):
    """The bundled base model with another config of one of its ControlNets."""
    folder.mkdir()
    for part in BUNDLED_BASE_MODEL.iterdir():
        if part.name != controlnet:
            (folder / part.name).symlink_to(part)
    shutil.copytree(BUNDLED_BASE_MODEL / controlnet, folder / controlnet)
    config = folder / controlnet / "config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | changed))
    return folder


@pytest.mark.parametrize("preset", ["pose", "objects"])
def test_images_of_another_size_are_refused(preset):
    with pytest.raises(InputsMissing) as raised:
        load_experiment(preset, ["encoding.options.image_size=[128,96]"])
    expected = "makes images of 64 x 64 px, event images are 128 x 96 px; set encoding.options.image_size=[64,64]"
    assert expected in str(raised.value) and "base_models" in str(raised.value)
    load_experiment(preset, ["encoding.options.image_size=[64,64]"])


def test_images_of_a_baseline_are_looked_at_too():
    baseline = "baselines={other: {generator: {name: controlnet}}}"
    size = "encoding.options.image_size=[32,32]"
    with pytest.raises(InputsMissing, match="64 x 64 px"):
        load_experiment("pose", [baseline, size, "generator={name: event_gan}", "condition={name: intensity_pair}"])


def test_a_controlnet_that_exchanges_colours_once_more_is_refused(tmp_path):
    folder = copy_of_base_model(tmp_path / "m", "controlnet_normals", controlnet_conditioning_channel_order="bgr")
    chosen = f"generator.options.base_model={folder}"
    with pytest.raises(InputsMissing, match="does not fit a ControlNet whose channel order is 'bgr'; set condition"):
        load_experiment("body", [chosen, "condition.options.convention=controlnet"])
    load_experiment("body", [chosen, "condition.options.convention=controlnet_unreversed"])


def test_a_base_model_that_the_experiment_makes_is_made_to_fit():
    load_experiment(
        "objects", ["encoding.options.image_size=[32,32]", "stochastic_rounding=false", "base_model={image_size: 32}"]
    )
