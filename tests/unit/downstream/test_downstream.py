import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.downstream import classifier, pose2d
from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.supervised.batches import TrainingRows
from data_contracts.errors import DataError, TrainingError
from data_contracts.labels import Labels

FAST_POSE = {
    "width": 0.5,
    "batch_norm": True,
    "loss": "cross_entropy",
    "sigma_px": 1.0,
    "decoding": "soft_argmax",
    "batch_size": 8,
    "learning_rate": 5e-3,
    "warmup_steps": 5,
    "device": "cpu",
}


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def blobs(count: int, seed: int = 0, size: int = 24) -> tuple[np.ndarray, Labels]:
    """A small bright spot (joint 0) and a large dim one (joint 1) on each frame, at sub-pixel positions."""
    generator = np.random.default_rng(seed)
    points = generator.uniform(3, size - 3, size=(count, 2, 2)).astype(np.float32)
    centres = np.arange(size) + 0.5
    image = np.zeros((count, size, size))
    for joint, (height, sigma) in enumerate(((255, 0.8), (110, 2.2))):
        x, y = points[:, joint, 0, None, None], points[:, joint, 1, None, None]
        squared = (centres[None, None, :] - x) ** 2 + (centres[None, :, None] - y) ** 2
        image = np.maximum(image, height * np.exp(-squared / (2 * sigma**2)))
    frames = np.repeat(np.round(image).astype(np.uint8)[..., None], 3, axis=-1)
    return frames, Labels(("",) * count, np.zeros(count, np.int64), points, np.ones((count, 2), bool), "blobs")


def stripes(count: int, seed: int = 0, size: int = 32) -> tuple[np.ndarray, Labels]:
    """Noisy stripes, upright in class `up` and level in class `level`."""
    generator = np.random.default_rng(seed)
    names = tuple(generator.choice(["up", "level"], size=count).tolist())
    wave = 120 + 100 * np.sin(np.arange(size)[None, :] * 0.9 + generator.uniform(0, 6, size=(count, 1)))
    images = np.stack([np.tile(row, (size, 1)) if name == "up" else np.tile(row[:, None], size)
                       for row, name in zip(wave, names, strict=True)])  # fmt: skip
    images = np.clip(images + generator.normal(0, 20, size=images.shape), 0, 255).astype(np.uint8)
    return np.repeat(images[..., None], 3, axis=-1), Labels(names, np.zeros(count, np.int64))


def weights(folder) -> bytes:
    return (folder / "model.safetensors").read_bytes()


@pytest.mark.parametrize(
    ("changes", "num_steps", "limit_px"),
    [pytest.param({}, 300, 0.6, marks=pytest.mark.slow), ({"output_stride": 2, "decoding": "mean"}, 300, 1.0)],
)
def test_pose_network_finds_blobs(tmp_path, changes, num_steps, limit_px):
    frames, labels = blobs(200)
    options = pose2d.Options(**{**FAST_POSE, **changes}, num_steps=num_steps)
    history = pose2d.train(frames, labels, options, seed=0, out=tmp_path / "model", work=tmp_path / "work")
    assert history.step[-1] == num_steps and history.loss[-1] < 0.7 * history.loss[0]
    test_frames, test_labels = blobs(50, seed=1)
    predicted = pose2d.predict(tmp_path / "model", test_frames)
    assert predicted["joints2d"].shape == (50, 2, 2) and predicted["confidence"].shape == (50, 2)
    assert test_labels.joints2d is not None
    error_px = np.linalg.norm(predicted["joints2d"] - test_labels.joints2d, axis=-1)
    assert np.median(error_px) < limit_px


def test_published_recipe_learns_without_batch_norm(tmp_path):
    """ReLU after the output can die and leave empty heatmaps; He initialisation keeps it alive."""
    frames, labels = blobs(200)
    options = pose2d.Options(sigma_px=2.0, width=0.5, num_steps=250, batch_size=8, learning_rate=2e-3, device="cpu")
    assert (options.loss, options.batch_norm, options.decoding) == ("mse", False, "argmax")
    pose2d.train(frames, labels, options, seed=0, out=tmp_path / "model", work=tmp_path / "work")
    test_frames, test_labels = blobs(50, seed=1)
    assert test_labels.joints2d is not None
    error_px = np.linalg.norm(
        pose2d.predict(tmp_path / "model", test_frames)["joints2d"] - test_labels.joints2d, axis=-1
    )
    assert np.median(error_px) < 1.5


@pytest.mark.parametrize("kind", ["pose2d", "pose2d, channels last", "classifier"])
def test_interrupted_training_ends_in_the_same_model(tmp_path, monkeypatch, kind):
    if kind != "classifier":
        module, (frames, labels) = pose2d, blobs(30)
        options = pose2d.Options(
            **FAST_POSE,
            num_steps=12,
            log_every=5,
            checkpoint_every_s=0,
            shift_px=2,
            channels_last=kind == "pose2d, channels last",
        )
    else:
        module, (frames, labels) = classifier, stripes(30)
        options = classifier.Options(
            num_steps=12, log_every=5, checkpoint_every_s=0, batch_size=8, flip=True, device="cpu"
        )
    whole = module.train(frames, labels, options, seed=3, out=tmp_path / "whole", work=tmp_path / "w1")
    batch = TrainingRows.batch

    def stop_at_nine(self, batch_size, seed, step):
        if step == 9:
            raise KeyboardInterrupt
        return batch(self, batch_size, seed, step)

    monkeypatch.setattr(TrainingRows, "batch", stop_at_nine)
    with pytest.raises(KeyboardInterrupt):
        module.train(frames, labels, options, seed=3, out=tmp_path / "parts", work=tmp_path / "w2")
    steps = []
    monkeypatch.setattr(TrainingRows, "batch", lambda self, *args: steps.append(args[-1]) or batch(self, *args))
    resumed = module.train(frames, labels, options, seed=3, out=tmp_path / "parts", work=tmp_path / "w2")
    assert steps == [9, 10, 11], "training did not continue from the checkpoint after step 9"
    assert weights(tmp_path / "parts") == weights(tmp_path / "whole")
    assert resumed == whole
    assert whole.step == [5, 10, 12]


def test_checkpoint_of_another_run_is_not_continued(tmp_path):
    frames, labels = blobs(30)
    options = pose2d.Options(**FAST_POSE, num_steps=6, checkpoint_every_s=0)
    pose2d.train(frames, labels, options, seed=1, out=tmp_path / "other", work=tmp_path / "shared")
    pose2d.train(frames, labels, options, seed=2, out=tmp_path / "a", work=tmp_path / "shared")
    pose2d.train(frames, labels, options, seed=2, out=tmp_path / "b", work=tmp_path / "fresh")
    assert weights(tmp_path / "a") == weights(tmp_path / "b") != weights(tmp_path / "other")


def test_invisible_joints_and_joints_outside_do_not_matter(tmp_path):
    frames, labels = blobs(30)
    assert labels.joints2d is not None and labels.visible is not None
    options = pose2d.Options(**FAST_POSE, num_steps=5)
    visible = labels.visible.copy()
    visible[::3, 1] = False
    folders = []
    for number, hidden in enumerate((np.nan, 7.5)):
        points = labels.joints2d.copy()
        points[::3, 1] = hidden
        # The same joints again, once as a visible joint outside the image.
        points[0, 0] = (-5.0, 3.0) if number else (400.0, 3.0)
        changed = Labels(labels.class_names, labels.t_us, points, visible, labels.joint_set)
        folders.append(tmp_path / str(number))
        pose2d.train(frames, changed, options, seed=0, out=folders[-1], work=tmp_path / f"w{number}")
    assert weights(folders[0]) == weights(folders[1])


def test_training_leaves_inputs_and_the_global_random_state_alone(tmp_path):
    frames, labels = blobs(20)
    assert labels.joints2d is not None
    frames_before, points_before, state = frames.copy(), labels.joints2d.copy(), torch.get_rng_state()
    options = pose2d.Options(**FAST_POSE, num_steps=2, shift_px=3)
    pose2d.train(frames, labels, options, seed=0, out=tmp_path / "m", work=tmp_path / "w")
    assert np.array_equal(frames, frames_before) and np.array_equal(labels.joints2d, points_before)
    assert torch.equal(torch.get_rng_state(), state)


def test_loss_that_is_not_finite_stops_the_training(tmp_path):
    frames, labels = blobs(20)
    options = pose2d.Options(**{**FAST_POSE, "learning_rate": 1e30, "batch_norm": False}, num_steps=20)
    with pytest.raises(TrainingError, match=r"step \d+ of 20, not finite for 10 steps in a row; lower learning_rate"):
        pose2d.train(frames, labels, options, seed=0, out=tmp_path / "m", work=tmp_path / "w")
    assert not (tmp_path / "m").exists()


def test_bad_training_sets_are_named(tmp_path):
    frames, labels = blobs(6)
    options = pose2d.Options(**FAST_POSE, num_steps=1)
    folders = {"seed": 0, "out": tmp_path / "m", "work": tmp_path / "w"}
    with pytest.raises(DataError, match="5 frames but 6 labels"):
        pose2d.train(frames[:5], labels, options, **folders)
    with pytest.raises(DataError, match=r"\[N, H, W, 3\] uint8, got \(6, 24, 24, 3\) float64"):
        pose2d.train(frames.astype(float), labels, options, **folders)
    hidden = Labels(labels.class_names, labels.t_us, labels.joints2d, np.zeros((6, 2), bool), "blobs")
    with pytest.raises(DataError, match="no joint of any of the 6 rows"):
        pose2d.train(frames, hidden, options, **folders)
    with pytest.raises(DataError, match="flip needs a joint set"):
        pose2d.train(frames, labels, pose2d.Options(**FAST_POSE, num_steps=1, flip=True), **folders)
    with pytest.raises(DataError, match="row 1 has no class name"):
        classifier.train(frames, Labels(("a", "", "b", "a", "b", "a"), labels.t_us), classifier.Options(), **folders)
    with pytest.raises(DataError, match="at least two classes, got 'a' alone"):
        classifier.train(frames, Labels(("a",) * 6, labels.t_us), classifier.Options(), **folders)


def test_model_folders_are_told_apart(tmp_path):
    frames, labels = blobs(6)
    with pytest.raises(DataError, match="found none"):
        pose2d.predict(tmp_path, frames)
    options = pose2d.Options(**FAST_POSE, num_steps=1)
    pose2d.train(frames, labels, options, seed=0, out=tmp_path / "m", work=tmp_path / "w")
    with pytest.raises(DataError, match="expected a classifier model, got 'pose2d'"):
        classifier.predict(tmp_path / "m", frames)
    config = json.loads((tmp_path / "m" / "config.json").read_text())
    assert config["joint_set"] == "blobs" and "device" not in config["options"]
    assert pose2d.predict(tmp_path / "m", frames[:0])["joints2d"].shape == (0, 2, 2)


@settings(max_examples=40, deadline=None)
@given(st.floats(8, 16), st.floats(8, 12), st.sampled_from(["mse", "cross_entropy"]), st.sampled_from([1, 2]))
def test_decoding_finds_a_gaussian_between_pixels(x, y, loss, stride):
    centres_x, centres_y = ((np.arange(size // stride) + 0.5) * stride for size in (24, 20))
    squared = (centres_x - x) ** 2 + (centres_y[:, None] - y) ** 2
    log_heatmap = torch.from_numpy(-squared / (2 * 2.0**2))[None, None].float()
    heatmap = log_heatmap if loss == "cross_entropy" else log_heatmap.exp()
    for decoding, tolerance_px in (("argmax", 0.501 * stride), ("soft_argmax", 0.3 * stride), ("mean", 0.01)):
        options = pose2d.Options(loss=loss, sigma_px=2.0, decoding=decoding, output_stride=stride)
        points, confidence = pose2d._decode(heatmap, options)
        assert points.shape == (1, 1, 2) and confidence.shape == (1, 1)
        np.testing.assert_allclose(points[0, 0].numpy(), [x, y], atol=tolerance_px)


def test_empty_heatmap_decodes_to_a_finite_point():
    options = pose2d.Options(decoding="mean")
    points, confidence = pose2d._decode(torch.zeros(1, 2, 8, 8), options)
    assert torch.isfinite(points).all() and (confidence == 0).all()


def test_augmentation_moves_images_and_joints_together():
    images, points = np.zeros((64, 20, 16), np.uint8), np.zeros((64, 13, 2), np.float32)
    generator = np.random.default_rng(0)
    where = generator.integers(4, 12, size=(64, 2))
    images[np.arange(64), where[:, 1], where[:, 0]] = 255
    points[:, 3] = where + 0.5
    visible = np.ones((64, 13), bool)
    visible[:, 9] = False
    shifted, shifted_points = pose2d._shift(images, points, 3, np.arange(64), generator)
    mirror = JOINT_SETS["dhp19"].mirror
    flipped, flipped_points, flipped_visible = pose2d._flip_half(
        shifted, shifted_points, visible, mirror, np.arange(64), generator
    )
    was_flipped = flipped_visible[:, 9]
    assert 10 < was_flipped.sum() < 54
    joint = np.where(was_flipped, mirror[3], 3)
    y, x = np.array([np.argwhere(image == 255)[0] for image in flipped]).T
    np.testing.assert_allclose(flipped_points[np.arange(64), joint], np.stack([x, y], axis=-1) + 0.5)
    offsets = shifted_points[:, 3] - points[:, 3]
    assert offsets.min() == -3 and offsets.max() == 3


def test_classifier_learns_stripes_and_gives_features(tmp_path):
    frames, labels = stripes(80)
    options = classifier.Options(num_steps=40, batch_size=16, warmup_steps=5, head_width=8, device="cpu")
    classifier.train(frames, labels, options, seed=0, out=tmp_path / "m", work=tmp_path / "w")
    test_frames, test_labels = stripes(70, seed=1)
    predicted = classifier.predict(tmp_path / "m", test_frames)
    assert predicted["classes"].tolist() == ["level", "up"]
    np.testing.assert_allclose(predicted["probability"].sum(axis=1), 1, rtol=1e-5)
    names = predicted["classes"][predicted["probability"].argmax(axis=1)]
    assert np.mean(names == np.array(test_labels.class_names)) > 0.9
    features = classifier.features(tmp_path / "m", test_frames)
    assert features.shape == (70, 128) and features.dtype == np.float32 and features.std(axis=0).max() > 0
    assert classifier.features(tmp_path / "m", test_frames[:0]).shape == (0, 128)
