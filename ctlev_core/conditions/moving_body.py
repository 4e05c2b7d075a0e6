"""3D bodies that show how they move: shading in red, and where the surface moves in the image in green and blue.

Events come from what moves, and which way an edge moves decides their polarity; a normal map says neither. Red is how
much the surface faces the camera, green its optical flow to the right and blue its flow down: grey there stands still.

An addition to ControlEvents, whose condition is the normal map of one pose. It makes frames that follow one another
agree on what moves, as `moving_skeleton` does for skeletons.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import Field

from ctlev_core.body.smpl_files import given_body_file
from data_contracts.config import RUN_SETTING, Frozen
from data_contracts.errors import DataError
from data_contracts.labels import BodyMotions, Conditions, Labels, check_body_motions

VERSION = 1
NEEDS = "motion"
WHERE = "condition 'moving_body'"
STILL = 128
DARKEST, BRIGHTEST = 64, 255
"""Of red on a body: seen edge-on, and facing the camera."""
BATCH = 64
"""Bodies posed at a time."""


class Options(Frozen):
    """Options of the moving body."""

    prompt: str = Field(default="A moving human", description="The same prompt for every image, as in the paper.")
    full_speed: float = Field(
        default=1.0, gt=0, description="image widths a second from which on a colour gets no stronger"
    )
    body: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="SMPL file (.pkl, .npz) of the labels' body; the bundled body when null",
    )


def input_files(options: Options) -> list[Path]:
    """The body file where one is given; its content enters the cache key.

    Raises:
        DataError: no such file.
    """
    return given_body_file(options.body, WHERE)


def render(
    labels: Labels, image_size: tuple[int, int], options: Options, seeds: Sequence[int], motions: BodyMotions
) -> Conditions:
    """Draw the body of each row with its flow; nothing is random, so `seeds` only has to fit.

    Args:
        labels: N rows with SMPL parameters in the camera frame, and the intrinsics of an image of `image_size`.
        image_size: (width, height) px.
        options: see `Options`.
        seeds: N integers, unused.
        motions: N motions of the same bodies; the flow is from the first of their key poses to the last.
    Returns:
        N conditions with images [N, H, W, 3] uint8; (0, 128, 128) where no body is.
    Raises:
        DataError: the labels have no SMPL parameters or no intrinsics, a motion is malformed, the numbers of rows
            differ, or the body file is wrong.
    """
    from ctlev_core.body.layer import load_body, pose_vertices
    from ctlev_core.body.rotations import matrix_from_axis_angle

    if not len(seeds) == len(motions) == len(labels):
        raise DataError(f"{WHERE}: {len(labels)} labels but {len(motions)} motions and {len(seeds)} seeds")
    check_body_motions(motions, WHERE)
    if labels.smpl_pose is None or labels.smpl_betas is None or labels.smpl_transl is None:
        raise DataError(f"{WHERE}: the labels have no SMPL parameters; use condition 'moving_skeleton' for joints")
    if labels.intrinsics is None:
        raise DataError(f"{WHERE}: the labels have no camera intrinsics, so bodies have no place in the image")
    body = load_body(options.body)
    width, height = image_size
    images = np.empty((len(labels), height, width, 3), np.uint8)
    seconds = 1e-6 * (motions.t_us[:, -1] - motions.t_us[:, 0])
    for start in range(0, len(labels), BATCH):
        rows = slice(start, start + BATCH)
        betas = labels.smpl_betas[rows]

        def posed(pose: np.ndarray, transl: np.ndarray, betas: np.ndarray = betas) -> np.ndarray:
            return pose_vertices(body, matrix_from_axis_angle(pose.reshape(-1, 24, 3)), betas, transl)[0]

        now = posed(labels.smpl_pose[rows], labels.smpl_transl[rows])
        first, last = (posed(motions.smpl_pose[rows, key], motions.smpl_transl[rows, key]) for key in (0, -1))
        for row, vertices in enumerate(now, start):
            ends = first[row - start], last[row - start]
            speed = _flow(*ends, labels.intrinsics[row]) / (seconds[row] * width * options.full_speed)
            images[row] = _draw(vertices, body.faces, speed, labels.intrinsics[row], image_size)
    return Conditions((options.prompt,) * len(labels), images)


def turn(images: np.ndarray, turns: np.ndarray, options: Options) -> np.ndarray:
    """Square images [N, S, S, 3] uint8 in `turns` [N] quarter turns against the clock, the flow turned as well."""
    turned = [np.rot90(image, int(count)).copy() for image, count in zip(images, turns, strict=True)]
    for image, count in zip(turned, turns, strict=True):
        for _ in range(int(count) % 4):
            right, down = image[..., 1].copy(), image[..., 2].astype(np.int16)
            image[..., 1], image[..., 2] = down, 2 * STILL - right.astype(np.int16)
    return np.stack(turned)


def _flow(first: np.ndarray, last: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """[V, 2] px that vertices [V, 3] move in the image; 0 where one end of the way is not before the camera."""
    from ctlev_core.render.rasteriser import NEAR_M

    focal, centre = intrinsics[:2], intrinsics[2:]
    seen = (first[:, 2] > NEAR_M) & (last[:, 2] > NEAR_M)
    ends = [focal * points[seen, :2] / points[seen, 2:] + centre for points in (first, last)]
    flow = np.zeros((len(first), 2))
    flow[seen] = ends[1] - ends[0]
    return flow


def _draw(
    vertices: np.ndarray, faces: np.ndarray, speed: np.ndarray, intrinsics: np.ndarray, image_size: tuple[int, int]
) -> np.ndarray:
    """[H, W, 3] uint8 of one body; `speed` [V, 2] as a share of the full one."""
    from ctlev_core.render.rasteriser import render_attributes, vertex_normals

    vertices = np.ascontiguousarray(vertices, np.float64)
    towards_camera = -vertices / np.maximum(np.linalg.norm(vertices, axis=1, keepdims=True), 1e-9)
    facing = (vertex_normals(vertices, np.ascontiguousarray(faces, np.int32)) * towards_camera).sum(axis=1)
    red = DARKEST + (BRIGHTEST - DARKEST) * np.clip(facing, 0, 1)
    colours = np.column_stack([red, STILL + 127 * np.clip(speed, -1, 1)])
    width, height = image_size
    background = np.tile(np.array([0.0, STILL, STILL]), (height, width, 1))
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    camera = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    drawn, _ = render_attributes(vertices, faces, colours, camera, image_size, background)
    return np.rint(drawn).astype(np.uint8)
