"""Visibility of joints against rays cast through the body, and the cases with one obvious answer."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.body.layer import load_body
from ctlev_core.geometry.joint_sets import SMPL_JOINTS
from ctlev_core.render.normals import render_normals
from ctlev_core.render.visibility import SMPL_FLESH_M, joint_visibility
from data_contracts.errors import DataError

SIZE = (48, 36)
INTRINSICS = np.array([40.0, 41.0, 24.2, 17.7])
BODY = load_body()


def first_hits(origin, directions, triangles):
    """Distance along each direction [D, 3] to the first triangle [F, 3, 3], in lengths of the direction; inf = none."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    offset = origin - triangles[:, 0]
    hits = np.full(len(directions), np.inf)
    for i, direction in enumerate(directions):
        p = np.cross(direction, second)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / (first * p).sum(-1)
            u = (offset * p).sum(-1) * inverse
            q = np.cross(offset, first)
            v, t = q @ direction * inverse, (second * q).sum(-1) * inverse
            t = t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6)]
        hits[i] = t.min(initial=np.inf)
    return hits


def view_of_body(yaw_rad, distance_m):
    """Vertices and joints of the body at rest in the frame of a camera that looks at it from a side."""
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    R = np.diag([1.0, -1, -1]) @ np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    offset = np.array([0.0, -0.2, distance_m])
    return (BODY.v_template @ R.T + offset).astype(np.float32), BODY.joints @ R.T + offset


@settings(deadline=None, max_examples=12)
@given(st.floats(0, 2 * np.pi), st.floats(1.2, 4.0))
def test_against_rays_through_the_pixels_of_the_joints(yaw_rad, distance_m):
    vertices, joints = view_of_body(yaw_rad, distance_m)
    _, depth_inverse = render_normals(vertices[None], BODY.faces, INTRINSICS[None], SIZE)
    visible = joint_visibility(joints, depth_inverse[0], INTRINSICS, SMPL_FLESH_M)
    focal, centre = INTRINSICS[:2], INTRINSICS[2:]
    pixels = joints[:, :2] / joints[:, 2:] * focal + centre
    inside = ((pixels >= 0) & (pixels < SIZE)).all(axis=1)
    rays = np.column_stack([(np.floor(pixels) + 0.5 - centre) / focal, np.ones(len(joints))])
    surface = first_hits(np.zeros(3), rays, vertices[BODY.faces].astype(float))
    expected = inside & (surface >= joints[:, 2] - SMPL_FLESH_M)
    sure = np.abs(surface - joints[:, 2] + SMPL_FLESH_M) > 1e-4
    # A ray that grazes the silhouette is a matter of rounding: at most one joint.
    assert np.count_nonzero((visible != expected) & sure) <= 1


def visible_from(yaw_rad):
    vertices, joints = view_of_body(yaw_rad, 3.5)
    intrinsics = np.array([300.0, 300, 128, 128])
    _, depth_inverse = render_normals(vertices[None], BODY.faces, intrinsics[None], (256, 256))
    visible = joint_visibility(joints, depth_inverse[0], intrinsics, SMPL_FLESH_M)
    return dict(zip(SMPL_JOINTS, visible, strict=True)), dict(zip(SMPL_JOINTS, joints, strict=True))


def test_all_joints_of_a_person_from_the_front_and_one_side_of_it_from_there():
    visible, _ = visible_from(0.0)
    assert all(visible.values()), visible
    visible, joints = visible_from(-np.pi / 2)
    near, far = ("left", "right") if joints["left_wrist"][2] < joints["right_wrist"][2] else ("right", "left")
    assert visible["head"] and visible["pelvis"] and all(visible[f"{near}_{joint}"] for joint in ("hand", "knee"))
    assert not any(visible[f"{far}_{joint}"] for joint in ("shoulder", "elbow", "wrist", "hand", "knee", "ankle"))


def test_margins_are_the_thickness_of_the_body():
    """Of the trunk in three quarters of the directions, of limbs in nine of ten; a nicer body changes it."""
    turns = np.arange(100) + 0.5
    polar, azimuth = np.arccos(1 - 2 * turns / 100), np.pi * (1 + 5**0.5) * turns
    directions = np.column_stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)])
    triangles = BODY.v_template[BODY.faces].astype(float)
    limbs = ("knee", "ankle", "foot", "elbow", "wrist", "hand")
    for joint, margin, name in zip(BODY.joints, SMPL_FLESH_M, SMPL_JOINTS, strict=True):
        thickness = np.percentile(first_hits(joint, directions, triangles), 90 if name.endswith(limbs) else 75)
        assert abs(thickness - margin) < 0.01 + 0.25 * margin, f"{name}: {thickness:.3f} m, table {margin:.3f} m"


def ball_depth(centre, radius):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    vertices = (mesh.vertices + centre).astype(np.float32)
    return render_normals(vertices[None], mesh.faces, INTRINSICS[None], SIZE)[1][0]


@pytest.mark.parametrize(
    ("joint", "visible"),
    [
        ((0, 0, 2.0), True),
        ((0, 0, 2.08), False),
        ((0, 0, 1.0), True),
        ((0.6, 0, 2.0), True),
        ((2.0, 0, 2.0), False),
        ((0, -1.0, 2.0), False),
        ((0, 0, -2.0), False),
        ((0, 0, 0.0), False),
        ((np.nan, 0, 2), False),
        ((0, 0, np.inf), False),
    ],
)
def test_one_joint_in_or_behind_a_ball(joint, visible):
    """A ball of 0.3 m at 2 m; flesh of 0.35 m: its centre, deeper, before it, beside it, outside the image, behind."""
    depth_inverse = ball_depth((0, 0, 2.0), 0.3)
    assert joint_visibility(np.array([joint]), depth_inverse, INTRINSICS, 0.35).tolist() == [visible]


def test_margins_of_one_and_of_each():
    depth_inverse, joints = ball_depth((0, 0, 2.0), 0.3), np.array([[0, 0, 2.0], [0, 0, 2.0]])
    assert joint_visibility(joints, depth_inverse, INTRINSICS, np.array([0.1, 0.5])).tolist() == [False, True]
    assert joint_visibility(joints, np.zeros((36, 48)), INTRINSICS, 0.0).all()
    assert joint_visibility(np.zeros((0, 3)), depth_inverse, INTRINSICS, 0.1).shape == (0,)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joints_cam": np.zeros((2, 2))}, "joints_cam"),
        ({"depth_inverse": np.zeros((1, 4, 4))}, "depth_inverse"),
        ({"intrinsics": np.eye(3)}, "intrinsics"),
        ({"margin_m": np.zeros(3)}, "margin_m must be one number or"),
        ({"margin_m": -0.1}, "not negative"),
        ({"margin_m": np.nan}, "finite"),
    ],
)
def test_wrong_calls_are_named(changes, message):
    arguments = {
        "joints_cam": np.ones((2, 3)), "depth_inverse": np.zeros((4, 4)), "intrinsics": INTRINSICS, "margin_m": 0.1
    }  # fmt: skip
    with pytest.raises(DataError, match=message):
        joint_visibility(**(arguments | changes))
