"""Muon against the singular value decomposition, and its Adam against torch's."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.diffusion.training.loop import Trainer
from ctlev_core.diffusion.training.muon import COEFFICIENTS, ITERATIONS, MATRIX_RATE, Muon, is_matrix, orthogonalised
from ctlev_core.diffusion.training.options import TrainingOptions

BETAS = (0.9, 0.999)


def random_tensor(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@settings(max_examples=20, deadline=None)
@given(st.sampled_from([(16, 16), (16, 40), (48, 20), (64, 576)]), st.integers(0, 1000), st.floats(1e-4, 1e4))
def test_orthogonalised_keeps_singular_vectors_and_levels_singular_values(shape, seed, scale):
    matrix = scale * random_tensor(*shape, seed=seed)
    left, values, right = torch.linalg.svd(matrix.double(), full_matrices=False)
    rotated = (left.T @ orthogonalised(matrix[None])[0].double() @ right.T).numpy()
    heard = (values > 0.03 * values[0]).numpy()
    # The published range is 0.7 .. 1.2; bfloat16 adds some hundredths, on and off the diagonal.
    assert (np.diag(rotated)[heard] > 0.6).all() and (np.diag(rotated) < 1.3).all()
    assert np.abs(rotated - np.diag(np.diag(rotated))).max() < 0.15


@pytest.mark.parametrize("shape", [(64, 576), (96, 96), (768, 96)])
def test_bfloat16_is_near_to_the_same_iterations_in_float64(shape):
    """Matrices with singular values over four orders of magnitude; the error is a share of the largest value."""
    matrix = random_tensor(*shape) * torch.logspace(0, -4, shape[1])
    x = matrix.double() / matrix.double().norm()
    a, b, c = COEFFICIENTS
    for _ in range(ITERATIONS):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    assert (orthogonalised(matrix[None])[0] - x).abs().max() < 0.04 * x.abs().max()


def test_matrices_made_orthogonal_together_are_what_they_are_alone():
    matrices = random_tensor(5, 16, 40)
    alone = [orthogonalised(matrix[None])[0] for matrix in matrices]
    assert torch.equal(orthogonalised(matrices), torch.stack(alone))


def test_vectors_and_thin_weights_are_stepped_as_by_adamw():
    ours, theirs = ([torch.nn.Parameter(random_tensor(*shape)) for shape in ((32,), (4, 64))] for _ in range(2))
    muon = Muon(ours, lr=1e-2, betas=BETAS, weight_decay=0.1)
    adamw = torch.optim.AdamW(theirs, lr=1e-2, betas=BETAS, weight_decay=0.1)
    for number in range(5):
        for parameters in (ours, theirs):
            for parameter in parameters:
                parameter.grad = random_tensor(*parameter.shape, seed=number)
        muon.step()
        adamw.step()
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other)  # float32 rounding


def test_a_kernel_is_stepped_as_one_matrix_of_its_outputs():
    kernel = torch.nn.Parameter(torch.zeros(16, 8, 3, 3))
    assert is_matrix(kernel) and not is_matrix(torch.zeros(8, 64)) and not is_matrix(torch.zeros(64))
    kernel.grad = random_tensor(16, 8, 3, 3)
    Muon([kernel], lr=1e-3, betas=BETAS, weight_decay=0.0).step()
    # All 16 singular values of the first step are about 1, so its norm is about 4.
    assert float(kernel.detach().norm()) / (MATRIX_RATE * 1e-3) == pytest.approx(4.0, rel=0.2)


def test_a_restored_optimiser_goes_on_as_if_it_had_not_stopped(tmp_path):
    def trainer():
        return Trainer([torch.nn.Parameter(random_tensor(16, 16)), torch.nn.Parameter(random_tensor(3))],
            TrainingOptions(num_steps=4), "run", "muon")  # fmt: skip

    def train(one, steps):
        for _ in range(steps):
            for parameter in one.parameters:
                parameter.grad = random_tensor(*parameter.shape, seed=one.step)
            one.update(0.0)
            one.step += 1

    whole, first, second = trainer(), trainer(), trainer()
    train(whole, 4)
    train(first, 2)
    first.save(tmp_path / "state.pt")
    second.restore(tmp_path / "state.pt")
    train(second, 2)
    assert all(torch.equal(one, other) for one, other in zip(whole.parameters, second.parameters, strict=True))


def test_closures_are_refused():
    with pytest.raises(ValueError, match="no closure"):
        Muon([torch.nn.Parameter(torch.zeros(3))], lr=1.0, betas=BETAS, weight_decay=0.0).step(lambda: 0.0)
