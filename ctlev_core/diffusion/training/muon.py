"""Muon: steps of momentum with every weight matrix replaced by a nearly orthogonal one, and Adam for all other weights.

A kernel [out, in, h, w] counts as a matrix [out, in * h * w]. All directions of a weight then learn equally fast,
however seldom the pictures ask for them. In equal time on one core the small base model got further with it than with
AdamW (`flows/presets/pretraining/small.yaml`), although a step costs as much as the gradients of seven images.

Source: K. Jordan et al., "Muon: an optimizer for hidden layers in neural networks", 2024: the update, the coefficients,
Nesterov momentum of 0.95. First and last layers are treated like all others here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from ctlev_core.cpu_precision import computed_in

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


def orthogonalised(matrices: Tensor) -> Tensor:
    """Roughly U V^T of the singular value decompositions U S V^T: singular values between 0.7 and 1.2 instead of S.

    Args:
        matrices: [B, M, N]; their scales are of no account.
    Returns:
        [B, M, N]; by Newton-Schulz iterations in bfloat16, or `computed_in`. Directions below a thousandth of the norm
        stay smaller.
    """
    a, b, c = COEFFICIENTS
    tall = matrices.shape[1] > matrices.shape[2]
    # Sums within a product are in float32: fused, a step's additions cost nothing and are rounded once.
    dtype = getattr(torch, computed_in("bfloat16", matrices.device.type))
    x = (matrices.mT if tall else matrices).to(dtype).contiguous()
    x = x / (torch.stack([matrix.norm() for matrix in x])[:, None, None] + 1e-7)
    for _ in range(ITERATIONS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return (x.mT if tall else x).to(matrices.dtype)


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
            alike: dict[tuple[int, ...], list[tuple[Tensor, Tensor]]] = {}
            for parameter in group["params"]:
                gradient = parameter.grad
                if gradient is None:
                    continue
                if is_matrix(parameter):
                    alike.setdefault(tuple(gradient.flatten(1).shape), []).append((parameter, gradient))
                else:
                    _move(group, parameter, self._adam_direction(parameter, gradient, group["betas"]), 1.0)
            for matrices in alike.values():
                directions = self._matrix_directions(matrices)
                for (parameter, _), direction in zip(matrices, directions, strict=True):
                    _move(group, parameter, direction.view_as(parameter), MATRIX_RATE)

    def _matrix_directions(self, matrices: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
        """[B, M, N] of B weights of one shape with their gradients; together, since many small products are slow."""
        nesterov = []
        for parameter, gradient in matrices:
            state = self.state[parameter]
            if not state:
                state["momentum"] = torch.zeros_like(parameter)
            momentum = state["momentum"].lerp_(gradient, 1 - MOMENTUM)
            nesterov.append(gradient.lerp(momentum, MOMENTUM).flatten(1))
        directions = orthogonalised(torch.stack(nesterov))
        rows, columns = directions.shape[1:]
        return directions.mul_(max(1.0, rows / columns) ** 0.5)

    def _adam_direction(self, parameter: Tensor, gradient: Tensor, betas: tuple[float, float]) -> Tensor:
        state = self.state[parameter]
        if not state:
            state.update(step=0, mean=torch.zeros_like(parameter), square=torch.zeros_like(parameter))
        state["step"] += 1
        mean = state["mean"].lerp_(gradient, 1 - betas[0]) / (1 - betas[0] ** state["step"])
        square = state["square"].lerp_(gradient.square(), 1 - betas[1]) / (1 - betas[1] ** state["step"])
        return mean / (square.sqrt() + EPSILON)


def _move(group: dict[str, Any], parameter: Tensor, direction: Tensor, rate: float) -> None:
    """Down the direction, and towards zero by the weight decay; `rate` is a multiple of the learning rate."""
    rate *= group["lr"]
    parameter.mul_(1 - rate * group["weight_decay"]).add_(direction, alpha=-rate)
