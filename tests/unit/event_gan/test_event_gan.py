"""Event-GAN as a generator: it learns, repeats itself, resumes, and says what is wrong with its input."""

import json

import numpy as np
import pytest
import torch

from ctlev_core.event_gan import batches, training
from ctlev_core.event_gan.event_images import pairs_to_tensor
from ctlev_core.generators import event_gan
from ctlev_core.supervised import batches as training_rows
from ctlev_core.supervised import models
from data_contracts.errors import DataError, TrainingError
from data_contracts.labels import Conditions

TINY = {
    "base_channels": 4,
    "num_encoders": 2,
    "num_residual_blocks": 1,
    "discriminator_channels": 4,
    "discriminator_layers": 1,
    "batch_size": 4,
    "num_steps": 6,
    "validation_every": 2,
    "log_every": 4,
    "device": "cpu",
}
# For tests that look at what was learned; RAdam with this beta2 hardly warms up.
FAST = {
    "base_channels": 8,
    "discriminator_channels": 8,
    "num_steps": 60,
    "batch_size": 8,
    "generator_learning_rate": 1e-2,
    "beta2": 0.9,
    "ema_decay": 0.9,
    "validation_every": 20,
}
SAMPLE = event_gan.SampleOptions(device="cpu")


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def moving_squares(count, seed=0, size=16, polarity=False):
    """A bright square on grey that moves by up to 3 px; an event wherever the brightness changed."""
    random = np.random.default_rng(seed)
    pairs = np.full((count, size, size, 3), 60, np.uint8)
    pairs[..., 2] = 0
    frames = np.zeros_like(pairs)
    for pair, frame in zip(pairs, frames, strict=True):
        side = int(random.integers(4, 7))
        start = random.integers(3, size - side - 3, 2)
        for channel, (y, x) in enumerate((start, start + random.integers(-3, 4, 2))):
            pair[y : y + side, x : x + side, channel] = 200
        change = pair[..., 1].astype(int) - pair[..., 0]
        if polarity:
            frame[..., 0], frame[..., 2] = 255 * (change > 0), 255 * (change < 0)
        else:
            frame[:] = 255 * (change != 0)[..., None]
    return frames, Conditions(("",) * count, pairs)


def images_of(conditions):
    assert conditions.images is not None
    return conditions.images


def square_pairs(count):
    frames, conditions = moving_squares(count)
    return batches.Pairs(images_of(conditions), frames, "grey", 1.0)


def weights(folder):
    return (folder / "model.safetensors").read_bytes()


def config(folder):
    return json.loads((folder / "config.json").read_text())


def run(folder, options=None, *, seed=0, data=None, work="work"):
    frames, conditions = data or moving_squares(20)
    chosen = event_gan.Options(**{**TINY, **(options or {})})
    history = event_gan.train(frames, conditions, chosen, seed=seed, out=folder / "model", work=folder / work)
    return history, folder / "model"


@pytest.mark.parametrize("polarity", [False, True])
def test_learns_that_changes_are_events(tmp_path, polarity):
    """An image without events is wrong by the mean of the events; the trained network by less than half of that."""
    history, model = run(tmp_path, {**FAST, "reconstruction_weight": 30}, data=moving_squares(100, polarity=polarity))
    frames, conditions = moving_squares(40, seed=1, polarity=polarity)
    made = event_gan.sample(model, conditions, SAMPLE, seeds=range(40), work=tmp_path)
    # Reached: a quarter. What is left are edges of squares that the 60 steps have not yet placed to the pixel.
    assert np.abs(made.astype(int) - frames).mean() < 0.5 * frames.mean()
    assert history.validation_loss[-1] < 0.5 and history.shuffled_loss[-1] > 1.5 * history.validation_loss[-1]
    palette = "red_blue" if polarity else "grey"
    assert config(model)["palette"] == palette
    assert not made[..., 1].any() if polarity else np.array_equal(made[..., 0], made[..., 1])


def test_adversary_alone_teaches_where_events_are(tmp_path):
    """The published loss, nothing but the discriminator: better than no events, and than the events of other pairs."""
    options = {**FAST, "beta2": 0.99, "discriminator_learning_rate": 1e-2, "reconstruction_weight": 0}
    history, _ = run(tmp_path, options, data=moving_squares(100))
    best = int(np.argmin(history.validation_loss))
    assert history.validation_loss[best] < 0.8
    assert history.shuffled_loss[best] > 1.2 * history.validation_loss[best]


class Killed(Exception):
    pass


def test_resumed_run_ends_in_the_same_weights(tmp_path, monkeypatch):
    options = {"checkpoint_every_s": 1e-9, "num_steps": 7}
    history, whole = run(tmp_path / "whole", options)
    original, count = training.EventGAN.train_generator, [0]

    def dies_in_the_fifth_step(self, batch):
        count[0] += 1
        if count[0] == 5:
            raise Killed
        return original(self, batch)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(training.EventGAN, "train_generator", dies_in_the_fifth_step)
        run(tmp_path / "killed", options)
    assert not (tmp_path / "killed" / "model").exists()
    steps = []
    monkeypatch.setattr(training.EventGAN, "train_generator", lambda gan, b: steps.append(gan.step) or original(gan, b))
    again, resumed = run(tmp_path / "killed", options)
    assert steps == [4, 5, 6], "training did not go on after step 4"
    assert weights(resumed) == weights(whole) and config(resumed) == config(whole)
    assert again == history and history.step == [4, 7] and history.validation_step == [2, 4, 6, 7]


def test_resumed_state_is_the_whole_state(tmp_path):
    """Networks, average and both optimisers go on as they would have."""
    data = square_pairs(20)
    options = event_gan.Options(**TINY)
    first = training.EventGAN(data, options, seed=0, identity="run")
    for _ in range(7):  # more than the warm-up of RAdam, so that second moments matter
        first.train_step()
    first.save(tmp_path / "state.pt")
    second = training.EventGAN(data, options, seed=0, identity="run")
    second.restore(tmp_path / "state.pt")
    for gan in (first, second):
        gan.train_step()
    for name in ("generator", "discriminator", "averaged"):
        one, other = getattr(first, name).state_dict(), getattr(second, name).state_dict()
        assert all(torch.equal(one[key], other[key]) for key in one), name
    moments = [gan.discriminator_optimizer.state_dict()["state"][0]["exp_avg_sq"] for gan in (first, second)]
    assert torch.equal(*moments) and moments[0].abs().sum() > 0


def test_state_of_another_run_is_refused(tmp_path):
    run(tmp_path, work="shared")
    with pytest.raises(TrainingError, match="state is of another run, delete it"):
        run(tmp_path, seed=1, work="shared")
    (tmp_path / "shared" / "state.pt").write_bytes(b"cut off")
    with pytest.raises(TrainingError, match="cannot be read, delete it"):
        run(tmp_path, work="shared")


def test_same_seed_same_model_and_the_global_random_state_is_left_alone(tmp_path):
    data = moving_squares(20)
    arrays = data[0], images_of(data[1])
    before, state = [array.copy() for array in arrays], torch.get_rng_state()
    history, one = run(tmp_path / "one", seed=3, data=data)
    assert torch.equal(torch.get_rng_state(), state)
    assert all(np.array_equal(a, b) for a, b in zip(before, arrays, strict=True))
    torch.rand(7)
    again, same = run(tmp_path / "same", seed=3)
    _, other = run(tmp_path / "other", seed=4)
    assert weights(one) == weights(same) != weights(other) and history == again


@pytest.fixture(scope="module")
def lively(tmp_path_factory):
    """A model that has learned enough to make events."""
    torch.set_num_threads(1)
    return run(tmp_path_factory.mktemp("lively"), {**FAST, "num_steps": 30, "reconstruction_weight": 30})[1]


@pytest.mark.parametrize("rounding", ["threshold", "stochastic", "none"])
def test_rows_do_not_depend_on_one_another(tmp_path, lively, rounding):
    _, conditions = moving_squares(9, seed=5)
    options = event_gan.SampleOptions(rounding=rounding, device="cpu")
    seeds = np.arange(100, 109)

    def sample(rows):
        chosen = Conditions(("",) * len(rows), images_of(conditions)[rows])
        return event_gan.sample(lively, chosen, options, seeds=seeds[rows].tolist(), work=tmp_path)

    whole, order = sample(np.arange(9)), np.array([4, 2, 8])
    assert whole.any(axis=(1, 2, 3)).sum() > 4, "there is nothing to see"
    assert np.array_equal(sample(order), whole[order]) and np.array_equal(sample(np.array([7])), whole[[7]])
    assert sample(np.array([], int)).shape == (0, 16, 16, 3)


def test_only_stochastic_rounding_uses_the_seed(tmp_path, lively):
    _, conditions = moving_squares(2, seed=5)
    for rounding, differs in (("threshold", False), ("none", False), ("stochastic", True)):
        options = event_gan.SampleOptions.model_validate({"rounding": rounding, "device": "cpu"})
        one, other = (event_gan.sample(lively, conditions, options, seeds=s, work=tmp_path) for s in ([1, 2], [3, 4]))
        assert np.array_equal(one, other) != differs


def test_best_of_the_checkpoints_is_kept(tmp_path, monkeypatch):
    """The rate is constant, so a shorter run ends in the weights that the longer one passes through."""
    _, short = run(tmp_path / "short", {"num_steps": 4, "validation_every": 100})
    scores = iter([0.9, 9, 0.2, 9, 0.5, 9])
    monkeypatch.setattr(training, "local_statistics_error", lambda generated, real: next(scores))
    history, best = run(tmp_path / "long")
    assert history.validation_loss == [0.9, 0.2, 0.5] and config(best)["best_step"] == 4
    monkeypatch.undo()
    _, last = run(tmp_path / "last", {"validation_every": 100})
    assert config(last)["best_step"] == 6
    assert weights(best) == weights(short) != weights(last)


def test_without_validation_the_last_average_is_kept_and_all_rows_train(tmp_path):
    history, model = run(tmp_path, {"validation_fraction": 0})
    assert history.validation_step == [] and config(model)["best_step"] == 6
    data = square_pairs(5)
    gan = training.EventGAN(data, event_gan.Options(**TINY, validation_fraction=0), seed=0, identity="")
    assert len(gan.data.frames) == 5 and len(gan.validation.frames) == 0


@pytest.mark.parametrize(
    ("count", "fraction", "held_back"), [(20, 0.1, 2), (21, 0.1, 3), (1, 0.5, 0), (3, 0.99, 2), (5000, 0.1, 128)]
)
def test_split_is_disjoint_and_complete(count, fraction, held_back):
    train, validation = batches.split_rows(count, fraction, seed=7)
    assert sorted([*train, *validation]) == list(range(count)) and len(validation) == held_back
    if count == 21:
        assert not np.array_equal(validation, batches.split_rows(count, fraction, seed=8)[1])


def test_augmentation_mirrors_pair_and_events_alike():
    data, cpu = square_pairs(8), torch.device("cpu")
    straight = batches.make_batch(data, event_gan.Options(batch_size=8, flip=0, appearance=0), 0, 3, cpu)
    mirrored = batches.make_batch(data, event_gan.Options(batch_size=8, flip=1, appearance=0.2), 0, 3, cpu)
    rows = training_rows.batch_rows(8, 8, 0, 3)
    assert torch.equal(straight.pairs, pairs_to_tensor(data.conditions[rows]))
    assert torch.equal(straight.seen, straight.pairs)
    assert torch.equal(mirrored.pairs, straight.pairs.flip(-1, -2))
    assert torch.equal(mirrored.volumes, straight.volumes.flip(-1, -2))
    # Brightness changes for the generator alone, by up to a fifth, and differs from row to row.
    ratio = ((mirrored.seen + 1) / (mirrored.pairs + 1)).amax((1, 2, 3))
    assert len(set(ratio.tolist())) == 8 and not torch.equal(mirrored.seen, mirrored.pairs)


def test_average_lags_behind_the_weights(tmp_path):
    data = square_pairs(8)
    gan = training.EventGAN(data, event_gan.Options(**TINY, ema_decay=0.5), seed=0, identity="")
    expected = [parameter.detach().clone() for parameter in gan.generator.parameters()]
    for step in range(6):
        gan.train_step()
        decay = min(0.5, (1 + step) / (10 + step))
        for average, parameter in zip(expected, gan.generator.parameters(), strict=True):
            average.mul_(decay).add_(parameter.detach(), alpha=1 - decay)
    for average, parameter in zip(expected, gan.averaged.parameters(), strict=True):
        assert torch.allclose(average, parameter, atol=1e-6)


def test_loss_that_is_not_finite_stops_the_training(tmp_path):
    with pytest.raises(TrainingError, match=r"loss is \S+ at step \d+ of 60; lower \w+_learning_rate"):
        run(tmp_path, {"generator_learning_rate": 1e30, "discriminator_learning_rate": 1e30, "num_steps": 60})
    assert not (tmp_path / "model").exists()


def test_weights_that_are_not_finite_are_never_kept():
    gan = training.EventGAN(square_pairs(5), event_gan.Options.model_validate(TINY), seed=0, identity="")
    with torch.no_grad():
        next(gan.averaged.parameters())[0] = torch.nan
    with pytest.raises(TrainingError, match=r"not finite after step 0 of 6; lower generator_learning_rate \(now 0.001"):
        gan.finish()


def test_bad_training_sets_are_named(tmp_path):
    frames, conditions = moving_squares(6)
    images = images_of(conditions)
    skeleton = np.full_like(images, 255)
    colourful = frames.copy()
    colourful[0, 0, 0] = (255, 10, 0)
    cases = [
        (frames, Conditions(("",) * 6), ValueError, "needs pairs of intensity frames as condition images"),
        (frames, Conditions(("",) * 6, skeleton), DataError, "zeros in channel 2, which row 0 has not"),
        (frames, Conditions(("",) * 6, images.astype(np.float32)), DataError, r"uint8, got \[6, 16, 16, 3\] float32"),
        (frames, Conditions(("",) * 5, images), DataError, "6 pairs do not match 5 prompts"),
        (frames[:5], conditions, DataError, r"shape of the pairs, \[6, 16, 16, 3\] uint8, got \[5, 16, 16, 3\]"),
        (frames / 255, conditions, DataError, r"uint8, got \[6, 16, 16, 3\] float64"),
        (frames[:0], Conditions((), images[:0]), DataError, "at least one frame, got none"),
        (np.zeros_like(frames), conditions, DataError, "none of the 6 frames has an event"),
        (colourful, conditions, DataError, "must be grey .* or red and blue"),
    ]
    for wrong_frames, wrong_conditions, kind, message in cases:
        with pytest.raises(kind, match=message):
            run(tmp_path, data=(wrong_frames, wrong_conditions))
    with pytest.raises(ValueError, match=r"needs images of at least 33 px a side, got 16 x 16 px; lower num_encoders"):
        run(tmp_path, {"num_encoders": 5})
    with pytest.raises(ValueError, match="needs images of at least 24 px"):
        run(tmp_path, {"discriminator_layers": 3})
    assert list(tmp_path.iterdir()) == []


def test_smallest_images_that_are_allowed_do_train(tmp_path):
    for number, shape in enumerate(({"num_encoders": 3}, {"num_encoders": 1, "discriminator_layers": 1})):
        side = (9, 6)[number]
        frames = np.zeros((3, side, side + 1, 3), np.uint8)
        frames[:, 2, 2] = 200
        pairs = np.zeros_like(frames)
        _, model = run(
            tmp_path / str(number), {**shape, "norm": "instance"}, data=(frames, Conditions(("",) * 3, pairs))
        )
        made = event_gan.sample(model, Conditions(("",) * 3, pairs), SAMPLE, seeds=[0, 0, 0], work=tmp_path)
        assert made.shape == frames.shape


def test_sampling_says_what_is_wrong(tmp_path):
    _, model = run(tmp_path)
    _, conditions = moving_squares(3)
    with pytest.raises(ValueError, match="got 2 seeds for 3 pairs"):
        event_gan.sample(model, conditions, SAMPLE, seeds=[0, 1], work=tmp_path)
    _, larger = moving_squares(3, size=20)
    with pytest.raises(DataError, match="learned images of 16 x 16 px, got pairs of 20 x 20 px"):
        event_gan.sample(model, larger, SAMPLE, seeds=[0, 1, 2], work=tmp_path)
    with pytest.raises(ValueError, match="got prompts only"):
        event_gan.sample(model, Conditions(("a",)), SAMPLE, seeds=[0], work=tmp_path)


def test_other_checkpoints_are_refused(tmp_path):
    _, model = run(tmp_path)
    _, conditions = moving_squares(1)

    def sample(folder):
        return event_gan.sample(folder, conditions, SAMPLE, seeds=[0], work=tmp_path)

    with pytest.raises(DataError, match="found none"):
        sample(tmp_path / "nothing")
    models.write_model(tmp_path / "other", torch.nn.Linear(2, 2), {"model": "classifier"})
    with pytest.raises(DataError, match="expected a event_gan model, got 'classifier'"):
        sample(tmp_path / "other")
    whole = weights(model)
    (model / "model.safetensors").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match="cannot be loaded"):
        sample(model)
    (model / "model.safetensors").write_bytes(whole)
    changed = config(model)
    changed["generator"]["base_channels"] = 5
    (model / "config.json").write_text(json.dumps(changed))
    with pytest.raises(DataError, match="cannot be loaded"):
        sample(model)
    (model / "config.json").write_text("{")
    with pytest.raises(DataError, match="cannot be loaded"):
        sample(model)


def test_run_settings_stay_out_of_the_checkpoint(tmp_path):
    _, model = run(tmp_path)
    record = config(model)
    assert record["model"] == "event_gan" and record["image_size"] == [16, 16] and record["one_event"] == 1.0
    assert "device" not in record["options"] and "checkpoint_every_s" not in record["options"]
    assert len(record["discriminator_loss"]) == 2 and event_gan.base_model_folders(event_gan.Options()) == []
