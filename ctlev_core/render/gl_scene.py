"""A pyrender scene that draws nothing but normals: one renderer, buffers rewritten in place, no multisampling.

pyrender's own offscreen picture has 8 bits a channel and 4 samples a pixel, which mixes the normals of a silhouette
with the background: up to 144 degrees off. Here the colour buffer has 32-bit floats: normal, and 1 / depth as alpha.

Import this only after the environment variable PYOPENGL_PLATFORM names a platform that works: see `gl.py`. It overrides
private methods of pyrender, which is therefore pinned.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import numpy as np
import pyrender
from OpenGL import GL
from pyrender.constants import RenderFlags
from pyrender.platforms.base import Platform
from pyrender.renderer import Renderer
from pyrender.shader_program import ShaderProgram

from ctlev_core.render.rasteriser import NEAR_M, vertex_normals
from data_contracts.errors import DataError

PYRENDER_VERSION = "0.1.45"
FLAGS = RenderFlags.FLAT | RenderFlags.OFFSCREEN
"""No lights, into the framebuffer of our own."""

# Vertices come in OpenCV's camera frame; OpenGL looks along -z with y up.
VERTEX_SHADER = """#version 330 core
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
uniform mat4 P;
out vec3 surface_normal;
out float depth;
void main() {
    gl_Position = P * vec4(position.x, -position.y, -position.z, 1.0);
    surface_normal = normal;
    depth = position.z;
}
"""
FRAGMENT_SHADER = """#version 330 core
in vec3 surface_normal;
in float depth;
out vec4 colour;
void main() {
    float size = length(surface_normal);
    colour = vec4(size > 0.0 ? surface_normal / size : vec3(0.0, 0.0, -1.0), 1.0 / depth);
}
"""


_one_at_a_time = threading.Lock()


@contextmanager
def current_context() -> Iterator[None]:
    """The one OpenGL context of this process, for this thread alone while it lasts.

    One for all sizes and meshes, and never deleted: pyrender closes the display with a context, which ends the others.

    Raises:
        DataError: no context, or something else in this process has ended it in that way.
    """
    with _one_at_a_time:
        platform = _platform()
        try:
            platform.make_current()
        except (GL.error.GLError, AssertionError) as error:
            raise DataError(
                "the OpenGL context of renderer 'pyrender' is lost; deleting any pyrender.OffscreenRenderer in this "
                "process ends it. Keep such renderers, or use renderer 'numba'"
            ) from error
        try:
            yield
        finally:
            _release(platform)


@cache
def _platform() -> Platform:
    """What pyrender chose by the environment; the size is that of a buffer nobody draws into."""
    platform = _offscreen_renderer()._platform
    if platform is None:
        raise DataError("pyrender made no OpenGL context")
    return platform


@cache
def _offscreen_renderer() -> pyrender.OffscreenRenderer:
    if pyrender.__version__ != PYRENDER_VERSION:
        raise DataError(f"renderer 'pyrender' needs pyrender {PYRENDER_VERSION}, found {pyrender.__version__}")
    return pyrender.OffscreenRenderer(1, 1)


def _release(platform: Platform) -> None:
    """Let another thread take the context; pyrender's own method does nothing, and OSMesa does not mind."""
    display = getattr(platform, "_egl_display", None)
    if display is not None:
        from OpenGL import EGL

        EGL.eglMakeCurrent(display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT)


class NormalsScene:
    """A mesh of fixed faces before a camera of fixed size. Make, use and delete it inside `current_context`."""

    def __init__(self, faces: np.ndarray, num_vertices: int, image_size: tuple[int, int]) -> None:
        width, height = image_size
        self._faces = faces
        self._corners = np.zeros((num_vertices, 6), np.float32)
        self._renderer = _FloatRenderer(width, height)
        self._camera = pyrender.IntrinsicsCamera(1.0, 1.0, 0.0, 0.0)
        self._primitive = pyrender.Primitive(self._corners[:, :3], self._corners[:, 3:], indices=faces)
        self._scene = pyrender.Scene(bg_color=(0.0, 0.0, 0.0, 0.0))
        self._scene.add(pyrender.Mesh([self._primitive], is_visible=True))
        self._scene.add(self._camera)
        self._all_faces_uploaded = True

    def render(self, vertices: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
        """Normals and 1 / depth as [H, W, 4] float32, 0 where there is nothing.

        Args:
            vertices: [V, 3] float32, m, camera frame.
            intrinsics: [4] (fx, fy, cx, cy) px.
        """
        self._renderer._update_context(self._scene, FLAGS)
        finite = np.asarray(np.isfinite(vertices).all(axis=1))
        depths = vertices[finite, 2]
        if not (depths > NEAR_M).any():
            return np.zeros((self._renderer.viewport_height, self._renderer.viewport_width, 4), np.float32)
        # Planes close around the mesh: the depth buffer resolves what lies between them.
        self._camera.znear = max(NEAR_M, 0.999 * float(depths.min()))
        self._camera.zfar = 1.001 * float(depths.max())
        self._camera.fx, self._camera.fy, self._camera.cx, self._camera.cy = intrinsics
        self._upload(vertices, finite)
        return np.asarray(self._renderer.render(self._scene, FLAGS))

    def delete(self) -> None:
        """Free the buffers and the program."""
        self._renderer.delete()

    def _upload(self, vertices: np.ndarray, finite: np.ndarray) -> None:
        """Rewrite the vertex buffer, and the faces where vertices are not finite: those become points."""
        self._corners[:, :3], self._corners[:, 3:] = vertices, vertex_normals(vertices, self._faces)
        vertex_buffer, _, face_buffer = self._primitive._buffers
        all_finite = bool(finite.all())
        if not (all_finite and self._all_faces_uploaded):
            self._corners[~finite] = 0.0
            faces = np.where(finite[self._faces].all(axis=1, keepdims=True), self._faces, 0).astype(np.uint32)
            GL.glBindBuffer(GL.GL_ELEMENT_ARRAY_BUFFER, face_buffer)
            GL.glBufferSubData(GL.GL_ELEMENT_ARRAY_BUFFER, 0, faces.nbytes, faces)
            self._all_faces_uploaded = all_finite
        GL.glBindBuffer(GL.GL_ARRAY_BUFFER, vertex_buffer)
        GL.glBufferSubData(GL.GL_ARRAY_BUFFER, 0, self._corners.nbytes, self._corners)


class _Source(ShaderProgram):
    """A program from the text of its shaders instead of their files."""

    def _load(self, shader_filename: str) -> str:
        return shader_filename


class _FloatRenderer(Renderer):
    """pyrender's renderer with our program and our framebuffer: floats, one sample a pixel."""

    def __init__(self, viewport_width: int, viewport_height: int) -> None:
        super().__init__(viewport_width, viewport_height)
        self._program = _Source(VERTEX_SHADER, FRAGMENT_SHADER)

    def _get_primitive_program(self, primitive, flags, program_flags) -> ShaderProgram:
        if not self._program._in_context():
            self._program._add_to_context()
        return self._program

    def _configure_main_framebuffer(self) -> None:
        if self._main_fb is not None:
            return
        self._main_cb, self._main_db = GL.glGenRenderbuffers(2)
        self._main_fb = self._main_fb_ms = GL.glGenFramebuffers(1)
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._main_fb)
        for buffer, content, attachment in (
            (self._main_cb, GL.GL_RGBA32F, GL.GL_COLOR_ATTACHMENT0),
            (self._main_db, GL.GL_DEPTH_COMPONENT32F, GL.GL_DEPTH_ATTACHMENT),
        ):
            GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
            GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, content, self.viewport_width, self.viewport_height)
            GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, attachment, GL.GL_RENDERBUFFER, buffer)
        status = GL.glCheckFramebufferStatus(GL.GL_FRAMEBUFFER)
        if status != GL.GL_FRAMEBUFFER_COMPLETE:
            raise DataError(f"this OpenGL cannot draw into 32-bit floats (status {status:#x}); use renderer 'numba'")

    def _delete_main_framebuffer(self) -> None:
        if self._main_fb is not None:
            GL.glDeleteFramebuffers(1, [self._main_fb])
            GL.glDeleteRenderbuffers(2, [self._main_cb, self._main_db])
        self._main_fb = self._main_fb_ms = self._main_cb = self._main_db = None

    def _read_main_framebuffer(self, scene, flags) -> np.ndarray:
        shape = self.viewport_height, self.viewport_width, 4
        pixels = np.empty(shape, np.float32)
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
        GL.glReadPixels(0, 0, self.viewport_width, self.viewport_height, GL.GL_RGBA, GL.GL_FLOAT, pixels)
        return pixels[::-1]
