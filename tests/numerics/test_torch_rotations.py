"""Rotations in torch against mpmath, scipy and finite differences, where formulas break: at 0, at pi, past a turn."""

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ctlev_core.body import rotations as numpy_rotations
from ctlev_core.body import torch_rotations as rotations

PI = np.pi
SMALL = [0.0, 1e-160, 1e-12, 1e-8, 1e-4, 1e-2, 0.1, 0.4999, 0.5001, 1.0]
NEAR_PI = [PI - 10.0**-k for k in range(1, 9)] + [PI]
LARGE = [2 * PI - 1e-6, 2 * PI, 7.0, 3 * PI, 50.0]
AXES = np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1], [0.6, 0, -0.8], [-0.48, 0.64, 0.6], [2 / 3, -1 / 3, 2 / 3]])
unit_axes = st.tuples(*[st.floats(-1, 1) for _ in range(3)]).filter(lambda v: np.linalg.norm(v) > 0.1)
angles = st.one_of(st.floats(0, PI), st.sampled_from([*SMALL, *NEAR_PI]))


def vectors_at(angle):
    return torch.from_numpy(angle * AXES)


def exact_matrix(vector):
    """Rodrigues' formula in 60 digits, of the vector as the doubles it is made of."""
    with mpmath.workdps(60):
        x, y, z = (mpmath.mpf(float(part)) for part in vector)
        angle = mpmath.sqrt(x * x + y * y + z * z)
        cross = mpmath.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        if angle == 0:
            return np.eye(3)
        exact = mpmath.eye(3) + mpmath.sin(angle) / angle * cross + (1 - mpmath.cos(angle)) / angle**2 * cross * cross
        return np.array(exact.tolist(), dtype=np.float64)


@pytest.mark.parametrize("angle", [*SMALL, *NEAR_PI, *LARGE])
def test_exponential_against_sixty_digits(angle):
    vectors = vectors_at(angle)
    expected = np.stack([exact_matrix(vector) for vector in vectors])
    # The angle is rounded to half a unit in its last place before the sine is taken.
    np.testing.assert_allclose(rotations.matrix_from_axis_angle(vectors), expected, rtol=0, atol=4e-16 * (1 + angle))
    single = vectors.float()
    expected = np.stack([exact_matrix(vector) for vector in single])
    np.testing.assert_allclose(rotations.matrix_from_axis_angle(single), expected, rtol=0, atol=2e-7 * (1 + angle))


@pytest.mark.parametrize("angle", [*SMALL, *NEAR_PI])
def test_logarithm_returns_the_vector(angle):
    vectors = vectors_at(angle)
    matrices = np.stack([exact_matrix(vector) for vector in vectors])
    logarithm = rotations.axis_angle_from_matrix(torch.from_numpy(matrices)).numpy()
    # At pi exactly, and where rounding puts the matrix there, either sign of the axis is right.
    sign = np.sign(np.sum(logarithm * vectors.numpy(), axis=1, keepdims=True)) if angle >= PI - 1e-15 else 1.0
    np.testing.assert_allclose(sign * logarithm, vectors, rtol=1e-12, atol=2e-15)
    assert np.linalg.norm(logarithm, axis=1).max() <= PI + 1e-15


@pytest.mark.parametrize("angle", [1e-6, 0.1, 3.0, *NEAR_PI[:5]])
def test_logarithm_of_float32_matrices_is_right_near_pi(angle):
    """A matrix rounded to float32 tells the rotation to 1e-7; acos of its trace is 0.05 rad off at pi - 1e-3."""
    matrices = torch.from_numpy(np.stack([exact_matrix(vector) for vector in angle * AXES])).float()
    logarithm = rotations.axis_angle_from_matrix(matrices).double().numpy()
    between = Rotation.from_rotvec(logarithm).inv() * Rotation.from_rotvec(angle * AXES)
    assert between.magnitude().max() < 4e-7
    if angle < PI - 1e-6:  # nearer, rounding may put the matrix on the other side, with the opposite axis
        assert np.linalg.norm(logarithm - angle * AXES, axis=1).max() < 1e-6


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.3, 0.5, 1.0, 3.0, PI - 1e-3, PI, 2 * PI, 10.0])
def test_gradient_of_the_exponential(angle):
    # Finite differences of float64 with steps of 1e-6 are good to 1e-9; 1e-7 leaves room for curvature.
    torch.autograd.gradcheck(
        rotations.matrix_from_axis_angle, vectors_at(angle).requires_grad_(), eps=1e-6, atol=1e-7, rtol=1e-6
    )


def test_gradients_of_the_exponential_at_zero_are_the_generators():
    vector = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    jacobian = torch.autograd.functional.jacobian(rotations.matrix_from_axis_angle, vector)
    generators = np.zeros((3, 3, 3))
    generators[2, 1, 0] = generators[0, 2, 1] = generators[1, 0, 2] = 1
    generators -= generators.transpose(1, 0, 2)
    np.testing.assert_array_equal(jacobian, generators)
    assert torch.autograd.gradgradcheck(rotations.matrix_from_axis_angle, vector, eps=1e-4, atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.1, 0.24, 0.26, 1.0, 3.0, PI - 1e-3])
def test_gradient_of_the_logarithm(angle):
    """Along the rotations: what is no rotation has no logarithm to compare with."""
    matrices = rotations.matrix_from_axis_angle(vectors_at(angle))

    def logarithm_after(step):
        return rotations.axis_angle_from_matrix(matrices @ rotations.matrix_from_axis_angle(step))

    still = torch.zeros(len(AXES), 3, dtype=torch.float64, requires_grad=True)
    torch.autograd.gradcheck(logarithm_after, still, eps=1e-6, atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-4, 1.0, PI - 1e-1, PI - 1e-3, PI - 1e-6, PI - 1e-8])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_logarithm_of_the_exponential_has_the_identity_as_its_gradient(angle, dtype):
    def there_and_back(vector):
        return rotations.axis_angle_from_matrix(rotations.matrix_from_axis_angle(vector))

    if dtype == torch.float32 and angle > PI - 1e-5:
        angle = PI - 1e-5  # nearer, a float32 vector may round to the other side, where the logarithm jumps
    for vector in vectors_at(angle).to(dtype):
        jacobian = torch.autograd.functional.jacobian(there_and_back, vector)
        # Products of a few numbers of size 1 to 4, each rounded.
        np.testing.assert_allclose(jacobian, np.eye(3), atol=3e-6 if dtype == torch.float32 else 1e-14)


def test_gradients_at_pi_are_finite():
    matrices = torch.from_numpy(np.stack([2 * np.outer(axis, axis) - np.eye(3) for axis in AXES])).requires_grad_()
    logarithm = rotations.axis_angle_from_matrix(matrices)
    np.testing.assert_allclose(torch.linalg.vector_norm(logarithm, dim=1).detach(), PI, atol=1e-15)
    (gradient,) = torch.autograd.grad(logarithm.sum(), matrices)
    assert torch.isfinite(gradient).all() and gradient.abs().max() < 10


def test_quaternions_agree_with_scipy():
    matrices = Rotation.from_rotvec(2 * np.random.default_rng(0).normal(size=(200, 3))).as_matrix()
    expected = Rotation.from_matrix(matrices).as_quat(canonical=True)
    np.testing.assert_allclose(rotations.quaternion_from_matrix(torch.from_numpy(matrices)), expected, atol=1e-15)


@settings(deadline=None, max_examples=150)
@given(unit_axes, angles)
def test_round_trips(axis, angle):
    vector = torch.tensor(angle * np.array(axis) / np.linalg.norm(axis), dtype=torch.float64)
    matrix = rotations.matrix_from_axis_angle(vector)
    again = rotations.matrix_from_axis_angle(rotations.axis_angle_from_matrix(matrix))
    np.testing.assert_allclose(again, matrix, atol=3e-15)
    np.testing.assert_allclose(matrix, numpy_rotations.matrix_from_axis_angle(vector.numpy()), atol=3e-15)
    six = rotations.rotation_6d_from_matrix(matrix)
    np.testing.assert_array_equal(six, np.concatenate([matrix[:, 0], matrix[:, 1]]))
    np.testing.assert_allclose(rotations.matrix_from_rotation_6d(six), matrix, atol=2e-15)


@settings(deadline=None, max_examples=150)
@given(st.lists(st.floats(-1e30, 1e30), min_size=6, max_size=6))
def test_any_six_numbers_are_a_rotation(numbers):
    matrix = rotations.matrix_from_rotation_6d(torch.tensor(numbers, dtype=torch.float64))
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(torch.linalg.det(matrix), 1.0, atol=1e-14)


def test_6d_agrees_with_numpy_and_has_gradients():
    six = torch.from_numpy(np.random.default_rng(0).normal(size=(5, 6))).requires_grad_()
    expected = numpy_rotations.matrix_from_rotation_6d(six.detach().numpy())
    np.testing.assert_allclose(rotations.matrix_from_rotation_6d(six).detach(), expected, atol=1e-15)
    torch.autograd.gradcheck(rotations.matrix_from_rotation_6d, six)


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ([0, 0, 0, 0, 1, 0], np.eye(3)),
        ([1, 0, 0, 0, 0, 0], np.eye(3)),
        ([1, 0, 0, -5, 0, 0], np.eye(3)),
        ([0, 0, 0, 0, 0, 0], np.eye(3)),
        ([np.nan, 0, 0, 0, 2, 0], np.eye(3)),
        ([0, 3, 0, 0, 1, 1e-8], np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])),
    ],
)
def test_degenerate_6d_has_the_documented_rotation_and_finite_gradients(numbers, expected):
    six = torch.tensor(numbers, dtype=torch.float64, requires_grad=True)
    matrix = rotations.matrix_from_rotation_6d(six)
    np.testing.assert_allclose(matrix.detach(), expected, atol=1e-15)
    (gradient,) = torch.autograd.grad((matrix * torch.arange(9.0).view(3, 3)).sum(), six)
    assert torch.isfinite(gradient).all()


def test_nearly_parallel_6d_in_float32_is_orthogonal_all_the_same():
    six = torch.tensor([1.0, 2.0, 3.0, 1.0, 2.0, 3.0 + 3e-5])
    matrix = rotations.matrix_from_rotation_6d(six)
    # Two roundings of float32.
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=3e-7)


def test_slerp_agrees_with_numpy_and_has_gradients():
    rng = np.random.default_rng(1)
    start, end = (numpy_rotations.matrix_from_axis_angle(rng.normal(size=(4, 3))) for _ in range(2))
    fraction = np.array([0.0, 0.3, 0.7, 1.0])
    got = rotations.slerp(torch.from_numpy(start), torch.from_numpy(end), torch.from_numpy(fraction))
    np.testing.assert_allclose(got, numpy_rotations.slerp(start, end, fraction), atol=3e-15)
    same = torch.from_numpy(start).requires_grad_()
    middle = rotations.slerp(same, same, 0.5)
    np.testing.assert_allclose(middle.detach(), start, atol=1e-15)
    (gradient,) = torch.autograd.grad(middle.sum(), same)
    assert torch.isfinite(gradient).all()


def test_empty_batches_and_wrong_shapes():
    assert rotations.matrix_from_axis_angle(torch.zeros(0, 24, 3)).shape == (0, 24, 3, 3)
    assert rotations.axis_angle_from_matrix(torch.zeros(0, 3, 3)).shape == (0, 3)
    assert rotations.matrix_from_rotation_6d(torch.zeros(0, 6)).shape == (0, 3, 3)
    with pytest.raises(ValueError, match=r"axis_angle must end in the shape \(3,\), got \(2, 4\)"):
        rotations.matrix_from_axis_angle(torch.zeros(2, 4))
    with pytest.raises(ValueError, match="matrix must be floating point"):
        rotations.axis_angle_from_matrix(torch.zeros(3, 3, dtype=torch.int64))
