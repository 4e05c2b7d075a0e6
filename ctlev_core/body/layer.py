"""Linear blend skinning of any body with SMPL's interface: 24 joints, 10 shape directions.

World frame: metres, y up, the rest pose (a T) faces +z, the person's left is +x. Pose-dependent corrective shapes are
not applied.

Source: Loper et al., SMPL, ACM TOG 2015, eq. 2-10 without B_P.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numba
import numpy as np

from ctlev_core.skeletons import SMPL_JOINTS, SMPL_PARENTS
from data_contracts.errors import DataError

BUNDLED_BODY = Path(__file__).with_name("procedural_body.npz")
NUM_JOINTS = len(SMPL_JOINTS)
NUM_BETAS = 10
BONES_PER_VERTEX = 4


@dataclass(frozen=True, eq=False)
class BodyModel:
    """A body in its rest pose.

    Attributes:
        v_template: [V, 3] float32, m, vertices of the mean shape.
        faces: [F, 3] int32, counter-clockwise seen from outside.
        weight_indices: [V, 4] int32, the joints that move each vertex.
        weight_values: [V, 4] float32, how much; non-negative, rows sum to 1.
        shapedirs: [V, 3, 10] float32, m per unit of beta.
        j_regressor: [24, V] float32, joints from vertices; rows sum to 1.
        normals: [V, 3] float32, unit vertex normals of the mean shape.
        joints: [24, 3] float64, m, rest joints of the mean shape.
        joint_shapedirs: [24, 3, 10] float64, m per unit of beta.
    """

    v_template: np.ndarray
    faces: np.ndarray
    weight_indices: np.ndarray
    weight_values: np.ndarray
    shapedirs: np.ndarray
    j_regressor: np.ndarray
    normals: np.ndarray
    joints: np.ndarray
    joint_shapedirs: np.ndarray


def make_body(
    v_template: np.ndarray, faces: np.ndarray, weights: np.ndarray, shapedirs: np.ndarray, j_regressor: np.ndarray
) -> BodyModel:
    """A `BodyModel` from the arrays of an SMPL file.

    Args:
        v_template: [V, 3] m.
        faces: [F, 3].
        weights: [V, 24]; the four largest of each row are kept and normalised.
        shapedirs: [V, 3, B], B >= 10; the first ten are used.
        j_regressor: [24, V].
    Raises:
        DataError: shapes disagree, a face names a vertex that does not exist, or a value is not finite.
    """
    count = len(v_template)
    expected = {
        "v_template": (v_template, (count, 3)),
        "f": (faces, (len(faces), 3)),
        "weights": (weights, (count, NUM_JOINTS)),
        "shapedirs": (shapedirs[..., :NUM_BETAS], (count, 3, NUM_BETAS)),
        "J_regressor": (j_regressor, (NUM_JOINTS, count)),
    }
    for name, (array, shape) in expected.items():
        if array.shape != shape:
            raise DataError(f"body model: {name} must have the shape {shape}, got {array.shape}")
        if not np.isfinite(array).all():
            raise DataError(f"body model: {name} holds values that are not finite")
    if len(faces) and (faces.min() < 0 or faces.max() >= count):
        raise DataError(f"body model: faces must name vertices 0 .. {count - 1}, got {faces.min()} .. {faces.max()}")
    indices = np.argsort(-weights, axis=1, kind="stable")[:, :BONES_PER_VERTEX]
    values = np.take_along_axis(weights.astype(np.float64), indices, axis=1)
    vertices, directions = v_template.astype(np.float64), shapedirs[..., :NUM_BETAS].astype(np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    return BodyModel(
        v_template=vertices.astype(np.float32),
        faces=faces,
        weight_indices=indices.astype(np.int32),
        weight_values=(values / values.sum(axis=1, keepdims=True)).astype(np.float32),
        shapedirs=directions.astype(np.float32),
        j_regressor=j_regressor.astype(np.float32),
        normals=_rest_normals(vertices, faces).astype(np.float32),
        joints=j_regressor.astype(np.float64) @ vertices,
        joint_shapedirs=np.einsum("jv,vcb->jcb", j_regressor.astype(np.float64), directions, optimize=True),
    )


@lru_cache(maxsize=4)
def load_body(path: Path | None = None) -> BodyModel:
    """Load a body from an .npz with SMPL's key names; the bundled procedural body without a path.

    Raises:
        DataError: the file is missing, is no .npz, lacks a key, or its arrays do not fit together.
    """
    path = BUNDLED_BODY if path is None else Path(path)
    keys = ("v_template", "f", "weights", "shapedirs", "J_regressor")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            missing = [key for key in keys if key not in arrays]
            if missing:
                raise DataError(f"{path}: body model lacks {', '.join(missing)}; found {', '.join(arrays.files)}")
            return make_body(*(arrays[key] for key in keys))
    except (OSError, zipfile.BadZipFile, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path}: cannot be read as a body model (.npz without pickled objects): {error}") from error


def shape_vertices(body: BodyModel, betas: np.ndarray) -> np.ndarray:
    """Rest vertices [V, 3] float32, m, of the shape `betas` [10]."""
    return body.v_template + body.shapedirs @ np.asarray(betas, dtype=np.float32)


def joint_transforms(
    body: BodyModel, rotations: np.ndarray, betas: np.ndarray, transl: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Forward kinematics: the map of each bone from the rest pose to the world, and the joints.

    Args:
        body: the body.
        rotations: [T, 24, 3, 3], each joint relative to its parent; the root turns about the pelvis.
        betas: [10] shape.
        transl: [T, 3] m, added to everything.
    Returns:
        transforms: [T, 24, 3, 4] float64; posed = transforms[:, :, :3] @ rest + transforms[:, :, 3].
        joints: [T, 24, 3] float64, m.
    Raises:
        ValueError: shapes differ.
    """
    rotations, transl = np.asarray(rotations, dtype=np.float64), np.asarray(transl, dtype=np.float64)
    if rotations.ndim != 4 or rotations.shape[1:] != (NUM_JOINTS, 3, 3):
        raise ValueError(f"rotations must be [T, {NUM_JOINTS}, 3, 3], got {rotations.shape}")
    if transl.shape != (len(rotations), 3):
        raise ValueError(f"transl must be [{len(rotations)}, 3], got {transl.shape}")
    rest = body.joints + body.joint_shapedirs @ np.asarray(betas, dtype=np.float64)
    orientation = np.empty_like(rotations)
    joints = np.empty((len(rotations), NUM_JOINTS, 3))
    for joint, parent in enumerate(SMPL_PARENTS):
        if parent < 0:
            orientation[:, joint] = rotations[:, joint]
            joints[:, joint] = rest[joint] + transl
        else:
            orientation[:, joint] = orientation[:, parent] @ rotations[:, joint]
            joints[:, joint] = orientation[:, parent] @ (rest[joint] - rest[parent]) + joints[:, parent]
    offset = joints - np.einsum("tjab,jb->tja", orientation, rest)
    return np.concatenate([orientation, offset[..., None]], axis=-1), joints


def pose_vertices(
    body: BodyModel, rotations: np.ndarray, betas: np.ndarray, transl: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Posed vertices [T, V, 3] float32 and joints [T, 24, 3] float64, m; arguments as for `joint_transforms`."""
    transforms, joints = joint_transforms(body, rotations, betas, transl)
    rest = shape_vertices(body, betas)
    posed = np.empty((len(transforms), *rest.shape), dtype=np.float32)
    # The kernel moves normals along; here nobody asks for them.
    normals = np.empty_like(rest)
    for frame, moves in enumerate(transforms.astype(np.float32)):
        skin(rest, body.normals, body.weight_indices, body.weight_values, moves, posed[frame], normals)
    return posed, joints


@numba.njit(cache=True, nogil=True)
def skin(vertices, normals, weight_indices, weight_values, transforms, posed, posed_normals):
    """Linear blend skinning of one frame, into `posed` and `posed_normals`, all [V, 3].

    Normals turn with the blended matrix and are left unnormalised: exact for a rigid bone, within a few degrees at a
    bent joint, and a third of the cost of normals from the posed faces.
    """
    for i in range(vertices.shape[0]):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for row in range(3):
            a = b = c = d = vertices.dtype.type(0.0)
            for k in range(weight_indices.shape[1]):
                weight, bone = weight_values[i, k], weight_indices[i, k]
                a += weight * transforms[bone, row, 0]
                b += weight * transforms[bone, row, 1]
                c += weight * transforms[bone, row, 2]
                d += weight * transforms[bone, row, 3]
            posed[i, row] = a * x + b * y + c * z + d
            posed_normals[i, row] = a * nx + b * ny + c * nz


def _rest_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], face_normals)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
