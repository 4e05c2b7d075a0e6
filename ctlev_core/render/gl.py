"""Normals through OpenGL: pyrender on EGL, or on OSMesa, whichever gives a context first.

It exists to be compared with, and for graphics cards; on a CPU the numba rasteriser is faster. A missing driver can end
the process, so a context is first tried in another one. PyOpenGL decides on its platform when it is first imported.
"""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import AbstractContextManager
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from data_contracts.errors import DataError

if TYPE_CHECKING:
    from ctlev_core.render.gl_scene import NormalsScene

PLATFORMS = ("egl", "osmesa")
PROBE_TIMEOUT_S = 120
PROBE = """
import numpy as np
from ctlev_core.render.gl_scene import NormalsScene, current_context
corners = np.array([[-9.0, -9.0, 1.0], [9.0, -9.0, 1.0], [0.0, 9.0, 1.0]], np.float32)
with current_context():
    scene = NormalsScene(np.array([[0, 2, 1]], np.int32), 3, (8, 8))
    image = scene.render(corners, np.array([8.0, 8.0, 4.0, 4.0]))
assert np.allclose(image[4, 4], [0.0, 0.0, -1.0, 1.0], atol=1e-5), image[4, 4]
"""
INSTALL = (
    "apt-get install libegl1 libgles2 libgl1 libgl1-mesa-dri libegl-mesa0 libglx-mesa0, for EGL; or libosmesa6 and "
    "pip install --no-deps PyOpenGL==3.1.10, for OSMesa"
)
_scenes: dict[tuple[int, int], tuple[int, np.ndarray, NormalsScene]] = {}
"""By image size: number of vertices, faces, and the scene made of them."""


def gl_available() -> str | None:
    """The platform on which OpenGL draws here, "egl" or "osmesa", or None. Tried once a process, in another one.

    Only the platform in the environment variable PYOPENGL_PLATFORM is tried where that is set.
    """
    return next((platform for platform in _candidates() if not _failure(platform)), None)


def render_normals_gl(
    vertices: np.ndarray, faces: np.ndarray, intrinsics: np.ndarray, normals: np.ndarray, depth_inverse: np.ndarray
) -> None:
    """`render_normals` by OpenGL into arrays of the final shapes, arguments checked and of their final dtypes.

    Triangles meet the pixels on a grid of OpenGL's choice, often 1/256 px, so pixels at an edge can differ from those
    of the numba rasteriser.

    Raises:
        DataError: no OpenGL here; the message names what to install.
    """
    if vertices.size == 0 or len(faces) == 0:
        normals[:], depth_inverse[:] = 0.0, 0.0
        return
    height, width = depth_inverse.shape[1:]
    with _context():
        scene = _scene(faces, vertices.shape[1], (width, height))
        for i, (corners, camera) in enumerate(zip(vertices, intrinsics, strict=True)):
            pixels = scene.render(corners, camera)
            normals[i], depth_inverse[i] = pixels[..., :3], pixels[..., 3]


def _context() -> AbstractContextManager[None]:
    platform = gl_available()
    if platform is None:
        tried = "; ".join(f"{name}: {_failure(name)}" for name in _candidates())
        raise DataError(
            f"renderer 'pyrender' finds no OpenGL ({tried}). Install it ({INSTALL}) or use renderer 'numba', "
            "which needs none and is faster on a CPU"
        )
    os.environ["PYOPENGL_PLATFORM"] = platform
    from ctlev_core.render.gl_scene import current_context

    return current_context()


def _scene(faces: np.ndarray, num_vertices: int, image_size: tuple[int, int]) -> NormalsScene:
    """The scene of this mesh and size; made, in place of another mesh of this size, where there is none."""
    from ctlev_core.render.gl_scene import NormalsScene

    if image_size in _scenes:
        known_vertices, known_faces, scene = _scenes[image_size]
        if known_vertices == num_vertices and np.array_equal(known_faces, faces):
            return scene
        del _scenes[image_size]
        scene.delete()
    scene = NormalsScene(faces, num_vertices, image_size)
    _scenes[image_size] = num_vertices, faces.copy(), scene
    return scene


def _candidates() -> tuple[str, ...]:
    wanted = os.environ.get("PYOPENGL_PLATFORM")
    return PLATFORMS if wanted is None else (wanted,)


@cache
def _failure(platform: str) -> str:
    """Why OpenGL does not draw on this platform; empty where it does."""
    environment = os.environ | {"PYOPENGL_PLATFORM": platform}
    try:
        probe = subprocess.run(
            [sys.executable, "-c", PROBE], env=environment, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S
        )
    except subprocess.TimeoutExpired:
        return f"no answer in {PROBE_TIMEOUT_S} s"
    if probe.returncode == 0:
        return ""
    lines = probe.stderr.strip().splitlines()
    return lines[-1] if lines else f"ended with status {probe.returncode}"
