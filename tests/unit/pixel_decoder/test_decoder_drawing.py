"""Counts are drawn as probable as they are, whatever the number of passes, and each image by itself."""

import numpy as np
import pytest
import torch

from ctlev_core.pixel_decoder.drawing import (
    draw_classes,
    draw_values,
    frames_of_planes,
    image_planes,
    noise_levels,
)
from ctlev_core.pixel_decoder.training import build_network
from ctlev_core.pixel_decoder.value_classes import fit_classes
from ctlev_core.seeds import distinct_seeds

PRIOR = np.array([0.8, 0.12, 0.05, 0.03])


def known_classes():
    counts = np.repeat(np.arange(4), (1000 * PRIOR).astype(int)).astype(np.uint16)
    return fit_classes(counts[:, None])


def network_of(classes, num_planes=1, conditioned=False, *, seed=None):
    """One that knows the prior and nothing else; with a seed a random one."""
    torch.manual_seed(0 if seed is None else seed)
    network = build_network(classes, num_planes, conditioned, width=16, depth=1).eval().requires_grad_(False)
    if seed is None:
        last = network.detail[-1]
        logits = np.full(len(classes), -30.0)
        logits[: len(PRIOR)] = np.log(PRIOR)
        last.weight.zero_()
        last.bias.copy_(torch.from_numpy(np.tile(logits, num_planes)))
    return network


def drawn(network, classes, frames, conditions=None, *, seeds=None, num_passes=4):
    seeds = range(len(frames)) if seeds is None else seeds
    return np.stack(list(draw_values(network, classes, frames, conditions, seeds=seeds, num_passes=num_passes)))


def test_the_logits_are_those_of_bayes_where_the_surroundings_say_nothing():
    classes = known_classes()
    network = network_of(classes)
    noisy, level = torch.randn(2, 1, 6, 6, generator=torch.Generator().manual_seed(3)), torch.tensor([0.5, 3.0])
    found = torch.softmax(network(noisy, level, torch.zeros(2, 1, 6, 6), None), dim=2).numpy()
    for row in range(2):
        for place in ((0, 0), (3, 5)):
            value, sigma = float(noisy[row, 0][place]), float(level[row])
            posterior = PRIOR * np.exp(-((value - classes.embeddings[:4]) ** 2) / (2 * sigma**2))
            np.testing.assert_allclose(
                found[row, 0, :4, place[0], place[1]], posterior / posterior.sum(), rtol=1e-4, atol=1e-6
            )


@pytest.mark.parametrize("num_passes", [1, 2, 4, 9])
def test_every_number_of_passes_draws_the_same_distribution(num_passes):
    classes = known_classes()
    counts = drawn(network_of(classes), classes, np.zeros((8, 64, 64, 3), np.uint8), num_passes=num_passes)
    shares = np.bincount(counts.ravel(), minlength=4) / counts.size
    np.testing.assert_allclose(shares, PRIOR, atol=4 * np.sqrt(0.16 / counts.size))
    neighbours = np.corrcoef((counts[..., 1:] > 0).ravel(), (counts[..., :-1] > 0).ravel())[0, 1]
    assert abs(neighbours) < 4 / np.sqrt(counts.size), "independent, as the network says they are"


@pytest.mark.parametrize("num_planes", [1, 2])
def test_an_image_depends_on_its_own_row_alone(num_planes):
    classes = known_classes()
    network = network_of(classes, num_planes, conditioned=True, seed=5)
    rng = np.random.default_rng(2)
    frames, conditions = (rng.integers(0, 256, (20, 17, 18, 3), np.uint8) for _ in range(2))
    seeds = list(range(100, 120))
    together = drawn(network, classes, frames, conditions, seeds=seeds)
    assert together.shape == (20, num_planes, 17, 18) and together.dtype == np.uint16
    for row in (0, 7, 19):
        one = slice(row, row + 1)
        alone = drawn(network, classes, frames[one], conditions[one], seeds=seeds[one])
        np.testing.assert_array_equal(alone[0], together[row])
    again = drawn(network, classes, frames, conditions, seeds=[seed + 1 for seed in seeds])
    assert (again != together).any(axis=(1, 2, 3)).all()


def test_classes_are_drawn_with_their_probabilities():
    logits = torch.log(torch.tensor([0.2, 0.5, 0.3]))[None, None, :, None, None].expand(1, 1, 3, 100, 100)
    uniform = (torch.arange(10_000) + 0.5).reshape(1, 1, 100, 100) / 10_000
    assert torch.bincount(draw_classes(logits, uniform).ravel()).tolist() == [2000, 5000, 3000]


def test_noise_levels_fall_from_all_to_hardly_any():
    classes = known_classes()
    levels = noise_levels(5, classes) / classes.active_step
    assert levels[0] == pytest.approx(8) and levels[-1] == pytest.approx(0.2) and (np.diff(levels) < 0).all()
    assert noise_levels(1, classes).tolist() == [pytest.approx(8 * classes.active_step)]


def test_numbers_that_do_not_match_are_refused():
    classes = known_classes()
    with pytest.raises(ValueError, match="one seed and condition a frame, got 2, 1 and none"):
        drawn(network_of(classes), classes, np.zeros((2, 8, 8, 3), np.uint8), seeds=[1])


@pytest.mark.parametrize("num_planes", [1, 2, 3])
def test_planes_of_frames_and_back(num_planes):
    rng = np.random.default_rng(1)
    planes = rng.integers(0, 256, (4, num_planes, 5, 6)).astype(np.uint8)
    frames = frames_of_planes(planes)
    assert frames.shape == (4, 5, 6, 3) and frames.dtype == np.uint8
    np.testing.assert_array_equal(image_planes(frames, num_planes), planes)
    assert (frames[..., 1] == (planes[:, 0] if num_planes == 1 else 0)).all() or num_planes == 3


def test_frames_that_share_a_seed_are_drawn_differently():
    assert distinct_seeds([7, 9, 4]) == [7, 9, 4]
    found = distinct_seeds([7, 7, 9, 7])
    assert found[0] == 7 and found[2] == 9 and len(set(found)) == 4
    assert distinct_seeds([7, 7]) == found[:2], "nothing depends on the rows after"
