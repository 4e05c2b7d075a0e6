"""The bundled body: round cones -> smooth union -> marching cubes -> skin weights, shape directions, joint regressor.

It has SMPL's interface and none of its data. `python -m ctlev_core.body.procedural` writes `procedural_body.npz` anew.

Source: round cones and smooth union after Inigo Quilez; diffusion weights after Baran and Popovic, Pinocchio,
SIGGRAPH 2007, with the mesh Laplacian; joint positions are those of an average adult.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctlev_core.body.layer import BONES_PER_VERTEX, BUNDLED_BODY, NUM_BETAS, NUM_JOINTS, BodyModel, make_body
from ctlev_core.skeletons import SMPL_JOINTS, SMPL_PARENTS

INDEX = {name: joint for joint, name in enumerate(SMPL_JOINTS)}
LEG_JOINTS = ("hip", "knee", "ankle", "foot")

# Rest joints, m; the right side mirrors the left.
MIDDLE_JOINTS = {
    "pelvis": (0, -0.223, 0.025),
    "spine1": (0, -0.114, 0.0),
    "spine2": (0, 0.021, 0.0),
    "spine3": (0, 0.074, 0.022),
    "neck": (0, 0.288, -0.015),
    "head": (0, 0.353, 0.035),
}
LEFT_JOINTS = {
    "hip": (0.069, -0.314, 0.022),
    "knee": (0.104, -0.693, 0.016),
    "ankle": (0.090, -1.091, -0.027),
    "foot": (0.116, -1.143, 0.094),
    "collar": (0.080, 0.194, -0.008),
    "shoulder": (0.174, 0.226, -0.017),
    "elbow": (0.431, 0.213, -0.042),
    "wrist": (0.683, 0.221, -0.045),
    "hand": (0.767, 0.214, -0.058),
}

ROUND = (1.0, 1.0, 1.0)
# (owner, start joint, offset, end joint, offset, radius at start, radius at end, stretch of the axes), m
MIDDLE_CONES = (
    ("pelvis", "pelvis", (-0.062, -0.055, -0.020), "pelvis", (0.062, -0.055, -0.020), 0.118, 0.118, (1, 1.05, 1.02)),
    ("spine1", "spine1", (-0.048, 0.0, 0.006), "spine1", (0.048, 0.0, 0.006), 0.108, 0.108, (1, 1.35, 1.02)),
    ("spine2", "spine2", (-0.054, 0.020, 0.002), "spine2", (0.054, 0.020, 0.002), 0.107, 0.107, (1, 1.5, 1)),
    ("spine3", "spine3", (-0.075, 0.085, -0.018), "spine3", (0.075, 0.085, -0.018), 0.105, 0.105, ROUND),
    ("neck", "neck", (0, -0.060, -0.002), "neck", (0, 0.070, 0.020), 0.060, 0.053, ROUND),
    ("head", "head", (0, 0.115, 0.008), "head", (0, 0.135, -0.012), 0.092, 0.094, (0.86, 1.12, 1.05)),  # skull
    ("head", "head", (0, 0.035, 0.045), "head", (0, 0.070, 0.050), 0.052, 0.060, (0.92, 1, 1)),  # jaw
    ("head", "head", (0, 0.072, 0.115), "head", (0, 0.055, 0.122), 0.010, 0.014, ROUND),  # nose
)
LEFT_CONES = (
    ("spine3", "spine3", (0.075, 0.045, 0.058), "spine3", (0.050, 0.055, 0.055), 0.062, 0.062, ROUND),  # chest
    ("pelvis", "pelvis", (0.062, -0.090, -0.075), "hip", (0, -0.050, -0.055), 0.085, 0.078, ROUND),  # gluteus
    ("collar", "collar", (-0.030, 0.050, -0.010), "shoulder", (-0.005, 0.005, 0), 0.056, 0.060, ROUND),
    ("shoulder", "shoulder", (0.010, -0.004, 0), "elbow", (0, 0, 0), 0.060, 0.041, ROUND),
    ("shoulder", "shoulder", (0.070, 0, 0.008), "elbow", (-0.090, 0, 0.012), 0.049, 0.042, ROUND),  # biceps
    ("elbow", "elbow", (0.020, 0, 0), "elbow", (0.080, 0, 0), 0.040, 0.043, ROUND),
    ("elbow", "elbow", (0.080, 0, 0), "wrist", (0, 0, 0), 0.043, 0.027, ROUND),
    ("wrist", "wrist", (0, 0, 0), "hand", (-0.010, 0, 0.010), 0.028, 0.034, (1, 0.62, 1.15)),
    ("hand", "hand", (0.010, 0, 0.012), "hand", (0.085, -0.008, 0.012), 0.030, 0.016, (1, 0.62, 1.6)),
    ("wrist", "wrist", (0.030, -0.005, 0.020), "hand", (0, -0.012, 0.066), 0.016, 0.012, ROUND),  # thumb
    ("hip", "hip", (0.018, -0.020, -0.008), "knee", (-0.002, 0.030, 0), 0.093, 0.056, ROUND),
    ("hip", "hip", (0.020, -0.080, 0.020), "knee", (0, 0.120, 0.012), 0.076, 0.056, ROUND),  # quadriceps
    ("knee", "knee", (0, 0, 0.003), "ankle", (0, 0.020, 0), 0.053, 0.036, ROUND),
    ("knee", "knee", (0.004, -0.070, -0.022), "knee", (0, -0.190, -0.030), 0.050, 0.044, ROUND),  # calf
    ("ankle", "ankle", (0, -0.010, -0.018), "ankle", (0, -0.045, -0.030), 0.040, 0.036, ROUND),  # heel
    ("ankle", "ankle", (0, -0.020, 0.010), "foot", (-0.005, 0.012, -0.010), 0.040, 0.032, (1.05, 1, 1)),
    ("foot", "foot", (-0.008, 0.004, -0.010), "foot", (0.005, -0.006, 0.070), 0.036, 0.022, (1.35, 0.9, 1)),
)

BLEND_M = 0.012
SIDE_BLEND_M = 0.006
"""Between the two legs the union is sharper, so that the thighs do not grow together."""
WEIGHT_DIFFUSION = 2.2
"""Width of the soft border between two bones, in squared mesh edges."""
SHAPE_NAMES = ("height", "legs", "arms", "torso", "shoulders", "hips", "girth", "limb_girth", "belly", "head")


@dataclass(frozen=True, eq=False)
class RoundCone:
    """A cone with spherical ends, squeezed along the axes; `limb` is 0 above the legs, 1 left leg, 2 right leg."""

    owner: int
    start: np.ndarray
    end: np.ndarray
    radius_start: float
    radius_end: float
    stretch: np.ndarray
    limb: int


def rest_joints() -> np.ndarray:
    """Rest joints [24, 3] float64, m."""
    joints = np.zeros((NUM_JOINTS, 3))
    for name, position in MIDDLE_JOINTS.items():
        joints[INDEX[name]] = position
    for name, position in LEFT_JOINTS.items():
        joints[INDEX[f"left_{name}"]] = position
        joints[INDEX[f"right_{name}"]] = np.multiply(position, (-1, 1, 1))
    return joints


def round_cones() -> list[RoundCone]:
    """All cones of both sides."""
    joints = rest_joints()

    def cone(row: tuple, side: str) -> RoundCone:
        owner, start, start_offset, end, end_offset, radius_start, radius_end, stretch = row
        flip = np.array([-1.0 if side == "right_" else 1.0, 1.0, 1.0])

        def joint(name: str) -> int:
            return INDEX[name if name in INDEX else side + name]

        limb = 0 if owner not in LEG_JOINTS else 1 if side == "left_" else 2
        ends = joints[joint(start)] + flip * start_offset, joints[joint(end)] + flip * end_offset
        return RoundCone(joint(owner), *ends, radius_start, radius_end, np.array(stretch, dtype=np.float64), limb)

    cones = [cone(row, "") for row in MIDDLE_CONES]
    return cones + [cone(row, side) for side in ("left_", "right_") for row in LEFT_CONES]


def cone_distances(points: np.ndarray, cones: list[RoundCone]) -> np.ndarray:
    """Approximate signed distance [len(cones), N], m, of points [N, 3] to each cone; negative inside."""
    distances = np.empty((len(cones), len(points)))
    for row, cone in enumerate(cones):
        middle = (cone.start + cone.end) / 2
        start, axis = (cone.start - middle) / cone.stretch, (cone.end - cone.start) / cone.stretch
        local = (points - middle) / cone.stretch - start
        along = np.clip(local @ axis / (axis @ axis), 0.0, 1.0)
        radius = cone.radius_start + (cone.radius_end - cone.radius_start) * along
        distances[row] = (np.linalg.norm(local - along[:, None] * axis, axis=1) - radius) * np.sqrt(cone.stretch.min())
    return distances


def body_distance(points: np.ndarray, cones: list[RoundCone]) -> np.ndarray:
    """Signed distance [N], m, to the smooth union; each leg joins the trunk apart from the other leg."""
    distances = cone_distances(points, cones)
    limbs = np.array([cone.limb for cone in cones])
    trunk, left, right = (_smooth_union(distances[limbs == limb], BLEND_M) for limb in range(3))
    sides = [_smooth_union(np.stack([trunk, leg]), BLEND_M) for leg in (left, right)]
    return _smooth_union(np.stack(sides), SIDE_BLEND_M)


def _smooth_union(distances: np.ndarray, blend_m: float) -> np.ndarray:
    return -blend_m * np.logaddexp.reduce(-distances / blend_m, axis=0)


def _gradient(points: np.ndarray, cones: list[RoundCone], step_m: float = 1e-4) -> np.ndarray:
    steps = step_m * np.eye(3)
    return np.stack(
        [(body_distance(points + d, cones) - body_distance(points - d, cones)) / (2 * step_m) for d in steps], axis=1
    )


def _extract_surface(cones: list[RoundCone], voxel_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3] of the zero level, counter-clockwise from outside."""
    from skimage.measure import marching_cubes

    low, high = np.array([-0.95, -1.24, -0.22]), np.array([0.95, 0.66, 0.30])
    axes = [np.arange(a, b + voxel_m, voxel_m) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    blocks = np.array_split(grid, 16)
    field = np.concatenate([body_distance(block, cones) for block in blocks]).reshape([len(axis) for axis in axes])
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(voxel_m,) * 3)
    vertices, faces = vertices + low, faces.astype(np.int64)
    corners = vertices[faces]
    volume = np.einsum("fa,fa->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return vertices, faces if volume > 0 else faces[:, ::-1].copy()


def _neighbours(faces: np.ndarray, count: int):
    """Symmetric 0/1 adjacency [V, V] of the mesh, sparse."""
    import scipy.sparse as sparse

    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    matrix = sparse.coo_matrix((np.ones(len(edges)), edges.T), (count, count)).tocsr()
    return ((matrix + matrix.T) > 0).astype(np.float64)


def _relax(vertices: np.ndarray, adjacency, cones: list[RoundCone], rounds: int = 8) -> np.ndarray:
    """Even out the triangles along the surface, then project back onto it (one Newton step a round)."""
    degree = np.asarray(adjacency.sum(axis=1))
    for _ in range(rounds):
        gradient = _gradient(vertices, cones)
        length = np.linalg.norm(gradient, axis=1, keepdims=True)
        normals = gradient / length
        move = adjacency @ vertices / degree - vertices
        vertices = vertices + 0.5 * (move - np.sum(move * normals, axis=1, keepdims=True) * normals)
        distance = body_distance(vertices, cones)[:, None] / length
        vertices = vertices - np.clip(distance, -0.01, 0.01) * normals
    return vertices


def _skin_weights(vertices: np.ndarray, adjacency, cones: list[RoundCone]) -> np.ndarray:
    """[V, 24]: the owner of the nearest cone, diffused over the mesh.

    (I + c L) w = onehot has an M-matrix, so weights cannot turn negative and rows sum to 1.
    """
    import scipy.sparse as sparse
    from scipy.sparse.linalg import splu

    count = len(vertices)
    owners = np.array([cone.owner for cone in cones])[cone_distances(vertices, cones).argmin(axis=0)]
    onehot = np.zeros((count, NUM_JOINTS))
    onehot[np.arange(count), owners] = 1.0
    laplacian = sparse.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency
    weights = splu((sparse.eye(count) + WEIGHT_DIFFUSION * laplacian).tocsc()).solve(onehot)
    smallest = np.argsort(weights, axis=1)[:, :-BONES_PER_VERTEX]
    np.put_along_axis(weights, smallest, 0.0, axis=1)
    return weights / weights.sum(axis=1, keepdims=True)


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
        thicken[0], thicken[6] = 0.04, 0.06
        thicken[7] = 0.07 if name.startswith(("left_", "right_")) and not name.endswith("collar") else 0.0
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


def build_arrays(voxel_m: float = 0.02) -> dict[str, np.ndarray]:
    """The body as arrays under SMPL's key names, float64; see `make_body`."""
    cones, joints = round_cones(), rest_joints()
    vertices, faces = _extract_surface(cones, voxel_m)
    adjacency = _neighbours(faces, len(vertices))
    vertices = _relax(vertices, adjacency, cones)
    weights = _skin_weights(vertices, adjacency, cones)
    joint_shapedirs = _joint_shapedirs(joints)
    shapedirs = _shapedirs(vertices, weights, joints, joint_shapedirs)
    regressor = _joint_regressor(vertices, shapedirs, joints, joint_shapedirs)
    return {
        "v_template": vertices,
        "f": faces,
        "weights": weights,
        "shapedirs": shapedirs,
        "J_regressor": regressor,
        "kintree_table": np.stack([SMPL_PARENTS, np.arange(NUM_JOINTS)]),
    }


def build_body(voxel_m: float = 0.02) -> BodyModel:
    """Build the procedural body from nothing; needs scikit-image (in the `test` extra).

    Args:
        voxel_m: edge of the marching-cubes grid; 0.02 gives about 6,800 vertices.
    Raises:
        ValueError: the grid is too coarse to hold the fingers, or would need gigabytes.
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
