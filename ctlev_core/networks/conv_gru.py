"""A gated recurrent unit of feature maps, whose products with matrices are convolutions.

Source: Ballas et al., Delving Deeper into Convolutional Networks for Learning Video Representations, ICLR 2016,
eqs. 6-9 (GRU-RCN), of the gated recurrent unit of Cho et al., EMNLP 2014. The biases are ours.
"""

from __future__ import annotations

import torch
from torch import nn


class ConvGRU(nn.Module):
    """States of feature maps [N, C, H, W], as wide as these, over the frames of sequences; each begins with zero.

    The untrained unit's state stays zero: the convolutions of the new state are zero at first, and only they. Added to
    the features, it leaves a network as it is without, and training goes on from there.

    Args:
        channels: C.
        kernel_size: of all convolutions, px, odd; beyond the edge is zero.
    """

    def __init__(self, channels: int, kernel_size: int = 3) -> None:
        super().__init__()
        self.channels = channels
        padding = kernel_size // 2
        self.of_features = nn.Conv2d(channels, 3 * channels, kernel_size, padding=padding)
        self.gates_of_state = nn.Conv2d(channels, 2 * channels, kernel_size, padding=padding, bias=False)
        self.new_of_state = nn.Conv2d(channels, channels, kernel_size, padding=padding, bias=False)
        with torch.no_grad():
            self.of_features.weight[2 * channels :] = 0
            self.of_features.bias.zero_()  # pyright: ignore[reportOptionalMemberAccess]
            self.new_of_state.weight.zero_()

    def forward(self, features: torch.Tensor, firsts: torch.Tensor, lengths: torch.Tensor) -> torch.Tensor:
        """The states [S, C, H, W] at the end of S sequences; those that begin with the same frame are run as one.

        Args:
            features: [N, C, H, W] of frames.
            firsts: [S] int64, on the CPU: the first frame of each sequence, which the others follow in `features`.
            lengths: [S] int64, on the CPU: frames of each, at least 1.
        """
        begins, run = firsts.unique(return_inverse=True)
        longest = torch.zeros_like(begins).scatter_reduce(0, run, lengths, "amax")
        # The longest first: those that go on are then the first so many.
        order = longest.argsort(descending=True, stable=True)
        begins, longest, run = begins[order], longest[order], order.argsort()[run]
        of_features = self.of_features(features)
        state = torch.zeros_like(features[: len(begins)])
        states, ends = [], []
        for moment in range(int(longest[0])):
            going_on = int((longest > moment).sum())
            state = self._step(of_features[begins[:going_on] + moment], state[:going_on])
            ending = (lengths == moment + 1).nonzero()[:, 0]
            states.append(state[run[ending]])
            ends.append(ending)
        return torch.cat(states)[torch.cat(ends).argsort()]

    def _step(self, of_features: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """The next state, from the convolved features [S, 3C, H, W] of a frame and the state before it."""
        of_gates, of_new = of_features.split([2 * self.channels, self.channels], dim=1)
        update, reset = (of_gates + self.gates_of_state(state)).sigmoid().chunk(2, dim=1)
        new = (of_new + self.new_of_state(reset * state)).tanh()
        return state + update * (new - state)
