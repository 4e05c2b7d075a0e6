"""Renderers of normals, timed in turns and compared with exact surfaces: one process for each platform of OpenGL.

Started by `rendering.py` with PYOPENGL_PLATFORM set, because PyOpenGL keeps the platform it is imported with. Writes a
list of `Measurement`s as JSON.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np
from analytic_surfaces import CENTRE, Surface, capsule, compare, exact_normals, sphere

from ctlev_core.body.layer import load_body, pose_vertices
from ctlev_core.body.motion.procedural import sample_pose
from ctlev_core.render.gl import gl_available
from ctlev_core.render.normals import render_normals
from ctlev_core.render.rasteriser import NEAR_M, rasterise_normals, vertex_normals

SIZES = (256, 512)
NUM_POSES = 16
SLOW_POSES = 3
"""Frames a round of the routes that build a scene each time."""

Frames = tuple[np.ndarray, np.ndarray]
Route = Callable[[np.ndarray, np.ndarray, np.ndarray, tuple[int, int]], Frames]


@dataclass(frozen=True)
class Measurement:
    """One renderer, scene and size; the errors are None where there is no exact surface or there are no normals.

    Attributes:
        route: the renderer and how it is set up.
        scene: "body", "sphere" or "capsule".
        size_px: of the square image.
        num_faces: of the mesh.
        min_ms: the fastest round, wall clock, per frame.
        median_ms: the median round.
        cpu_ms: the least of the processor's time, all threads together, per frame.
        error: fields of `NormalsError`.
    """

    route: str
    scene: str
    size_px: int
    num_faces: int
    min_ms: float
    median_ms: float
    cpu_ms: float
    error: dict[str, float] | None


def main() -> None:
    """Measure what this process can draw with."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--out", type=Path, required=True, help="file for the JSON")
    arguments = parser.parse_args()
    platform = gl_available()
    routes: dict[str, Route] = {"numba": numba_route, "numba, float64": numba_float64_route}
    if platform is not None:
        routes[f"pyrender {platform}, tuned"] = tuned_route
        routes[f"pyrender {platform}, default, colours"] = DefaultScene(lit=False)
    lit: dict[str, Route] = {f"pyrender {platform}, default, lit": DefaultScene(lit=True)} if platform else {}
    surfaces = [*(sphere(subdivisions) for subdivisions in (3, 4, 5, 6)), capsule(52), capsule(104)]
    found: list[Measurement] = []
    for size in SIZES:
        vertices, faces, intrinsics = walking_body(size)
        found += measure(routes | lit, "body", vertices, faces, intrinsics, size, arguments.rounds, None)
        for surface in surfaces:
            camera = surface_camera(size)
            found += measure(
                routes, surface.name, surface.vertices[None], surface.faces, camera, size, arguments.rounds, surface
            )
    arguments.out.write_text(json.dumps([asdict(measurement) for measurement in found]))


def measure(
    routes: dict[str, Route],
    scene: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    intrinsics: np.ndarray,
    size: int,
    rounds: int,
    surface: Surface | None,
) -> list[Measurement]:
    """All routes on one mesh, in turns, because a machine's speed drifts; the first round is not timed."""
    wall: dict[str, list[float]] = {name: [] for name in routes}
    cpu: dict[str, list[float]] = {name: [] for name in routes}
    first: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for turn in range(rounds + 1):
        for name, route in routes.items():
            some = slice(0, SLOW_POSES if "default" in name else None)
            count = len(vertices[some])
            cpu_start, start = time.process_time(), time.perf_counter()
            frames = route(vertices[some], faces, intrinsics[some], (size, size))
            stop, cpu_stop = time.perf_counter(), time.process_time()
            if not turn:
                first[name] = frames[0][0].copy(), frames[1][0] > 0
            else:
                wall[name].append(1e3 * (stop - start) / count)
                cpu[name].append(1e3 * (cpu_stop - cpu_start) / count)
    found = []
    for name, (normals, covered) in first.items():
        error = None
        if surface is not None:
            exact = exact_normals(surface, intrinsics[0], (size, size))
            error = asdict(compare(normals, covered, exact))
        times = min(wall[name]), statistics.median(wall[name]), min(cpu[name])
        found.append(Measurement(name, scene, size, len(faces), *times, error))
    return found


def walking_body(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The bundled body in `NUM_POSES` poses of a walk, 3 m before the camera, as large as conditions are."""
    body = load_body()
    rotations, transl = walk(NUM_POSES)
    vertices, _ = pose_vertices(body, rotations, np.zeros(10), transl)
    return vertices, body.faces, surface_camera(size).repeat(NUM_POSES, axis=0)


def walk(num_poses: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [N, 24, 3, 3] and translations [N, 3] of a walk, in the camera frame: y down, facing the camera."""
    rotations, transl = sample_pose("walk", np.linspace(0.0, 1.0, num_poses), np.random.default_rng(0))
    upside_down = np.diag([1.0, -1.0, -1.0])
    rotations = np.array(rotations)
    rotations[:, 0] = upside_down @ rotations[:, 0]
    return rotations, np.asarray(transl - transl.mean(axis=0)) @ upside_down + CENTRE


def surface_camera(size: int) -> np.ndarray:
    """Intrinsics [1, 4] px."""
    return np.array([[1.25 * size, 1.25 * size, size / 2, size / 2]])


def numba_route(vertices: np.ndarray, faces: np.ndarray, intrinsics: np.ndarray, image_size: tuple[int, int]) -> Frames:
    """What the project uses by default, on one core."""
    return render_normals(vertices, faces, intrinsics, image_size, out=memory(len(vertices), image_size, np.float32))


def numba_float64_route(
    vertices: np.ndarray, faces: np.ndarray, intrinsics: np.ndarray, image_size: tuple[int, int]
) -> Frames:
    """The same kernel on float64 vertices and pictures: what float32 costs in error and saves in time."""
    normals, depth_inverse = memory(len(vertices), image_size, np.float64)
    normals[:], depth_inverse[:] = 0.0, 0.0
    rasterise_normals(vertices.astype(np.float64), faces, intrinsics, NEAR_M, normals, depth_inverse)
    return normals, depth_inverse


def tuned_route(vertices: np.ndarray, faces: np.ndarray, intrinsics: np.ndarray, image_size: tuple[int, int]) -> Frames:
    """Normals shader, one renderer, buffers rewritten, floats, one sample a pixel."""
    out = memory(len(vertices), image_size, np.float32)
    return render_normals(vertices, faces, intrinsics, image_size, renderer="pyrender", out=out)


@cache
def memory(num_frames: int, image_size: tuple[int, int], dtype: type) -> Frames:
    """Normals and 1 / depth to write over: new memory costs as much as the drawing, in some virtual machines more."""
    shape = num_frames, image_size[1], image_size[0]
    return np.zeros((*shape, 3), dtype), np.zeros(shape, dtype)


class DefaultScene:
    """pyrender as its documentation uses it, save that the renderer is kept: a new mesh and scene for each frame.

    Not lit, the normals are the colours of the vertices, which gives a picture of normals without a shader of one's
    own: 8 bits, 4 samples a pixel. Lit, it is the phong scene with one lamp, which shows no normals.
    """

    def __init__(self, lit: bool) -> None:
        self._lit = lit
        self._renderers = {}

    def __call__(
        self, vertices: np.ndarray, faces: np.ndarray, intrinsics: np.ndarray, image_size: tuple[int, int]
    ) -> Frames:
        """Normals and 1 / depth; the normals of a lit scene are its colours, for nothing but the time."""
        import pyrender

        if image_size not in self._renderers:
            # Kept to the end: pyrender closes the display, and with it every context, when it deletes one.
            self._renderers[image_size] = pyrender.OffscreenRenderer(*image_size)
        renderer, frames = self._renderers[image_size], []
        flags = pyrender.RenderFlags.NONE if self._lit else pyrender.RenderFlags.FLAT
        for corners, (fx, fy, cx, cy) in zip(vertices, intrinsics, strict=True):
            scene = pyrender.Scene(bg_color=(0.0, 0.0, 0.0, 0.0))
            scene.add(self._mesh(corners, faces))
            scene.add(pyrender.IntrinsicsCamera(fx, fy, cx, cy))
            if self._lit:
                scene.add(pyrender.DirectionalLight(intensity=3.0))
            frames.append(renderer.render(scene, flags))
        colours, depths = (np.stack(images) for images in zip(*frames, strict=True))
        normals = colours[..., :3].astype(np.float32) / 127.5 - 1.0
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
        return normals, np.where(depths > 0.0, 1.0 / np.maximum(depths, 1e-6), 0.0)

    def _mesh(self, corners: np.ndarray, faces: np.ndarray):
        import pyrender
        import trimesh

        upright = corners * np.array([1.0, -1.0, -1.0], np.float32)
        if self._lit:
            return pyrender.Mesh.from_trimesh(trimesh.Trimesh(upright, faces))
        colours = np.column_stack([vertex_normals(corners, faces) * 0.5 + 0.5, np.ones(len(corners), np.float32)])
        return pyrender.Mesh([pyrender.Primitive(positions=upright, color_0=colours, indices=faces)])


if __name__ == "__main__":
    main()
