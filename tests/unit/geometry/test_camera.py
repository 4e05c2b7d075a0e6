"""Cameras: conventions, projection matrices, triangulation, and points no camera sees."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.geometry.camera import (
    Camera,
    camera_from_intrinsics,
    from_projection_matrix,
    is_inside,
    orbit_rotation,
    project,
    triangulate,
    undistort_points,
)
from ctlev_core.geometry.lens_distortion import undistort
from data_contracts.errors import DataError

K = np.array([[400.0, 0.3, 170.0], [0.0, 410.0, 125.0], [0.0, 0.0, 1.0]])
SIZE = (346, 260)
BARREL = np.array([-0.28, 0.07, 1e-3, -2e-3, 0.01, 0.05, -0.02, 0.003])


def camera_at(centre, yaw=0.0, pitch=0.0, distortion=None):
    R = orbit_rotation(yaw, pitch)
    return Camera(K, R, -R @ np.asarray(centre, float), SIZE, distortion)


def ring(distortion=None):
    """Three cameras 4 m from the origin that look at it."""
    yaws = (0.0, 0.7, -0.9)
    return [camera_at(4 * orbit_rotation(yaw, 0.1).T @ [0, 0, -1], yaw, 0.1, distortion) for yaw in yaws]


def test_the_middle_of_the_view_is_the_principal_point():
    camera = replace(camera_at([0, 1.2, 5]), K=np.array([[400.0, 0, 170], [0, 410, 125], [0, 0, 1]]))
    pixel = project(camera, np.array([[0, 1.2, 0], [0, 1.7, 0], [0.5, 1.2, 0]]))
    # A person who faces +z, seen from +z: up is up, and the person's left (+x) is on the right.
    np.testing.assert_allclose(pixel, [[170, 125], [170, 125 - 41], [170 + 40, 125]], atol=1e-9)


def test_orbit_yaw_walks_around_and_pitch_looks_down():
    for yaw, pitch in ((0.0, 0.0), (1.1, 0.3), (-2.5, -0.4)):
        R = orbit_rotation(yaw, pitch)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(R) == pytest.approx(1.0)
        forward = R[2]
        assert forward[1] == pytest.approx(-np.sin(pitch))
        assert R[0, 1] == pytest.approx(0.0)  # no roll


UNSEEN = [
    [0, 0, -1.0], [0, 0, 0.0], [1, 1, 0.0], [0, 0, -0.0], [np.nan, 0, 1], [0, 0, np.nan], [np.inf, 0, 1],
    [0, 0, np.inf], [0, 0, -np.inf], [1e308, 1e308, 1e-308], [1e300, 0, 1e-300],
]  # fmt: skip


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("distortion", [None, BARREL], ids=["pinhole", "distorted"])
def test_points_without_a_finite_pixel_are_nan(distortion):
    camera = Camera(K, np.eye(3), np.zeros(3), SIZE, distortion)
    pixels = project(camera, np.array(UNSEEN, float))
    assert np.isnan(pixels).all() and not is_inside(pixels, SIZE).any()


@settings(deadline=None, max_examples=150)
@given(st.lists(st.floats(width=64), min_size=3, max_size=3), st.booleans())
def test_projection_is_finite_or_nan_for_any_point(point, distorted):
    camera = Camera(K, orbit_rotation(0.4, 0.2), np.array([0.1, 0, 3]), SIZE, BARREL if distorted else None)
    pixel = project(camera, np.array(point))
    assert pixel.shape == (2,) and (np.isfinite(pixel).all() or np.isnan(pixel).all())
    seen = np.isfinite(pixel).all()
    if seen and distorted:
        back = undistort_points(camera, pixel)
        np.testing.assert_allclose(back, project(Camera(K, camera.R, camera.translation, SIZE), np.array(point)), 1e-6)


@settings(deadline=None, max_examples=150)
@given(st.lists(st.floats(width=64), min_size=2, max_size=2), st.booleans())
def test_undistorting_any_pixel_is_finite_or_nan(pixel, distorted):
    camera = Camera(K, np.eye(3), np.zeros(3), SIZE, BARREL if distorted else None)
    found = undistort_points(camera, np.array(pixel))
    assert np.isfinite(found).all() or np.isnan(found).all()


@pytest.mark.parametrize("pixel", [(np.inf, 1.0), (1.0, -np.inf), (-np.inf, np.inf), (np.nan, 1.0)])
@pytest.mark.parametrize("skew", [0.0, 0.5])
def test_undistorting_a_pixel_that_is_not_finite_is_nan(pixel, skew):
    skewed = K + np.array([[0, skew, 0], [0, 0, 0], [0, 0, 0]])
    for distortion in (None, BARREL):
        camera = Camera(skewed, np.eye(3), np.zeros(3), SIZE, distortion)
        assert np.isnan(undistort_points(camera, np.array(pixel))).all()
    assert np.isnan(undistort(np.array(pixel), BARREL)).all()


def test_a_lens_that_ends_shows_nothing_beyond_its_rim():
    # k1 alone: r (1 + k1 r^2) rises up to r = 1 / sqrt(-3 k1) = 1.054, whose image is at 2/3 of that.
    camera = Camera(K, np.eye(3), np.zeros(3), SIZE, np.array([-0.3, 0, 0, 0, 0, 0, 0, 0]))
    radius = 1 / np.sqrt(0.9)
    inside, outside = project(camera, np.array([[0.999 * radius, 0, 1], [1.001 * radius, 0, 1]]))
    assert np.isfinite(inside).all() and np.isnan(outside).all()
    rim = camera.K[0, 0] * 2 / 3 * radius
    found = undistort_points(camera, np.array([[170 + 0.999 * rim, 125], [170 + 1.001 * rim, 125]]))
    assert np.isfinite(found[0]).all() and np.isnan(found[1]).all()


def test_empty_inputs_keep_their_shape():
    for distortion in (None, BARREL):
        camera = Camera(K, np.eye(3), np.zeros(3), SIZE, distortion)
        assert project(camera, np.zeros((0, 13, 3))).shape == (0, 13, 2)
        assert undistort_points(camera, np.zeros((0, 2))).shape == (0, 2)
    assert triangulate(ring(), np.zeros((3, 0, 13, 2))).shape == (0, 13, 3)


def test_scaled_views_see_the_same_in_other_pixels():
    camera = ring(BARREL)[1]
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    np.testing.assert_allclose(project(camera.scaled(2), points), 2 * project(camera, points), rtol=1e-13)
    assert camera.scaled(2).image_size == (692, 520)


def test_intrinsics_name_the_camera():
    camera = camera_from_intrinsics(np.array([400, 410, 170, 125], np.float32), SIZE)
    np.testing.assert_array_equal(camera.intrinsics, [400, 410, 170, 125])
    np.testing.assert_array_equal(camera.centre, np.zeros(3))
    np.testing.assert_allclose(camera_at([1, 2, 3], 0.5).centre, [1, 2, 3])


@pytest.mark.parametrize("scale", [1.0, -3.7, 1e-9, -1e9])
def test_a_projection_matrix_of_any_scale_and_sign_gives_its_camera(scale):
    camera = ring()[2]
    matrix = scale * K @ np.column_stack([camera.R, camera.translation])
    found = from_projection_matrix(matrix, SIZE, "test")
    np.testing.assert_allclose(found.K, K, atol=1e-10)
    np.testing.assert_allclose(found.R, camera.R, atol=1e-13)
    np.testing.assert_allclose(found.translation, camera.translation, atol=1e-13)
    assert found.image_size == SIZE


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.zeros((3, 4)), "singular"),
        (np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]), "singular"),  # an affine camera
        (np.full((3, 4), np.nan), "finite"),
        (np.eye(4), r"\[3, 4\]"),
    ],
)
def test_matrices_of_no_camera_are_errors(matrix, message):
    with pytest.raises(DataError, match=rf"P1\.npy.*{message}"):
        from_projection_matrix(matrix, SIZE, "P1.npy")


@pytest.mark.parametrize(
    "wrong",
    [
        {"K": np.eye(2)}, {"K": np.full((3, 3), np.nan)}, {"R": np.zeros(3)}, {"translation": np.zeros((3, 1))},
        {"distortion": np.zeros(5)}, {"distortion": np.full(8, np.inf)},
    ],
)  # fmt: skip
def test_a_camera_of_wrong_numbers_is_refused(wrong):
    fields = {"K": K, "R": np.eye(3), "translation": np.zeros(3), "image_size": SIZE} | wrong
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Camera(**fields)


@pytest.mark.parametrize("distortion", [None, BARREL], ids=["pinhole", "distorted"])
def test_triangulation_undoes_projection(distortion):
    cameras = ring(distortion)
    points = np.random.default_rng(1).uniform(-0.8, 0.8, (5, 13, 3))
    pixels = np.stack([project(camera, points) for camera in cameras])
    # 1e-12 of undistortion and 1e-16 of double precision, at 5 m and 400 px.
    np.testing.assert_allclose(triangulate(cameras, pixels), points, atol=1e-10)


def test_cameras_that_miss_a_point_are_left_out():
    cameras, points = ring(), np.random.default_rng(2).uniform(-0.8, 0.8, (4, 3))
    pixels = np.stack([project(camera, points) for camera in cameras])
    pixels[0, 0] = np.nan
    pixels[1, 1, 0] = np.inf
    pixels[:2, 2] = np.nan
    pixels[:, 3] = np.nan
    found = triangulate(cameras, pixels)
    np.testing.assert_allclose(found[:2], points[:2], atol=1e-10)
    assert np.isnan(found[2:]).all()
    # A point does not depend on the others of its batch.
    np.testing.assert_array_equal(triangulate(cameras, pixels[:, 1:2])[0], found[1])


def test_rays_that_fix_no_point_are_nan():
    cameras = [camera_at([0, 0, 4]), camera_at([1, 0, 4])]
    parallel = np.full((2, 1, 2), [200.0, 100.0])
    assert np.isnan(triangulate(cameras, parallel)).all()
    behind = np.array([[[150.0, 125.0]], [[190.0, 125.0]]])  # to the left of the left one, right of the right one
    assert np.isnan(triangulate(cameras, behind)).all()
    same_place = [camera_at([0, 0, 4]), camera_at([0, 0, 4])]
    assert np.isnan(triangulate(same_place, parallel)).all()


def test_far_away_origins_cost_no_digits():
    offset = np.array([4e5, 0, 5e6])  # map coordinates
    cameras = [Camera(c.K, c.R, c.translation - c.R @ offset, SIZE) for c in ring()]
    points = np.random.default_rng(3).uniform(-0.8, 0.8, (6, 3))
    pixels = np.stack([project(camera, points) for camera in ring()])
    # R @ offset is rounded to 1e-9 m.
    np.testing.assert_allclose(triangulate(cameras, pixels) - offset, points, atol=1e-7)


def test_triangulation_needs_two_cameras_with_pixels():
    with pytest.raises(ValueError, match="two cameras or more"):
        triangulate(ring()[:1], np.zeros((1, 2)))
    with pytest.raises(ValueError, match="two cameras or more"):
        triangulate(ring(), np.zeros((2, 4, 2)))
