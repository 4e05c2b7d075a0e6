"""The procedural body: a closed, symmetric surface with human measures that bends without losing its flesh."""

import numpy as np
import pytest
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ctlev_core.body import layer, procedural
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.geometry.joint_sets import JOINT_SETS, SMPL_JOINTS

BODY = layer.load_body()
MESH = trimesh.Trimesh(BODY.v_template, BODY.faces, process=False)
MIRROR_JOINT = list(JOINT_SETS["smpl"].mirror)


def partners():
    """Index of each vertex's mirror image, and how far it is from where it should be."""
    distance, index = KDTree(BODY.v_template).query(BODY.v_template * [-1, 1, 1])
    return index, distance


def dense_weights():
    dense = np.zeros((len(BODY.v_template), 24))
    np.put_along_axis(dense, BODY.weight_indices, BODY.weight_values, axis=1)
    return dense


def count_loops(axis, position):
    """Closed curves in which a plane cuts the left hand."""
    height = BODY.v_template[:, axis] - position
    wrist = BODY.joints[SMPL_JOINTS.index("left_wrist"), 0]
    crossing = (np.ptp(np.sign(height[BODY.faces]), axis=1) > 0) & (BODY.v_template[BODY.faces, 0].min(axis=1) > wrist)
    pairs = MESH.face_adjacency[crossing[MESH.face_adjacency].all(axis=1)]
    # Two faces share a curve where their common edge crosses the plane.
    edges = height[MESH.face_adjacency_edges[crossing[MESH.face_adjacency].all(axis=1)]]
    pairs = pairs[np.sign(edges[:, 0]) != np.sign(edges[:, 1])]
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), (len(BODY.faces),) * 2)
    labels = connected_components(graph, directed=False)[1]
    return len(np.unique(labels[crossing]))


def girths(axis, positions, keep):
    """Lengths of the body's outline in planes across an axis, m."""
    lengths = []
    for position in positions:
        normal = np.eye(3)[axis]
        lines = np.asarray(trimesh.intersections.mesh_plane(MESH, normal, position * normal))
        lengths.append(np.linalg.norm(lines[:, 0] - lines[:, 1], axis=1)[keep(lines.mean(axis=1))].sum())
    return np.array(lengths)


def flexed(**axis_angles_deg):
    rotations = np.tile(np.eye(3), (1, 24, 1, 1))
    for name, angles in axis_angles_deg.items():
        rotations[0, SMPL_JOINTS.index(name)] = matrix_from_axis_angle(np.deg2rad(np.array(angles, dtype=float)))
    posed, _ = layer.pose_vertices(BODY, rotations, np.zeros(10), np.zeros((1, 3)))
    return trimesh.Trimesh(posed[0], BODY.faces, process=False)


def test_it_is_one_closed_surface_without_handles():
    assert MESH.is_watertight and MESH.is_winding_consistent and MESH.body_count == 1 and MESH.euler_number == 2
    assert 5_000 <= len(BODY.v_template) <= 8_000
    angles = np.rad2deg(trimesh.triangles.angles(MESH.triangles))
    assert angles.min() > 5 and np.percentile(angles.min(axis=1), 1) > 20
    # No triangle is folded over its neighbours.
    assert np.sum(MESH.face_normals[:, None] * BODY.normals[BODY.faces], axis=2).min() > -0.2


def test_left_and_right_are_mirror_images():
    index, distance = partners()
    # Stored in float32, mirrored before it: not one bit apart.
    assert distance.max() == 0
    np.testing.assert_array_equal(index[index], np.arange(len(index)))
    weights = dense_weights()
    np.testing.assert_allclose(weights[index][:, MIRROR_JOINT], weights, atol=1e-7)
    np.testing.assert_allclose(BODY.shapedirs[index] * np.array([-1, 1, 1])[:, None], BODY.shapedirs, atol=1e-7)
    np.testing.assert_allclose(BODY.j_regressor[MIRROR_JOINT][:, index], BODY.j_regressor, atol=1e-7)


def test_measures_are_those_of_an_adult():
    # Ranges: roughly what surveys of adults find between the slight and the stout.
    assert 1.72 < MESH.extents[1] < 1.77
    assert 0.065 < MESH.volume < 0.085
    left = BODY.v_template[BODY.v_template[:, 0] > 0]
    foot = left[left[:, 1] < -1.10]
    assert 0.24 < np.ptp(foot[:, 2]) < 0.28 and 0.085 < np.ptp(foot[:, 0]) < 0.115
    hand = left[left[:, 0] > BODY.joints[SMPL_JOINTS.index("left_wrist"), 0]]
    assert 0.17 < np.ptp(hand[:, 0]) < 0.21
    chin_m = 0.34
    assert 7 < MESH.extents[1] / (left[:, 1].max() - chin_m) < 8
    waist, chest, hips = girths(1, [-0.08, 0.10, -0.27], lambda middle: np.abs(middle[:, 0]) < 0.22)
    assert 0.65 < waist < 0.90 and waist < chest < 1.10 and waist < hips < 1.10
    neck, ankle, calf, thigh = girths(1, [0.33, -1.03, -0.85, -0.45], lambda middle: middle[:, 0] > 0)
    assert 0.17 < neck < 0.21  # its left half
    assert 0.19 < ankle < 0.25 < 0.32 < calf < 0.40 < 0.48 < thigh < 0.62


def test_a_hand_has_four_fingers_and_a_thumb():
    assert count_loops(0, 0.83) == 4
    # Across the palm and the thumb, then across the thumb alone.
    assert count_loops(0, 0.77) == 2
    assert count_loops(2, 0.015) == 1


@pytest.mark.parametrize(
    ("limb", "axis", "start", "end", "keep"),
    [
        ("leg", 1, -1.02, -0.45, lambda middle: middle[:, 0] > 0),
        ("arm", 0, 0.25, 0.63, lambda middle: middle[:, 1] > 0.1),
        ("trunk", 1, -0.25, 0.11, lambda middle: np.abs(middle[:, 0]) < 0.25),
    ],
)
def test_limbs_swell_and_narrow_without_rings(limb, axis, start, end, keep):
    step = 0.01
    radii = girths(axis, np.arange(start, end, step), keep) / (2 * np.pi)
    curvature = np.diff(radii, 2) / step**2
    # 1 / m along the limb; a ring step of 3 mm over 3 cm has 13.
    assert np.abs(curvature).max() < 8, limb


@pytest.mark.parametrize(
    ("pose", "kept"),
    [
        ({"left_hip": (-60, 0, 0), "right_hip": (-60, 0, 0)}, 0.99),
        ({"left_hip": (-110, 0, 0), "right_hip": (-110, 0, 0)}, 0.98),
        ({"left_knee": (120, 0, 0), "right_knee": (120, 0, 0)}, 0.98),
        ({"left_elbow": (0, -120, 0), "right_elbow": (0, 120, 0)}, 0.99),
        ({"left_shoulder": (0, 0, -78), "right_shoulder": (0, 0, 78)}, 0.98),
    ],
)
def test_deep_flexion_keeps_the_volume(pose, kept):
    assert kept < flexed(**pose).volume / MESH.volume < 1.03


@pytest.mark.parametrize("direction", range(10))
@pytest.mark.parametrize("beta", [-5.0, 5.0])
def test_extreme_shapes_stay_bodies(direction, beta):
    vertices = layer.shape_vertices(BODY, beta * np.eye(10)[direction])
    mesh = trimesh.Trimesh(vertices, BODY.faces, process=False)
    assert np.isfinite(vertices).all()
    assert 0.02 < mesh.volume < 0.2
    # Inside out a face would look the other way; a dented belly may turn a few.
    turned = np.sum(mesh.face_normals * MESH.face_normals, axis=1) < 0
    assert turned.mean() < 0.005


def test_a_grid_that_loses_the_fingers_is_refused():
    pytest.importorskip("skimage")
    with pytest.raises(ValueError, match=r"voxel_m = 0.05 m: fingers touch or come off"):
        procedural.build_body(voxel_m=0.05)


@pytest.mark.slow
def test_the_finer_mesh_has_the_same_shape():
    pytest.importorskip("skimage")
    fine = procedural.build_body(voxel_m=0.018)
    assert len(fine.v_template) > 1.5 * len(BODY.v_template)
    mesh = trimesh.Trimesh(fine.v_template, fine.faces, process=False)
    assert mesh.is_watertight and mesh.euler_number == 2
    assert abs(mesh.volume / MESH.volume - 1) < 0.02
    distance, _ = KDTree(fine.v_template).query(BODY.v_template)
    assert distance.max() < 0.02
