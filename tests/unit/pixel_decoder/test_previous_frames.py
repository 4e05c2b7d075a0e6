"""A decoder that sees what it drew for the frame before: learnt from consecutive frames, drawn stretch by stretch."""

import cv2
import numpy as np
import pytest
import torch

from ctlev_core.pixel_decoder.drawing import draw_values
from ctlev_core.pixel_decoder.files import CONFIG_FILE, load_decoder, save_decoder
from ctlev_core.pixel_decoder.options import PixelDecoderOptions
from ctlev_core.pixel_decoder.training import Places, TrainingPairs, build_network, train_pixel_decoder
from ctlev_core.pixel_decoder.value_classes import fit_classes
from data_contracts.errors import DataError

SMALL = PixelDecoderOptions(
    num_steps=250, batch_size=16, crop_px=16, width=16, depth=1, learning_rate=2e-3, precision="float32",
    previous_frame=True,
)  # fmt: skip
KEPT, ACTIVE = 0.9, 0.2


def chains(count, length, seed):
    """Stretches [count * length, 1, 16, 16] of a Markov chain in each pixel: a value stays, or is drawn anew."""
    rng = np.random.default_rng(seed)
    values = rng.random((count, length, 1, 16, 16)) < ACTIVE
    for position in range(1, length):
        stays = rng.random(values[:, 0].shape) < KEPT
        values[:, position] = np.where(stays, values[:, position - 1], values[:, position])
    return values.astype(np.uint16).reshape(-1, 1, 16, 16)


def chain_pairs(count=20, length=4):
    values = chains(count, length, 0)
    own = np.arange(len(values))
    grey = np.full((len(values), 16, 16, 3), 50, np.uint8)  # the image says nothing
    return TrainingPairs(values, [grey], None, Places(own, np.where(own % length, own - 1, -1)))


def random_network(classes, seed=3):
    torch.manual_seed(seed)
    network = build_network(classes, 1, True, width=16, depth=1, sees_previous=True).eval().requires_grad_(False)
    torch.nn.init.normal_(network.detail[-1].weight, std=1.0)
    return network


def test_values_stay_from_frame_to_frame_as_those_learnt_from_did(tmp_path):
    network, classes, _ = train_pixel_decoder(chain_pairs(), SMALL, seed=1, work=tmp_path)
    grey = np.full((60, 16, 16, 3), 50, np.uint8)
    drawn = list(draw_values(network, classes, grey, None, seeds=range(60), num_passes=4, lengths=[6] * 10))
    values = np.stack(drawn).reshape(10, 6, 16, 16)
    before, after = values[:, :-1], values[:, 1:]
    assert values.mean() == pytest.approx(ACTIVE, abs=0.04)
    assert (after == before).mean() == pytest.approx(KEPT + (1 - KEPT) * (ACTIVE**2 + (1 - ACTIVE) ** 2), abs=0.03)
    assert after[before == 1].mean() == pytest.approx(KEPT + (1 - KEPT) * ACTIVE, abs=0.06)
    # Each by itself: independent of the one before.
    alone = np.stack(list(draw_values(network, classes, grey, None, seeds=range(60), num_passes=4)))
    alone = alone.reshape(10, 6, 16, 16)
    assert alone[:, 1:][alone[:, :-1] == 1].mean() == pytest.approx(ACTIVE, abs=0.06)


@pytest.mark.parametrize("moving_noise", [False, True])
def test_a_stretch_depends_on_its_own_rows_alone(moving_noise):
    classes, rng = fit_classes(chains(4, 4, 0)), np.random.default_rng(2)
    network, lengths = random_network(classes), [3, 1, 5, 2] * 6
    count = sum(lengths)
    frames, conditions = (rng.integers(0, 256, (count, 17, 18, 3), np.uint8) for _ in range(2))

    def drawn(rows, lengths):
        seeds = range(100 + rows.start, 100 + rows.stop)
        found = draw_values(
            network, classes, frames[rows], conditions[rows], seeds=seeds, num_passes=3, lengths=lengths,
            moving_noise=moving_noise,
        )  # fmt: skip
        return np.stack(list(found))

    together = drawn(slice(0, count), lengths)
    starts = np.cumsum(lengths) - lengths
    for number in (0, 2, 17, 22):  # of two batches
        rows = slice(int(starts[number]), int(starts[number]) + lengths[number])
        np.testing.assert_array_equal(drawn(rows, lengths[number : number + 1]), together[rows])
    # What comes before matters, what comes after does not.
    single = drawn(slice(0, count), [1] * count)
    firsts = np.zeros(count, bool)
    firsts[starts] = True
    np.testing.assert_array_equal(single[firsts], together[firsts])
    assert (single[~firsts] != together[~firsts]).any(axis=(1, 2, 3)).all()
    with pytest.raises(ValueError, match=f"lengths must be 1 or more and add up to {count}, got"):
        drawn(slice(0, count), [1, 2])


def test_the_frame_before_is_cut_and_turned_with_its_frame():
    rng = np.random.default_rng(4)
    values = rng.integers(1, 200, (7, 2, 24, 18)).astype(np.uint16)
    own, previous = np.array([1, 4, 6, 2] * 20), np.array([0, 3, -1, 5] * 20)
    values[[0, 3, 5]] = values[[1, 4, 2]]  # the frame before is the frame itself
    frames = np.stack([values[own, 0], np.zeros_like(values[own, 0]), values[own, 1]], axis=3).astype(np.uint8)
    pairs = TrainingPairs(values, [frames], None, Places(own, previous))
    crops = pairs.crops(np.arange(80), 12, 2, np.random.default_rng(0))
    shown = (crops.previous >= 0).all(axis=(1, 2, 3))
    assert ((crops.previous == -1).all(axis=(1, 2, 3)) == ~shown).all(), "a frame is shown whole or not at all"
    assert not shown[2::4].any() and 0.75 < shown[np.arange(80) % 4 != 2].mean() < 1
    np.testing.assert_array_equal(crops.previous[shown], crops.values[shown])
    with pytest.raises(ValueError, match="expected images and conditions of shape"):
        TrainingPairs(values, [frames[:5]], None, Places(own, previous))
    assert pairs.digest() != TrainingPairs(values, [frames], None, Places(own, previous[::-1])).digest()


def test_a_decoder_on_disk_knows_that_it_sees_the_frame_before(tmp_path):
    classes = fit_classes(chains(4, 4, 0))
    network = random_network(classes)
    save_decoder(tmp_path, network, classes, SMALL, conditioned=True, whole_counts=True, interval_us=20_000)
    saved = load_decoder(tmp_path, torch.device("cpu"))
    assert saved.interval_us == 20_000 and saved.network.sees_previous
    frames = np.random.default_rng(0).integers(0, 256, (4, 16, 16, 3), np.uint8)
    one, other = (
        np.stack(list(draw_values(each, classes, frames, frames, seeds=range(4), num_passes=2, lengths=[4])))
        for each in (network, saved.network)
    )
    np.testing.assert_array_equal(one, other)
    config = tmp_path / CONFIG_FILE
    for wrong in ("0", '"20"', "true"):
        config.write_text(config.read_text().replace("20000", wrong))
        with pytest.raises(DataError, match="interval_us must be a whole number from 1"):
            load_decoder(tmp_path, torch.device("cpu"))
        config.write_text(config.read_text().replace(wrong, "20000", 1))


def test_values_move_with_a_picture_where_their_noise_does():
    """A network that knows nothing of the frame before, and images in which a texture moves by two pixels."""
    classes = fit_classes(chains(4, 4, 0))
    torch.manual_seed(5)
    network = build_network(classes, 1, False, width=16, depth=1).eval().requires_grad_(False)
    blurred = cv2.GaussianBlur(np.random.default_rng(1).standard_normal((96, 96)), (0, 0), 2.5)
    texture = np.clip(60 + 150 * blurred, 0, 120).astype(np.uint8)
    frames = np.stack([texture[20:68, 30 - 2 * number : 78 - 2 * number] for number in range(6)])
    frames = np.repeat(frames[..., None], 3, axis=-1)

    def agreement(moving_noise):
        drawn = draw_values(
            network, classes, frames, None, seeds=range(6), num_passes=4, lengths=[6], moving_noise=moving_noise
        )
        values = np.stack(list(drawn))[:, 0, 12:-12, 12:-12]
        return float(np.corrcoef(values[1:, :, 2:].ravel(), values[:-1, :, :-2].ravel())[0, 1])

    assert abs(agreement(False)) < 0.1 and agreement(True) > 0.6
