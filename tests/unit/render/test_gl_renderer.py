"""The OpenGL route against the numba one, and what it says where there is no OpenGL."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from ctlev_core.body.layer import load_body
from ctlev_core.render.gl import gl_available
from ctlev_core.render.normals import normal_map, render_normal_maps, render_normals
from data_contracts.errors import DataError

BODY = load_body()
FACES = BODY.faces


@pytest.fixture
def opengl():
    platform = gl_available()
    if platform is None:
        pytest.skip("no OpenGL here: pyrender cannot be tested")
    return platform


def scene(size, distances_m=(3.0,)):
    """Bodies at rest, turned as a camera sees them, and intrinsics off the middle."""
    upright = BODY.v_template * np.array([1, -1, -1], np.float32)
    vertices = np.stack([upright + np.array([0.1, -0.2, distance], np.float32) for distance in distances_m])
    intrinsics = np.array([1.2 * size[0], 1.25 * size[0], size[0] / 2 + 5.3, size[1] / 2 - 4.2])
    return vertices, np.tile(intrinsics, (len(vertices), 1))


def angles_deg(first, second):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second), axis=-1), (first * second).sum(-1)))


def assert_same_picture(ours, theirs):
    """OpenGL rounds corners to 1/256 px: a pixel in 500 may lie on the other side of an edge, inner ones included."""
    covered, covered_gl = ours[1] > 0, theirs[1] > 0
    assert np.count_nonzero(covered != covered_gl) <= 0.002 * covered.sum()
    both = covered & covered_gl
    angles = angles_deg(ours[0][both].astype(float), theirs[0][both].astype(float))
    assert both.sum() > 1000 and angles.mean() < 0.01
    assert np.count_nonzero(angles > 0.1) <= 0.002 * len(angles)
    depths, depths_gl = 1 / ours[1][both], 1 / theirs[1][both]
    assert np.count_nonzero(np.abs(depths - depths_gl) > 1e-4 * depths) <= 0.002 * len(depths)
    assert not theirs[0][~covered_gl].any() and (theirs[1] >= 0).all()


@pytest.mark.parametrize("size", [(256, 256), (346, 260), (131, 97)])
def test_both_renderers_agree(opengl, size):
    """At several distances, the nearest across the near plane of the camera."""
    vertices, intrinsics = scene(size, (3.0, 1.5, 0.1, 30.0))
    ours = render_normals(vertices, FACES, intrinsics, size)
    theirs = render_normals(vertices, FACES, intrinsics, size, renderer="pyrender")
    assert theirs[0].dtype == theirs[1].dtype == np.float32
    assert_same_picture(ours, theirs)
    assert (ours[1][3] > 0).any()
    maps = render_normal_maps(vertices, FACES, intrinsics, size, "controlnet", renderer="pyrender")
    np.testing.assert_array_equal(maps, normal_map(theirs[0], "controlnet"))


def test_other_sizes_other_meshes_and_back(opengl):
    """One context serves all; a mesh of another number of vertices takes the place of the first."""
    vertices, intrinsics = scene((64, 64))
    first = render_normals(vertices, FACES, intrinsics, (64, 64), renderer="pyrender")
    wide, wide_intrinsics = scene((96, 80))
    render_normals(wide, FACES, wide_intrinsics, (96, 80), renderer="pyrender")
    triangle = np.array([[[-1, -1, 2], [1, -1, 2], [0, 1, 2]]], np.float32)
    small = render_normals(triangle, np.array([[0, 2, 1]]), intrinsics, (64, 64), renderer="pyrender")
    assert (small[1] > 0).sum() > 100
    again = render_normals(vertices, FACES, intrinsics, (64, 64), renderer="pyrender")
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)


def test_vertices_that_are_not_finite_and_then_are(opengl):
    vertices, intrinsics = scene((128, 128), (3.0, 3.0, 3.0))
    clean = vertices[0].copy()
    vertices[1, 100:200] = np.nan
    vertices[2, 0] = np.inf
    ours = render_normals(vertices, FACES, intrinsics, (128, 128))
    theirs = render_normals(vertices, FACES, intrinsics, (128, 128), renderer="pyrender")
    assert_same_picture(ours, theirs)
    after = render_normals(clean[None], FACES, intrinsics[:1], (128, 128), renderer="pyrender")
    np.testing.assert_array_equal(after[0], theirs[0][:1])
    nothing = render_normals(np.full_like(vertices, np.nan), FACES, intrinsics, (128, 128), renderer="pyrender")
    assert not nothing[0].any() and not nothing[1].any()


def test_behind_the_camera_and_no_faces(opengl):
    vertices, intrinsics = scene((64, 64), (-3.0,))
    assert not render_normals(vertices, FACES, intrinsics, (64, 64), renderer="pyrender")[1].any()
    empty = render_normals(vertices, np.zeros((0, 3), int), intrinsics, (64, 64), renderer="pyrender")
    assert not empty[1].any()
    used = np.ones((1, 64, 64, 3), np.float32), np.ones((1, 64, 64), np.float32)
    for faces in (FACES, np.zeros((0, 3), int)):
        render_normals(vertices, faces, intrinsics, (64, 64), renderer="pyrender", out=used)
        assert not used[0].any() and not used[1].any()
        used[0][:], used[1][:] = 1.0, 1.0


@pytest.mark.parametrize("distance", [3.0, 30.0, 300.0])
def test_the_nearer_of_two_sheets_a_millimetre_apart(opengl, distance):
    """The depth buffer spans the mesh alone, else 24 or 32 bits would not tell them apart at 300 m."""
    square = np.array([[-0.3, -0.3, 1], [0.3, -0.3, 1], [0.3, 0.3, 1], [-0.3, 0.3, 1]]) * distance
    sheets = np.concatenate([square + np.array([0, 0, 0.001]), square]).astype(np.float32)
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 6, 5], [4, 7, 6]])
    intrinsics = np.array([[60.0, 60, 32, 32]])
    for order in (faces, faces[::-1]):
        _, depth_inverse = render_normals(sheets[None], order, intrinsics, (64, 64), renderer="pyrender")
        seen = depth_inverse[depth_inverse > 0].astype(float)
        assert len(seen) > 900
        np.testing.assert_allclose(1 / seen, distance, atol=0.0002 + 1e-7 * distance)


def test_threads_take_turns(opengl):
    vertices, intrinsics = scene((96, 96), (3.0, 2.5))
    expected = render_normals(vertices, FACES, intrinsics, (96, 96), renderer="pyrender")
    with ThreadPoolExecutor(3) as pool:
        futures = [
            pool.submit(render_normals, vertices, FACES, intrinsics, (96, 96), renderer="pyrender") for _ in range(6)
        ]
    for future in futures:
        np.testing.assert_array_equal(future.result()[0], expected[0])


LOSE_CONTEXT = """
import numpy as np
import pyrender
from ctlev_core.render.normals import render_normals
corners = np.array([[[-1, -1, 2], [1, -1, 2], [0, 1, 2]]], np.float32)
scene = corners, np.array([[0, 2, 1]]), np.array([[8.0, 8, 4, 4]]), (8, 8)
assert render_normals(*scene, renderer="pyrender")[1].any()
pyrender.OffscreenRenderer(8, 8).delete()
try:
    assert render_normals(*scene, renderer="pyrender")[1].any()
except Exception as error:
    print(type(error).__name__, error)
else:
    print("survived")
"""


def test_a_context_that_others_have_ended_is_named(opengl):
    environment = os.environ | {"PYOPENGL_PLATFORM": opengl}
    ended = subprocess.run(
        [sys.executable, "-c", LOSE_CONTEXT], env=environment, capture_output=True, text=True, timeout=120
    )
    assert ended.stdout.startswith(("DataError the OpenGL context", "survived")), ended.stdout + ended.stderr


def test_without_opengl_the_message_says_what_to_do(monkeypatch):
    monkeypatch.setenv("PYOPENGL_PLATFORM", "no_such_platform")
    assert gl_available() is None
    vertices, intrinsics = scene((16, 16))
    with pytest.raises(DataError, match=r"apt-get install libegl1.*libosmesa6.*'numba'") as caught:
        render_normals(vertices, FACES, intrinsics, (16, 16), renderer="pyrender")
    assert "no_such_platform" in str(caught.value)
