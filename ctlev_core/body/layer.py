"""Linear blend skinning of any body with SMPL's interface: 24 joints, 10 shape directions.

World frame: metres, y up, the rest pose (a T) faces +z, the person's left is +x. Pose-dependent corrective shapes are
applied where the body has them; the bundled one has none. `ctlev_core.body.torch_layer` is the same with gradients.

Source: Loper et al., SMPL, ACM TOG 2015, eq. 2-10.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from ctlev_core.body.skinning import abreast, chain_bones, skin, skin_frames
from ctlev_core.body.smpl_files import read_smpl_file
from ctlev_core.geometry.joint_sets import SMPL_JOINTS, SMPL_PARENTS
from data_contracts.errors import DataError

__all__ = ["BodyModel", "joint_transforms", "load_body", "make_body", "pose_offsets", "pose_vertices", "shape_vertices"]
__all__ += ["skin"]

BUNDLED_BODY = Path(__file__).with_name("procedural_body.npz")
NUM_JOINTS = len(SMPL_JOINTS)
NUM_BETAS = 10
BONES_PER_VERTEX = 4
NUM_POSE_FEATURES = 9 * (NUM_JOINTS - 1)
FRAMES_A_MATMUL = 64
"""So many frames of corrective shapes at once: their memory stays below the last cache's."""
_FEW_PRODUCTS = 100**3
"""Up to so many multiplications OpenBLAS takes its kernels for small matrices."""


@dataclass(frozen=True, eq=False)
class BodyModel:
    """A body in its rest pose.

    Attributes:
        v_template: [V, 3] float32, m, vertices of the mean shape.
        faces: [F, 3] int32, counter-clockwise seen from outside.
        weight_indices: [V, B] int32, the joints that move each vertex, the heaviest first; B is what the vertex with
            the most joints needs, and at least 4.
        weight_values: [V, B] float32, how much; non-negative, rows sum to 1.
        shapedirs: [V, 3, 10] float32, m per unit of beta.
        j_regressor: [24, V] float32, joints from vertices; rows sum to 1.
        normals: [V, 3] float32, unit vertex normals of the mean shape.
        joints: [24, 3] float64, m, rest joints of the mean shape.
        joint_shapedirs: [24, 3, 10] float64, m per unit of beta.
        posedirs: [207, 3 V] float32, m per entry of R - 1 of joints 1 to 23, row by row; None: no such correctives.
            Transposed against SMPL's files: so a matrix product with few frames is twice as fast.
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
    posedirs: np.ndarray | None = None


def make_body(
    v_template: np.ndarray,
    faces: np.ndarray,
    weights: np.ndarray,
    shapedirs: np.ndarray,
    j_regressor: np.ndarray,
    posedirs: np.ndarray | None = None,
) -> BodyModel:
    """A `BodyModel` from the arrays of an SMPL file.

    Args:
        v_template: [V, 3] m.
        faces: [F, 3].
        weights: [V, 24], non-negative; rows sum to 1 within 1 % and are normalised.
        shapedirs: [V, 3, B], B >= 10; the first ten are used.
        j_regressor: [24, V].
        posedirs: [V, 3, 207], or None.
    Raises:
        DataError: shapes disagree, a face names a vertex that does not exist, a value is not finite, or the weights of
            a vertex are negative or do not sum to 1.
    """
    count = len(v_template)
    expected = {
        "v_template": (v_template, (count, 3)),
        "f": (faces, (len(faces), 3)),
        "weights": (weights, (count, NUM_JOINTS)),
        "shapedirs": (shapedirs[..., :NUM_BETAS], (count, 3, NUM_BETAS)),
        "J_regressor": (j_regressor, (NUM_JOINTS, count)),
    }
    if posedirs is not None:
        expected["posedirs"] = (posedirs, (count, 3, NUM_POSE_FEATURES))
    for name, (array, shape) in expected.items():
        if array.shape != shape:
            raise DataError(f"body model: {name} must have the shape {shape}, got {array.shape}")
        if not np.isfinite(array).all():
            raise DataError(f"body model: {name} holds values that are not finite")
    if len(faces) and (faces.min() < 0 or faces.max() >= count):
        raise DataError(f"body model: faces must name vertices 0 .. {count - 1}, got {faces.min()} .. {faces.max()}")
    indices, values = _heaviest(weights.astype(np.float64))
    vertices, directions = v_template.astype(np.float64), shapedirs[..., :NUM_BETAS].astype(np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    return BodyModel(
        v_template=vertices.astype(np.float32),
        faces=faces,
        weight_indices=indices.astype(np.int32),
        weight_values=values.astype(np.float32),
        shapedirs=directions.astype(np.float32),
        j_regressor=j_regressor.astype(np.float32),
        normals=_rest_normals(vertices, faces).astype(np.float32),
        joints=j_regressor.astype(np.float64) @ vertices,
        joint_shapedirs=np.einsum("jv,vcb->jcb", j_regressor.astype(np.float64), directions, optimize=True),
        posedirs=None if posedirs is None else np.ascontiguousarray(_rows_first(posedirs), dtype=np.float32),
    )


def _heaviest(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints and weights of each vertex, [V, B] each, the heaviest first; no joint is dropped."""
    sums = weights.sum(axis=1, keepdims=True)
    wrong = (weights.min(axis=1) < 0) | (np.abs(sums[:, 0] - 1) > 0.01)
    if wrong.any():
        vertex = int(np.argmax(wrong))
        raise DataError(
            f"body model: weights of a vertex must be non-negative with a sum of 1; those of vertex {vertex} sum to "
            f"{sums[vertex, 0]:.4g}, the least is {weights[vertex].min():.4g}"
        )
    most = max(BONES_PER_VERTEX, int(np.count_nonzero(weights, axis=1).max(initial=0)))
    indices = np.argsort(-weights, axis=1, kind="stable")[:, :most]
    return indices, np.take_along_axis(weights, indices, axis=1) / sums


@lru_cache(maxsize=4)
def load_body(path: Path | None = None) -> BodyModel:
    """Load a body from an SMPL file, .pkl or .npz (`smpl_files`); the bundled procedural body without a path.

    Raises:
        DataError: the file is missing, is no body model, lacks an array, or its arrays do not fit together.
    """
    path = BUNDLED_BODY if path is None else Path(path)
    arrays = read_smpl_file(path)
    names = ("v_template", "f", "weights", "shapedirs", "J_regressor")
    try:
        return make_body(*(arrays[name] for name in names), posedirs=arrays.get("posedirs"))
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def shape_vertices(body: BodyModel, betas: np.ndarray) -> np.ndarray:
    """Rest vertices [..., V, 3] float32, m, of the shapes `betas` [..., 10] (eq. 8)."""
    betas = np.asarray(betas, dtype=np.float32)
    if betas.ndim == 1:
        return body.v_template + (body.shapedirs.reshape(-1, NUM_BETAS) @ betas).reshape(-1, 3)
    offsets = _blend(_rows_first(body.shapedirs), betas.reshape(-1, NUM_BETAS))
    return body.v_template + offsets.reshape(*betas.shape[:-1], -1, 3)


def pose_offsets(body: BodyModel, rotations: np.ndarray) -> np.ndarray | None:
    """Corrective shapes of poses, to add to the rest vertices before they are skinned (eq. 9).

    Args:
        body: the body.
        rotations: [T, 24, 3, 3], each joint relative to its parent.
    Returns:
        [T, V, 3] float32, m; None where the body has no correctives.
    """
    if body.posedirs is None:
        return None
    return _blend(body.posedirs, _pose_features(np.asarray(rotations)))


def joint_transforms(
    body: BodyModel, rotations: np.ndarray, betas: np.ndarray, transl: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Forward kinematics: the map of each bone from the rest pose to the world, and the joints.

    Args:
        body: the body.
        rotations: [T, 24, 3, 3], each joint relative to its parent; the root turns about the pelvis.
        betas: [10] shape, or [T, 10] one a frame.
        transl: [T, 3] m, added to everything.
    Returns:
        transforms: [T, 24, 3, 4] float64; posed = transforms[:, :, :3] @ rest + transforms[:, :, 3].
        joints: [T, 24, 3] float64, m.
    Raises:
        ValueError: shapes differ.
        DataError: a number is not finite; names the frame, and the joint of a rotation.
    """
    rotations, betas, transl = _checked(rotations, betas, transl)
    rest = body.joints + np.einsum("jcb,...b->...jc", body.joint_shapedirs, betas)
    transforms, joints = np.empty((len(rotations), NUM_JOINTS, 3, 4)), np.empty((len(rotations), NUM_JOINTS, 3))
    rest = np.ascontiguousarray(rest.reshape(-1, NUM_JOINTS, 3))
    chain_bones(rotations, rest, transl, np.array(SMPL_PARENTS), transforms, joints)
    return transforms, joints


def pose_vertices(
    body: BodyModel, rotations: np.ndarray, betas: np.ndarray, transl: np.ndarray, out: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Posed vertices and joints of a batch of frames.

    Args:
        body: the body.
        rotations: [T, 24, 3, 3], each joint relative to its parent; the root turns about the pelvis.
        betas: [10] shape, or [T, 10] one a frame.
        transl: [T, 3] m, added to everything.
        out: [T, V, 3] float32, contiguous, to write the vertices to; new memory when None.
    Returns:
        vertices: [T, V, 3] float32, m, `out` itself where given.
        joints: [T, 24, 3] float64, m.
    Raises:
        ValueError: shapes differ.
        DataError: a number is not finite; names the frame, and the joint of a rotation.
    """
    transforms, joints = joint_transforms(body, rotations, betas, transl)
    rotations, betas = np.asarray(rotations), np.asarray(betas, dtype=np.float32)
    shape = (len(transforms), *body.v_template.shape)
    posed = np.empty(shape, np.float32) if out is None else out
    if posed.shape != shape or posed.dtype != np.float32 or not posed.flags.c_contiguous:
        raise ValueError(f"out must be {shape} float32 and contiguous, got {posed.shape} {posed.dtype}")
    rest = shape_vertices(body, betas) if betas.ndim == 1 else body.v_template
    has_offsets = body.posedirs is not None or betas.ndim == 2
    for start in range(0, len(posed), FRAMES_A_MATMUL):
        rows = slice(start, start + FRAMES_A_MATMUL)
        if has_offsets:
            _write_offsets(body, rotations[rows], betas[rows] if betas.ndim == 2 else None, posed[rows])
        moves = abreast(transforms[rows])
        skin_frames(rest, body.weight_indices, body.weight_values, moves, has_offsets, posed[rows])
    return posed, joints


def _checked(rotations: np.ndarray, betas: np.ndarray, transl: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rotations = np.ascontiguousarray(rotations, dtype=np.float64)
    betas, transl = np.asarray(betas, dtype=np.float64), np.ascontiguousarray(transl, dtype=np.float64)
    if rotations.ndim != 4 or rotations.shape[1:] != (NUM_JOINTS, 3, 3):
        raise ValueError(f"rotations must be [T, {NUM_JOINTS}, 3, 3], got {rotations.shape}")
    count = len(rotations)
    if betas.shape not in ((NUM_BETAS,), (count, NUM_BETAS)):
        raise ValueError(f"betas must be [{NUM_BETAS}] or [{count}, {NUM_BETAS}], got {betas.shape}")
    if transl.shape != (count, 3):
        raise ValueError(f"transl must be [{count}, 3], got {transl.shape}")
    if not np.isfinite(rotations).all():
        frame, joint = np.argwhere(~np.isfinite(rotations).all(axis=(2, 3)))[0]
        raise DataError(f"rotations of frame {frame}, joint {SMPL_JOINTS[joint]} are not finite")
    for name, array in (("betas", betas), ("transl", transl)):
        if not np.isfinite(array).all():
            where = f" of frame {np.argmax(~np.isfinite(array).all(axis=1))}" if array.ndim == 2 else ""
            raise DataError(f"{name}{where} are not finite")
    return rotations, betas, transl


def _pose_features(rotations: np.ndarray) -> np.ndarray:
    return (rotations[:, 1:] - np.eye(3)).reshape(len(rotations), NUM_POSE_FEATURES).astype(np.float32)


def _rows_first(directions: np.ndarray) -> np.ndarray:
    """Blend shapes [V, 3, K] as a view [K, 3 V]."""
    return directions.reshape(-1, directions.shape[2]).T


def _blend(directions: np.ndarray, features: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Blend shapes [K, 3 V] by features [T, K] as one matrix product: [T, V, 3] float32."""
    out = np.empty((len(features), directions.shape[1] // 3, 3), np.float32) if out is None else out
    # Every batch shall give the same bits, and BLAS has other routines, with other rounding, for few products.
    least = min(FRAMES_A_MATMUL, max(2, _FEW_PRODUCTS // directions.size + 1))
    if len(features) >= least:
        np.matmul(features, directions, out=out.reshape(len(features), -1))
    else:
        padded = np.zeros((least, features.shape[1]), np.float32)
        padded[: len(features)] = features
        out[:] = (padded @ directions)[: len(features)].reshape(out.shape)
    return out


def _write_offsets(body: BodyModel, rotations: np.ndarray, betas: np.ndarray | None, posed: np.ndarray) -> None:
    """What pose, and shape where each frame has its own, add to the rest vertices, into `posed`."""
    if body.posedirs is not None:
        _blend(body.posedirs, _pose_features(rotations), posed)
    if betas is not None and body.posedirs is not None:
        posed += _blend(_rows_first(body.shapedirs), betas)
    elif betas is not None:
        _blend(_rows_first(body.shapedirs), betas, posed)


def _rest_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], face_normals)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
