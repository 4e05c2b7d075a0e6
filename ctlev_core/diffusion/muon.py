"""Muon: steps of momentum with every weight matrix replaced by a nearly orthogonal one, and Adam for all other weights.

A kernel [out, in, h, w] counts as a matrix [out, in * h * w]. All directions of a weight then learn equally fast,
however seldom the pictures ask for them. In equal time on one core the small prior got further with it than with AdamW
(`flows/presets/pretraining/small_prior.yaml`), although a step costs as much as the gradients of eight images.

Source: K. Jordan et al., "Muon: an optimizer for hidden layers in neural networks", 2024: the update, the coefficients,
Nesterov momentum of 0.95. First and last layers are treated like all others here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

COEFFICIENTS = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5
MOMENTUM = 0.95
MATRIX_RATE = 20.0
"""Learning rate of matrices over that of the other weights."""
MIN_SIDE = 16
"""Weights with fewer rows or columns go to Adam, as vectors do."""
EPSILON = 1e-8


def is_matrix(parameter: Tensor) -> bool:
    """Is this a weight that Muon steps, not Adam?"""
    return parameter.ndim >= 2 and min(parameter.shape[0], parameter[0].numel()) >= MIN_SIDE


def orthogonalised(matrix: Tensor) -> Tensor:
    """Roughly U V^T of the singular value decomposition U S V^T: singular values between 0.7 and 1.2 instead of S.

    Args:
        matrix: [M, N]; its scale is of no account.
    Returns:
        [M, N]; Newton-Schulz iterations in bfloat16. Directions with less than a thousandth of the norm stay smaller.
    """
    a, b, c = COEFFICIENTS
    tall = matrix.shape[0] > matrix.shape[1]
    x = (matrix.T if tall else matrix).bfloat16()
    x = x / (x.norm() + 1e-7)
    for _ in range(ITERATIONS):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    return (x.T if tall else x).to(matrix.dtype)


class Muon(torch.optim.Optimizer):
    """One optimiser for all weights of a network; `lr` is that of Adam, matrices take `MATRIX_RATE` times as much."""

    def __init__(
        self, parameters: Iterable[Tensor], *, lr: float, betas: tuple[float, float], weight_decay: float
    ) -> None:
        """Prepare to step `parameters`; `betas` are Adam's, `weight_decay` is decoupled and scaled by the rate."""
        super().__init__(list(parameters), {"lr": lr, "betas": betas, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """One step on the gradients; weights without one stay as they are. `closure` is not supported."""
        if closure is not None:
            raise ValueError("Muon takes no closure: compute the gradients before the step")
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                step, rate = (self._matrix_step, MATRIX_RATE) if is_matrix(parameter) else (self._adam_step, 1.0)
                rate *= group["lr"]
                direction = step(parameter, parameter.grad, group["betas"])
                parameter.mul_(1 - rate * group["weight_decay"]).add_(direction, alpha=-rate)

    def _matrix_step(self, parameter: Tensor, gradient: Tensor, betas: tuple[float, float]) -> Tensor:
        state = self.state[parameter]
        if not state:
            state["momentum"] = torch.zeros_like(parameter)
        momentum = state["momentum"].lerp_(gradient, 1 - MOMENTUM)
        nesterov = gradient.lerp(momentum, MOMENTUM).flatten(1)
        rows, columns = nesterov.shape
        return orthogonalised(nesterov).mul_(max(1.0, rows / columns) ** 0.5).view_as(parameter)

    def _adam_step(self, parameter: Tensor, gradient: Tensor, betas: tuple[float, float]) -> Tensor:
        state = self.state[parameter]
        if not state:
            state.update(step=0, mean=torch.zeros_like(parameter), square=torch.zeros_like(parameter))
        state["step"] += 1
        mean = state["mean"].lerp_(gradient, 1 - betas[0]) / (1 - betas[0] ** state["step"])
        square = state["square"].lerp_(gradient.square(), 1 - betas[1]) / (1 - betas[1] ** state["step"])
        return mean / (square.sqrt() + EPSILON)
