"""Bodies from consecutive frames: what a sequence is, the recurrent unit, and that only the past of a frame counts."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.downstream import smpl_regressor
from ctlev_core.networks.resnet_files import ARCHITECTURES
from ctlev_core.networks.smpl_regressor import SmplRegressor
from ctlev_core.supervised.augmentation import BodySamples, mirror_half, shift
from ctlev_core.supervised.batches import TrainingRows
from ctlev_core.supervised.frame_sequences import (
    ages_in,
    find_sequences,
    find_training_sequences,
    name_recordings,
)
from data_contracts.config import cache_material
from data_contracts.labels import Labels

SHAPE = {"depths": [1, 1, 1, 1], "hidden_sizes": [4, 4, 4, 6], "embedding_size": 4}
LENGTH = 3
TINY = smpl_regressor.Options(
    num_steps=6, batch_size=4, warmup_steps=2, log_every=3, device="cpu", sequence_length=LENGTH, checkpoint_every_s=0
)
# A forward pass of another batch sums in another order: micrometres of joints some metres away.
CLOSE_MM = 0.02


def people(count, seed=0):
    random = np.random.default_rng(seed)
    pose = np.zeros((count, 72), np.float32)
    pose[:, :3] = [np.pi, 0, 0]
    pose[:, 3:] = random.normal(0, 0.2, (count, 69))
    return Labels(
        ("",) * count,
        np.arange(count),
        smpl_pose=pose,
        smpl_betas=np.zeros((count, 10), np.float32),
        smpl_transl=random.uniform([-0.2, -0.1, 3.0], [0.2, 0.3, 3.4], (count, 3)).astype(np.float32),
        intrinsics=np.tile(np.array([45, 45, 16, 16], np.float32), (count, 1)),
    )


def frames_of(count, seed=0):
    return np.random.default_rng([seed, 1]).integers(0, 255, (count, 32, 32, 3), dtype=np.uint8)


def train(folder, count=10, options=TINY, recordings=(), **more):
    settings = {"seed": 0, "parts": (), "groups": (), "recordings": recordings, **more}
    return smpl_regressor.train_sequences(
        frames_of(count), people(count), options, out=folder / "model", work=folder / "work", **settings
    )


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sequences")
    train(folder, recordings=["a"] * 6 + ["b"] * 4)
    return folder / "model"


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 1), st.integers(1, 5)), min_size=1, max_size=6), st.integers(1, 7), st.data())
def test_sequences_are_what_a_loop_finds(recordings, length, data):
    names = [name for name, size in recordings for _ in range(size)]
    ends = data.draw(st.lists(st.integers(0, len(names) - 1), max_size=9))
    chosen, lengths = find_sequences(len(names), length, names).ending_at(np.array(ends, np.int64))
    expected = []
    for end in ends:
        rows = [end]
        while len(rows) < length and rows[0] > 0 and names[rows[0] - 1] == names[end]:
            rows.insert(0, rows[0] - 1)
        expected.append(rows)
    assert chosen.tolist() == [row for rows in expected for row in rows]
    assert lengths.tolist() == [len(rows) for rows in expected]


def test_sequences_cross_no_name_at_all():
    recordings, subjects = ["a"] * 6, ["x", "x", "y", "y", "y", "y"]
    assert find_sequences(6, 9, recordings, subjects).starts.tolist() == [0, 0, 2, 2, 2, 2]
    assert find_sequences(3, 9, ()).starts.tolist() == [0, 1, 2]
    assert find_sequences(0, 9, ()).ending_at(np.zeros(0, np.int64))[0].tolist() == []
    with pytest.raises(ValueError, match="expected names of 3 rows, got 2"):
        find_sequences(3, 9, ["a", "b"])


def test_training_sequences_cross_into_no_group_and_no_other_set():
    def starts(groups, parts):
        return find_training_sequences(6, 9, recordings=["a"] * 6, groups=groups, parts=parts).starts.tolist()

    assert starts((), ()) == [0] * 6
    assert starts(["x", "x", "y", "y", "y", "y"], ()) == [0, 0, 2, 2, 2, 2]
    assert starts((), (4, 2)) == [0, 0, 0, 0, 4, 4]
    assert starts(["x", "x", "y", "y", "y", "y"], (0, 4, 2)) == [0, 0, 2, 2, 4, 4]
    with pytest.raises(ValueError, match="expected names of 6 rows, got 5"):
        starts((), (4, 1))


def test_ages_count_the_frames_before():
    assert ages_in(np.array([3, 1, 2])).tolist() == [0, 1, 2, 0, 0, 1]


class Table:
    """A manifest held in memory."""

    def __init__(self, **columns):
        self.table = pa.table(columns)

    def column(self, name):
        return self.table[name].to_pylist()


def names_of(rows, **columns):
    found = name_recordings(Table(**columns), np.array(rows))  # pyright: ignore[reportArgumentType]
    return find_sequences(len(rows), 9, found).starts.tolist()


def test_real_frames_follow_within_their_recording():
    assert names_of([0, 2, 3], recording_id=["a", "a", "a", "b"]) == [0, 0, 2]


def test_synthetic_frames_follow_where_their_labels_do():
    ids = [f"synthetic/{row}" for row in range(6)]
    in_time = ["a:10", "a:20", "b:30", "b:40", "b:5", "b:5"]
    assert names_of(range(6), recording_id=ids, source_id=in_time) == [0, 0, 2, 2, 4, 5]
    # Frames of training windows have names without a time.
    assert names_of(range(3), recording_id=ids[:3], source_id=["a/000001", "a/000002", "a/000003"]) == [0, 1, 2]


def slow_gru(weights, features):
    """Hidden states of one sequence by the definition, one step and one gate after another, from zero."""
    names = ("weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "bias_hh_l0")
    w_in, w_state, b_in, b_state = (weights[name].numpy() for name in names)
    size, states = features.shape[1], []
    state = np.zeros(size)
    for row in features:
        r_in, z_in, n_in = np.split(w_in @ row + b_in, 3)
        r_state, z_state, n_state = np.split(w_state @ state + b_state, 3)
        reset, update = 1 / (1 + np.exp(-(r_in + r_state))), 1 / (1 + np.exp(-(z_in + z_state)))
        new = np.tanh(n_in + reset * n_state)
        state = (1 - update) * new + update * state
        states.append(state)
    return np.array(states)


@pytest.mark.parametrize("lengths", [[1], [4, 1, 3], [2, 2]])
def test_the_recurrent_unit_is_the_definition(lengths):
    torch.manual_seed(0)
    network = SmplRegressor(SHAPE, grid=1, head_width=0, recurrent=True).double()
    assert network.recurrent is not None
    features = torch.randn(sum(lengths), 6, dtype=torch.float64)
    found = network.over_time(features, torch.tensor(lengths)).detach().numpy()
    parts = np.split(features.numpy(), np.cumsum(lengths)[:-1])
    expected = np.concatenate([part + slow_gru(network.recurrent.state_dict(), part) for part in parts])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


def test_event_hpe_s_own_size_can_be_chosen():
    with torch.device("meta"):
        network = SmplRegressor(ARCHITECTURES["resnet50"], grid=1, head_width=0, recurrent=True)
    assert network.recurrent is not None
    # A ResNet-50 has 25,557,032 weights, 2,049,000 of them in the layer of ImageNet's classes.
    assert sum(weight.numel() for weight in network.network.backbone.parameters()) == 25_557_032 - 2_049_000
    assert sum(weight.numel() for weight in network.recurrent.parameters()) == 6 * 2048 * (2048 + 1)


def test_without_the_option_there_is_no_unit_and_no_other_key():
    assert "sequence_length" not in cache_material(smpl_regressor.Options())
    assert cache_material(smpl_regressor.Options(sequence_length=8))["sequence_length"] == 8
    alone = SmplRegressor(SHAPE, grid=1, head_width=0)
    features = torch.randn(3, 6)
    assert alone.over_time(features, torch.tensor([2, 1])) is features
    assert not any("recurrent" in name for name in alone.state_dict())


def test_single_images_are_learnt_alike_whatever_their_recordings(tmp_path):
    single = TINY.model_copy(update={"sequence_length": 1})
    train(tmp_path / "named", options=single, recordings=["a"] * 10)
    frames, labels = frames_of(10), people(10)
    smpl_regressor.train(frames, labels, single, seed=0, out=tmp_path / "plain" / "model", work=tmp_path / "w")
    files = [tmp_path / name / "model" / "model.safetensors" for name in ("named", "plain")]
    assert files[0].read_bytes() == files[1].read_bytes()


def joints(model, frames, recordings):
    return smpl_regressor.predict_sequences(model, frames, recordings)["joints3d"]


def test_a_frame_knows_its_own_past_and_nothing_else(model):
    frames, recordings = frames_of(8, seed=3), ["a"] * 6 + ["b"] * 2
    before = joints(model, frames, recordings)
    changed = frames.copy()
    changed[2] = 255 - changed[2]
    moved = np.abs(joints(model, changed, recordings) - before).max(axis=(1, 2))
    assert (moved[[0, 1, 5, 6, 7]] < CLOSE_MM).all() and (moved[2 : 2 + LENGTH] > 10 * CLOSE_MM).all()


def test_predictions_do_not_depend_on_what_else_is_predicted(model):
    frames, recordings = frames_of(150, seed=4), [f"{row // 6:02d}" for row in range(150)]
    together = joints(model, frames, recordings)
    alone = [joints(model, frames[start : start + 6], recordings[start : start + 6]) for start in range(0, 150, 6)]
    np.testing.assert_allclose(np.concatenate(alone), together, rtol=0, atol=CLOSE_MM)
    order = np.arange(150).reshape(25, 6)[::-1].ravel()
    turned = joints(model, frames[order], [recordings[row] for row in order])
    np.testing.assert_allclose(turned, together[order], rtol=0, atol=CLOSE_MM)


def test_a_recording_shorter_than_a_sequence_and_single_frames(model):
    frames = frames_of(4, seed=5)
    short = joints(model, frames, ["a", "a", "b", "c"])
    alone = smpl_regressor.predict(model, frames)["joints3d"]
    np.testing.assert_allclose(short[[0, 2, 3]], alone[[0, 2, 3]], rtol=0, atol=CLOSE_MM)
    assert np.abs(short[1] - alone[1]).max() > 10 * CLOSE_MM
    assert len(joints(model, frames[:0], [])) == 0
    with pytest.raises(ValueError, match="expected names of 4 rows, got 2"):
        joints(model, frames, ["a", "b"])


def test_an_interrupted_run_ends_in_the_same_model(model, tmp_path, monkeypatch):
    batch = TrainingRows.batch

    def stop(self, batch_size, seed, step):
        if step == 4:
            raise KeyboardInterrupt
        return batch(self, batch_size, seed, step)

    recordings = ["a"] * 6 + ["b"] * 4
    monkeypatch.setattr(TrainingRows, "batch", stop)
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, recordings=recordings)
    steps = []
    monkeypatch.setattr(TrainingRows, "batch", lambda self, *args: steps.append(args[-1]) or batch(self, *args))
    train(tmp_path, recordings=recordings)
    assert steps == [4, 5]
    assert (tmp_path / "model" / "model.safetensors").read_bytes() == (model / "model.safetensors").read_bytes()


def test_a_state_of_other_sequences_is_not_continued(model, tmp_path, monkeypatch):
    steps, batch = [], TrainingRows.batch
    monkeypatch.setattr(TrainingRows, "batch", lambda self, *args: steps.append(args[-1]) or batch(self, *args))
    train(tmp_path, recordings=["a"] * 10)
    train(tmp_path, recordings=["a"] * 5 + ["b"] * 5)
    assert steps == [*range(6), *range(6)]


def test_frames_held_back_are_in_no_sequence_that_is_learnt_from(tmp_path, monkeypatch):
    seen = []

    def loss(found, wanted, body, width, options):
        seen.append((torch.is_grad_enabled(), wanted[2][:, 0].tolist()))
        return found.transl.square().mean()

    monkeypatch.setattr(smpl_regressor, "_loss", loss)
    options = TINY.model_copy(update={"validation_share": 0.3, "validation_every": 3, "flip": False})
    names = [name for name in "abcde" for _ in range(2)]
    train(tmp_path, options=options, recordings=names)
    learnt = {value for graph, values in seen if graph for value in values}
    held = {value for graph, values in seen if not graph for value in values}
    assert held and learnt and not held & learnt


def test_frames_of_a_sequence_are_mirrored_and_moved_alike():
    labels = people(12)
    samples = BodySamples(
        frames_of(12), np.tile(np.eye(3, dtype=np.float32), (12, 24, 1, 1)), labels.smpl_betas, labels.smpl_transl,
        labels.intrinsics,
    )  # fmt: skip
    sequence = np.repeat(np.arange(4), 3)
    mirrored = mirror_half(samples, sequence, np.random.default_rng(1))
    flipped = (mirrored.frames == samples.frames).all(axis=(1, 2, 3)).reshape(4, 3)
    assert (flipped == flipped[:, :1]).all() and 0 < flipped[:, 0].sum() < 4
    moved = shift(samples, 3, sequence, np.random.default_rng(0))
    by_px = ((moved.transl - samples.transl)[:, :2] / samples.transl[:, 2:] * 45).reshape(4, 3, 2)
    np.testing.assert_allclose(by_px, by_px[:, :1].repeat(3, axis=1), atol=1e-4)
    assert len(np.unique(by_px.round(2)[:, 0], axis=0)) > 1


def test_what_only_the_past_shows_is_learnt(tmp_path):
    """The first frame of each recording shows where the body is; the frame to judge is black."""
    count = 60
    places = np.random.default_rng(0).uniform(-0.3, 0.3, count // 2)
    labels = people(count)
    transl = np.tile(np.array([0, 0, 3.2], np.float32), (count, 1))
    transl[:, 0] = np.repeat(places, 2)
    labels = replace(labels, smpl_pose=np.tile(labels.smpl_pose[:1], (count, 1)), smpl_transl=transl)
    frames = np.zeros((count, 32, 32, 3), np.uint8)
    for row in range(0, count, 2):
        column = int(16 + 45 * transl[row, 0] / 3.2)
        frames[row, 8:24, column - 2 : column + 2] = 255
    names = [str(row // 2) for row in range(count)]
    options = smpl_regressor.Options(
        num_steps=60, batch_size=16, warmup_steps=5, device="cpu", sequence_length=2, flip=False, transl_weight=10
    )
    folders = {"out": tmp_path / "model", "work": tmp_path / "work"}
    learn = {"seed": 0, "parts": (), "groups": ()}
    smpl_regressor.train_sequences(frames, labels, options, **learn, **folders, recordings=names)
    found = smpl_regressor.predict_sequences(tmp_path / "model", frames, names)["smpl_transl"][1::2, 0]
    assert np.corrcoef(found, places)[0, 1] > 0.8
    assert np.ptp(smpl_regressor.predict(tmp_path / "model", frames)["smpl_transl"][1::2, 0]) < 1e-4
