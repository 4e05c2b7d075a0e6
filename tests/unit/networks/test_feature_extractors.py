"""Ready-made networks as feature extractors: their features by hand, their names, and what is refused."""

import hashlib
import json

import numpy as np
import pytest
import torch

from ctlev_core.downstream import torchscript, transformers_features
from ctlev_core.networks import feature_extractors
from data_contracts.config import cache_material
from data_contracts.errors import DataError
from data_contracts.labels import Labels

MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]


def pictures(count=5, size=(12, 10)):
    return np.random.default_rng(0).integers(0, 256, (count, *size, 3)).astype(np.uint8)


def keep(module, options, tmp_path, frames=None, name="model"):
    frames = pictures() if frames is None else frames
    labels = Labels(("",) * len(frames), np.arange(len(frames)))
    history = module.train(frames, labels, options, seed=0, out=tmp_path / name, work=tmp_path / "work")
    assert history.loss == []
    return tmp_path / name


class Means(torch.nn.Module):
    """Mean of each channel, and of its left half."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        left = images[..., : images.shape[-1] // 2]
        return torch.cat([images.mean([2, 3]), left.mean([2, 3])], 1)


class LikeInception(torch.nn.Module):
    """Class scores, or what lies before them: the signature of the published file."""

    def forward(self, images: torch.Tensor, return_features: bool = False) -> torch.Tensor:
        means = images.mean([2, 3])
        if return_features:
            return means[:, :, None, None]
        return means.softmax(1)


class OneNumber(torch.nn.Module):
    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images.mean()


class Root(torch.nn.Module):
    """Finite only where the first pixel is bright."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return (images[:, :, 0, 0] - 100).sqrt()


class FourChannels(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.convolution = torch.nn.Conv2d(4, 2, 1)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.convolution(images).mean([2, 3])


def script(module, path):
    torch.jit.script(module).save(str(path))
    return path


def means(frames):
    images = frames.astype(np.float64)
    return np.concatenate([images.mean((1, 2)), images[:, :, : frames.shape[2] // 2].mean((1, 2))], 1)


def test_torchscript_sees_frames_as_they_are(tmp_path):
    frames = pictures(70)
    file = script(Means(), tmp_path / "means.pt")
    model = keep(torchscript, torchscript.Options(file=file, device="cpu", trusted=True), tmp_path)
    found = torchscript.features(model, frames)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, means(frames), rtol=1e-5)
    np.testing.assert_array_equal(torchscript.predict(model, frames)["features"], found)


def test_torchscript_is_kept_wherever_its_file_goes(tmp_path):
    file = script(Means(), tmp_path / "means.pt")
    model = keep(torchscript, torchscript.Options(file=file, device="cpu", trusted=True), tmp_path)
    content = file.read_bytes()
    file.unlink()
    assert torchscript.features(model, pictures()).shape == (5, 6)
    name = torchscript.name_score(model, "fd")
    assert name == f"fd_event_torchscript_{hashlib.sha256(content).hexdigest()[:8]}"
    (model / "network" / "network.pt").write_bytes(content + b"0")
    for function in (lambda: torchscript.features(model, pictures()), lambda: torchscript.name_score(model, "fd")):
        with pytest.raises(DataError, match=r"network\.pt: expected SHA-256"):
            function()


def test_values_and_size_are_options(tmp_path):
    frames = np.full((3, 8, 6, 3), 51, np.uint8)
    file = script(Means(), tmp_path / "means.pt")
    for values, expected in (("0..1", [0.2] * 3), ("imagenet", (0.2 - np.array(MEAN)) / STD)):
        options = torchscript.Options(
            file=file, values=values, image_size=16, architecture="means", device="cpu", trusted=True
        )
        model = keep(torchscript, options, tmp_path, frames, name=values)
        np.testing.assert_allclose(torchscript.features(model, frames)[:, :3], np.tile(expected, (3, 1)), rtol=1e-5)
        assert torchscript.name_score(model, "kid").startswith("kid_event_means_")


def test_only_the_verified_inception_is_called_fid(tmp_path, monkeypatch):
    """The real file is not here: another one stands in for it by its checksum."""
    file = script(LikeInception(), tmp_path / "inception.pt")
    options = torchscript.Options(file=file, device="cpu")
    other = keep(torchscript, options.model_copy(update={"trusted": True}), tmp_path, name="other")
    assert torchscript.name_score(other, "fd").startswith("fd_event_torchscript_")
    monkeypatch.setattr(feature_extractors, "INCEPTION_SHA256", hashlib.sha256(file.read_bytes()).hexdigest())
    model = keep(torchscript, options, tmp_path)
    assert torchscript.name_score(model, "fd") == "fid" and torchscript.name_score(model, "kid") == "kid"
    assert torchscript.name_score(model, "coverage").startswith("coverage_event_inception_")
    # Features, not class scores, are asked for.
    np.testing.assert_allclose(torchscript.features(model, pictures()), means(pictures())[:, :3], rtol=1e-5)
    wrong = torchscript.Options(file=file, values="imagenet", image_size=299)
    with pytest.raises(DataError, match=r"takes 0\.\.255 and resizes by itself; .* got imagenet and 299"):
        torchscript.input_files(wrong)


def test_the_checksum_is_the_published_one():
    assert feature_extractors.INCEPTION_SHA256.startswith("f58cb9b6") and len(feature_extractors.INCEPTION_SHA256) == 64


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (OneNumber(), r"expected features \[2, D\] of the network, got \(\)"),
        (Root(), r"the features of row 1 are not finite"),
        (FourChannels(), r"the network cannot run on images \[2, 3, 12, 10\]"),
    ],
    ids=["one number", "not finite", "channels"],
)
def test_networks_that_make_no_features_are_refused(tmp_path, module, message):
    frames = pictures()
    frames[:, 0, 0], frames[1, 0, 0] = 200, 0
    file = script(module, tmp_path / "network.pt")
    with pytest.raises(DataError, match=message):
        keep(torchscript, torchscript.Options(file=file, device="cpu", trusted=True), tmp_path, frames)


def test_wrong_files_are_named(tmp_path):
    for file in (None, tmp_path / "none.pt"):
        with pytest.raises(DataError, match="expected option `file` to be a TorchScript file, got"):
            torchscript.input_files(torchscript.Options(file=file, trusted=True))
    (tmp_path / "text.pt").write_text("no network")
    with pytest.raises(DataError, match="cannot be loaded as TorchScript"):
        keep(torchscript, torchscript.Options(file=tmp_path / "text.pt", trusted=True), tmp_path)
    file = script(Means(), tmp_path / "means.pt")
    with pytest.raises(DataError, match="no frames to compute features of"):
        keep(torchscript, torchscript.Options(file=file, trusted=True), tmp_path, pictures(0))
    with pytest.raises(DataError, match="expected a transformers_features extractor, got 'torchscript'"):
        transformers_features.features(
            keep(torchscript, torchscript.Options(file=file, trusted=True), tmp_path, name="other"), pictures()
        )


def tiny_models():
    """Networks of a few thousand random weights, saved as the published ones are, and their features by hand."""
    import transformers as hf

    vision = {"hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "patch_size": 7, "image_size": 28}
    torch.manual_seed(0)
    dino = hf.Dinov2Model(hf.Dinov2Config(**vision))
    clip = hf.CLIPModel(
        hf.CLIPConfig(
            vision_config={**vision, "intermediate_size": 24, "projection_dim": 12},
            text_config={"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 24},
            projection_dim=12,
        )
    )
    shape = {"depths": [1, 1], "hidden_sizes": [8, 16], "embedding_size": 8, "layer_type": "basic"}
    resnet = hf.ResNetForImageClassification(hf.ResNetConfig(**shape))
    return {
        "dinov2": (dino, lambda images: dino(images).last_hidden_state[:, 0]),
        "clip": (clip, lambda images: clip.visual_projection(clip.vision_model(images).pooler_output)),
        "resnet": (resnet, lambda images: resnet.resnet(images).pooler_output.flatten(1)),
    }


def save(network, folder, **changes):
    network.save_pretrained(folder)
    preprocessor = {"crop_size": {"height": 28, "width": 28}, "image_mean": MEAN, "image_std": STD, **changes}
    (folder / "preprocessor_config.json").write_text(json.dumps(preprocessor))
    return folder


@pytest.mark.parametrize("kind", ["dinov2", "clip", "resnet"])
def test_transformers_folders_give_their_features(tmp_path, kind):
    network, by_hand = tiny_models()[kind]
    network.eval()
    folder = save(network, tmp_path / kind)
    options = transformers_features.Options(folder=folder, device="cpu")
    frames = pictures(4, (28, 28))
    model = keep(transformers_features, options, tmp_path, frames)
    found = transformers_features.features(model, frames)
    images = torch.from_numpy(frames).permute(0, 3, 1, 2).float() / 255
    normalised = (images - torch.tensor(MEAN).view(3, 1, 1)) / torch.tensor(STD).view(3, 1, 1)
    with torch.inference_mode():
        expected = by_hand(normalised).numpy()
    # float32 through three layers; batches of another size may add in another order.
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    names = {transformers_features.name_score(model, "fd"), transformers_features.name_score(model, "fd")}
    assert len(names) == 1 and names.pop().startswith(f"fd_event_{kind}_")
    np.testing.assert_array_equal(transformers_features.predict(model, frames)["features"], found)


def test_images_are_squeezed_and_stay_in_range(tmp_path):
    network, _ = tiny_models()["dinov2"]
    folder = save(network.eval(), tmp_path / "dinov2")
    model = keep(transformers_features, transformers_features.Options(folder=folder, device="cpu"), tmp_path)
    white = np.full((1, 40, 64, 3), 255, np.uint8)
    small = np.full((1, 28, 28, 3), 255, np.uint8)
    first, second = (transformers_features.features(model, frames) for frames in (white, small))
    np.testing.assert_allclose(first, second, rtol=1e-4, atol=1e-5)


def change_json(path, **changes):
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


WRONG = {
    "kind": (lambda f: change_json(f / "config.json", model_type="bert"), "expected model_type dinov2, .* got 'bert'"),
    "config": (lambda f: (f / "config.json").unlink(), "expected config.json of a transformers model"),
    "preprocessor": (lambda f: (f / "preprocessor_config.json").unlink(), "expected preprocessor_config.json"),
    "no json": (lambda f: (f / "preprocessor_config.json").write_text("{"), "is no JSON"),
    "mean": (lambda f: change_json(f / "preprocessor_config.json", image_mean=[0.5]), r"mean \[0.5\]"),
    "size": (lambda f: change_json(f / "preprocessor_config.json", crop_size=0, size=None), "size None"),
    "weights": (lambda f: (f / "model.safetensors").unlink(), r"expected weights as model\*.safetensors"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_folders_are_refused_before_anything_is_planned(tmp_path, case):
    folder = save(tiny_models()["dinov2"][0], tmp_path / "dinov2")
    options = transformers_features.Options(folder=folder)
    assert {path.name for path in transformers_features.input_files(options)} == {
        "config.json",
        "preprocessor_config.json",
        "model.safetensors",
    }
    spoil, message = WRONG[case]
    spoil(folder)
    with pytest.raises(DataError, match=message):
        transformers_features.input_files(options)


def test_weights_that_lack_a_tensor_are_refused(tmp_path):
    """transformers itself would go on with random numbers in its place."""
    from safetensors.torch import load_file, save_file

    folder = save(tiny_models()["dinov2"][0], tmp_path / "dinov2")
    tensors = load_file(folder / "model.safetensors")
    tensors.pop("encoder.layer.1.mlp.fc1.weight")
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(DataError, match=r"the weights lack 1 tensors of Dinov2Model, the first encoder\.layer"):
        keep(transformers_features, transformers_features.Options(folder=folder), tmp_path)
    (folder / "model.safetensors").write_bytes(b"short")
    with pytest.raises(DataError, match="cannot be loaded as Dinov2Model"):
        keep(transformers_features, transformers_features.Options(folder=folder), tmp_path, name="again")


def test_no_folder_is_named():
    with pytest.raises(DataError, match="expected option `folder` to be a folder, got None"):
        transformers_features.input_files(transformers_features.Options())


def test_a_program_in_a_file_runs_only_where_somebody_trusts_it(tmp_path):
    """`torch.from_file(shared=True)` in a TorchScript file makes and writes files."""
    written = tmp_path / "written"

    class WritesFile(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.place = str(written)

        def forward(self, images: torch.Tensor) -> torch.Tensor:
            written = torch.from_file(self.place, True, 4, dtype=torch.float32).fill_(1)
            return images.mean([2, 3]) + written.sum()

    file = script(WritesFile(), tmp_path / "network.pt")
    for function in (torchscript.input_files, lambda options: keep(torchscript, options, tmp_path)):
        with pytest.raises(DataError, match=r"network\.pt: .* is a program .* set the option trusted=true") as refused:
            function(torchscript.Options(file=file, device="cpu"))
        assert len(str(refused.value)) < 500 and not written.exists()
    keep(torchscript, torchscript.Options(file=file, device="cpu", trusted=True), tmp_path)
    assert written.stat().st_size == 16


def test_trust_changes_no_cache_key(tmp_path):
    options = torchscript.Options(file=tmp_path / "a.pt")
    assert cache_material(options) == cache_material(options.model_copy(update={"trusted": True}))
