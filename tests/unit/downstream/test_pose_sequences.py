"""Joints from consecutive frames: only the past of a frame counts, and what only the past shows is learnt."""

import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from ctlev_core.downstream import pose2d
from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.supervised.batches import TrainingRows
from ctlev_core.supervised.frame_sequences import FrameSequences
from data_contracts.config import cache_material
from data_contracts.labels import Labels

LENGTH = 3
TINY = {
    "width": 0.25,
    "batch_norm": True,
    "output_stride": 2,
    "loss": "cross_entropy",
    "sigma_px": 1.5,
    "decoding": "mean",
    "batch_size": 4,
    "num_steps": 8,
    "learning_rate": 1e-2,
    "warmup_steps": 2,
    "device": "cpu",
    "checkpoint_every_s": 0,
    "sequence_length": LENGTH,
}
SIDE = 20
# A forward pass of another batch sums in another order.
CLOSE_PX = 1e-3


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def noise(count, seed=0):
    random = np.random.default_rng(seed)
    frames = random.integers(0, 256, (count, SIDE, SIDE, 3), dtype=np.uint8)
    points = random.uniform(2, SIDE - 2, (count, 13, 2)).astype(np.float32)
    return frames, Labels(("",) * count, np.arange(count), points, np.ones((count, 13), bool), "dhp19")


def train(folder, recordings=(), count=10, **options):
    frames, labels = noise(count)
    pose2d.train_sequences(
        frames,
        labels,
        pose2d.Options(**{**TINY, **options}),
        seed=0,
        out=folder / "model",
        work=folder / "work",
        parts=(),
        groups=(),
        recordings=recordings,
    )
    return folder / "model"


def weights(model):
    return (model / "model.safetensors").read_bytes()


def joints(model, frames, recordings):
    return pose2d.predict_sequences(model, frames, recordings)["joints2d"]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """Its recurrent unit has random weights: in so few steps it hardly begins to remember."""
    folder = train(tmp_path_factory.mktemp("sequences"), ["a"] * 6 + ["b"] * 4)
    found, random = load_file(folder / "model.safetensors"), torch.Generator().manual_seed(0)
    for name, value in found.items():
        if name.startswith("recurrent."):
            value.normal_(std=0.3, generator=random)
    save_file(found, folder / "model.safetensors")
    return folder


def test_a_frame_knows_its_own_past_and_nothing_else(model):
    frames, recordings = noise(8, seed=3)[0], ["a"] * 6 + ["b"] * 2
    before = joints(model, frames, recordings)
    changed = frames.copy()
    changed[2] = 255 - changed[2]
    moved = np.abs(joints(model, changed, recordings) - before).max(axis=(1, 2))
    assert (moved[[0, 1, 5, 6, 7]] < CLOSE_PX).all() and (moved[2 : 2 + LENGTH] > 10 * CLOSE_PX).all()


def test_another_recording_tells_nothing(model):
    frames = noise(6, seed=4)[0]
    other = frames.copy()
    other[:3] = 255 - other[:3]
    names = ["a"] * 3 + ["b"] * 3
    np.testing.assert_allclose(joints(model, other, names)[3:], joints(model, frames, names)[3:], rtol=0, atol=CLOSE_PX)
    together = joints(model, other, ["a"] * 6) - joints(model, frames, ["a"] * 6)
    assert (np.abs(together[3:5]).max(axis=(1, 2)) > 10 * CLOSE_PX).all()


def test_predictions_do_not_depend_on_what_else_is_predicted(model):
    frames, recordings = noise(150, seed=5)[0], [f"{row // 6:02d}" for row in range(150)]
    together = joints(model, frames, recordings)
    alone = [joints(model, frames[start : start + 6], recordings[start : start + 6]) for start in range(0, 150, 6)]
    np.testing.assert_allclose(np.concatenate(alone), together, rtol=0, atol=CLOSE_PX)
    order = np.arange(150).reshape(25, 6)[::-1].ravel()
    turned = joints(model, frames[order], [recordings[row] for row in order])
    np.testing.assert_allclose(turned, together[order], rtol=0, atol=CLOSE_PX)


def test_a_long_recording_is_predicted_as_its_sequences_are_one_by_one(model):
    """More frames than a batch of the prediction has."""
    frames = noise(70, seed=6)[0]
    found = joints(model, frames, ["a"] * 70)
    for row in (0, 1, 2, 40, 63, 64, 65, 69):
        own = frames[max(0, row - LENGTH + 1) : row + 1]
        np.testing.assert_allclose(joints(model, own, ["x"] * len(own))[-1], found[row], rtol=0, atol=CLOSE_PX)


def test_single_frames_are_sequences_of_one(model):
    frames = noise(4, seed=7)[0]
    alone, short = pose2d.predict(model, frames)["joints2d"], joints(model, frames, ["a", "a", "b", "c"])
    np.testing.assert_allclose(short[[0, 2, 3]], alone[[0, 2, 3]], rtol=0, atol=CLOSE_PX)
    assert np.abs(short[1] - alone[1]).max() > 10 * CLOSE_PX
    assert joints(model, frames[:0], []).shape == (0, 13, 2)
    with pytest.raises(ValueError, match="expected names of 4 rows, got 2"):
        joints(model, frames, ["a", "b"])


def test_without_the_option_nothing_is_different(tmp_path):
    assert "sequence_length" not in cache_material(pose2d.Options())
    named = train(tmp_path / "named", ["a"] * 10, sequence_length=1)
    frames, labels = noise(10)
    options = pose2d.Options(**{**TINY, "sequence_length": 1})
    pose2d.train(frames, labels, options, seed=0, out=tmp_path / "model", work=tmp_path / "work")
    assert weights(named) == weights(tmp_path / "model")
    assert b"recurrent" not in weights(named)
    assert "sequence_length" not in json.loads((named / "config.json").read_text())["options"]
    assert np.array_equal(joints(named, frames, ["a"] * 10), pose2d.predict(named, frames)["joints2d"])


def test_the_model_says_how_far_it_looks_back(model):
    assert json.loads((model / "config.json").read_text())["options"]["sequence_length"] == LENGTH


@pytest.mark.parametrize(
    "changes",
    [{}, {"single_frame_share": 0.9}, {"channels_last": True, "precision": "bfloat16", "flip": True, "shift_px": 2}],
)
def test_an_interrupted_run_ends_in_the_same_model(tmp_path, monkeypatch, changes):
    recordings, batch = ["a"] * 6 + ["b"] * 4, TrainingRows.batch
    whole = train(tmp_path / "whole", recordings, **changes)

    def stop(self, batch_size, seed, step):
        if step == 5:
            raise KeyboardInterrupt
        return batch(self, batch_size, seed, step)

    monkeypatch.setattr(TrainingRows, "batch", stop)
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, recordings, **changes)
    steps = []
    monkeypatch.setattr(TrainingRows, "batch", lambda self, *args: steps.append(args[-1]) or batch(self, *args))
    assert weights(train(tmp_path, recordings, **changes)) == weights(whole)
    assert steps == [5, 6, 7]


def test_a_state_of_other_sequences_is_not_continued(tmp_path, monkeypatch):
    steps, batch = [], TrainingRows.batch
    monkeypatch.setattr(TrainingRows, "batch", lambda self, *args: steps.append(args[-1]) or batch(self, *args))
    train(tmp_path, ["a"] * 10)
    train(tmp_path, ["a"] * 5 + ["b"] * 5)
    assert steps == [*range(8), *range(8)]


def test_frames_of_a_sequence_are_mirrored_and_moved_alike():
    frames, labels = noise(12)
    images, points, visible, sequence = frames[..., 0], labels.joints2d, labels.visible, np.repeat(np.arange(4), 3)
    assert points is not None and visible is not None
    moved, moved_points = pose2d._shift(images, points, 3, sequence, np.random.default_rng(0))
    by_px = (moved_points - points)[:, 0].round(3).reshape(4, 3, 2)
    assert (by_px == by_px[:, :1]).all() and len(np.unique(by_px[:, 0], axis=0)) > 1
    dx, dy = by_px[1, 0].astype(int)
    inner = np.s_[3:6, 3 + dy : SIDE - 3 + dy, 3 + dx : SIDE - 3 + dx]
    assert np.array_equal(moved[inner], images[3:6, 3 : SIDE - 3, 3 : SIDE - 3])
    mirror = JOINT_SETS["dhp19"].mirror
    flipped, _, _ = pose2d._flip_half(images, points, visible, mirror, sequence, np.random.default_rng(1))
    as_before = (flipped == images).all(axis=(1, 2)).reshape(4, 3)
    assert (as_before == as_before[:, :1]).all() and 0 < as_before[:, 0].sum() < 4


def moving_spots(recordings, length, seed):
    """A spot that moves in every third frame: only then, and only at its edges, is there something to be seen."""
    random, side = np.random.default_rng(seed), 24
    centres = np.arange(side) + 0.5
    frames, points = [], []
    for _ in range(recordings):
        place = random.uniform(7, side - 7, 2)
        for moment in range(length):
            step = random.uniform(-3, 3, 2) if moment % 3 == 0 else np.zeros(2)
            images = []
            for x, y in (place, place + step):
                squared = (centres - x) ** 2 + (centres[:, None] - y) ** 2
                images.append(255 * np.exp(-squared / (2 * 2.5**2)))
            place = np.clip(place + step, 4, side - 4)
            frames.append(np.abs(images[1] - images[0]))
            points.append(place)
    grey = np.round(frames).astype(np.uint8)
    count = recordings * length
    labels = Labels(
        ("",) * count,
        np.arange(count),
        np.array(points, np.float32)[:, None],
        np.ones((count, 1), bool),
        "spot",
    )
    return np.repeat(grey[..., None], 3, axis=-1), labels, [str(row // length) for row in range(count)]


def test_what_only_the_past_shows_is_learnt(tmp_path):
    frames, labels, names = moving_spots(24, 6, seed=0)
    shown, target, shown_names = moving_spots(20, 6, seed=1)
    assert target.joints2d is not None
    still = np.arange(len(shown)) % 3 > 0
    assert not shown[still].any() and shown[~still].any(axis=(1, 2, 3)).mean() > 0.9
    errors_px = {}
    for length in (1, 4):
        options = pose2d.Options(**{**TINY, "num_steps": 60, "batch_size": 8, "sequence_length": length, "shift_px": 2})
        folders = {"out": tmp_path / f"m{length}", "work": tmp_path / f"w{length}"}
        learn = {"seed": 0, "parts": (), "groups": ()}
        pose2d.train_sequences(frames, labels, options, **learn, **folders, recordings=names)
        found = joints(folders["out"], shown, shown_names)
        errors_px[length] = np.linalg.norm(found - target.joints2d, axis=-1)[:, 0]
    assert errors_px[4][still].mean() < 0.5 * errors_px[1][still].mean()
    assert errors_px[4][~still].mean() < 1.2 * errors_px[1][~still].mean()


def test_the_first_steps_may_learn_from_single_frames(tmp_path, monkeypatch):
    """As many frames a batch as sequences would have, and no past; afterwards sequences as ever."""
    seen, ending_at = [], FrameSequences.ending_at

    def note(sequences, rows, **further):
        chosen, lengths = ending_at(sequences, rows, **further)
        seen.append(lengths.tolist())
        return chosen, lengths

    monkeypatch.setattr(FrameSequences, "ending_at", note)
    train(tmp_path, ["a"] * 24, count=24, single_frame_share=0.5)
    assert len(seen) == 8
    assert all(lengths == [1] * 4 * LENGTH for lengths in seen[:4])
    assert all(len(lengths) == 4 and max(lengths) == LENGTH for lengths in seen[4:])


def test_single_frames_first_are_what_a_network_of_single_frames_learns_from(tmp_path):
    """Until sequences come, the rest of the network is trained as without a recurrent unit would see it."""
    both = pose2d.Options(**{**TINY, "single_frame_share": 0.5, "num_steps": 8})
    single = pose2d.Options(**{**TINY, "sequence_length": 1, "batch_size": 4 * LENGTH})
    rows = TrainingRows((np.arange(50),), 1.0, np.zeros(0, np.int64))
    for step in range(4):
        first, second = (rows.batch(options.batch_size_at(step), 0, step) for options in (both, single))
        np.testing.assert_array_equal(first, second)
    assert [both.batch_size_at(step) for step in range(8)] == [4 * LENGTH] * 4 + [4] * 4


def test_without_single_frames_nothing_has_another_key():
    assert "single_frame_share" not in cache_material(pose2d.Options(**TINY))
    assert cache_material(pose2d.Options(**TINY, single_frame_share=0.5))["single_frame_share"] == 0.5
