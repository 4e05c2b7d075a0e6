"""Networks of random weights: the sizes that were published, in files that every check takes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ctlev_core.diffusion.pretrained.loading import load_base_model
from ctlev_core.diffusion.pretrained.paths import base_model_places
from ctlev_core.downstream import torchscript
from ctlev_core.networks.resnet_files import check_resnet_folder
from ctlev_core.stand_ins import networks
from ctlev_core.stand_ins.making import make_stand_in
from data_contracts.errors import DataError

MILLIONS = {"unet": 859.5, "vae": 83.7, "text_encoder": 123.1, "controlnet": 361.3}
"""Of Stable Diffusion v1.4 and ControlNet v1.0, as published."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("stand_ins")


@pytest.mark.parametrize("part", MILLIONS)
def test_networks_have_the_published_numbers_of_weights(part):
    with torch.device("meta"):
        network = networks.build_network(part, networks.stable_diffusion_configs("full", 512)[part])
    assert sum(weight.numel() for weight in network.parameters()) / 1e6 == pytest.approx(MILLIONS[part], abs=0.05)


def test_a_tiny_base_model_passes_the_checks_and_loads(folder):
    place, controlnet = (make_stand_in(name, "tiny", folder) for name in ("stable_diffusion", "controlnet_openpose"))
    assert base_model_places(place, controlnet=controlnet, needs_controlnet=True) == [place, controlnet]
    model = load_base_model(place, controlnet=controlnet)
    assert model.image_size == (64, 64)
    # What a trained ControlNet has: its condition is heard.
    assert all(block.weight.abs().max() > 0 for block in model.controlnet.controlnet_down_blocks)


def test_two_controlnets_differ(folder):
    one, other = (make_stand_in(f"controlnet_{kind}", "tiny", folder) for kind in ("openpose", "normal"))
    name = "diffusion_pytorch_model.safetensors"
    assert (one / name).stat().st_size == (other / name).stat().st_size
    assert (one / name).read_bytes() != (other / name).read_bytes()


def test_weights_are_stored_in_half(folder):
    from ctlev_core.safe_files.tensor_files import read_tensor_table

    place = make_stand_in("stable_diffusion", "tiny", folder)
    table = read_tensor_table(place / "unet" / "diffusion_pytorch_model.safetensors")
    assert {tensor.dtype for tensor in table.values()} == {"F16"}


def test_resnet34_has_the_layout_of_transformers(folder):
    place = make_stand_in("resnet34", "tiny", folder)
    assert check_resnet_folder(place, "resnet34") == [place / "config.json", place / "model.safetensors"]
    with pytest.raises(DataError, match="resnet18"):
        check_resnet_folder(place, "resnet18")


@pytest.mark.parametrize(("size", "count"), [("tiny", 64), ("full", 2048)])
def test_inception_makes_features_of_images(size, count, folder, tmp_path):
    file = make_stand_in("inception", size, folder)
    with pytest.raises(DataError, match="trusted=true"):
        torchscript.input_files(torchscript.Options(file=file))
    assert torchscript.input_files(torchscript.Options(file=file, trusted=True)) == [file]
    side = networks.IMAGE_SIZE[size]
    images = np.random.default_rng(0).integers(0, 256, (2, 3, side, side)).astype(np.float32)
    program = torch.jit.load(file)
    made_where_it_was_traced = {"aten::arange", "aten::zeros", "aten::to"}
    assert not made_where_it_was_traced & {node.kind() for node in program.inlined_graph.nodes()}
    with torch.inference_mode():
        features = program(torch.from_numpy(images))
    assert features.shape == (2, count) and not torch.equal(features[0], features[1])
