"""Published residual networks as a start: what is taken over, what is refused, and what enters the cache key."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from transformers import ResNetConfig, ResNetForImageClassification

from ctlev_core.downstream import classifier
from ctlev_core.networks.resnet_files import ARCHITECTURES
from data_contracts.config import DownstreamChoice
from data_contracts.errors import DataError
from data_contracts.labels import Labels
from data_contracts.manifest import ManifestRef
from tasks.downstream import train_downstream
from tasks.store import Store


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """A random network in the layout of microsoft/resnet-34: 1,000 classes, running means that are not 0."""
    config = ResNetConfig(layer_type="basic", num_labels=1000, **ARCHITECTURES["resnet10-quarter"])
    torch.manual_seed(0)
    network = ResNetForImageClassification(config)
    with torch.no_grad():
        for buffer in network.buffers():
            if buffer.is_floating_point():
                buffer.uniform_(0.5, 1.5)
    folder = tmp_path_factory.mktemp("published") / "resnet"
    network.save_pretrained(folder)
    return network.eval(), folder


def options(folder, **others):
    return classifier.Options(weights=folder, device="cpu", num_steps=1, batch_size=2, **others)


def pictures(count=4):
    frames = np.random.default_rng(0).integers(0, 256, (count, 40, 48, 3)).astype(np.uint8)
    return frames, Labels(("a", "b") * (count // 2), np.arange(count))


def test_all_weights_but_the_head_are_taken_over(published):
    network, folder = published
    built = classifier._build_from_options(7, options(folder, head_width=5))
    state = built.backbone.state_dict()
    assert set(state) == set(network.resnet.state_dict())
    for name, tensor in network.resnet.state_dict().items():
        assert torch.equal(state[name], tensor), name
    assert [layer.out_features for layer in built.head if isinstance(layer, torch.nn.Linear)] == [5, 7]


def test_it_sees_the_input_that_it_was_published_with(published):
    """0..1, then ImageNet's mean and standard deviation, as the folder's own preprocessor would."""
    network, folder = published
    frames, _ = pictures()
    built = classifier._build_from_options(2, options(folder)).eval()
    images = torch.from_numpy(frames).permute(0, 3, 1, 2).float() / 255
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    with torch.inference_mode():
        expected = network.resnet((images - mean[:, None, None]) / std[:, None, None]).pooler_output.flatten(1)
        torch.testing.assert_close(built.features(images), expected)


def test_training_starts_from_them(published, tmp_path):
    network, folder = published
    frames, labels = pictures()
    chosen = options(folder, learning_rate=1e-12)
    classifier.train(frames, labels, chosen, seed=0, out=tmp_path / "m", work=tmp_path / "w")
    trained, config = classifier._read_model(tmp_path / "m")
    for name, weight in network.resnet.named_parameters():
        torch.testing.assert_close(trained.backbone.get_parameter(name), weight, msg=name)
    assert set(config["weights"]) == {"config.json", "model.safetensors"}
    assert "weights" not in config["options"], "a path would differ between machines"


def test_a_file_without_head_and_batch_counts_fits_too(published, tmp_path):
    network, folder = published
    shutil.copytree(folder, tmp_path / "bare")
    tensors = {name: tensor.contiguous() for name, tensor in network.resnet.state_dict().items()}
    tensors = {name: tensor for name, tensor in tensors.items() if "num_batches" not in name}
    save_file(tensors, tmp_path / "bare" / "model.safetensors")
    built = classifier._build_from_options(2, options(tmp_path / "bare"))
    assert all(torch.equal(built.backbone.state_dict()[name], tensor) for name, tensor in tensors.items())


def change_config(folder, **changes):
    path = folder / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def change_tensor(folder, name, change):
    tensors = load_file(folder / "model.safetensors")
    changed = change(tensors.pop(name))
    save_file({**tensors, **({} if changed is None else {name: changed})}, folder / "model.safetensors")


NORM = "resnet.encoder.stages.1.layers.0.shortcut.normalization.running_var"
WRONG_FOLDERS = {
    "nothing": (shutil.rmtree, "expected config.json and model.safetensors, found no config.json"),
    "weights": (lambda folder: (folder / "model.safetensors").unlink(), "found no model.safetensors"),
    "no json": (lambda folder: (folder / "config.json").write_text("{"), "expected the JSON config of a model"),
    "no kind": (lambda folder: (folder / "config.json").write_text("[]"), "expected the JSON config of a model"),
    "other kind": (lambda folder: change_config(folder, model_type="vit"), "expected model_type 'resnet', got 'vit'"),
    "blocks": (lambda folder: change_config(folder, layer_type="bottleneck"), "expected layer_type basic of resnet10"),
    "depths": (
        lambda folder: change_config(folder, depths=[3, 4, 6, 3]),
        r"expected depths \[1, 1, 1, 1\] of ",
    ),
}
WRONG_TENSORS = {
    "truncated": (
        lambda folder: (folder / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes()[:9000]),
        "cannot be read as safetensors",
    ),
    "missing": (
        lambda folder: change_tensor(folder, NORM, lambda _: None),
        "lacks 1 of 72 tensors, the first enc",
    ),
    "shape": (
        lambda folder: change_tensor(folder, NORM, lambda tensor: tensor[:5]),
        r"running_var must be of shape \[32\], got \[5\]",
    ),
    "nan": (
        lambda folder: change_tensor(folder, NORM, lambda tensor: tensor * float("nan")),
        "has values that are not finite",
    ),
}


@pytest.mark.parametrize("case", WRONG_FOLDERS)
def test_wrong_folders_are_refused_before_anything_is_planned(published, tmp_path, case):
    shutil.copytree(published[1], tmp_path / "resnet")
    spoil, message = WRONG_FOLDERS[case]
    spoil(tmp_path / "resnet")
    with pytest.raises(DataError, match=message):
        classifier.input_files(options(tmp_path / "resnet"))


@pytest.mark.parametrize("case", WRONG_TENSORS)
def test_wrong_weights_are_refused_before_the_first_step(published, tmp_path, case):
    shutil.copytree(published[1], tmp_path / "resnet")
    spoil, message = WRONG_TENSORS[case]
    spoil(tmp_path / "resnet")
    frames, labels = pictures()
    with pytest.raises(DataError, match=message):
        classifier.train(frames, labels, options(tmp_path / "resnet"), seed=0, out=tmp_path / "m", work=tmp_path / "w")
    assert not (tmp_path / "m").exists() and not (tmp_path / "w").exists()


def test_another_architecture_is_named(published):
    with pytest.raises(DataError, match=r"expected hidden_sizes \[32, 64, 128, 256\] of resnet10-half, got \[16, 32"):
        classifier.input_files(options(published[1], architecture="resnet10-half"))


def test_the_content_of_the_weights_is_in_the_cache_key_and_their_place_is_not(published, tmp_path, home):
    def key(folder):
        chosen = {} if folder is None else {"weights": str(folder)}
        arguments = {
            "training_sets": [ManifestRef(key="0" * 32, path=Path("frames"))],
            "downstream": DownstreamChoice(name="classifier", options=chosen),
            "seed": 0,
        }
        return train_downstream.key(arguments, Store())

    for name in ("copy", "changed"):
        shutil.copytree(published[1], tmp_path / name)
    change_tensor(tmp_path / "changed", NORM, lambda tensor: tensor + 1)
    keys = [key(folder) for folder in (published[1], tmp_path / "copy", tmp_path / "changed", None)]
    assert keys[0] == keys[1] and len(set(keys)) == 3
