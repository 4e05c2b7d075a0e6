"""3D bodies: a picture of the surface normals of the SMPL body, and one fixed prompt.

Source: ControlEvents, the human-body experiments: SMPL as normal maps for the "normal" ControlNet v1.0. The body is the
bundled procedural one unless a licensed SMPL file is given; no light, colour or background is rendered.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from data_contracts.config import RUN_SETTING, Frozen
from data_contracts.errors import DataError
from data_contracts.labels import Conditions, Labels

VERSION = 1
BATCH = 64
"""Bodies posed at a time: 64 of SMPL's are 5 MB."""


class Options(Frozen):
    """Options of the normal map."""

    prompt: str = Field(default="A moving human", description="The same prompt for every image, as in the paper.")
    convention: Literal["controlnet", "controlnet_unreversed", "rgb"] = Field(
        default="controlnet",
        description="which axis is which colour: as ControlNet v1.0 sees it, red for near and blue for left; the same "
        "in the order of v1.0's annotator, for a ControlNet whose config says `bgr` and reverses it itself; or right, "
        "up, near as red, green, blue",
    )
    body: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="SMPL file (.pkl, .npz) of the labels' body; the bundled body when null",
    )
    renderer: Literal["numba", "pyrender"] = Field(
        default="numba", description="rasteriser on the CPU, or OpenGL through EGL or OSMesa"
    )
    workers: int | None = Field(
        default=None, ge=1, json_schema_extra=RUN_SETTING, description="threads; one a core when null"
    )


def input_files(options: Options) -> list[Path]:
    """The body file where one is given; its content enters the cache key.

    Raises:
        DataError: no such file.
    """
    if options.body is None:
        return []
    if not options.body.is_file():
        raise DataError(f"condition 'normals': {options.body}: no such file; expected an SMPL body (.pkl or .npz)")
    return [options.body]


def render(labels: Labels, image_size: tuple[int, int], options: Options, seeds: Sequence[int]) -> Conditions:
    """Render the body of each row; nothing is random, so `seeds` only has to fit.

    Args:
        labels: N rows with SMPL parameters in the camera frame, and the intrinsics of an image of `image_size`.
        image_size: (width, height) px.
        options: see `Options`.
        seeds: N integers, unused.
    Returns:
        N conditions with images [N, H, W, 3] uint8.
    Raises:
        DataError: the labels have no SMPL parameters or no intrinsics, the body file is wrong, the number of seeds
            differs, or the renderer needs an OpenGL that is not there.
    """
    from ctlev_core.body.layer import load_body, pose_vertices
    from ctlev_core.body.rotations import matrix_from_axis_angle
    from ctlev_core.render.normals import render_normal_maps

    if labels.smpl_pose is None or labels.smpl_betas is None or labels.smpl_transl is None:
        raise DataError("condition 'normals': the labels have no SMPL parameters; use condition 'skeleton' for joints")
    if labels.intrinsics is None:
        raise DataError(
            "condition 'normals': the labels have no camera intrinsics, so bodies have no place in the image"
        )
    if len(seeds) != len(labels):
        raise DataError(f"condition 'normals': {len(labels)} labels but {len(seeds)} seeds")
    body = load_body(options.body)
    width, height = image_size
    images = np.empty((len(labels), height, width, 3), dtype=np.uint8)
    rotations = matrix_from_axis_angle(labels.smpl_pose.reshape(-1, 24, 3))
    workers = options.workers or os.cpu_count() or 1
    for start in range(0, len(labels), BATCH):
        rows = slice(start, start + BATCH)
        vertices, _ = pose_vertices(body, rotations[rows], labels.smpl_betas[rows], labels.smpl_transl[rows])
        intrinsics = labels.intrinsics[rows]
        images[rows] = render_normal_maps(
            vertices, body.faces, intrinsics, image_size, options.convention, renderer=options.renderer, workers=workers
        )
    return Conditions((options.prompt,) * len(labels), images)
