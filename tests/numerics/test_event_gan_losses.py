"""Losses, norms, receptive fields and the validation criterion of Event-GAN against closed forms and slow loops."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.event_gan import losses
from ctlev_core.event_gan.batches import change_appearance
from ctlev_core.event_gan.event_images import one_event_value, volumes_to_frames
from ctlev_core.event_gan.local_statistics import local_statistics_error
from ctlev_core.event_gan.networks import EventVolumeUNet, PatchDiscriminator, RevivableReLU, without_spectral_norm
from ctlev_core.event_gan.options import SamplingOptions

PUBLISHED = {
    "base_channels": 32,
    "num_encoders": 4,
    "num_residual_blocks": 2,
    "norm": "batch",
    "spectral_norm": True,
}
SMALL = {**PUBLISHED, "base_channels": 4, "num_encoders": 2}
logits = st.lists(st.floats(-4, 4, width=32), min_size=1, max_size=6)


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@given(logits, logits)
@settings(max_examples=50, deadline=None)
def test_discriminator_hinge_loss_and_its_gradient(real, generated):
    tensors = [torch.tensor(values, dtype=torch.float64, requires_grad=True) for values in (real, generated)]
    loss = losses.discriminator_hinge_loss(*tensors)
    expected = sum(max(0.0, 1 - value) for value in real) / len(real)
    expected += sum(max(0.0, 1 + value) for value in generated) / len(generated)
    assert loss.item() == pytest.approx(expected, abs=1e-12)
    loss.backward()
    assert tensors[0].grad is not None and tensors[1].grad is not None
    assert tensors[0].grad.tolist() == [-1 / len(real) if value < 1 else 0.0 for value in real]
    assert tensors[1].grad.tolist() == [1 / len(generated) if value > -1 else 0.0 for value in generated]


def test_hinge_losses_at_known_points():
    zero, sure = torch.zeros(2, 1, 3, 3), torch.full((2, 1, 3, 3), 1.0)
    assert losses.discriminator_hinge_loss(zero, zero).item() == 2
    assert losses.discriminator_hinge_loss(sure, -sure).item() == 0
    assert losses.discriminator_hinge_loss(-sure, sure).item() == 4
    # The generator's gradient is the same for patches that were found out and for those that were not.
    logits = torch.tensor([-50.0, 0.0, 50.0, 4.0], requires_grad=True)
    loss = losses.generator_hinge_loss(logits)
    loss.backward()
    assert loss.item() == -1 and logits.grad is not None and logits.grad.tolist() == [-0.25] * 4


def test_flipped_labels_exchange_logits_and_nothing_else():
    real, generated = torch.arange(6.0).view(2, 1, 3, 1), -torch.arange(1.0, 7.0).view(2, 1, 3, 1)
    is_flipped = torch.tensor([True, False, False, True, True, False]).view(2, 1, 3, 1)
    new_real, new_generated = losses.flip_labels(real, generated, is_flipped)
    assert new_real.flatten().tolist() == [-1, 1, 2, -4, -5, 5]
    assert new_generated.flatten().tolist() == [0, -2, -3, 3, 4, -6]
    again = losses.flip_labels(new_real, new_generated, is_flipped)
    assert torch.equal(again[0], real) and torch.equal(again[1], generated)


def test_reconstruction_loss_is_the_mean_absolute_difference():
    random = np.random.default_rng(0)
    one, other = random.random((2, 3, 2, 5, 4))
    expected = np.mean([abs(a - b) for a, b in zip(one.ravel(), other.ravel(), strict=True)])
    assert losses.reconstruction_loss(torch.from_numpy(one), torch.from_numpy(other)).item() == pytest.approx(expected)


def largest_singular_value(weight):
    return float(np.linalg.svd(weight.detach().double().numpy().reshape(len(weight), -1), compute_uv=False)[0])


def test_spectral_norm_bounds_every_layer_of_the_discriminator():
    torch.manual_seed(0)
    network = PatchDiscriminator(2, channels=8, num_layers=2, spectral_norm=True)
    convolutions: list[Any] = [layer for layer in network.layers if isinstance(layer, torch.nn.Conv2d)]
    assert len(convolutions) == 4
    with torch.no_grad():
        for layer in convolutions:
            layer.parametrizations.weight.original.mul_(37.0)
            for _ in range(200):
                layer.weight  # noqa: B018 - every look at the weight is a power iteration
    network.eval()
    for layer in convolutions:
        # 200 iterations leave less than 1e-3 of the gap between the two largest singular values.
        assert largest_singular_value(layer.weight) == pytest.approx(1.0, abs=1e-3)
        assert largest_singular_value(layer.parametrizations.weight.original) > 5


def test_spectral_norm_is_where_it_was_published():
    network = EventVolumeUNet(2, **SMALL)
    normalised = {
        name.removesuffix(".parametrizations.weight.original").split(".")[0]
        for name, _ in network.named_parameters()
        if "parametrizations" in name
    }
    assert normalised == {"residual_blocks", "decoders"}


def test_folded_spectral_norm_is_the_same_function():
    torch.manual_seed(1)
    network = EventVolumeUNet(2, **SMALL)
    pairs = torch.rand(3, 2, 16, 20) * 2 - 1
    network(pairs)
    before = network.eval()(pairs)
    folded = without_spectral_norm(network)
    assert not any("parametrizations" in name for name in folded.state_dict())
    assert torch.allclose(folded(pairs), before, atol=1e-6) and before.max() > 0
    plain = EventVolumeUNet(2, **{**SMALL, "spectral_norm": False})
    plain.load_state_dict(folded.state_dict())
    assert torch.equal(plain.eval()(pairs), folded(pairs))


def convolution(num_inputs, num_outputs, kernel, bias):
    return num_inputs * num_outputs * kernel**2 + bias * num_outputs


def test_published_networks_have_their_numbers_of_parameters():
    """Counted from the table of layers of the released code: 18 channels of events, widths 32 to 512."""
    expected = convolution(2, 32, 3, True) + convolution(32, 18, 1, True)
    for width in (32, 64, 128, 256):
        expected += convolution(width, 2 * width, 3, False) + 2 * (2 * width)
        expected += convolution(3 * width, width, 3, False) + 2 * width
    expected += 4 * (convolution(512, 512, 3, False) + 2 * 512)
    network = EventVolumeUNet(18, **PUBLISHED)
    assert sum(parameter.numel() for parameter in network.parameters()) == expected
    widths = (20, 64, 128, 256, 512, 512, 1)
    expected = sum(convolution(a, b, 4, True) for a, b in itertools.pairwise(widths))
    discriminator = PatchDiscriminator(18, channels=64, num_layers=4, spectral_norm=False)
    assert sum(parameter.numel() for parameter in discriminator.parameters()) == expected


@pytest.mark.parametrize(("num_layers", "patch_px"), [(1, 16), (2, 34), (3, 70)])
def test_patches_of_the_discriminator(num_layers, patch_px):
    """A logit feels the pixels of its patch and no others."""
    torch.manual_seed(0)
    network = PatchDiscriminator(1, channels=2, num_layers=num_layers, spectral_norm=False)
    side = 3 * patch_px
    volumes = torch.rand(1, 1, side, side, requires_grad=True)
    output = network(volumes, torch.rand(1, 2, side, side))
    output[0, 0, output.shape[2] // 2, output.shape[3] // 2].backward()
    assert volumes.grad is not None
    for axis in (0, 1):
        felt = torch.nonzero(volumes.grad[0, 0].abs().sum(axis)).flatten()
        assert felt[-1] - felt[0] + 1 == patch_px


@pytest.mark.parametrize("size", [(16, 16), (17, 23), (40, 33)])
def test_volumes_have_the_size_of_the_pair_and_are_not_negative(size):
    network = EventVolumeUNet(2, **{**SMALL, "num_encoders": 3, "norm": "instance"})
    volumes = network(torch.rand(2, 2, *size))
    assert volumes.shape == (2, 2, *size) and volumes.min() >= 0


def test_relu_revives_what_should_grow_and_is_relu_otherwise():
    values = torch.tensor([-2.0, -2.0, 0.0, 0.0, 3.0, 3.0], requires_grad=True)
    output = RevivableReLU.apply(values)
    assert torch.equal(output, torch.relu(values))
    output.backward(torch.tensor([-1.0, 1.0, -0.5, 0.5, -4.0, 4.0]))
    assert values.grad is not None and values.grad.tolist() == [-1, 0, -0.5, 0, -4, 4]


def test_a_dead_network_comes_back_to_life():
    """From a bias far below 0 plain ReLU never returns; the absolute difference alone brings this one back."""
    bias, target = torch.tensor([-1.0], requires_grad=True), torch.tensor([0.5])
    for _ in range(40):
        (gradient,) = torch.autograd.grad(losses.reconstruction_loss(RevivableReLU.apply(bias), target), bias)
        bias = (bias - 0.05 * gradient).detach().requires_grad_()
    assert bias.item() == pytest.approx(0.5, abs=0.06)


def slow_statistics_error(generated, real):
    errors = []
    for statistic in (lambda value: float(value), lambda value: float(value > 0)):
        difference = total = 0.0
        for row, top, left, channel in np.ndindex(len(real), 8, 8, 3):
            values = []
            for frames in (generated, real):
                block = frames[row, 8 * top : 8 * top + 8, 8 * left : 8 * left + 8, channel].ravel()
                values.append(sum(statistic(value) for value in block) / len(block) if len(block) else 0.0)
            difference += abs(values[0] - values[1])
            total += values[1]
        errors.append(difference / total)
    return sum(errors) / 2


@pytest.mark.parametrize("size", [(16, 24), (19, 9), (5, 3)])
def test_local_statistics_error_is_what_a_slow_loop_says(size):
    random = np.random.default_rng(2)
    real, generated = (random.integers(0, 256, (2, 2, *size, 3)) * (random.random((2, 2, *size, 3)) < 0.2)).astype(
        np.uint8
    )
    assert local_statistics_error(generated, real) == pytest.approx(slow_statistics_error(generated, real), rel=1e-12)


def test_local_statistics_error_at_known_points():
    random = np.random.default_rng(3)
    real = np.zeros((2, 32, 32, 3), np.uint8)
    real[:, 3:20, 4:29] = random.integers(0, 2, (2, 17, 25, 1)) * 100
    none = np.zeros_like(real)
    assert local_statistics_error(real, real) == 0
    assert local_statistics_error(none, real) == 1
    assert local_statistics_error(none, none) == 0 and local_statistics_error(real, none) == math.inf
    # Half the brightness everywhere: rates are half, active pixels the same.
    assert local_statistics_error(real // 2, real) == pytest.approx(0.25)
    # Where in its block an event lies is chance; in which block it lies is not.
    within, elsewhere = real.copy(), np.roll(real[:, ::-1], 16, axis=2)
    within[:, :8, :8] = real[:, :8, :8][:, ::-1, ::-1]
    assert local_statistics_error(within, real) == 0 and local_statistics_error(elsewhere, real) > 0.3


def test_value_of_one_event():
    frames = np.zeros((4, 6, 6, 3), np.uint8)
    for row, value in enumerate((51, 85, 102)):
        frames[row, row, 1:4] = value
        frames[row, row, 4] = 255
    assert one_event_value(frames) == 85 / 255  # the image without events does not count


def test_stochastic_rounding_keeps_the_mean_rate():
    one_event, value = 0.4, 0.1
    volumes = np.full((1, 1, 200, 200), value, np.float32)
    options = SamplingOptions(rounding="stochastic")
    frames = volumes_to_frames(volumes, "grey", one_event, options, [5])
    assert set(np.unique(frames)) == {0, 102}
    # 40,000 pixels that fire with probability 1/4: four standard deviations are 0.0087.
    assert (frames[..., 0] > 0).mean() == pytest.approx(value / one_event, abs=0.0087)
    bright = np.full((1, 1, 4, 4), 0.7, np.float32)
    assert (volumes_to_frames(bright, "grey", one_event, options, [5]) == round(0.7 * 255)).all()


def test_rounding_rules():
    values = np.array([0.0, 0.19, 0.21, 0.5, 1.0, 7.0], np.float32)
    volumes = np.stack([values, values[::-1]]).reshape(1, 2, 1, 6)
    kept = volumes_to_frames(volumes, "red_blue", 0.4, SamplingOptions(), [0])
    assert kept[0, 0, :, 0].tolist() == [0, 0, 54, 128, 255, 255] and not kept[..., 1].any()
    assert kept[0, 0, :, 2].tolist() == [255, 255, 128, 54, 0, 0]
    published = volumes_to_frames(volumes[:, :1], "grey", 0.4, SamplingOptions(rounding="none"), [0])
    assert published[0, 0, :, 1].tolist() == [0, 48, 54, 128, 255, 255]
    assert np.array_equal(published[..., 0], published[..., 2])


def test_change_of_appearance_is_gain_times_intensity_to_the_gamma():
    intensity = np.array([0.0, 0.25, 0.5, 1.0])
    pairs = torch.from_numpy(2 * intensity - 1).view(1, 2, 2, 1)
    changed = change_appearance(pairs, torch.tensor(1.2), torch.tensor(0.8))
    expected = np.minimum(1.2 * intensity**0.8, 1)
    assert ((changed.numpy().ravel() + 1) / 2).tolist() == pytest.approx(expected.tolist(), abs=1e-7)
    assert torch.equal(change_appearance(pairs, torch.ones(1), torch.ones(1)), pairs)
