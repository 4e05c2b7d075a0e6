"""The Inception network of FID: its size, its joints between layers, its resizing, and who may call a score `fid`."""

import hashlib

import numpy as np
import pytest
import torch
from torch.nn import functional

from ctlev_core.downstream import inception
from ctlev_core.networks import feature_extractors
from ctlev_core.networks.inception import InceptionFeatures, resize_as_tensorflow
from data_contracts.errors import DataError
from data_contracts.labels import Labels


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    made = InceptionFeatures()
    for name, buffer in made.named_buffers():  # as if trained: running means and variances that are not 0 and 1
        if buffer.is_floating_point():
            buffer.uniform_(0.5, 1.5) if name.endswith("var") else buffer.normal_(0, 0.1)
    return made


def test_the_number_of_weights_is_that_of_inception_v3(network):
    """23,834,568 without auxiliary classes (torchvision's documentation, 27,161,264 with), for 8 classes fewer."""
    assert sum(weights.numel() for weights in network.parameters()) == 23_834_568 + 8 * 2049
    names = network.state_dict()
    assert sum(name.endswith("conv.weight") for name in names) == 94
    for name, shape in (
        ("Mixed_5b.branch5x5_2.conv.weight", (64, 48, 5, 5)),
        ("Mixed_6a.branch3x3.conv.weight", (384, 288, 3, 3)),
        ("Mixed_6c.branch7x7dbl_4.conv.weight", (160, 160, 7, 1)),
        ("Mixed_7a.branch7x7x3_4.conv.weight", (192, 192, 3, 3)),
        ("Mixed_7c.branch3x3dbl_3b.conv.weight", (384, 384, 3, 1)),
        ("fc.weight", (1008, 2048)),
    ):
        assert tuple(names[name].shape) == shape


def layer(block, name, x):
    """Written out: convolution with the border that keeps the size, normalisation, ReLU."""
    part = getattr(block, name)
    weight, norm = part.conv.weight, part.bn
    x = functional.conv2d(x, weight, padding=(weight.shape[2] // 2, weight.shape[3] // 2))
    scale = norm.weight / torch.sqrt(norm.running_var + 1e-3)
    return torch.relu(x * scale[:, None, None] + (norm.bias - norm.running_mean * scale)[:, None, None])


@torch.no_grad()
def test_the_last_blocks_differ_in_their_pooling_and_join_their_branches_in_order(network):
    x = torch.randn(2, 2048, 4, 5)
    inside = functional.avg_pool2d(torch.ones(1, 1, 4, 5), 3, 1, 1)  # the share of each 3 x 3 that is in the image
    pooled = {"Mixed_7b": None, "Mixed_7c": functional.max_pool2d(x, 3, 1, 1)}
    pooled["Mixed_7b"] = functional.avg_pool2d(x[:, :1280], 3, 1, 1) / inside
    for name, pool in pooled.items():
        block, seen = getattr(network, name), x[:, : pool.shape[1]]
        middle = layer(block, "branch3x3_1", seen)
        double = layer(block, "branch3x3dbl_2", layer(block, "branch3x3dbl_1", seen))
        expected = [layer(block, "branch1x1", seen)]
        expected += [layer(block, f"branch3x3_2{side}", middle) for side in "ab"]
        expected += [layer(block, f"branch3x3dbl_3{side}", double) for side in "ab"]
        expected += [layer(block, "branch_pool", pool)]
        torch.testing.assert_close(block(seen), torch.cat(expected, dim=1), rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_the_grid_is_halved_without_a_border(network):
    block, x = network.Mixed_6a, torch.randn(1, 288, 9, 9)
    found = block(x)
    assert found.shape == (1, 768, 4, 4)
    torch.testing.assert_close(found[:, 480:], functional.max_pool2d(x, 3, 2))


@pytest.mark.parametrize("size", [(5, 8), (30, 7), (11, 11)])
def test_resizing_is_that_of_tensorflow_1(size):
    """Its kernel, resize_bilinear_op.cc with align_corners and half_pixel_centers off, pixel by pixel."""
    image = np.random.default_rng(0).uniform(0, 255, size)
    expected = np.empty((11, 11))
    for row in range(11):
        for column in range(11):
            y, x = row * size[0] / 11, column * size[1] / 11
            top, left = int(y), int(x)
            bottom, right = min(top + 1, size[0] - 1), min(left + 1, size[1] - 1)
            upper = image[top, left] + (image[top, right] - image[top, left]) * (x - left)
            lower = image[bottom, left] + (image[bottom, right] - image[bottom, left]) * (x - left)
            expected[row, column] = upper + (lower - upper) * (y - top)
    found = resize_as_tensorflow(torch.from_numpy(image)[None, None], 11)[0, 0]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)


def test_only_the_published_weights_are_taken_and_called_fid(tmp_path, monkeypatch, network):
    """The real file is not here: another one stands in for it by its checksum."""
    assert feature_extractors.INCEPTION_STATE_SHA256.startswith("6726825d")
    file, frames = tmp_path / "weights.pth", np.random.default_rng(1).integers(0, 256, (2, 40, 32, 3)).astype(np.uint8)
    torch.save(network.state_dict(), file)
    options = inception.Options(file=file, device="cpu")
    with pytest.raises(DataError, match=r"weights\.pth: expected the published weights, SHA-256 6726825d0af5"):
        inception.input_files(options)
    with pytest.raises(DataError, match=r"expected option `file` to be .* got None"):
        inception.input_files(inception.Options())
    monkeypatch.setattr(feature_extractors, "INCEPTION_STATE_SHA256", hashlib.sha256(file.read_bytes()).hexdigest())
    places = {"out": tmp_path / "model", "work": tmp_path / "work"}
    inception.train(frames, Labels(("", ""), np.zeros(2, np.int64)), options, seed=0, **places)
    assert [inception.name_score(tmp_path / "model", score) for score in ("fd", "kid")] == ["fid", "kid"]
    with torch.inference_mode():
        expected = network(torch.from_numpy(frames.transpose(0, 3, 1, 2).copy()).float())
    found = inception.features(tmp_path / "model", frames, "cpu")
    assert found.shape == (2, 2048) and found.dtype == np.float32
    np.testing.assert_allclose(found, expected.numpy(), rtol=1e-5, atol=1e-6)


def test_weights_of_another_network_are_refused(tmp_path, monkeypatch):
    file = tmp_path / "weights.pth"
    torch.save({"fc.weight": torch.zeros(2, 2)}, file)
    monkeypatch.setattr(feature_extractors, "INCEPTION_STATE_SHA256", hashlib.sha256(file.read_bytes()).hexdigest())
    with pytest.raises(DataError, match="expected the state dictionary of the 2015 Inception network"):
        inception.train(
            np.zeros((1, 8, 8, 3), np.uint8), Labels(("",), np.zeros(1, np.int64)),
            inception.Options(file=file, device="cpu"), seed=0, out=tmp_path / "model", work=tmp_path / "work",
        )  # fmt: skip
