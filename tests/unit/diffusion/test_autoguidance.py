"""Guidance away from the network without its attention blocks: by hand, with other guidance, and without any."""

import copy

import numpy as np
import pytest
import torch
from tiny_base_model import make_data, shared_base_model
from tiny_families import write_family

from ctlev_core.diffusion.denoising import Denoiser
from ctlev_core.diffusion.pretrained.loading import load_base_model
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.sampling.autoguidance import attention_blocks, without_blocks
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.sampling import guided_predictions, sample_frames, sample_latents
from data_contracts.errors import DataError

OPTIONS = SamplingOptions(num_inference_steps=4, device="cpu")


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return load_base_model(write_family("v1", tmp_path_factory.mktemp("v1") / "v1"))


class Identity(torch.nn.Module):
    """An attention block that does nothing, put in the place of one."""

    def forward(self, hidden_states, **named):
        return hidden_states


def worse_by_hand(model, layers):
    """The network rebuilt without blocks, and not by hooks."""
    unet = copy.deepcopy(model.unet)
    for name, module in list(unet.named_modules()):
        if type(module).__name__ == "BasicTransformerBlock" and (layers == "all" or name.startswith("mid_block.")):
            parent, _, last = name.rpartition(".")
            unet.get_submodule(parent)[int(last)] = Identity()
    return unet


@pytest.mark.parametrize("layers", ["middle", "all"])
@pytest.mark.parametrize("guidance_scale", [1.0, 3.0])
def test_predictions_go_beyond_those_of_the_worse_network(model, layers, guidance_scale):
    options = OPTIONS.model_copy(
        update={"autoguidance_scale": 2.5, "autoguidance_layers": layers, "guidance_scale": guidance_scale}
    )
    generator = torch.Generator().manual_seed(0)
    noisy = torch.randn((2, 4, 4, 4), generator=generator)
    images = torch.rand((2, 3, 32, 32), generator=generator)
    table = encode_prompts(model, ["a photo of a cup", "a photo of a ball", ""])
    with guided_predictions(model, table[:2], table[2:], images, options) as predict, torch.no_grad():
        found = predict(noisy, torch.tensor(700))
        again = predict(noisy, torch.tensor(700))
    timesteps = torch.full((2,), 700)
    good, bad = (Denoiser(unet, model.controlnet) for unet in (model.unet, worse_by_hand(model, layers)))
    with torch.no_grad():
        prompted, worse = (each.predict(noisy, timesteps, table[:2], images) for each in (good, bad))
        plain = good.predict(noisy, timesteps, table[[2, 2]], images)
    assert (prompted - worse).abs().max() > 3e-4
    expected = plain + guidance_scale * (prompted - plain) + 1.5 * (prompted - worse)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=2e-6)
    assert torch.equal(found, again)
    assert options.passes_a_step == (2 if guidance_scale == 1 else 3)


def test_blocks_are_there_again_afterwards(model):
    blocks = attention_blocks(model.unet, "all")
    assert len(attention_blocks(model.unet, "middle")) == 1 < len(blocks)
    with pytest.raises(KeyError), without_blocks(blocks):
        raise KeyError
    assert not any(block._forward_hooks for block in blocks)


def test_without_guidance_nothing_changes(model):
    table = encode_prompts(model, ["a cup", ""])

    def sampled(**changes):
        options = OPTIONS.model_copy(update=changes)
        return sample_latents(model, table[:1], table[1:], None, [5], options)

    assert torch.equal(sampled(), sampled(autoguidance_scale=1.0, autoguidance_layers="all"))
    assert torch.equal(sampled(), sampled(autoguidance_scale=3.0, guidance_interval=(0.9999, 0.9999)))
    assert not torch.allclose(sampled(), sampled(autoguidance_scale=3.0), atol=1e-3)


def test_frames_do_not_depend_on_batches(tmp_path):
    base_model = shared_base_model()
    _, conditions = make_data(3)
    found = []
    for size in (3, 1):
        options = OPTIONS.model_copy(update={"autoguidance_scale": 2.0, "batch_size": size})
        found.append(
            sample_frames(base_model, conditions, options, seeds=range(3), work=tmp_path / str(size)).astype(int)
        )
    assert np.abs(found[0] - found[1]).max() <= 1 and found[0].std() > 1


def test_a_network_without_attention_in_the_middle_is_named():
    unet = type("Unet", (), {"mid_block": torch.nn.Identity()})()
    with pytest.raises(DataError, match="autoguidance_layers 'middle': this U-Net has no attention blocks there"):
        attention_blocks(unet, "middle")


def test_students_take_none():
    with pytest.raises(ValueError, match="tcd takes no autoguidance_scale"):
        SamplingOptions(scheduler="tcd", autoguidance_scale=2.0)
