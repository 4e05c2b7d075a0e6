"""Distances between the vertices of predicted and labelled bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.geometry.joint_sets import SMPL_JOINTS
from ctlev_core.geometry.procrustes import RELATIVE_SIZE
from ctlev_core.scoring.pose import Alignment
from data_contracts.labels import Labels

_ROWS_AT_ONCE = 16
"""Vertices of so many bodies stay in the cache; matrix products of fewer are slower a body."""
_PARAMETERS = {"smpl_pose": 72, "smpl_betas": 10, "smpl_transl": 3}


def compute_vertex_errors_mm(
    predicted: Mapping[str, Any], target: Labels, body_file: Path | None, alignments: Sequence[Alignment]
) -> dict[Alignment, np.ndarray]:
    """Mean distance of corresponding vertices of each row, mm, for each alignment.

    Args:
        predicted: `smpl_pose` [N, 72] rad, `smpl_betas` [N, 10] and `smpl_transl` [N, 3] m, camera frame.
        target: labels with the same parameters in the same frame.
        body_file: SMPL file of both bodies; None = the bundled body.
        alignments: none; pelvis: both are moved until the middle of their hip joints is the origin; procrustes: the
            prediction is turned, scaled and moved to fit best.
    Returns:
        [N] float64 for each alignment.
    Raises:
        ValueError: the target has no SMPL parameters, shapes differ, or a number is not finite.
        DataError: the body cannot be read.
    """
    from ctlev_core.body.layer import load_body
    from ctlev_core.geometry.procrustes_kernels import mean_distances

    body = load_body(body_file)
    both = _check("predicted", predicted, len(target)), _check("target", target.arrays, len(target))
    moved: list[Alignment] = [alignment for alignment in alignments if alignment != "procrustes"]
    errors_m = np.empty((len(target), len(moved) + 1))
    for start in range(0, len(target), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        (vertices, hips), (true, true_hips) = (_pose(body, pose[rows], betas[rows]) for pose, betas, _ in both)
        # Vertices and hips are as seen from a body at the origin: places in space come in as float64.
        shift_of = {"none": both[0][2][rows] - both[1][2][rows], "pelvis": true_hips - hips}
        shifts = np.empty((len(hips), len(moved), 3))
        for number, alignment in enumerate(moved):
            shifts[:, number] = shift_of[alignment]
        mean_distances(vertices, true, shifts, "procrustes" in alignments, RELATIVE_SIZE, errors_m[rows])
    columns = {alignment: number for number, alignment in enumerate([*moved, "procrustes"])}
    return {alignment: 1000 * errors_m[:, columns[alignment]] for alignment in alignments}


def _check(name: str, arrays: Mapping[str, Any], count: int) -> list[np.ndarray]:
    """Pose, shape and translation as float64."""
    checked = []
    for key, width in _PARAMETERS.items():
        if key not in arrays:
            raise ValueError(f"the {name} bodies have no {key}")
        array = np.asarray(arrays[key], dtype=np.float64)
        if array.shape != (count, width):
            raise ValueError(f"{name} {key} must be ({count}, {width}), got {array.shape}")
        finite = np.isfinite(array).all(axis=1)
        if not finite.all():
            raise ValueError(f"{name} {key} of row {int(np.argmin(finite))} is not finite")
        checked.append(array)
    return checked


def _pose(body: Any, pose: np.ndarray, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [N, V, 3] float32 and the middle of the hips [N, 3] float64, m, of bodies at the origin."""
    from ctlev_core.body.layer import pose_vertices
    from ctlev_core.body.rotations import matrix_from_axis_angle

    rotations = matrix_from_axis_angle(pose.reshape(-1, len(SMPL_JOINTS), 3))
    vertices, joints = pose_vertices(body, rotations, betas, np.zeros((len(pose), 3)))
    return vertices, joints[:, [SMPL_JOINTS.index("left_hip"), SMPL_JOINTS.index("right_hip")]].mean(axis=1)
