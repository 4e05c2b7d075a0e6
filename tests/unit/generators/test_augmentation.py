"""The baseline of ordinary augmentation, and the small classifier that it competes for."""

import numpy as np
import pytest

from ctlev_core.downstream import classifier
from ctlev_core.generators import augmentation
from data_contracts.errors import DataError
from data_contracts.labels import Conditions, Labels


def training_frames():
    """Class a is a red square, class b a blue one, class c both."""
    frames = np.zeros((6, 16, 16, 3), np.uint8)
    frames[::3, 4:9, 4:9, 0] = frames[1::3, 4:9, 4:9, 2] = 102
    frames[2::3, 4:9, 4:9] = 51
    return frames, tuple("abcabc")


def asked(names):
    return Conditions(tuple(f"a photo of {name}" for name in names), class_names=tuple(names))


def made(tmp_path, names, seeds, **options):
    frames, classes = training_frames()
    augmentation.train(frames, asked(classes), augmentation.Options(), seed=0, out=tmp_path / "c", work=tmp_path)
    chosen = augmentation.SampleOptions(**options)
    return augmentation.sample(tmp_path / "c", asked(names), chosen, seeds=seeds, work=tmp_path)


def test_frames_are_of_the_class_asked_for_and_depend_on_their_seed_alone(tmp_path):
    names, seeds = list("abcab"), [1, 2, 3, 4, 5]
    together = made(tmp_path, names, seeds)
    for frame, name in zip(together, names, strict=True):
        has = {"a": (True, False), "b": (False, True), "c": (True, True)}[name]
        assert (frame[..., 0].any(), frame[..., 2].any()) == has
    assert np.array_equal(made(tmp_path, names[3:4], seeds[3:4])[0], together[3])
    assert len({frame.tobytes() for frame in made(tmp_path, ["a"] * 8, range(8))}) == 8


def test_without_moves_and_drops_a_frame_is_a_training_frame(tmp_path):
    frames, _ = training_frames()
    (frame,) = made(tmp_path, ["a"], [0], shift=0, turn_deg=0, scale=0, drop=0)
    assert np.array_equal(frame, frames[0])


def test_polarities_are_exchanged_in_half_of_the_frames(tmp_path):
    options = {"shift": 0, "turn_deg": 0, "scale": 0, "drop": 0, "exchange_polarity": True}
    frames = made(tmp_path, ["a"] * 64, range(64), **options)
    blue = frames[..., 2].any(axis=(1, 2))
    assert (blue ^ frames[..., 0].any(axis=(1, 2))).all()
    assert 16 <= blue.sum() <= 48  # 64 coins: four standard deviations


def test_a_class_without_frames_and_no_frames_at_all(tmp_path):
    with pytest.raises(DataError, match="no training frame of class 'd'"):
        made(tmp_path, ["d"], [0])
    empty = np.zeros((0, 16, 16, 3), np.uint8)
    with pytest.raises(DataError, match="at least one frame"):
        augmentation.train(empty, asked([]), augmentation.Options(), seed=0, out=tmp_path, work=tmp_path)


@pytest.fixture
def trained(tmp_path):
    frames, names = training_frames()
    labels = Labels(names, np.zeros(6, np.int64))
    options = classifier.Options(architecture="small-cnn", num_steps=150, batch_size=6, by_recording=True)
    classifier.train(frames, labels, options, seed=0, out=tmp_path / "m", work=tmp_path / "w")
    return tmp_path / "m"


def test_small_classifier_learns_and_gives_features(trained):
    frames, names = training_frames()
    found = classifier.predict(trained, frames)
    assert tuple(found["classes"][found["probability"].argmax(axis=1)]) == names
    assert classifier.features(trained, frames).shape == (6, 64 * 4)


def test_frames_of_a_recording_share_their_mean_probability(trained):
    frames, _ = training_frames()
    alone = classifier.predict(trained, frames)["probability"]
    together = classifier.predict_recordings(trained, frames, recordings=["r", "r", "s", "r", "s", "t"])["probability"]
    for rows in ([0, 1, 3], [2, 4], [5]):
        np.testing.assert_allclose(together[rows], np.repeat(alone[rows].mean(axis=0)[None], len(rows), 0), atol=1e-6)


def test_small_classifier_has_no_published_weights(tmp_path):
    with pytest.raises(DataError, match="small-cnn has no published weights"):
        classifier.input_files(classifier.Options(architecture="small-cnn", weights=tmp_path))
