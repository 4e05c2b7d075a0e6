"""The one example that DHP19's authors evaluate in public: what their pixels give by our metrics.

Source: SensorsINI/DHP19, Eval_2D_triangulation_and_3D_tutorial.ipynb, printed output: subject 16, session 2,
movement 1, image 24, cameras 2 and 3. Labels are printed as the pixels they lie in, (row, column), predictions as the
highest pixels of the heatmaps.
"""

from pathlib import Path

import numpy as np
import pytest

from ctlev_core.metrics import mpjpe2d, mpjpe3d
from data_contracts.labels import Labels

CALIBRATION = Path(__file__).resolve().parents[2].parent / "shared" / "real" / "dhp19_calib"
IMAGE_HEIGHT = 260
LABELS = {
    2: [(45, 124), (72, 129), (70, 158), (101, 142), (111, 169), (126, 130), (129, 151), (134, 135), (144, 156),
        (172, 113), (178, 149), (216, 129), (231, 144)],
    3: [(36, 197), (71, 163), (58, 193), (101, 155), (92, 203), (123, 183), (114, 199), (138, 158), (117, 224),
        (171, 198), (163, 194), (214, 187), (211, 204)],
}  # fmt: skip
PREDICTED = {
    2: [(32, 132), (68, 131), (68, 161), (100, 142), (106, 171), (118, 135), (127, 157), (126, 130), (147, 159),
        (168, 117), (175, 154), (211, 134), (223, 153)],
    3: [(24, 186), (67, 160), (54, 189), (105, 151), (88, 199), (118, 179), (109, 196), (136, 156), (112, 220),
        (168, 195), (163, 195), (210, 184), (206, 202)],
}  # fmt: skip
PUBLISHED_PX = {2: 6.9048320282, 3: 5.79560125641}
PUBLISHED_MM = 66.3753692654


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
