"""Spheres and capsules whose rays are solved exactly, their meshes, and how far rendered normals are from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_erosion

SILHOUETTE_PX = 4
CENTRE = np.array([0.03, -0.05, 3.0])
ROTATION = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])


@dataclass(frozen=True, eq=False)
class Surface:
    """A capsule, or a sphere where both ends are one point, and a mesh with its corners on it.

    Attributes:
        name: for tables.
        vertices: [V, 3] float32, m, camera frame.
        faces: [F, 3] int32.
        start: [3] m, one end of the middle line; `end`: the other.
        end: see above.
        radius: m.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    start: np.ndarray
    end: np.ndarray
    radius: float


@dataclass(frozen=True)
class NormalsError:
    """Angles in degrees between rendered and exact normals.

    Attributes:
        mean_deg: away from the silhouette by more than `SILHOUETTE_PX`.
        max_deg: there.
        rim_mean_deg: nearer to the silhouette.
        rim_max_deg: there.
        coverage_px: pixels covered by one of mesh and surface only.
        covered_px: pixels of the surface.
    """

    mean_deg: float
    max_deg: float
    rim_mean_deg: float
    rim_max_deg: float
    coverage_px: int
    covered_px: int


def sphere(subdivisions: int, radius: float = 0.7) -> Surface:
    """An icosphere of 20 * 4^subdivisions faces."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    vertices = (mesh.vertices @ ROTATION.T + CENTRE).astype(np.float32)
    return Surface("sphere", vertices, np.asarray(mesh.faces, np.int32), CENTRE, CENTRE, radius)


def capsule(around: int, radius: float = 0.35, half_length: float = 0.5) -> Surface:
    """Rings of `around` corners (a multiple of 4), as far from one another as their corners, each half a corner on."""
    bend = np.linspace(0.0, np.pi / 2, around // 4 + 1)
    steps = round(half_length * around / (np.pi * radius))
    straight = np.linspace(half_length, -half_length, steps + 1)[1:-1]
    high, wide = half_length + radius * np.cos(bend), radius * np.sin(bend)
    heights = np.concatenate([high, straight, -high[::-1]])[1:-1]
    widths = np.concatenate([wide, np.full(len(straight), radius), wide[::-1]])[1:-1]
    turns = 2 * np.pi / around * (np.arange(around) + 0.5 * np.arange(len(heights))[:, None])
    rings = np.stack([np.cos(turns), np.sin(turns), np.zeros_like(turns)], axis=-1) * widths[:, None, None]
    rings[..., 2] = heights[:, None]
    tip = half_length + radius
    vertices = np.concatenate([rings.reshape(-1, 3), [[0.0, 0.0, tip], [0.0, 0.0, -tip]]])
    here = np.arange(len(rings) * around).reshape(len(rings), around)
    beside = np.roll(here, -1, axis=1)
    north, south = np.full(around, len(vertices) - 2), np.full(around, len(vertices) - 1)
    triangles = (
        (here[:-1], here[1:], beside[:-1]),
        (beside[:-1], here[1:], beside[1:]),
        (north, here[0], beside[0]),
        (beside[-1], here[-1], south),
    )
    faces = np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in triangles]).astype(np.int32)
    start, end = np.array([[0.0, 0.0, half_length], [0.0, 0.0, -half_length]]) @ ROTATION.T + CENTRE
    return Surface("capsule", (vertices @ ROTATION.T + CENTRE).astype(np.float32), faces, start, end, radius)


def exact_normals(surface: Surface, intrinsics: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """Normals [H, W, 3] float64 where the ray through the pixel's centre first meets the surface; else NaN."""
    fx, fy, cx, cy = intrinsics
    rows, columns = np.mgrid[: image_size[1], : image_size[0]] + 0.5
    rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], axis=-1)
    length = float(np.linalg.norm(surface.end - surface.start))
    axis = (surface.end - surface.start) / length if length > 0.0 else np.zeros(3)
    depths = [_nearest_root(rays, tip, surface.radius) for tip in (surface.start, surface.end)]
    if length > 0.0:
        side = _nearest_root(
            rays - (rays @ axis)[..., None] * axis, surface.start - (surface.start @ axis) * axis, surface.radius
        )
        along = (side[..., None] * rays - surface.start) @ axis
        depths.append(np.where((along >= 0.0) & (along <= length), side, np.nan))
    points = np.fmin.reduce(depths)[..., None] * rays
    middle = surface.start + np.clip((points - surface.start) @ axis, 0.0, length)[..., None] * axis
    return (points - middle) / surface.radius


def _nearest_root(rays: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """Where rays from the origin first come within `radius` of `centre`: the smaller root of a quadratic, or NaN."""
    a, b, c = (rays**2).sum(axis=-1), rays @ centre, centre @ centre - radius**2
    with np.errstate(invalid="ignore"):
        return (b - np.sqrt(b * b - a * c)) / a


def compare(normals: np.ndarray, covered: np.ndarray, exact: np.ndarray) -> NormalsError:
    """Errors of one rendered picture.

    Args:
        normals: [H, W, 3], unit length where covered.
        covered: [H, W] bool.
        exact: [H, W, 3] as `exact_normals` returns them.
    """
    seen = np.isfinite(exact[..., 0])
    inner = np.asarray(binary_erosion(seen, iterations=SILHOUETTE_PX))
    first, second = normals.astype(np.float64), np.nan_to_num(exact)
    sines = np.linalg.norm(np.cross(first, second), axis=-1)
    angles = np.degrees(np.arctan2(sines, (first * second).sum(axis=-1)))
    middle, rim = angles[inner & covered], angles[seen & covered & np.logical_not(inner)]
    return NormalsError(
        mean_deg=float(middle.mean()),
        max_deg=float(middle.max()),
        rim_mean_deg=float(rim.mean()),
        rim_max_deg=float(rim.max()),
        coverage_px=int(np.count_nonzero(seen != covered)),
        covered_px=int(seen.sum()),
    )
