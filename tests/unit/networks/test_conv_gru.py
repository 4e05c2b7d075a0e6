"""The convolutional recurrent unit against its definition, pixel by pixel."""

import numpy as np
import pytest
import torch

from ctlev_core.networks.conv_gru import ConvGRU
from ctlev_core.networks.dhp19 import DHP19Network


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def slow_convolution(kernel, image):
    """[C', H, W] of a kernel [C', C, k, k] and an image [C, H, W] with zeros around it, one pixel after another."""
    reach, (_, height, width) = kernel.shape[-1] // 2, image.shape
    found = np.zeros((len(kernel), height, width))
    for y in range(height):
        for x in range(width):
            for dy in range(-reach, reach + 1):
                for dx in range(-reach, reach + 1):
                    if 0 <= y + dy < height and 0 <= x + dx < width:
                        found[:, y, x] += kernel[:, :, dy + reach, dx + reach] @ image[:, y + dy, x + dx]
    return found


def slow_states(unit, frames):
    """States of one sequence from zero: eqs. 6-9 of Ballas et al., with W and U of each gate by themselves."""
    weights = {name: value.detach().numpy() for name, value in unit.state_dict().items()}
    w_z, w_r, w = np.split(weights["of_features.weight"], 3)
    b_z, b_r, b = (part[:, None, None] for part in np.split(weights["of_features.bias"], 3))
    u_z, u_r = np.split(weights["gates_of_state.weight"], 2)
    u = weights["new_of_state.weight"]
    state, states = np.zeros(frames.shape[1:]), []
    for frame in frames:
        z = sigmoid(slow_convolution(w_z, frame) + slow_convolution(u_z, state) + b_z)
        r = sigmoid(slow_convolution(w_r, frame) + slow_convolution(u_r, state) + b_r)
        new = np.tanh(slow_convolution(w, frame) + slow_convolution(u, r * state) + b)
        state = (1 - z) * state + z * new
        states.append(state)
    return states


def random_unit(channels, kernel_size):
    torch.manual_seed(0)
    unit = ConvGRU(channels, kernel_size).double()
    for parameter in unit.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    return unit


@pytest.mark.parametrize("kernel_size", [1, 3, 5])
@pytest.mark.parametrize(
    ("firsts", "lengths"),
    [
        ([0], [1]),
        ([0, 4, 5], [4, 1, 3]),  # one after another
        ([5, 4, 0], [3, 1, 4]),
        ([2, 2, 2], [3, 1, 3]),  # parts of one
        ([0, 1, 2, 3, 0], [4, 4, 4, 4, 1]),  # overlapping, as those of consecutive rows
    ],
)
def test_states_are_the_definition(kernel_size, firsts, lengths):
    unit = random_unit(2, kernel_size)
    frames = torch.randn(8, 2, 5, 4, dtype=torch.float64)
    found = unit(frames, torch.tensor(firsts), torch.tensor(lengths)).detach().numpy()
    for state, first, length in zip(found, firsts, lengths, strict=True):
        expected = slow_states(unit, frames[first : first + length].numpy())[-1]
        np.testing.assert_allclose(state, expected, rtol=0, atol=1e-13)


def test_gradients_reach_every_weight_and_frame_of_the_past():
    unit = random_unit(2, 3)
    frames = torch.randn(4, 2, 3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: unit(x, torch.tensor([0, 1]), torch.tensor([3, 2])), (frames,))
    unit(frames, torch.tensor([0]), torch.tensor([3])).sum().backward()
    assert frames.grad is not None
    assert (frames.grad[:3].abs().amax(dim=(1, 2, 3)) > 0).all() and (frames.grad[3] == 0).all()
    assert all(parameter.grad is not None and parameter.grad.abs().max() > 0 for parameter in unit.parameters())


def test_untrained_it_changes_nothing_but_can_be_learnt():
    """The network with the unit begins as the one without, of the same seed."""
    networks = []
    for recurrent in (False, True):
        torch.manual_seed(3)
        networks.append(DHP19Network(4, 0.25, batch_norm=True, output_stride=2, recurrent=recurrent))
    alone, recurrent = networks
    images = torch.rand(5, 1, 14, 18)
    heatmaps = recurrent(images, torch.tensor([0, 1, 2, 0, 1]))
    assert torch.equal(heatmaps, alone(images)) and heatmaps.shape == (5, 4, 7, 9)
    heatmaps.square().sum().backward()
    unit = recurrent.recurrent
    assert unit is not None and unit.of_features.weight.grad is not None
    channels = unit.channels
    assert unit.of_features.weight.grad[2 * channels :].abs().max() > 0
    assert sum(value.numel() for value in unit.parameters()) == (3 + 2 + 1) * 9 * channels**2 + 3 * channels


def test_without_the_unit_weights_have_the_names_they_had():
    assert all(name.startswith("layers.") for name in DHP19Network().state_dict())
    assert sum(value.numel() for value in DHP19Network().parameters()) == 218_592
