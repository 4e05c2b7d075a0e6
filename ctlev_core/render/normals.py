"""Normal maps of posed meshes: one function over two renderers, and the pictures ControlNets are conditioned on.

Normals are rendered without light or colour. They come from the posed faces, are interpolated with perspective and
normalised in each pixel. Faces count by their area: on the body, against the normals of its surface subdivided without
end (Loop), that is 0.61 degrees off in the mean; by angle 0.76, by the weights of Max (1999), exact on spheres, 1.7.
OpenCV camera frame: x right, y down, z forward, pixel centres at integer + 0.5; the normal of a surface that faces the
camera has z < 0.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np

from ctlev_core.render.rasteriser import NEAR_M, rasterise_normals
from data_contracts.errors import DataError

RENDERERS = ("numba", "pyrender")
CONVENTIONS = ("controlnet", "controlnet_unreversed", "rgb")
_COLOURS = {
    "controlnet": ((2, 1, 0), (-127.5, -127.5, -127.5), 127.5, (255, 127, 127)),
    "controlnet_unreversed": ((0, 1, 2), (-127.5, -127.5, -127.5), 127.5, (127, 127, 255)),
    "rgb": ((0, 1, 2), (127.5, -127.5, -127.5), 128.0, (0, 0, 0)),
}
"""Component behind each channel, factors, offset (half a unit more rounds what is then cut), background."""
FRAMES_AT_A_TIME = 8
"""What one thread renders before it takes more: small enough to share, large enough not to wait for Python."""


def render_normals(
    vertices_cam: np.ndarray,
    faces: np.ndarray,
    intrinsics: np.ndarray,
    image_size: tuple[int, int],
    *,
    renderer: str = "numba",
    workers: int = 1,
    out: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Normals and inverse depth of a mesh in N poses.

    Faces that point away are culled, faces across the near plane are clipped, and a vertex that is not finite costs
    its own faces only. Frames do not depend on one another nor on `workers`.

    Args:
        vertices_cam: [N, V, 3] float32, m, camera frame.
        faces: [F, 3] integer, counter-clockwise seen from outside.
        intrinsics: [N, 4] float, (fx, fy, cx, cy) px; the origin is the outer corner of the top left pixel.
        image_size: (width, height) px.
        renderer: one of `RENDERERS`: "numba", a z-buffer on the CPU, which needs nothing else; "pyrender", OpenGL.
        workers: threads of "numba", 1 or more. OpenGL renders in one.
        out: normals and depth_inverse of an earlier call, to write over; new memory when None, which takes a fifth more
            time.
    Returns:
        normals: [N, H, W, 3] float32, unit length; 0 where there is nothing.
        depth_inverse: [N, H, W] float32, 1 / m; 0 where there is nothing.
    Raises:
        DataError: shapes disagree, the image has no pixels, a face names a vertex that does not exist, intrinsics are
            not finite or a focal length is not positive; "pyrender" finds no OpenGL.
        ValueError: unknown renderer, fewer than one worker, or an `out` of another shape or dtype.
    """
    vertices, triangles, cameras = _checked(vertices_cam, faces, intrinsics, image_size, renderer, workers)
    width, height = image_size
    shape = len(vertices), height, width
    if out is None:
        normals, depth_inverse = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
    else:
        normals, depth_inverse = out
        _check_out(normals, (*shape, 3))
        _check_out(depth_inverse, shape)
    if renderer == "pyrender":
        from ctlev_core.render.gl import render_normals_gl

        render_normals_gl(vertices, triangles, cameras, normals, depth_inverse)
        return normals, depth_inverse
    remaining = iter(range(0, len(vertices), FRAMES_AT_A_TIME))

    def work() -> None:
        for start in remaining:
            some = slice(start, start + FRAMES_AT_A_TIME)
            if out is not None:
                normals[some], depth_inverse[some] = 0.0, 0.0
            rasterise_normals(vertices[some], triangles, cameras[some], NEAR_M, normals[some], depth_inverse[some])

    _in_threads(work, workers)
    return normals, depth_inverse


def render_normal_maps(
    vertices_cam: np.ndarray,
    faces: np.ndarray,
    intrinsics: np.ndarray,
    image_size: tuple[int, int],
    convention: str,
    *,
    renderer: str = "numba",
    workers: int = 1,
) -> np.ndarray:
    """`normal_map` of `render_normals`, where nobody asks for the normals themselves.

    Each thread draws one frame after the other into memory that stays in its cache, and colours it there: a sixth of
    the memory, and a quarter less time.

    Args:
        vertices_cam: as for `render_normals`, and so are `faces`, `intrinsics`, `image_size`, `renderer`, `workers`.
        faces: see above.
        intrinsics: see above.
        image_size: see above.
        convention: one of `CONVENTIONS`.
        renderer: see above.
        workers: see above.
    Returns:
        [N, H, W, 3] uint8, channels in the order in which the network takes them.
    Raises:
        DataError: as `render_normals`.
        ValueError: as `render_normals`, or an unknown convention.
    """
    _check_convention(convention)
    vertices, triangles, cameras = _checked(vertices_cam, faces, intrinsics, image_size, renderer, workers)
    width, height = image_size
    images = np.empty((len(vertices), height, width, 3), np.uint8)
    if renderer == "pyrender":
        from ctlev_core.render.gl import render_normals_gl

        normals = np.empty((1, height, width, 3), np.float32)
        depth_inverse = np.empty((1, height, width), np.float32)
        for i in range(len(vertices)):
            one = slice(i, i + 1)
            render_normals_gl(vertices[one], triangles, cameras[one], normals, depth_inverse)
            _colour(normals, *_COLOURS[convention], images[one])
        return images
    remaining = iter(range(len(vertices)))

    def work() -> None:
        normals = np.empty((1, height, width, 3), np.float32)
        depth_inverse = np.empty((1, height, width), np.float32)
        for i in remaining:
            one = slice(i, i + 1)
            normals[:], depth_inverse[:] = 0.0, 0.0
            rasterise_normals(vertices[one], triangles, cameras[one], NEAR_M, normals, depth_inverse)
            _colour(normals, *_COLOURS[convention], images[one])

    _in_threads(work, workers)
    return images


def normal_map(normals: np.ndarray, convention: str) -> np.ndarray:
    """Normals as the picture a network sees.

    `controlnet`: ControlNet v1.0's "normal" condition. Its x and y are Sobel derivatives of MiDaS' inverse depth, which
    grows towards a surface's near side: positive where the surface faces left, and up. Its z points to the camera.
    Hence it is the negative of our normal. 127.5 x + 127.5, cut to whole numbers; the background is flat, (0, 0, 1).
    Its app then reverses the channels, and so do we: the network sees (z, y, x). Our normals are true ones. Those of
    v1.0 have the same direction on the screen, where pixels are square, but another tilt: 2 pi stands in for the
    unknown scale of MiDaS' depth.

    `controlnet_unreversed`: (x, y, z), before the app reverses them: for a ControlNet whose config has
    `controlnet_conditioning_channel_order: bgr`, and which therefore reverses them by itself.

    `rgb`: red = right, green = up, blue = towards the camera, as OpenGL's normal maps have it; 127.5 x + 127.5,
    rounded. The background is black, which no normal is.

    Args:
        normals: [N, H, W, 3] float, unit length or 0, as `render_normals` returns them.
        convention: one of `CONVENTIONS`.
    Returns:
        [N, H, W, 3] uint8 RGB.
    Raises:
        DataError: another shape.
        ValueError: unknown convention.
    Source: lllyasviel/ControlNet, annotator/midas/__init__.py and gradio_normal2image.py.
    """
    _check_convention(convention)
    if normals.ndim != 4 or normals.shape[3] != 3:
        raise DataError(f"normals must be [N, H, W, 3], got {normals.shape}")
    colours = np.empty(normals.shape, np.uint8)
    _colour(normals, *_COLOURS[convention], colours)
    return colours


def turn_normal_map(image: np.ndarray, turns: int, convention: str) -> np.ndarray:
    """A normal map as a camera that is rolled by quarter turns sees it, with the vectors turned as well.

    Args:
        image: [H, W, 3] uint8, as `normal_map` makes them.
        turns: quarter turns of the picture against the clock, as `numpy.rot90` counts them.
        convention: of the colours.
    Returns:
        [H, W, 3] or [W, H, 3] uint8; from rounding, a unit off the map of the turned body at most.
    Raises:
        ValueError: unknown convention.
    """
    _check_convention(convention)
    axes, factors, offset, background = _COLOURS[convention]
    across, down = axes.index(0), axes.index(1)
    turned = np.rot90(image, turns).copy()
    of_body = (turned != np.array(background, np.uint8)).any(axis=2)
    mirror = int(2 * offset) - 1  # what is cut to k lay between k and k + 1
    for _ in range(turns % 4):
        x, y = turned[..., across].astype(np.int16), turned[..., down].astype(np.int16)
        if factors[across] == factors[down]:
            new_x, new_y = y, mirror - x
        else:
            new_x, new_y = mirror - y, x
        turned[..., across] = np.where(of_body, np.clip(new_x, 0, 255), turned[..., across])
        turned[..., down] = np.where(of_body, np.clip(new_y, 0, 255), turned[..., down])
    return turned


@numba.njit(cache=True, nogil=True)
def _colour(normals, axes, factors, offset, background, colours):
    """Channel k of `colours` is factors[k] * component axes[k] + offset, cut to whole numbers in 0 .. 255."""
    for i in range(normals.shape[0]):
        for row in range(normals.shape[1]):
            for column in range(normals.shape[2]):
                normal = normals[i, row, column, 0], normals[i, row, column, 1], normals[i, row, column, 2]
                if normal[0] == 0.0 and normal[1] == 0.0 and normal[2] == 0.0:
                    for k in range(3):
                        colours[i, row, column, k] = background[k]
                else:
                    for k in range(3):
                        colour = factors[k] * normal[axes[k]] + offset
                        colours[i, row, column, k] = np.uint8(min(max(colour, 0.0), 255.0))


def _in_threads(work: Callable[[], None], workers: int) -> None:
    """Run the same work in each thread; they share what is left to do through an iterator, of which next is atomic."""
    if workers == 1:
        work()
        return
    with ThreadPoolExecutor(workers) as pool:
        for future in [pool.submit(work) for _ in range(workers)]:
            future.result()


def _checked(
    vertices_cam: np.ndarray,
    faces: np.ndarray,
    intrinsics: np.ndarray,
    image_size: tuple[int, int],
    renderer: str,
    workers: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and intrinsics as the kernels take them, after all checks."""
    if renderer not in RENDERERS:
        raise ValueError(f"unknown renderer {renderer!r}; known: {', '.join(RENDERERS)}")
    if workers < 1:
        raise ValueError(f"workers must be 1 or more, got {workers}")
    _check_mesh(vertices_cam, faces)
    _check_cameras(intrinsics, len(vertices_cam), image_size)
    return (
        np.ascontiguousarray(vertices_cam, np.float32),
        np.ascontiguousarray(faces, np.int32),
        np.ascontiguousarray(intrinsics, np.float64),
    )


def _check_out(array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape or array.dtype != np.float32 or not array.flags.c_contiguous:
        raise ValueError(f"out must hold {shape} float32, contiguous, got {array.shape} {array.dtype}")


def _check_convention(convention: str) -> None:
    if convention not in CONVENTIONS:
        raise ValueError(f"unknown convention {convention!r}; known: {', '.join(CONVENTIONS)}")


def _check_mesh(vertices_cam: np.ndarray, faces: np.ndarray) -> None:
    if vertices_cam.ndim != 3 or vertices_cam.shape[2] != 3:
        raise DataError(f"vertices_cam must be [N, V, 3], got {vertices_cam.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise DataError(f"faces must be [F, 3] integers, got {faces.shape} {faces.dtype}")
    num_vertices = vertices_cam.shape[1]
    if len(faces) and (faces.min() < 0 or faces.max() >= num_vertices):
        raise DataError(f"faces must name vertices 0 .. {num_vertices - 1}, got {faces.min()} .. {faces.max()}")


def _check_cameras(intrinsics: np.ndarray, num_frames: int, image_size: tuple[int, int]) -> None:
    width, height = image_size
    if width < 1 or height < 1:
        raise DataError(f"image_size must be (width, height) of 1 px or more, got {image_size}")
    if np.shape(intrinsics) != (num_frames, 4):
        raise DataError(f"intrinsics must be [{num_frames}, 4], (fx, fy, cx, cy) a frame, got {np.shape(intrinsics)}")
    if not np.isfinite(intrinsics).all() or (np.asarray(intrinsics)[:, :2] <= 0.0).any():
        raise DataError("intrinsics must be finite and their focal lengths positive")
