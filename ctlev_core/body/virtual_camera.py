"""Bodies given as SMPL parameters, before a virtual camera: the joints that a 2D label of them would have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctlev_core.body.layer import joint_transforms, load_body
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.camera import Camera, is_inside, project
from ctlev_core.skeletons import joint_indices
from data_contracts.errors import DataError
from data_contracts.events import SensorSize
from data_contracts.labels import Labels

FOCAL_PER_SIDE = 1.4
"""Focal length over the smaller side of the sensor: a person of 1.7 m at 3 m fills eight tenths of it."""


def with_joints(labels: Labels, sensor_size: SensorSize, joint_set: str) -> Labels:
    """Labels with the joints of their SMPL bodies in 2D and 3D.

    The body is the bundled one, shaped by the labels' coefficients. The camera has its principal point in the middle of
    the sensor and no distortion; self-occlusion is not looked at.

    Args:
        labels: N rows with SMPL parameters in the camera frame (x right, y down, z forward).
        sensor_size: (width, height) px.
        joint_set: of the result, a key of `ctlev_core.skeletons.JOINT_SETS`.
    Returns:
        The same rows with joints2d [N, J, 2] px, visible where they lie on the sensor, and joints3d [N, J, 3] mm. A
        joint behind the camera is NaN in 2D.
    Raises:
        DataError: the labels have no SMPL parameters.
    """
    if labels.smpl_pose is None or labels.smpl_betas is None or labels.smpl_transl is None:
        raise DataError("the recordings to sample poses from have neither joints nor SMPL parameters")
    rotations = matrix_from_axis_angle(labels.smpl_pose.reshape(len(labels), 24, 3).astype(np.float64))
    joints = np.empty((len(labels), 24, 3))
    shapes, of_row = np.unique(labels.smpl_betas, axis=0, return_inverse=True)
    for number, betas in enumerate(shapes):
        rows = of_row.reshape(-1) == number
        _, joints[rows] = joint_transforms(load_body(), rotations[rows], betas, labels.smpl_transl[rows])
    joints = joints[:, joint_indices("smpl", joint_set)]
    width, height = sensor_size
    focal = FOCAL_PER_SIDE * min(sensor_size)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    joints2d = project(Camera(K, np.eye(3), np.zeros(3), sensor_size), joints)
    return replace(
        labels,
        joints2d=joints2d.astype(np.float32),
        visible=is_inside(joints2d, sensor_size),
        joints3d=(1000 * joints).astype(np.float32),
        joint_set=joint_set,
    )
