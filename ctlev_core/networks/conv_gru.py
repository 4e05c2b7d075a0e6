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

    def forward(self, features: torch.Tensor, lengths: torch.Tensor) -> torch.Tensor:
        """The state [M, C, H, W] at each frame.

        Args:
            features: [M, C, H, W] of S sequences, one after the other.
            lengths: [S] of the sequences, at least 1 each; on the CPU, int64.
        """
        # The longest first: those that have a frame `moment` are the first so many, and none is filled up.
        order = lengths.argsort(descending=True, stable=True)
        firsts = (lengths.cumsum(0) - lengths)[order]
        alive = [int((lengths > moment).sum()) for moment in range(int(lengths.max()))]
        of_features = self.of_features(features)
        state = torch.zeros_like(features[: len(lengths)])
        rows, states = [], []
        for moment, count in enumerate(alive):
            now = firsts[:count] + moment
            state = self._step(of_features[now.to(features.device)], state[:count])
            rows.append(now)
            states.append(state)
        return torch.cat(states)[torch.cat(rows).argsort().to(features.device)]

    def _step(self, of_features: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """The next state, from the convolved features [S, 3C, H, W] of a frame and the state before it."""
        of_gates, of_new = of_features.split([2 * self.channels, self.channels], dim=1)
        update, reset = (of_gates + self.gates_of_state(state)).sigmoid().chunk(2, dim=1)
        new = (of_new + self.new_of_state(reset * state)).tanh()
        return state + update * (new - state)
