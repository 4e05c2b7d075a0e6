"""A body that moves before a camera, as the label an SMPL data set would give it."""

from __future__ import annotations

import numpy as np

from ctlev_core.body.layer import BodyModel, load_body
from ctlev_core.body.rotations import axis_angle_from_matrix
from ctlev_core.camera import Camera
from data_contracts.labels import Labels


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
    """SMPL labels in the frame of a camera.

    SMPL turns a body about its own pelvis J: x = R (x_rest - J) + J + transl. Seen from a camera at X' = A X + a, this
    is R' = A R and transl' = A (J + transl) + a - J, where J is that of the shape `betas`.

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
    body = body or load_body()
    pelvis = body.joints[0] + body.joint_shapedirs[0] @ np.asarray(betas, dtype=np.float64)
    seen = rotations.copy()
    seen[:, 0] = camera.R @ rotations[:, 0]
    count = len(rotations)
    return Labels(
        class_names=(class_name,) * count,
        t_us=t_us,
        smpl_pose=axis_angle_from_matrix(seen).reshape(count, 72).astype(np.float32),
        smpl_betas=np.tile(np.asarray(betas, dtype=np.float32), (count, 1)),
        smpl_transl=((pelvis + transl) @ camera.R.T + camera.translation - pelvis).astype(np.float32),
        intrinsics=np.tile(camera.intrinsics.astype(np.float32), (count, 1)),
    )
