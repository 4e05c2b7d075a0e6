"""The one example that DHP19's authors evaluate in public: what their pixels give by our metrics and cameras."""

from pathlib import Path

import numpy as np
import pytest
from dhp19_example import LABELS, PREDICTED, PUBLISHED_MM, PUBLISHED_PX

from ctlev_core.dataset_files import dhp19_files
from ctlev_core.geometry import camera as cameras
from ctlev_core.metrics import mpjpe2d, mpjpe3d
from data_contracts.labels import Labels

CALIBRATION = Path(__file__).resolve().parents[2].parent / "shared" / "real" / "dhp19_calib"
IMAGE_HEIGHT = 260


def points_px(pixels, place):
    """(x, y) [13, 2] of a place within pixels that are given as (row, column)."""
    return np.array(pixels, np.float64)[:, ::-1] + place


@pytest.mark.parametrize("camera", [2, 3])
@pytest.mark.parametrize("place", [0.01, 0.5, 0.99])
def test_2d_error_is_the_published_one_wherever_labels_lie_in_their_pixels(camera, place):
    joints = points_px(LABELS[camera], place)[None].astype(np.float32)
    target = Labels(("",), np.zeros(1, np.int64), joints, np.ones((1, 13), bool), "dhp19")
    predicted = {"joints2d": points_px(PREDICTED[camera], 0.5)[None]}
    found = mpjpe2d.compute(predicted, target, mpjpe2d.Options(protocol="dhp19"))
    # As many digits as were printed.
    assert found == {"mpjpe2d_dhp19_px": pytest.approx(PUBLISHED_PX[camera], abs=5e-11)}


def triangulate(points_by_camera):
    """Where the rays of two cameras are nearest to both, [13, 3] mm, as the authors compute it; y counts upwards."""
    matrices = np.zeros((13, 3, 3))
    goals = np.zeros((13, 3))
    for camera, points in points_by_camera.items():
        projection = np.load(CALIBRATION / f"P{camera}.npy")
        centre = np.load(CALIBRATION / "camera_positions.npy")[camera - 1]
        seen = np.column_stack([points[:, 0], IMAGE_HEIGHT - points[:, 1], np.ones(13)])
        on_ray = seen @ np.linalg.pinv(projection).T
        direction = on_ray[:, :3] / on_ray[:, 3:] - centre
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        across = np.eye(3) - direction[:, :, None] * direction[:, None]
        matrices += across
        goals += across @ centre
    return np.linalg.solve(matrices, goals[..., None])[..., 0]


def test_3d_error_is_the_published_one_but_for_the_rounding_of_the_labels():
    if not CALIBRATION.is_dir():
        pytest.skip("the calibration of DHP19's cameras is not part of the repository")
    # Their 3D label was not printed. Over places of the labels in their pixels the error has a deviation of 0.6 mm.
    labelled = triangulate({camera: points_px(pixels, 0.5) for camera, pixels in LABELS.items()})
    found = triangulate({camera: points_px(pixels, 0.0) for camera, pixels in PREDICTED.items()})
    target = Labels(("",), np.zeros(1, np.int64), joints3d=labelled[None].astype(np.float32), joint_set="dhp19")
    scores = mpjpe3d.compute({"joints3d": found[None]}, target, mpjpe3d.Options(alignment="none"))
    assert scores["mpjpe3d_mm"] == pytest.approx(PUBLISHED_MM, abs=1.2)


def real_cameras():
    """The cameras 2 and 3, whose rows count from the top like the labels': `camera_of` has turned them round."""
    if not CALIBRATION.is_dir():
        pytest.skip("the calibration of DHP19's cameras is not part of the repository")
    paths = [CALIBRATION / f"P{number}.npy" for number in LABELS]
    return [dhp19_files.camera_of(dhp19_files.read_projection(path), str(path)) for path in paths]


def seen_by_both(pixels, place):
    """(x, y) [2, 13, 2] of a place within pixels given as (row, column)."""
    return np.stack([points_px(each, place) for each in pixels.values()])


def test_3d_error_by_our_triangulation_is_the_published_one():
    views = real_cameras()
    # A label lies anywhere in the pixel it is printed as: its centre is the best guess, a corner shifts the result by
    # up to 3.5 mm. The authors feed the bare index of the highest pixel, which is that pixel's corner, to their rays.
    labelled = cameras.triangulate(views, seen_by_both(LABELS, 0.5))
    found = cameras.triangulate(views, seen_by_both(PREDICTED, 0.0))
    error_mm = 1000 * np.linalg.norm(found - labelled, axis=1).mean()
    assert 64 < error_mm < 67
    assert error_mm == pytest.approx(PUBLISHED_MM, abs=0.6), "66.29 mm, a deviation of the labels' rounding away"
    # With pixel centres, as our own networks give them, the same prediction is 2.4 mm better than published.
    centred = cameras.triangulate(views, seen_by_both(PREDICTED, 0.5))
    assert 1000 * np.linalg.norm(centred - labelled, axis=1).mean() == pytest.approx(error_mm - 2.37, abs=0.05)


def test_triangulated_labels_are_seen_in_the_pixels_they_were_printed_as():
    views = real_cameras()
    labels = seen_by_both(LABELS, 0.5)
    points = cameras.triangulate(views, labels)
    seen = np.stack([cameras.project(view, points) for view in views])
    distances = np.linalg.norm(seen - labels, axis=-1)
    # .15 px on average, .36 at most: less than the rounding to whole pixels.
    assert distances.max() < 0.5 and distances.mean() < 0.25
    np.testing.assert_array_equal(np.floor(seen), labels - 0.5)
    # Only if rows are turned round do the two views agree: with rows from the bottom they miss by 10 px on average.
    upside_down = labels * [1, -1] + [0, IMAGE_HEIGHT]
    apart = np.stack([cameras.project(view, cameras.triangulate(views, upside_down)) for view in views]) - upside_down
    assert np.linalg.norm(apart, axis=-1).mean() > 5
    # A person of ordinary size, some metres away from both: head to the lower foot.
    height_m = np.ptp(points[:, 2])
    assert 1.3 < height_m < 2.0
