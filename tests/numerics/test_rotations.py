"""Rotations against the matrix exponential, products of elementary rotations and the quaternion formula of slerp."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from ctlev_core.body import rotations
from data_contracts.errors import DataError

directions = st.tuples(*[st.floats(-1, 1) for _ in range(3)]).filter(lambda v: np.linalg.norm(v) > 0.1)
# Angles where formulas break: zero, where the axis vanishes, and pi, where its sign does.
angles = st.one_of(st.floats(0, np.pi), st.sampled_from([0.0, 1e-12, 1e-8, 1e-4, np.pi - 1e-3, np.pi - 1e-7, np.pi]))


def cross_matrix(vector):
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


@settings(deadline=None, max_examples=150)
@given(directions, angles)
def test_exponential_and_back(direction, angle):
    vector = angle * np.array(direction) / np.linalg.norm(direction)
    matrix = rotations.matrix_from_axis_angle(vector)
    np.testing.assert_allclose(matrix, expm(cross_matrix(vector)), atol=2e-15 * 10)
    again = rotations.matrix_from_axis_angle(rotations.axis_angle_from_matrix(matrix))
    # Read from the trace, the angle near pi is known to sqrt(eps) only; from the quaternion it keeps all digits.
    np.testing.assert_allclose(again, matrix, atol=1e-14)
    assert np.linalg.norm(rotations.axis_angle_from_matrix(matrix)) <= np.pi + 1e-12


@settings(deadline=None, max_examples=60)
@given(directions, angles)
def test_quaternions_round_trip(direction, angle):
    matrix = rotations.matrix_from_axis_angle(angle * np.array(direction) / np.linalg.norm(direction))
    quaternion = rotations.quaternion_from_matrix(matrix)
    assert quaternion[3] >= 0
    np.testing.assert_allclose(np.linalg.norm(quaternion), 1.0, atol=1e-14)
    for scale in (1.0, -3.0):
        np.testing.assert_allclose(rotations.matrix_from_quaternion(scale * quaternion), matrix, atol=1e-14)


def test_euler_is_a_product_of_elementary_rotations():
    a, b, c = np.deg2rad([20.0, -50.0, 110.0])
    x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    np.testing.assert_allclose(
        rotations.matrix_from_euler("YXZ", np.array([[20.0, -50.0, 110.0]]))[0], y @ x @ z, atol=1e-15
    )


def test_slerp_against_the_quaternion_formula():
    rng = np.random.default_rng(0)
    start, end = (rotations.matrix_from_axis_angle(rng.normal(size=(20, 3))) for _ in range(2))
    q0, q1 = rotations.quaternion_from_matrix(start), rotations.quaternion_from_matrix(end)
    cosine = np.sum(q0 * q1, axis=1, keepdims=True)
    q1, angle = q1 * np.sign(cosine), np.arccos(np.abs(cosine))
    for fraction in (0.0, 0.3, 1.0):
        mixed = (np.sin((1 - fraction) * angle) * q0 + np.sin(fraction * angle) * q1) / np.sin(angle)
        expected = rotations.matrix_from_quaternion(mixed)
        np.testing.assert_allclose(rotations.slerp(start, end, fraction), expected, atol=1e-13)


def test_slerp_broadcasts_and_keeps_equal_ends():
    start = rotations.matrix_from_axis_angle(np.ones((24, 3)))
    path = rotations.slerp(start, start, np.linspace(0, 1, 5)[:, None])
    assert path.shape == (5, 24, 3, 3)
    np.testing.assert_allclose(path, np.broadcast_to(start, path.shape), atol=1e-14)


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match="axis_angle must end in the shape"):
        rotations.matrix_from_axis_angle(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="matrix must end in the shape"):
        rotations.axis_angle_from_matrix(np.zeros((3, 2)))


@settings(deadline=None, max_examples=100)
@given(directions, angles)
def test_6d_round_trips_whatever_the_lengths(direction, angle):
    matrix = rotations.matrix_from_axis_angle(angle * np.array(direction) / np.linalg.norm(direction))
    six = rotations.rotation_6d_from_matrix(matrix)
    np.testing.assert_array_equal(six, np.concatenate([matrix[:, 0], matrix[:, 1]]))
    for scaled in (six, six * np.repeat([1e-200, 1e200], 3), six + np.r_[np.zeros(3), 0.7 * six[:3]]):
        np.testing.assert_allclose(rotations.matrix_from_rotation_6d(scaled), matrix, atol=3e-15)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ([0, 0, 0, 0, 1, 0], "has a vector that is 0"),
        ([1, 0, 0, 0, 0, 0], "has a vector that is 0"),
        ([1, 2, 3, -2, -4, -6], "has parallel vectors"),
        ([1, 0, 0, 1, 1e-9, 0], "has parallel vectors"),
        ([1, 0, 0, np.inf, 0, 1], "is not finite"),
    ],
)
def test_degenerate_6d_is_named(numbers, message):
    good = [1, 0, 0, 0, 1, 0]
    with pytest.raises(DataError, match=rf"rotation_6d\[1\] {message}"):
        rotations.matrix_from_rotation_6d(np.array([good, numbers], dtype=np.float64))


def test_empty_batches():
    assert rotations.matrix_from_axis_angle(np.zeros((0, 3))).shape == (0, 3, 3)
    assert rotations.axis_angle_from_matrix(np.zeros((0, 3, 3))).shape == (0, 3)
    assert rotations.matrix_from_rotation_6d(np.zeros((0, 6))).shape == (0, 3, 3)


def test_numbers_that_are_not_finite_are_named():
    vectors = np.zeros((3, 24, 3))
    vectors[1, 7, 2] = np.nan
    with pytest.raises(DataError, match=r"axis_angle\[1, 7\] is not finite: \[0.0, 0.0, nan\]"):
        rotations.matrix_from_axis_angle(vectors)
    with pytest.raises(DataError, match="matrix is not finite"):
        rotations.axis_angle_from_matrix(np.full((3, 3), np.inf))
