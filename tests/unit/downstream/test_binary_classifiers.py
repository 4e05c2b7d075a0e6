"""Binary classifiers: each is the classifier that is trained by hand on its own frames and those it is told from."""

from collections import Counter

import numpy as np
import pytest
import torch

from ctlev_core.downstream import classifier
from ctlev_core.supervised.binary_tasks import BINARY_FILE, binary_rows, predict_each
from data_contracts.config import cache_material
from data_contracts.errors import DataError
from data_contracts.labels import Labels

FAST = {"num_steps": 4, "batch_size": 4, "log_every": 2, "device": "cpu"}
NAMES = ("a", "b", "c", "a", "b", "c", "c", "a", "b", "c", "c", "c")


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def training_set(seed=0):
    frames = np.random.default_rng(seed).integers(0, 255, (len(NAMES), 32, 32, 3), dtype=np.uint8)
    return frames, Labels(NAMES, np.arange(len(NAMES)))


def test_without_the_option_there_is_no_other_key():
    assert "binary" not in cache_material(classifier.Options())
    assert cache_material(classifier.Options(binary="all"))["binary"] == "all"


def test_all_negatives_are_all_rows():
    rows, sizes = binary_rows(NAMES, "a", "all", seed=0, parts=[5, 7])
    assert rows.tolist() == list(range(12)) and sizes == [5, 7]


@pytest.mark.parametrize("seed", range(5))
def test_balanced_negatives_are_as_many_in_each_set_and_evenly_drawn(seed):
    names = ["a"] * 6 + ["b"] * 10 + ["c"] * 4 + ["d"] * 9 + ["a"] * 2 + ["b"]
    groups = [f"g{row % 3}" for row in range(len(names))]
    rows, sizes = binary_rows(names, "a", "balanced", seed=seed, parts=[29, 3], groups=groups)
    assert sizes == [12, 3], "the second set has one other frame for two of the class"
    assert (np.diff(rows) > 0).all()
    first = Counter(names[row] for row in rows[:12])
    assert first == {"a": 6, "b": 2, "c": 2, "d": 2}
    assert len({groups[row] for row in rows[:12] if names[row] == "b"}) == 2, "of two groups"
    again, _ = binary_rows(names, "a", "balanced", seed=seed, parts=[29, 3], groups=groups)
    other, _ = binary_rows(names, "a", "balanced", seed=seed + 100, parts=[29, 3], groups=groups)
    assert again.tolist() == rows.tolist() != other.tolist()


def test_probabilities_are_shared_among_the_classes_also_where_none_is_seen(tmp_path):
    said = {"000": [0.6, 0.0], "001": [0.3, 0.0], "002": [0.3, 0.0]}
    (tmp_path / BINARY_FILE).write_text('{"classes": ["a", "b", "c"]}')

    def predict(model):
        own = np.array(said[model.name], np.float32)
        name = "abc"[int(model.name)]
        return {"probability": np.stack([1 - own, own], axis=1), "classes": np.array([f"not {name}", name])}

    found = predict_each(predict, tmp_path)
    np.testing.assert_allclose(found["probability"], [[0.5, 0.25, 0.25], [1 / 3] * 3], rtol=1e-6)
    np.testing.assert_allclose(found["binary_probability"], np.transpose(list(said.values())))


def test_each_is_the_classifier_of_its_own_two_classes(tmp_path):
    frames, labels = training_set()
    options = classifier.Options(**FAST, binary="all")
    history = classifier.train(frames, labels, options, seed=3, out=tmp_path / "m", work=tmp_path / "w")
    assert history.step == [2, 4, 6, 8, 10, 12] and len(history.loss) == 6
    found = classifier.predict(tmp_path / "m", frames)
    assert found["classes"].tolist() == ["a", "b", "c"]
    assert found["probability"].sum(axis=1) == pytest.approx(1)
    for column, name in enumerate("abc"):
        # In the order of their names, as "a" and "not a" are: the class is the first column.
        two = Labels(tuple("class" if one == name else "other" for one in NAMES), labels.t_us)
        folder = tmp_path / name
        classifier.train(frames, two, classifier.Options(**FAST), seed=3, out=folder, work=tmp_path / f"w{name}")
        expected = classifier.predict(folder, frames)["probability"][:, 0]
        assert found["binary_probability"][:, column].tolist() == expected.tolist()


def test_frames_of_a_recording_are_joined_for_each(tmp_path):
    frames, labels = training_set()
    options = classifier.Options(**FAST, binary="balanced", by_recording=True)
    classifier.train(frames, labels, options, seed=0, out=tmp_path / "m", work=tmp_path / "w", parts=[6, 6])
    alone = classifier.predict(tmp_path / "m", frames)["binary_probability"]
    recordings = ["r", "s"] * 6
    joined = classifier.predict_recordings(tmp_path / "m", frames, recordings)["binary_probability"]
    assert joined[1::2] == pytest.approx(np.tile(alone[1::2].mean(axis=0), (6, 1)), rel=1e-6)


def test_they_have_no_common_features(tmp_path):
    frames, labels = training_set()
    options = classifier.Options(**FAST | {"num_steps": 1}, binary="balanced")
    classifier.train(frames, labels, options, seed=0, out=tmp_path / "m", work=tmp_path / "w")
    with pytest.raises(DataError, match="expected a classifier of all classes, got one with option `binary`"):
        classifier.features(tmp_path / "m", frames)
    with pytest.raises(DataError, match="at least two classes"):
        classifier.train(frames[:1], labels.take([0]), options, seed=0, out=tmp_path / "n", work=tmp_path / "v")
