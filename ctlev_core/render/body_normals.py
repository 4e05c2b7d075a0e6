"""Pictures of the normals of labelled bodies: what the conditions of bodies share."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ctlev_core.processes import num_cores
from data_contracts.errors import DataError
from data_contracts.labels import Labels

BATCH = 64
"""Bodies posed at a time: 64 of SMPL's are 5 MB."""


def render_labelled_normals(
    labels: Labels,
    image_size: tuple[int, int],
    where: str,
    *,
    convention: str = "controlnet",
    body_file: Path | None = None,
    renderer: str = "numba",
    workers: int | None = None,
) -> np.ndarray:
    """Normal maps [N, H, W, 3] uint8 of the bodies of N labels.

    Args:
        labels: N rows with SMPL parameters in the camera frame, and the intrinsics of an image of `image_size`.
        image_size: (width, height) px.
        where: begins the messages of errors.
        convention: which axis is which colour, see `ctlev_core.render.normals`.
        body_file: SMPL file of the labels' body; the bundled body when None.
        renderer: see `ctlev_core.render.normals`.
        workers: threads; one a core when None.
    Raises:
        DataError: the labels have no SMPL parameters or no intrinsics, the body file is wrong, or the renderer needs an
            OpenGL that is not there.
    """
    from ctlev_core.body.layer import load_body, pose_vertices
    from ctlev_core.body.rotations import matrix_from_axis_angle
    from ctlev_core.render.normals import render_normal_maps

    if labels.smpl_pose is None or labels.smpl_betas is None or labels.smpl_transl is None:
        raise DataError(f"{where}: the labels have no SMPL parameters; use condition 'skeleton' for joints")
    if labels.intrinsics is None:
        raise DataError(f"{where}: the labels have no camera intrinsics, so bodies have no place in the image")
    body = load_body(body_file)
    width, height = image_size
    images = np.empty((len(labels), height, width, 3), dtype=np.uint8)
    rotations = matrix_from_axis_angle(labels.smpl_pose.reshape(-1, 24, 3))
    workers = workers or num_cores()
    for start in range(0, len(labels), BATCH):
        rows = slice(start, start + BATCH)
        vertices, _ = pose_vertices(body, rotations[rows], labels.smpl_betas[rows], labels.smpl_transl[rows])
        intrinsics = labels.intrinsics[rows]
        images[rows] = render_normal_maps(
            vertices, body.faces, intrinsics, image_size, convention, renderer=renderer, workers=workers
        )
    return images
