"""Bodies before a camera as labels: SMPL parameters in its frame, and the joints that a label of them would have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctlev_core.body.layer import BodyModel, joint_transforms, load_body, pose_vertices
from ctlev_core.body.rigid_motion import move_roots
from ctlev_core.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from ctlev_core.geometry.camera import Camera, camera_from_intrinsics, is_inside, project
from ctlev_core.geometry.joint_sets import joint_indices
from ctlev_core.geometry.random_cameras import CameraRange, sample_camera
from data_contracts.errors import DataError
from data_contracts.events import SensorSize
from data_contracts.labels import Labels

FOCAL_PER_SIDE = 1.4
"""Focal length over the smaller side of the sensor: a person of 1.7 m at 3 m fills eight tenths of it."""
OCCLUSION_SIDE_PX = 256
"""The larger side of the depth pictures, at most: a wrist is some pixels wide, and a picture takes a millisecond."""
OCCLUSION_BATCH = 64
MAX_WAY_M = 0.3
"""Who goes farther while a camera looks needs it to stand back; jumps and steps on the spot are seen as one stands."""
BODY_REACH_M = 0.9
"""Of an upright body around its pelvis."""
UPRIGHT = np.diag([1.0, -1.0, -1.0])
"""Camera frame of a level camera to a world with y up, in which who faces the camera faces +z."""


def labels_in_camera(
    rotations: np.ndarray,
    transl: np.ndarray,
    betas: np.ndarray,
    camera: Camera,
    *,
    class_name: str,
    t_us: np.ndarray,
    body: BodyModel | None = None,
) -> Labels:
    """SMPL labels in the frame of a camera (`ctlev_core.body.rigid_motion`).

    Args:
        rotations: [T, 24, 3, 3] relative to the parent, the root's in the world.
        transl: [T, 3] m, world.
        betas: [10] shape.
        camera: who looks; its distortion is not part of the labels.
        class_name: of every row.
        t_us: [T] int64.
        body: the bundled body when None.
    Returns:
        T rows with SMPL parameters in the camera frame and the camera's intrinsics.
    """
    seen = rotations.copy()
    pelvis = rest_pelvis(np.asarray(betas), body)
    seen[:, 0], moved = move_roots(rotations[:, 0], transl, pelvis, camera.R, camera.translation)
    count = len(rotations)
    return Labels(
        class_names=(class_name,) * count,
        t_us=t_us,
        smpl_pose=axis_angle_from_matrix(seen).reshape(count, 72).astype(np.float32),
        smpl_betas=np.tile(np.asarray(betas, dtype=np.float32), (count, 1)),
        smpl_transl=moved.astype(np.float32),
        intrinsics=np.tile(camera.intrinsics.astype(np.float32), (count, 1)),
    )


def with_joints(labels: Labels, sensor_size: SensorSize, joint_set: str, occlusion: bool = False) -> Labels:
    """Labels with the joints of their SMPL bodies in 2D and 3D.

    The body is the bundled one, shaped by the labels' coefficients. The camera is that of the labels' intrinsics; where
    they have none, one with its principal point in the middle of the sensor and `FOCAL_PER_SIDE`. It has no distortion.

    Args:
        labels: N rows with SMPL parameters in the camera frame (x right, y down, z forward).
        sensor_size: (width, height) px of the image which the intrinsics are of.
        joint_set: of the result, a key of `ctlev_core.geometry.joint_sets.JOINT_SETS`.
        occlusion: joints that the body itself hides are not visible either. This poses and renders each body, at
            `OCCLUSION_SIDE_PX`. The data sets' own labels, from markers, call hidden joints visible.
    Returns:
        The same rows with the intrinsics used, joints2d [N, J, 2] px, visible where they lie on the sensor, and
        joints3d [N, J, 3] mm. A joint behind the camera is NaN in 2D.
    Raises:
        DataError: the labels have no SMPL parameters, SMPL lacks a joint of the set, or the sensor has no pixels.
    """
    if min(sensor_size) < 1:
        raise DataError(f"sensor_size must be (width, height) of 1 px or more, got {sensor_size}")
    chosen = joint_indices("smpl", joint_set)
    all_joints = smpl_joints(labels)
    joints = all_joints[:, chosen]
    intrinsics = labels.intrinsics
    if intrinsics is None:
        intrinsics = np.tile(default_intrinsics(sensor_size), (len(labels), 1))
    joints2d = np.empty((*joints.shape[:2], 2))
    cameras, of_row = np.unique(intrinsics, axis=0, return_inverse=True)
    for number, camera in enumerate(cameras):
        rows = of_row.reshape(-1) == number
        joints2d[rows] = project(camera_from_intrinsics(camera, sensor_size), joints[rows])
    visible = is_inside(joints2d, sensor_size)
    if occlusion:
        visible &= _in_sight(labels, all_joints, intrinsics, sensor_size)[:, chosen]
    return replace(
        labels,
        joints2d=joints2d.astype(np.float32),
        visible=visible,
        joints3d=(1000 * joints).astype(np.float32),
        joint_set=joint_set,
        intrinsics=intrinsics,
    )


def from_new_side(
    labels: Labels, rng: np.random.Generator, sensor_size: SensorSize, ranges: CameraRange | None = None
) -> Labels:
    """The same bodies as another still camera sees them, drawn at random around the space they move in.

    The camera that the labels come from is taken to stand upright and level: yaw and pitch of the new one count from
    its view. It stands as far away as is drawn, or where they go a long way so far that it sees all of it.

    Args:
        labels: N rows with SMPL parameters, one or more.
        rng: source of the randomness.
        sensor_size: (width, height) px of the new camera.
        ranges: what to draw from; see `ctlev_core.geometry.random_cameras.sample_camera`.
    Returns:
        The same rows with SMPL parameters in the new camera's frame, and its intrinsics. Joints of the old view are
        gone; `with_joints` gives those of the new one.
    Raises:
        DataError: the labels have no SMPL parameters, or no rows.
    """
    joints = smpl_joints(labels)
    camera = _far_enough(sample_camera(rng, joints @ UPRIGHT.T, sensor_size, ranges), joints @ UPRIGHT.T)
    pose, betas, transl = _bodies(labels)
    root, moved = move_roots(
        matrix_from_axis_angle(pose[:, :3].astype(np.float64)),
        transl.astype(np.float64),
        rest_pelvis(betas),
        camera.R @ UPRIGHT,
        camera.translation,
    )
    pose = np.concatenate([axis_angle_from_matrix(root), pose[:, 3:]], axis=1)
    return replace(
        labels,
        smpl_pose=pose.astype(np.float32),
        smpl_transl=moved.astype(np.float32),
        intrinsics=np.tile(camera.intrinsics.astype(np.float32), (len(labels), 1)),
        joints2d=None,
        visible=None,
        joints3d=None,
        joint_set="",
    )


def _far_enough(camera: Camera, joints: np.ndarray) -> Camera:
    """The camera moved back along its axis until all of a long way [N, J, 3] m is in the picture.

    Who stays about where they are is seen from the distance that was drawn.
    """
    pelvis = joints[:, 0]
    if np.ptp(pelvis, axis=0).max() <= MAX_WAY_M:
        return camera
    way = pelvis @ camera.R.T + camera.translation
    # At depth z the picture reaches z * side / (2 f) to each side.
    per_depth = 2 * camera.intrinsics[:2] / np.array(camera.image_size)
    needed = (per_depth * (np.abs(way[:, :2]) + BODY_REACH_M)).max(axis=1) - way[:, 2]
    back = np.array([0.0, 0.0, max(needed.max(), 0.0)])
    return replace(camera, translation=camera.translation + back)


def default_intrinsics(sensor_size: SensorSize) -> np.ndarray:
    """fx, fy, cx, cy [4] float32, px, of the virtual camera of labels that do not say what saw them."""
    width, height = sensor_size
    focal = FOCAL_PER_SIDE * min(sensor_size)
    return np.array([focal, focal, width / 2, height / 2], dtype=np.float32)


def rest_pelvis(betas: np.ndarray, body: BodyModel | None = None) -> np.ndarray:
    """The root joint [..., 3] float64, m, at rest of the body (the bundled one if None) shaped by `betas` [..., 10]."""
    body = body or load_body()
    return body.joints[0] + np.asarray(betas, np.float64) @ body.joint_shapedirs[0].T


def smpl_joints(labels: Labels) -> np.ndarray:
    """The joints [N, 24, 3] float64, m, camera frame, of the bundled body under the labels' SMPL parameters.

    Raises:
        DataError: the labels have none.
    """
    pose, betas, transl = _bodies(labels)
    rotations = matrix_from_axis_angle(pose.reshape(len(labels), 24, 3).astype(np.float64))
    return joint_transforms(load_body(), rotations, betas, transl)[1]


def _in_sight(labels: Labels, joints: np.ndarray, intrinsics: np.ndarray, sensor_size: SensorSize) -> np.ndarray:
    """Which of SMPL's joints [N, 24] lie on the sensor and are not behind another part of the body."""
    from ctlev_core.render.normals import render_normals
    from ctlev_core.render.visibility import SMPL_FLESH_M, joint_visibility

    pose, betas, transl = _bodies(labels)
    body = load_body()
    width, height = sensor_size
    shrink = min(1.0, OCCLUSION_SIDE_PX / max(sensor_size))
    size = max(1, round(width * shrink)), max(1, round(height * shrink))
    scaled = intrinsics * np.tile(np.divide(size, sensor_size), 2)
    rotations = matrix_from_axis_angle(pose.reshape(len(labels), 24, 3).astype(np.float64))
    visible = np.zeros(joints.shape[:2], np.bool_)
    for start in range(0, len(labels), OCCLUSION_BATCH):
        rows = slice(start, start + OCCLUSION_BATCH)
        vertices, _ = pose_vertices(body, rotations[rows], betas[rows], transl[rows])
        _, depth_inverse = render_normals(vertices, body.faces, scaled[rows], size)
        for row, depth in enumerate(depth_inverse, start):
            visible[row] = joint_visibility(joints[row], depth, scaled[row], SMPL_FLESH_M)
    return visible


def _bodies(labels: Labels) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if labels.smpl_pose is None or labels.smpl_betas is None or labels.smpl_transl is None:
        raise DataError("the recordings to sample poses from have neither joints nor SMPL parameters")
    return labels.smpl_pose, labels.smpl_betas, labels.smpl_transl
