"""The bundled body: tubes and cones -> smooth union -> marching cubes -> skin weights, shape directions, regressor.

It has SMPL's interface and none of its data. `python -m ctlev_core.body.procedural` writes `procedural_body.npz` anew.
The left half is built; the right half is its mirror image, vertex by vertex.

Source: diffusion weights after Baran and Popovic, Pinocchio, SIGGRAPH 2007, with the mesh Laplacian and a width that
varies over the body; the shape itself is in `body_shape`, the distance fields in `implicit_surface`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctlev_core.body.body_shape import BORDER_M, GROIN_NORMAL, GROIN_POINT, LEFT_JOINTS, MIDDLE_JOINTS, Cone, Tube
from ctlev_core.body.implicit_surface import MIRROR, PARTS, body_distance, magnify, part_distance
from ctlev_core.body.layer import BONES_PER_VERTEX, BUNDLED_BODY, NUM_BETAS, NUM_JOINTS, BodyModel, make_body
from ctlev_core.geometry.joint_sets import JOINT_SETS, SMPL_JOINTS, SMPL_PARENTS

INDEX = {name: joint for joint, name in enumerate(SMPL_JOINTS)}
MIRROR_JOINT = list(JOINT_SETS["smpl"].mirror)
LEG_JOINTS = ("hip", "knee", "ankle", "foot")
GRID_LOW, GRID_HIGH = (0.0, -1.34, -0.37), (1.46, 0.87, 0.38)
"""Box of the left half in the space of `magnify`, m."""
SHAPE_NAMES = ("height", "legs", "arms", "torso", "shoulders", "hips", "girth", "limb_girth", "belly", "head")


@dataclass(frozen=True, eq=False)
class SymmetricMesh:
    """A mesh whose vertices come in mirrored pairs.

    Attributes:
        half: [H, 3] vertices with x >= 0, in the space of `magnify`; they are the first vertices of the mesh.
        seam: [H] bool, those on the plane x = 0, which are their own partners.
        mirror: [V] index of each vertex's partner.
        faces: [F, 3] counter-clockwise from outside.
    """

    half: np.ndarray
    seam: np.ndarray
    mirror: np.ndarray
    faces: np.ndarray

    def whole(self, half: np.ndarray) -> np.ndarray:
        """[V, 3] from points [H, 3] of the left half."""
        return np.concatenate([half, half[~self.seam] * MIRROR])


def rest_joints() -> np.ndarray:
    """Rest joints [24, 3] float64, m."""
    joints = np.zeros((NUM_JOINTS, 3))
    for name, position in MIDDLE_JOINTS.items():
        joints[INDEX[name]] = position
    for name, position in LEFT_JOINTS.items():
        joints[INDEX[f"left_{name}"]] = position
        joints[INDEX[f"right_{name}"]] = np.multiply(position, MIRROR)
    return joints


def _extract_surface(voxel_m: float) -> SymmetricMesh:
    """The zero level of the body's left half, closed by its mirror image."""
    from skimage.measure import marching_cubes

    axes = [np.arange(low, high + voxel_m, voxel_m) for low, high in zip(GRID_LOW, GRID_HIGH, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    blocks = np.array_split(grid, max(1, len(grid) // 50_000))
    field = np.concatenate([body_distance(magnify(block)) for block in blocks]).reshape([len(axis) for axis in axes])
    half, faces, _, _ = marching_cubes(field, 0.0, spacing=(voxel_m,) * 3, allow_degenerate=False)
    half, faces = half + GRID_LOW, faces.astype(np.int64)
    corners = half[faces]
    if np.einsum("fa,fa->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        faces = faces[:, ::-1]
    seam = half[:, 0] < 1e-6 * voxel_m
    partner = np.arange(len(half))
    partner[~seam] = len(half) + np.arange(np.count_nonzero(~seam))
    mirror = np.concatenate([partner, np.flatnonzero(~seam)])
    return SymmetricMesh(half, seam, mirror, np.concatenate([faces, partner[faces][:, ::-1]]))


def _neighbours(faces: np.ndarray, count: int):
    """Symmetric 0/1 adjacency [V, V] of the mesh, sparse."""
    import scipy.sparse as sparse

    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    matrix = sparse.coo_matrix((np.ones(len(edges)), edges.T), (count, count)).tocsr()
    return ((matrix + matrix.T) > 0).astype(np.float64)


def _relax(mesh: SymmetricMesh, adjacency, rounds: int = 12) -> np.ndarray:
    """Left half [H, 3] with even triangles: slide along the surface, then back onto it (a Newton step a round).

    All in the space of `magnify`, where all triangles have the same size.
    """
    count = len(mesh.half)
    degree = np.asarray(adjacency.sum(axis=1))
    half = mesh.half
    steps = 1e-4 * np.eye(3)
    for _ in range(rounds):
        whole = mesh.whole(half)
        move = (adjacency @ whole / degree - whole)[:count]
        gradient = np.stack([_field(half + step) - _field(half - step) for step in steps], axis=1) / 2e-4
        length = np.linalg.norm(gradient, axis=1, keepdims=True)
        normals = gradient / length
        half = half + 0.5 * (move - np.sum(move * normals, axis=1, keepdims=True) * normals)
        half = half - np.clip(_field(half)[:, None] / length, -0.01, 0.01) * normals
        half[mesh.seam, 0] = 0.0
    return half


def _field(points: np.ndarray) -> np.ndarray:
    """`body_distance` in the space of `magnify`, for points on either side."""
    return body_distance(magnify(np.column_stack([np.abs(points[:, 0]), points[:, 1:]])))


def _owners(half: np.ndarray) -> np.ndarray:
    """The bone [H] each vertex of the left half belongs to: that of the nearest part, and the leg below the groin."""
    distances = np.stack([part_distance(half, part) for part in PARTS])
    distances[[isinstance(part, Cone) and part.carve for part in PARTS]] = np.inf
    nearest = distances.argmin(axis=0)
    owners = np.empty(len(half), dtype=np.int64)
    for row, part in enumerate(PARTS):
        rows = np.flatnonzero(nearest == row)
        if isinstance(part, Tube):
            ends = [end for end, _ in part.owners]
            bones = np.array([_bone(name) for _, name in part.owners])
            owners[rows] = bones[np.searchsorted(ends, half[rows, part.axis])]
        else:
            owners[rows] = _bone(part.owner)
    below = (half - GROIN_POINT) @ GROIN_NORMAL > 0
    around_groin = np.isin(owners, (INDEX["pelvis"], INDEX["left_hip"]))
    return np.where(around_groin, np.where(below, INDEX["left_hip"], INDEX["pelvis"]), owners)


def _bone(name: str) -> int:
    return INDEX[name if name in INDEX else f"left_{name}"]


def _skin_weights(vertices: np.ndarray, mesh: SymmetricMesh, adjacency) -> np.ndarray:
    """[V, 24]: the owner of each vertex, diffused twice over the surface, at most four bones a vertex.

    (I + s^2 L) w = onehot with s >= 0 per vertex has an M-matrix, so weights cannot turn negative and rows sum to 1.
    """
    import scipy.sparse as sparse
    from scipy.sparse.linalg import splu

    half = len(mesh.half)
    owners = _owners(vertices[:half])
    weights = np.zeros((len(vertices), NUM_JOINTS))
    weights[np.arange(half), owners] = 1.0
    weights[mesh.mirror[:half], np.array(MIRROR_JOINT)[owners]] = 1.0
    weights /= weights.sum(axis=1, keepdims=True)
    diffusion = sparse.diags(_border_widths(vertices) ** 2) @ _laplacian(vertices, adjacency)
    solve = splu((sparse.eye(len(vertices)) + diffusion).tocsc()).solve
    weights = solve(solve(weights))
    weights = (weights + weights[mesh.mirror][:, MIRROR_JOINT]) / 2
    # Where left and right tie for the last place on the plane of symmetry, both go.
    fifth = np.sort(weights, axis=1)[:, -BONES_PER_VERTEX - 1, None]
    weights = np.where(weights > fifth * (1 + 1e-9), weights, 0.0)
    return weights / weights.sum(axis=1, keepdims=True)


def _laplacian(vertices: np.ndarray, adjacency):
    """Positive Laplacian [V, V], 1 / m^2, sparse: 2/3 sum_j (f_i - f_j) / length_ij^2, exact on an even mesh."""
    import scipy.sparse as sparse

    edges = adjacency.tocoo()
    stiffness = 2 / 3 / np.sum((vertices[edges.row] - vertices[edges.col]) ** 2, axis=1)
    matrix = sparse.coo_matrix((stiffness, (edges.row, edges.col)), adjacency.shape).tocsr()
    return sparse.diags(np.asarray(matrix.sum(axis=1)).ravel()) - matrix


def _border_widths(vertices: np.ndarray, reach_m: float = 0.05) -> np.ndarray:
    """[V], m: `BORDER_M` of the joints near each vertex, fading from joint to joint."""
    widths = np.array([BORDER_M[name.removeprefix("left_").removeprefix("right_")] for name in SMPL_JOINTS])
    squares = np.sum((vertices[:, None] - rest_joints()) ** 2, axis=2)
    closeness = np.exp(-squares / (2 * reach_m**2)) + 1e-12
    return closeness @ widths / closeness.sum(axis=1)


def _joint_shapedirs(joints: np.ndarray) -> np.ndarray:
    """[24, 3, 10], m per unit of beta: how each shape direction moves the joints."""
    stretch = {  # relative stretch of the bone that ends at the joint, per unit of beta
        0: (0.04, SMPL_JOINTS),
        1: (0.05, ("left_knee", "left_ankle", "right_knee", "right_ankle")),
        2: (0.05, tuple(f"{side}_{name}" for side in ("left", "right") for name in ("elbow", "wrist", "hand"))),
        3: (0.05, ("spine1", "spine2", "spine3", "neck")),
    }
    directions = np.zeros((NUM_JOINTS, 3, NUM_BETAS))
    for direction, (amount, names) in stretch.items():
        for joint, parent in list(enumerate(SMPL_PARENTS))[1:]:
            bone = joints[joint] - joints[parent]
            grows = amount if SMPL_JOINTS[joint] in names else 0.0
            directions[joint, :, direction] = directions[parent, :, direction] + grows * bone
    for side, sign in (("left", 1.0), ("right", -1.0)):
        directions[INDEX[f"{side}_collar"], 0, 4] = sign * 0.006
        for name in ("shoulder", "elbow", "wrist", "hand"):
            directions[INDEX[f"{side}_{name}"], 0, 4] = sign * 0.012
        for name in LEG_JOINTS:
            directions[INDEX[f"{side}_{name}"], 0, 5] = sign * 0.010
    return directions


def _shapedirs(
    vertices: np.ndarray, weights: np.ndarray, joints: np.ndarray, joint_shapedirs: np.ndarray
) -> np.ndarray:
    """[V, 3, 10]: each bone carries its vertices along, stretches them with itself and thickens them."""
    total = np.zeros((len(vertices), 3, NUM_BETAS))
    for joint, name in enumerate(SMPL_JOINTS):
        children = [child for child, parent in enumerate(SMPL_PARENTS) if parent == joint]
        local = vertices - joints[joint]
        axis, stretch = np.array([0.0, 0.12, 0.0]), np.zeros((3, NUM_BETAS))
        along = local @ axis / (axis @ axis)
        if len(children) == 1:
            axis = joints[children[0]] - joints[joint]
            along = np.clip(local @ axis / (axis @ axis), -0.3, 1.3)
            stretch = joint_shapedirs[children[0]] - joint_shapedirs[joint]
        thicken = np.zeros(NUM_BETAS)
        # Flesh grows most, feet and hands less, the skull hardly.
        fleshy = 0.2 if name in ("neck", "head") else 0.5 if name.endswith(("wrist", "hand", "ankle", "foot")) else 1.0
        thicken[0], thicken[6] = 0.04, fleshy * 0.06
        thicken[7] = fleshy * 0.07 if name.startswith(("left_", "right_")) and not name.endswith("collar") else 0.0
        radial = local - along[:, None] * axis
        move = joint_shapedirs[joint] + along[:, None, None] * stretch + radial[:, :, None] * thicken
        if name == "head":
            move[:, :, 9] += 0.05 * local
        if name in ("pelvis", "spine1", "spine2"):
            front = np.clip(vertices[:, 2] / 0.1, 0.0, 1.0)
            move[:, 2, 8] += 0.015 * np.exp(-(((vertices[:, 1] + 0.09) / 0.1) ** 2)) * front
        total += weights[:, joint, None, None] * move
    return total


def _joint_regressor(
    vertices: np.ndarray, shapedirs: np.ndarray, joints: np.ndarray, joint_shapedirs: np.ndarray, support: int = 160
) -> np.ndarray:
    """[24, V]: the smallest weights on the nearest vertices that give the joints and their shape derivatives."""
    regressor = np.zeros((NUM_JOINTS, len(vertices)))
    for joint in range(NUM_JOINTS):
        near = np.argsort(np.sum((vertices - joints[joint]) ** 2, axis=1), kind="stable")[:support]
        system = np.concatenate(
            [np.ones((1, support)), vertices[near].T, shapedirs[near].transpose(2, 1, 0).reshape(-1, support)]
        )
        wanted = np.concatenate([[1.0], joints[joint], joint_shapedirs[joint].T.ravel()])
        start = np.full(support, 1.0 / support)
        correction = np.linalg.lstsq(system, wanted - system @ start, rcond=1e-10)[0]
        regressor[joint, near] = start + correction
    return regressor


def build_arrays(voxel_m: float = 0.025) -> dict[str, np.ndarray]:
    """The body as arrays under SMPL's key names, float64; see `make_body`."""
    joints = rest_joints()
    mesh = _extract_surface(voxel_m)
    adjacency = _neighbours(mesh.faces, len(mesh.mirror))
    # Vertices - edges + faces of a sphere: a grid that just misses the gap between two fingers makes handles.
    euler_number = len(mesh.mirror) - adjacency.nnz // 2 + len(mesh.faces)
    if euler_number != 2:
        raise ValueError(f"voxel_m = {voxel_m} m: fingers touch or come off; try a finer or slightly different grid")
    vertices = mesh.whole(magnify(_relax(mesh, adjacency)))
    weights = _skin_weights(vertices, mesh, adjacency)
    joint_shapedirs = _joint_shapedirs(joints)
    shapedirs = _shapedirs(vertices, weights, joints, joint_shapedirs)
    regressor = _joint_regressor(vertices, shapedirs, joints, joint_shapedirs)
    regressor = (regressor + regressor[MIRROR_JOINT][:, mesh.mirror]) / 2
    return {
        "v_template": vertices,
        "f": mesh.faces,
        "weights": weights,
        "shapedirs": shapedirs,
        "J_regressor": regressor,
        "kintree_table": np.stack([SMPL_PARENTS, np.arange(NUM_JOINTS)]),
    }


def build_body(voxel_m: float = 0.025) -> BodyModel:
    """Build the procedural body from nothing; needs scikit-image (in the `test` extra).

    Args:
        voxel_m: edge of the marching-cubes grid; 0.025 gives about 7,600 vertices.
    Raises:
        ValueError: the grid does not hold the fingers, or would need gigabytes.
    """
    if not 0.004 <= voxel_m <= 0.05:
        raise ValueError(f"voxel_m must be between 0.004 and 0.05 m, got {voxel_m}")
    arrays = build_arrays(voxel_m)
    return make_body(*(arrays[key] for key in ("v_template", "f", "weights", "shapedirs", "J_regressor")))


def main() -> None:
    """Write the bundled body anew."""
    arrays = build_arrays()
    integer = ("f", "kintree_table")
    stored = {name: array.astype(np.int32 if name in integer else np.float32) for name, array in arrays.items()}
    np.savez_compressed(BUNDLED_BODY, **stored)  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main()
