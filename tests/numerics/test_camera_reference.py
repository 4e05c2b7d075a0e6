"""Cameras against OpenCV, SciPy, and DHP19's own calibration."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial import KDTree

from ctlev_core.dataset_files.dhp19_files import CHANNEL_OF_CAMERA, camera_of
from ctlev_core.geometry.camera import Camera, orbit_rotation, project, triangulate, undistort_points
from ctlev_core.geometry.lens_distortion import distort, largest_radius

CALIBRATION = Path(__file__).resolve().parents[2].parent / "shared" / "real" / "dhp19_calib"
K = np.array([[335.86, 0.0, 128.2], [0.0, 330.0, 120.0], [0.0, 0.0, 1.0]])
SIZE = (256, 256)
LENSES = {
    "barrel": [-0.35, 0.12, 0, 0, -0.02, 0, 0, 0],
    "pincushion": [0.25, 0.1, 0, 0, 0, 0, 0, 0],
    "tangential": [-0.1, 0.02, 8e-3, -6e-3, 0, 0, 0, 0],
    "rational": [0.4, 0.11, 1e-3, -2e-3, 0.01, 0.75, 0.2, 0.03],
}


@pytest.fixture(params=LENSES)
def lens(request):
    return np.array(LENSES[request.param])


def points_in_view(count=500):
    """Up to 40 degrees from the axis, where all of these lenses are one-to-one."""
    random = np.random.default_rng(0)
    depth = random.uniform(0.5, 20, count)
    angle, radius = random.uniform(0, 2 * np.pi, count), 0.84 * np.sqrt(random.random(count))
    return np.stack([radius * np.cos(angle) * depth, radius * np.sin(angle) * depth, depth], axis=1)


def test_projection_is_that_of_opencv(lens):
    R, translation = orbit_rotation(0.3, 0.2), np.array([0.1, -0.2, 0.3])
    points = (points_in_view() - translation) @ R
    ours = project(Camera(K, R, translation, SIZE, lens), points)
    theirs = cv2.projectPoints(points, cv2.Rodrigues(R)[0], translation, K, lens)[0][:, 0]
    np.testing.assert_allclose(ours, theirs, atol=1e-10)  # px; rounding of some hundred px, and of Rodrigues


def test_undistortion_is_that_of_opencv_and_undoes_distortion(lens):
    camera = Camera(K, np.eye(3), np.zeros(3), SIZE, lens)
    seen = project(camera, points_in_view())
    ours = undistort_points(camera, seen)
    # OpenCV's fixed-point iteration, run far past its default of 5 rounds.
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-15)
    theirs = cv2.undistortPoints(seen[:, None], K, lens, None, None, K, criteria)[:, 0]
    np.testing.assert_allclose(ours, theirs, atol=1e-7)
    np.testing.assert_allclose(ours, project(Camera(K, np.eye(3), np.zeros(3), SIZE), points_in_view()), atol=1e-8)


def test_the_region_ends_where_the_radius_turns():
    random = np.random.default_rng(1)
    radii = np.linspace(0, 3, 300_001)
    ends = []
    for _ in range(60):
        lens = random.normal(0, 0.25, 8) * [1, 1, 0, 0, 1, 1, 1, 1]
        s = radii**2
        a = np.polyval([lens[4], lens[1], lens[0], 1], s)
        b = np.polyval([lens[7], lens[6], lens[5], 1], s)
        with np.errstate(all="ignore"):
            wrong = (np.diff(radii * a / b) <= 0) | (b[1:] <= 0)
        end = radii[np.argmax(wrong)] if wrong.any() else np.inf
        found = largest_radius(lens)
        assert found == pytest.approx(end, abs=3e-5) if np.isfinite(end) else found > 3
        ends.append(end)
    assert 10 < np.isfinite(ends).sum() < 60


def test_what_opencv_folds_into_the_picture_is_not_seen():
    lens = np.array([-0.35, 0, 0, 0, 0, 0, 0, 0])
    beside = np.array([[1.6, 0.0, 1.0]])  # 58 degrees from the axis
    folded = cv2.projectPoints(beside, np.zeros(3), np.zeros(3), K, lens)[0][0, 0]
    assert 0 < folded[0] < SIZE[0] and 0 < folded[1] < SIZE[1]
    assert np.isnan(project(Camera(K, np.eye(3), np.zeros(3), SIZE, lens), beside)).all()


def test_distortion_is_one_to_one_where_it_is_defined(lens):
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-4, 4, 161)]), axis=-1).reshape(-1, 2)
    image = distort(grid, lens)
    known = np.isfinite(image[:, 0])
    assert known.sum() > 100
    grid, image = grid[known], image[known]
    # Neighbours in the image are neighbours on the grid: no second sheet lies over the first. The Jacobian shrinks to
    # nothing at the rim, so the rim is left out.
    away_from_rim = np.hypot(*grid.T) < 0.9 * min(largest_radius(lens), 3.0)
    grid, image = grid[away_from_rim], image[away_from_rim]
    nearest = np.asarray(KDTree(image).query(image, k=2)[1])
    assert np.hypot(*(grid - grid[nearest[:, 1]]).T).max() < 0.25


def views():
    cameras = []
    for yaw in (0.0, 0.8, -1.0):
        R = orbit_rotation(yaw, 0.1)
        cameras.append(Camera(K, R, np.array([0.0, 0.0, 4.0]), SIZE))
    return cameras


def test_two_noiseless_views_agree_with_opencv():
    cameras, points = views()[:2], np.random.default_rng(2).uniform(-1, 1, (50, 3))
    pixels = np.stack([project(camera, points) for camera in cameras])
    matrices = [camera.K @ np.column_stack([camera.R, camera.translation]) for camera in cameras]
    homogeneous = cv2.triangulatePoints(matrices[0], matrices[1], pixels[0].T, pixels[1].T)
    theirs = (homogeneous[:3] / homogeneous[3]).T
    np.testing.assert_allclose(triangulate(cameras, pixels), theirs, atol=1e-10)


def test_noisy_views_give_the_least_squares_of_the_image():
    random = np.random.default_rng(3)
    cameras, points = views(), random.uniform(-1, 1, (8, 3))
    pixels = np.stack([project(camera, points) for camera in cameras]) + random.normal(0, 2, (3, 8, 2))
    ours = triangulate(cameras, pixels)
    for number, point in enumerate(points):

        def residuals(at, number=number):
            return np.concatenate(
                [project(camera, at) - seen[number] for camera, seen in zip(cameras, pixels, strict=True)]
            )

        theirs = least_squares(residuals, point, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        # Both stop where the sum of squares is flat to double precision: 1e-8 of the curvature's scale.
        np.testing.assert_allclose(ours[number], theirs, atol=1e-6)


@pytest.fixture
def matrices():
    if not CALIBRATION.is_dir():
        pytest.skip("DHP19's calibration is not beside this checkout")
    return {number: np.load(CALIBRATION / f"P{number}.npy") for number in (1, 2, 3, 4)}


def people():
    """Joints around the middle of the treadmill, mm, z up."""
    return np.random.default_rng(4).uniform([-500, -500, 0], [500, 500, 1800], (40, 13, 3))


def test_dhp19_joints_come_back_from_its_four_cameras(matrices):
    joints_mm = people()
    all_matrices = np.stack(list(matrices.values()))
    homogeneous = np.einsum("cij,nkj->cnki", all_matrices, np.insert(joints_mm, 3, 1, axis=-1))
    # SensorsINI/DHP19, heatmap_generation_example.ipynb: u = P0 / P2, v = 260 - P1 / P2.
    pixels = np.stack([homogeneous[..., 0], 260 * homogeneous[..., 2] - homogeneous[..., 1]], -1) / homogeneous[..., 2:]
    cameras = [camera_of(matrix, f"P{number}") for number, matrix in matrices.items()]
    for camera, expected in zip(cameras, pixels, strict=True):
        np.testing.assert_allclose(project(camera, joints_mm / 1000), expected, atol=1e-9)
    assert np.abs(1000 * triangulate(cameras, pixels) - joints_mm).max() < 1e-6
    # Any two cameras do, whichever they are.
    assert np.abs(1000 * triangulate(cameras[1:3], pixels[1:3]) - joints_mm).max() < 1e-5


def test_dhp19_cameras_are_upright_and_stand_where_the_authors_say(matrices):
    positions = np.load(CALIBRATION / "camera_positions.npy").reshape(4, 3)
    # heatmap_generation_example.ipynb: channel 0 belongs to P4, 1 to P1, 2 to P3, 3 to P2.
    assert {channel: number for number, channel in CHANNEL_OF_CAMERA.items()} == {0: 4, 1: 1, 2: 3, 3: 2}
    for number, matrix in matrices.items():
        camera = camera_of(matrix, f"P{number}")
        assert np.linalg.det(camera.R) == pytest.approx(1.0)
        low, high = project(camera, np.array([[0, 0, 1.0], [0, 0, 1.2]]))
        assert high[1] < low[1], "the motion capture's z points up, in the picture too"
        np.testing.assert_allclose(1000 * camera.centre, positions[number - 1], atol=1e-5)


def test_dhp19s_cameras_project_as_their_matrices(matrices):
    """u = P0 / P2 and v = 260 - P1 / P2, as in the authors' notebook."""
    points = np.random.default_rng(0).uniform([-1, -1, 0], [1, 1, 2], (50, 3))
    for number, matrix in matrices.items():
        projected = np.concatenate([1000 * points, np.ones((50, 1))], axis=1) @ matrix.T
        expected = np.stack([projected[:, 0] / projected[:, 2], 260 - projected[:, 1] / projected[:, 2]], axis=1)
        np.testing.assert_allclose(project(camera_of(matrix, f"P{number}"), points), expected, atol=1e-8)
