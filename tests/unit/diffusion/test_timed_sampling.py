"""Costs are counted, and timed frames are those of the generator; what rounding costs."""

import numpy as np
import pytest
import torch
from tiny_base_model import make_base_model, make_data

from ctlev_core.diffusion.pretrained.loading import save_base_model
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.solver_studies.timed_sampling import sample_timed
from ctlev_core.diffusion.solver_studies.trajectory_precision import PRECISIONS, precision_errors
from ctlev_core.generators import controlnet

SEEDS = [7, 1, 4, 3, 5]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoint")
    save_base_model(make_base_model(), folder)
    return folder


@pytest.mark.parametrize(
    ("changed", "unet", "controlnet_calls"),
    [
        ({}, 5, 5),
        ({"controlnet_every": 2}, 5, 3),
        # With and without the prompt.
        ({"guidance_scale": 2.0}, 10, 10),
        # Three of five steps lie in the noisier half; the ControlNet's residuals are not carried from one to the other.
        ({"guidance_scale": 2.0, "guidance_interval": (0.5, 1.0), "timestep_spacing": "linspace"}, 8, 8),
        (
            {
                "guidance_scale": 2.0,
                "guidance_interval": (0.5, 1.0),
                "timestep_spacing": "linspace",
                "controlnet_every": 2,
            },
            8,
            5,
        ),
        ({"scheduler": "sa_solver"}, 5, 5),
    ],
)
def test_evaluations_are_counted(tmp_path, checkpoint, changed, unet, controlnet_calls):
    options = SamplingOptions.model_validate({"num_inference_steps": 5, "batch_size": 2} | changed)
    conditions = make_data(5)[1]
    made = sample_timed(checkpoint, conditions, options, seeds=SEEDS, work=tmp_path)
    np.testing.assert_array_equal(made.unet_evaluations, [unet] * 5)
    np.testing.assert_array_equal(made.controlnet_evaluations, [controlnet_calls] * 5)
    assert (made.wall_seconds > 0).all() and (made.cpu_seconds > 0).all()
    assert made.wall_seconds[0] == made.wall_seconds[1] != made.wall_seconds[2], "a time a batch, shared by its images"
    assert not list(tmp_path.iterdir()), "a later run must not find shards and take no time"


def test_timed_frames_are_those_of_the_generator(tmp_path, checkpoint):
    options = controlnet.SampleOptions(num_inference_steps=3, batch_size=2)
    conditions = make_data(5)[1]
    made = sample_timed(checkpoint, conditions, options, seeds=SEEDS, work=tmp_path)
    expected = controlnet.sample(checkpoint, conditions, options, seeds=SEEDS, work=tmp_path / "shards")
    np.testing.assert_array_equal(made.frames, expected)


def test_prompts_alone_need_no_controlnet(tmp_path, checkpoint):
    conditions = make_data(3, with_images=False)[1]
    made = sample_timed(checkpoint, conditions, SamplingOptions(num_inference_steps=2), seeds=[0, 1, 2], work=tmp_path)
    assert made.controlnet_evaluations.tolist() == [0, 0, 0]


def test_fewer_digits_cost_more(checkpoint):
    """float32 has 24 binary digits, float16 11, bfloat16 8: errors must be ordered, and of their magnitude."""
    conditions = make_data(2)[1]
    options = [SamplingOptions(num_inference_steps=steps) for steps in (3, 8)]
    found = precision_errors(checkpoint, conditions, options, seeds=[0, 1])
    assert [len(errors) for errors in found] == [len(PRECISIONS)] * 2
    for errors in found:
        by_name = {error.name: error for error in errors}
        single, half, brain = (
            by_name[f"networks {name}, state float32"].latent_error for name in ("float32", "float16", "bfloat16")
        )
        # Within a factor of some tens of half a unit in the last place; equal to it only by chance.
        assert 2**-25 / 4 < single < 2**-25 * 100
        assert single < half < brain < 2**-9 * 50
        rounded = by_name["networks bfloat16, state bfloat16"]
        assert rounded.latent_error > brain
        assert rounded.pixel_max_levels >= rounded.pixel_rms_levels > 0


def test_precision_is_not_asked_of_solvers_that_compute_in_float32(checkpoint):
    with pytest.raises(ValueError, match=r"unipc or deis, got 'dpmpp_2m'"):
        precision_errors(checkpoint, make_data(1)[1], [SamplingOptions(scheduler="dpmpp_2m")], seeds=[0])


def test_the_patch_code_adds_no_rounding_of_its_own(checkpoint):
    """The reference is decoded in float64, and so are the others: equal latents give equal pixels."""
    found = precision_errors(checkpoint, make_data(1)[1], [SamplingOptions(num_inference_steps=3)], seeds=[0])
    single = found[0][0]
    assert single.name == f"networks {str(torch.float32)[6:]}, state float32"
    assert single.pixel_rms_levels < 1e-2
