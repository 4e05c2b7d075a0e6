"""What the decoder learns, from what, and that nothing is lost when it is interrupted."""

import numpy as np
import pytest
import torch
from simulated_gpu import simulated_gpu

from ctlev_core.pixel_decoder import training
from ctlev_core.pixel_decoder.drawing import draw_values
from ctlev_core.pixel_decoder.files import load_decoder, save_decoder
from ctlev_core.pixel_decoder.options import PixelDecoderOptions
from ctlev_core.pixel_decoder.pairs import level_planes
from ctlev_core.pixel_decoder.training import TrainingPairs, train_pixel_decoder
from data_contracts.config import ConditionChoice
from data_contracts.errors import DataError

SMALL = PixelDecoderOptions(
    num_steps=12, batch_size=4, crop_px=16, width=16, depth=1, log_every=4, validation_every=6, precision="float32"
)


def make_pairs(count=40, *, seed=0, num_planes=1):
    """Left half of each image grey, right half black: there the counts are Poisson of 0.6, there events are rare."""
    rng = np.random.default_rng(seed)
    frames = np.zeros((count, 16, 20, 3), np.uint8)
    frames[:, :, :10] = 120
    expected = np.where(np.arange(20) < 10, 0.6, 0.03)
    counts = rng.poisson(expected, (count, num_planes, 16, 20)).astype(np.uint16)
    return TrainingPairs(counts, [frames], None)


@pytest.mark.slow
def test_counts_are_drawn_as_the_training_frames_have_them(tmp_path):
    options = SMALL.model_copy(update={"num_steps": 250, "batch_size": 16, "learning_rate": 1e-3})
    network, classes, history = train_pixel_decoder(make_pairs(), options, seed=1, work=tmp_path)
    assert history.loss[-1] < 0.8 * history.loss[0] and history.validation_step[-1] == 250
    frames = make_pairs(30, seed=9).images[0]
    found = np.stack(list(draw_values(network, classes, frames, None, seeds=range(30), num_passes=4)))
    left, right = found[..., :10], found[..., 10:]
    assert left.mean() == pytest.approx(0.6, rel=0.1) and left.var() == pytest.approx(0.6, rel=0.15)
    assert right.mean() == pytest.approx(0.03, abs=0.02)


def test_a_training_that_was_killed_ends_as_one_that_was_not(tmp_path, monkeypatch):
    pairs, options = make_pairs(), SMALL.model_copy(update={"checkpoint_every_s": 1e-9})
    whole, _, curves = train_pixel_decoder(pairs, options, seed=2, work=tmp_path / "whole")
    steps = iter(range(7))

    def killed(*arguments):
        if next(steps, None) is None:
            raise KeyboardInterrupt
        return rows(*arguments)

    rows = training.sample_rows
    monkeypatch.setattr(training, "sample_rows", killed)
    with pytest.raises(KeyboardInterrupt):
        train_pixel_decoder(pairs, options, seed=2, work=tmp_path / "killed")
    monkeypatch.setattr(training, "sample_rows", rows)
    resumed, _, again = train_pixel_decoder(pairs, options, seed=2, work=tmp_path / "killed")
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    assert vars(again) == vars(curves)


def test_a_gpu_trains_by_deterministic_algorithms(tmp_path, monkeypatch):
    found, loss = [], training._Step.loss

    def noted(*arguments):
        found.append(torch.are_deterministic_algorithms_enabled())
        return loss(*arguments)

    monkeypatch.setattr(training._Step, "loss", noted)
    options = SMALL.model_copy(update={"num_steps": 2, "device": "cuda"})
    with simulated_gpu():
        train_pixel_decoder(make_pairs(), options, seed=2, work=tmp_path)
    assert found == [True, True, True] and not torch.are_deterministic_algorithms_enabled()  # two steps, a validation


@pytest.mark.parametrize("num_planes", [1, 2])
def test_counts_images_and_conditions_are_cut_and_turned_together(num_planes):
    rng = np.random.default_rng(4)
    counts = rng.integers(0, 200, (6, num_planes, 24, 18)).astype(np.uint16)
    channels = [counts[:, 0], counts[:, 0] if num_planes == 1 else np.zeros_like(counts[:, 0]), counts[:, -1]]
    frames = np.stack(channels, axis=3).astype(np.uint8)
    pairs = TrainingPairs(counts, [frames, frames], 255 - frames)
    found, images, conditions, _ = pairs.crops(np.arange(6), 12, num_planes, np.random.default_rng(0))
    assert found.shape == (6, num_planes, 12, 12) and conditions.shape == (6, 3, 12, 12)
    np.testing.assert_allclose((images.numpy() + 1) * 127.5, found, atol=1e-3)
    np.testing.assert_allclose(255 - conditions.numpy()[:, [0, 2][:num_planes]] * 255, found, atol=1e-3)
    moved = pairs.crops(np.arange(6), 12, num_planes, np.random.default_rng(1))[0]
    assert (moved != found).any()


def test_conditions_whose_colours_are_directions_turn_with_the_picture():
    """A surface that moves to the right, over a ramp that gets brighter to the right: in a crop both still agree."""
    side, flow_x, flow_y = 16, 1, 2
    conditions = np.full((1, side, side, 3), (255, 255, 128), np.uint8)
    frames = np.repeat((16 * np.arange(side, dtype=np.uint8))[None, None, :, None], side, axis=1).repeat(3, axis=3)
    values = frames[..., :1].transpose(0, 3, 1, 2)
    directions = set()
    for known in (True, False):
        made_by = ConditionChoice(name="moving_body") if known else None
        pairs, agreed = TrainingPairs(values, [frames], conditions, made_by=made_by), []
        for seed in range(24):
            crop = pairs.crops(np.array([0]), side, 1, np.random.default_rng(seed))
            ramp = crop.values[0, 0].astype(int)
            right, down = np.sign(ramp[0, -1] - ramp[0, 0]), np.sign(ramp[-1, 0] - ramp[0, 0])
            told = np.rint(255 * crop.conditions[0, [flow_x, flow_y], 0, 0].numpy()) - 128
            agreed.append(tuple(np.sign(told * (np.abs(told) > 1))) == (right, down))
            directions.add((right, down))
        assert all(agreed) == known, "a picture turns as a picture"
    assert directions == {(1, 0), (-1, 0), (0, 1), (0, -1)}


def test_pairs_of_different_sizes_are_refused():
    pairs = make_pairs()
    with pytest.raises(ValueError, match="expected images and conditions of shape"):
        TrainingPairs(pairs.values, [pairs.images[0][:, :8]], None)


def test_a_decoder_on_disk_is_the_one_that_was_saved(tmp_path):
    network, classes, _ = train_pixel_decoder(make_pairs(), SMALL, seed=3, work=tmp_path / "work")
    save_decoder(tmp_path / "decoder", network, classes, SMALL, conditioned=False, whole_counts=True)
    loaded, same, conditioned, whole_counts, interval_us = load_decoder(tmp_path / "decoder", torch.device("cpu"))
    assert whole_counts and not conditioned and interval_us is None and vars(same).keys() == vars(classes).keys()
    frames = make_pairs(3).images[0]
    one, other = (
        np.stack(list(draw_values(*each, frames, None, seeds=range(3), num_passes=2)))
        for each in ((network, classes), (loaded, same))
    )
    np.testing.assert_array_equal(one, other)
    config = tmp_path / "decoder" / "decoder.json"
    config.write_text(config.read_text().replace('"width": 16', '"width": 24'))
    with pytest.raises(DataError, match="no pixel decoder can be read"):
        load_decoder(tmp_path / "decoder", torch.device("cpu"))


def test_ten_frames_are_enough_to_train_on_and_few_enough_to_say_so(tmp_path, caplog):
    _, _, history = train_pixel_decoder(make_pairs(10), SMALL, seed=0, work=tmp_path)
    assert "learns from 10 frames; fewer than 50 are soon learnt by heart" in caplog.text
    assert np.isfinite(history.loss).all() and np.isfinite(history.validation_loss).all()


def test_grey_levels_are_learnt_in_as_many_planes_as_tell_something(tmp_path):
    rng = np.random.default_rng(0)
    grey = np.repeat(rng.integers(0, 256, (5, 8, 8, 1), np.uint8), 3, axis=3)
    for channels, num_planes in (((0, 1, 2), 3), ((0, 2), 2)):
        coloured = np.zeros_like(grey)
        coloured[..., channels] = rng.integers(0, 256, (5, 8, 8, len(channels)))
        planes = level_planes(coloured, tmp_path)
        assert planes.shape == (5, num_planes, 8, 8)
        np.testing.assert_array_equal(planes, coloured[..., channels].transpose(0, 3, 1, 2))
    np.testing.assert_array_equal(level_planes(grey, tmp_path), grey[:, None, :, :, 0])
