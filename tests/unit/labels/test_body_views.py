"""Bodies of SMPL parameters before a virtual camera."""

from dataclasses import replace

import numpy as np
import pytest

from ctlev_core.body.layer import joint_transforms, load_body
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.geometry.camera import is_inside, project
from ctlev_core.geometry.joint_sets import JOINT_SETS, SMPL_TO_DHP19
from ctlev_core.geometry.random_cameras import CameraRange, sample_camera
from ctlev_core.labels.body_views import FOCAL_PER_SIDE, from_new_side, with_joints
from data_contracts.errors import DataError
from data_contracts.labels import Labels, check_labels

SENSOR = (346, 260)


def labels_of(pose, transl, betas=None):
    count = len(pose)
    return Labels(
        ("walk",) * count,
        np.arange(count, dtype=np.int64),
        smpl_pose=np.asarray(pose, np.float32),
        smpl_betas=np.zeros((count, 10), np.float32) if betas is None else betas.astype(np.float32),
        smpl_transl=np.asarray(transl, np.float32),
    )


def facing():
    """Upright in a T pose, the face to the camera: turned by pi about x, from y up to y down."""
    pose = np.zeros((1, 72))
    pose[0, 0] = np.pi
    return pose


def test_a_person_who_faces_the_camera_has_the_left_hand_on_the_right_of_the_picture():
    labels = check_labels(with_joints(labels_of(facing(), [[0, 0, 3]]), SENSOR, "dhp19"), "test")
    assert labels.joints2d is not None and labels.visible is not None
    at = dict(zip(JOINT_SETS["dhp19"].joints, labels.joints2d[0], strict=True))
    assert at["left_hand"][0] > SENSOR[0] / 2 > at["right_hand"][0]
    assert at["head"][1] < at["left_hip"][1] < at["left_foot"][1]
    assert labels.visible.all()
    height = at["left_foot"][1] - at["head"][1]
    assert 0.4 * SENSOR[1] < height < 0.9 * SENSOR[1]


def test_joints_are_those_of_each_rows_own_body():
    random = np.random.default_rng(0)
    pose, transl = random.normal(0, 0.4, (6, 72)), random.uniform(-0.3, 0.3, (6, 3)) + np.array([0.0, 0.0, 4.0])
    betas = np.repeat(random.normal(0, 1, (2, 10)), 3, axis=0)[[0, 3, 1, 4, 2, 5]]
    labels = with_joints(labels_of(pose, transl, betas), SENSOR, "dhp19")
    assert labels.joints2d is not None and labels.joints3d is not None
    focal = FOCAL_PER_SIDE * 260
    for row in range(6):
        rotations = matrix_from_axis_angle(pose[row].astype(np.float32).reshape(1, 24, 3))
        _, joints = joint_transforms(load_body(), rotations, betas[row], transl[row : row + 1])
        x, y, z = joints[0, list(SMPL_TO_DHP19)].T
        expected = np.stack([focal * x / z + 173, focal * y / z + 130], axis=1)
        np.testing.assert_allclose(labels.joints2d[row], expected, atol=1e-2)  # float32 parameters, hundreds of px
        np.testing.assert_allclose(labels.joints3d[row], 1000 * np.stack([x, y, z], axis=1), atol=1e-2)


def test_a_body_behind_the_camera_is_not_seen():
    labels = check_labels(with_joints(labels_of(facing(), [[0, 0, -3]]), SENSOR, "smpl"), "test")
    assert labels.joints2d is not None and labels.visible is not None
    assert np.isnan(labels.joints2d).all() and not labels.visible.any()


def test_labels_without_a_body_are_an_error():
    with pytest.raises(DataError, match="neither joints nor SMPL parameters"):
        with_joints(Labels(("walk",), np.zeros(1, np.int64)), SENSOR, "dhp19")


def test_intrinsics_of_the_labels_are_used_and_kept():
    labels = labels_of(np.repeat(facing(), 3, axis=0), [[0, 0, 3], [0, 0, 3], [0.2, 0, 5]])
    intrinsics = np.array([[300, 310, 170, 100], [500, 500, 160, 90], [300, 310, 170, 100]], np.float32)
    seen = check_labels(with_joints(replace(labels, intrinsics=intrinsics), SENSOR, "smpl"), "test")
    assert seen.joints2d is not None and seen.joints3d is not None
    np.testing.assert_array_equal(seen.intrinsics, intrinsics)
    x, y, z = np.moveaxis(seen.joints3d.astype(float), -1, 0)
    fx, fy, cx, cy = intrinsics.T[:, :, None]
    np.testing.assert_allclose(seen.joints2d[..., 0], fx * x / z + cx, atol=1e-3)  # float32, hundreds of px
    np.testing.assert_allclose(seen.joints2d[..., 1], fy * y / z + cy, atol=1e-3)


def test_the_default_camera_is_told():
    labels = with_joints(labels_of(facing(), [[0, 0, 3]]), SENSOR, "dhp19")
    assert labels.intrinsics is not None and labels.joints2d is not None
    np.testing.assert_allclose(labels.intrinsics, [[FOCAL_PER_SIDE * 260, FOCAL_PER_SIDE * 260, 173, 130]], rtol=1e-6)
    again = with_joints(labels, SENSOR, "dhp19")
    assert again.joints2d is not None
    np.testing.assert_array_equal(again.joints2d, labels.joints2d)


def test_new_sides_are_views_of_the_same_bodies():
    random = np.random.default_rng(5)
    pose, transl = random.normal(0, 0.3, (4, 72)), random.uniform(-0.3, 0.3, (4, 3)) + np.array([0.0, 0.0, 4.0])
    labels = with_joints(labels_of(pose, transl, random.normal(0, 1, (4, 10))), SENSOR, "smpl")
    turned = from_new_side(labels, np.random.default_rng(1), SENSOR)
    assert turned.joints2d is None and turned.joint_set == ""
    seen = check_labels(with_joints(turned, SENSOR, "smpl"), "test")
    assert seen.joints3d is not None and labels.joints3d is not None and seen.visible is not None
    assert seen.visible.mean() > 0.9
    # One rigid motion takes all joints of all rows from one camera to the other (Kabsch).
    before, after = labels.joints3d.reshape(-1, 3).astype(float), seen.joints3d.reshape(-1, 3).astype(float)
    u, _, v = np.linalg.svd((before - before.mean(0)).T @ (after - after.mean(0)))
    assert np.linalg.det(u @ v) > 0
    np.testing.assert_allclose((before - before.mean(0)) @ u @ v + after.mean(0), after, atol=0.02)  # mm; float32


@pytest.mark.parametrize("way_m", [8.0, 14.0])
def test_who_goes_a_long_way_stays_in_the_picture_from_every_new_side(way_m):
    across = np.linspace([-way_m / 2, 0.1, 6.0], [way_m / 2, 0.1, 9.0], 12)
    labels = labels_of(np.repeat(facing(), 12, axis=0), across)
    for seed in range(20):
        seen = with_joints(from_new_side(labels, np.random.default_rng(seed), SENSOR), SENSOR, "smpl")
        assert seen.joints3d is not None and seen.visible is not None
        assert seen.joints3d[..., 2].min() > 1000 and seen.visible.mean(axis=1).min() > 0.85


def test_yaw_zero_sees_what_the_old_camera_saw():
    ahead = CameraRange((3.0, 3.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (1.4, 1.4))
    labels = labels_of(facing(), [[0.4, 0.3, 5.0]])
    seen = with_joints(from_new_side(labels, np.random.default_rng(0), SENSOR, ahead), SENSOR, "dhp19")
    expected = with_joints(labels, SENSOR, "dhp19")
    assert seen.joints3d is not None and expected.joints3d is not None
    moved = seen.joints3d - expected.joints3d
    np.testing.assert_allclose(moved, np.broadcast_to(moved[:, :1], moved.shape), atol=0.02)
    # From the side, the depths of the hands differ and the left one is far to neither side.
    side = replace(ahead, yaw_rad=(np.pi / 2, np.pi / 2))
    seen = with_joints(from_new_side(labels, np.random.default_rng(0), SENSOR, side), SENSOR, "dhp19")
    assert seen.joints3d is not None
    at = dict(zip(JOINT_SETS["dhp19"].joints, seen.joints3d[0], strict=True))
    assert abs(at["left_hand"][2] - at["right_hand"][2]) > 1000
    assert abs(at["left_hand"][0] - at["right_hand"][0]) < 100


def test_a_new_side_needs_bodies():
    with pytest.raises(DataError, match="finite joints"):
        from_new_side(labels_of(facing(), [[0, 0, 3]]).take([]), np.random.default_rng(0), SENSOR)


def test_cameras_look_at_the_person_from_within_the_ranges():
    joints = np.random.default_rng(0).uniform([-0.4, 0, -0.4], [0.4, 1.8, 0.4], (5, 24, 3))
    ranges = CameraRange((3.0, 3.5), (0.1, 0.4), (-1.0, 1.0), (0.2, 0.1), (1.2, 1.6))
    middle = (joints.min(axis=(0, 1)) + joints.max(axis=(0, 1))) / 2
    yaws = []
    for seed in range(40):
        camera = sample_camera(np.random.default_rng(seed), joints, SENSOR, ranges)
        x, y, z = camera.R @ middle + camera.translation
        assert abs(x) <= 0.2 and abs(y) <= 0.1 and 3.0 <= z <= 3.5
        assert 0.1 <= np.arcsin(-camera.R[2, 1]) <= 0.4
        yaws.append(np.arctan2(-camera.R[2, 0], -camera.R[2, 2]))
        focal, _, cx, cy = camera.intrinsics
        assert 1.2 * 260 <= focal <= 1.6 * 260 and (cx, cy) == (173, 130)
        assert is_inside(project(camera, joints), SENSOR).mean() > 0.7
    assert -1.0 <= min(yaws) < -0.5 and 0.5 < max(yaws) <= 1.0
    with pytest.raises(DataError, match="finite joints"):
        sample_camera(np.random.default_rng(0), np.full((1, 3), np.nan), SENSOR)


def test_joints_behind_the_body_are_hidden_where_asked():
    """From the side, in a T pose: the far arm and leg lie behind the near ones."""
    side = CameraRange((3.0, 3.0), (0.0, 0.0), (np.pi / 2, np.pi / 2), (0.0, 0.0), (1.4, 1.4))
    labels = from_new_side(labels_of(facing(), [[0, 0, 3]]), np.random.default_rng(0), (640, 480), side)
    plain = with_joints(labels, (640, 480), "dhp19")
    seen = check_labels(with_joints(labels, (640, 480), "dhp19", occlusion=True), "test")
    assert plain.visible is not None and plain.visible.all() and seen.visible is not None and seen.joints3d is not None
    names = JOINT_SETS["dhp19"].joints
    depth = dict(zip(names, seen.joints3d[0, :, 2], strict=True))
    near, far = ("left", "right") if depth["left_hand"] < depth["right_hand"] else ("right", "left")
    visible = dict(zip(names, seen.visible[0].tolist(), strict=True))
    assert not any(visible[f"{far}_{name}"] for name in ("shoulder", "elbow", "hand", "knee", "foot"))
    # The near wrist is behind the fingers, which point to the camera.
    assert visible["head"] and all(visible[f"{near}_{name}"] for name in ("hip", "knee", "foot"))
    np.testing.assert_array_equal(seen.joints2d, plain.joints2d)


def test_nothing_hides_a_person_seen_from_the_front():
    labels = labels_of(np.repeat(facing(), 70, axis=0), np.linspace([-0.4, 0, 3], [0.4, 0, 4], 70))
    seen = with_joints(labels, SENSOR, "dhp19", occlusion=True)
    np.testing.assert_array_equal(seen.visible, with_joints(labels, SENSOR, "dhp19").visible)
    # Rows do not depend on the others, nor on how many are rendered at a time.
    alone = with_joints(labels.take([66]), SENSOR, "dhp19", occlusion=True)
    assert seen.visible is not None and alone.visible is not None
    np.testing.assert_array_equal(alone.visible[0], seen.visible[66])
    assert with_joints(labels.take([]), SENSOR, "smpl", occlusion=True).visible is not None
    behind = with_joints(labels_of(facing(), [[0, 0, -3]]), SENSOR, "smpl", occlusion=True)
    assert behind.visible is not None and not behind.visible.any()


def test_wrong_calls_are_named():
    with pytest.raises(DataError, match="1 px or more"):
        with_joints(labels_of(facing(), [[0, 0, 3]]), (0, 260), "dhp19")
    with pytest.raises(DataError, match="'smpl' lacks joints of 'openpose': nose"):
        with_joints(labels_of(facing(), [[0, 0, 3]]), SENSOR, "openpose")
    with pytest.raises(DataError, match="finite"):
        with_joints(labels_of(facing() * np.nan, [[0, 0, 3]]), SENSOR, "dhp19")
