"""Means over the cells of a grid, on a CPU and on a simulated GPU."""

import pytest
import torch
from simulated_gpu import simulated_gpu

from ctlev_core.networks.grid_pool import GridPool


def pooled(maps, grid, device):
    maps = maps.to(device).requires_grad_()
    means = GridPool(grid)(maps)
    (gradient,) = torch.autograd.grad((means**2).sum(), maps)
    return means.detach().cpu(), gradient.cpu()


@pytest.mark.parametrize("grid", [1, 2, 4, (2, 1), 3])
def test_a_gpu_gives_the_means_of_a_cpu(grid):
    maps = torch.randn(3, 5, 8, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    means, gradient = pooled(maps, grid, "cpu")
    assert torch.equal(means, torch.nn.AdaptiveAvgPool2d(grid)(maps))
    with simulated_gpu():
        there, gradient_there = pooled(maps, grid, "cuda")
    torch.testing.assert_close(there, means, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(gradient_there, gradient, rtol=1e-14, atol=1e-14)


def test_a_gpu_pools_cells_of_one_size_without_the_operation_that_has_no_fixed_order(monkeypatch):
    def refuse(*_):
        raise AssertionError("adaptive")

    monkeypatch.setattr(torch.nn.AdaptiveAvgPool2d, "forward", refuse)
    with simulated_gpu():
        GridPool(2)(torch.zeros(1, 1, 8, 4, device="cuda"))
        for unequal in (3, (2, None)):
            with pytest.raises(AssertionError, match="adaptive"):
                GridPool(unequal)(torch.zeros(1, 1, 8, 4, device="cuda"))
