"""Smooth unions of tubes and round cones as signed distance fields.

Source: round cones and smooth union after Inigo Quilez; the distance to a tube is its implicit function over the
length of its gradient (Taubin, Distance approximations for rasterizing implicit curves, ACM TOG 1994).
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from ctlev_core.body.body_shape import BLEND_OF_SIDES, FINE_REGIONS, LEFT_PARTS, MIDDLE_PARTS, Cone, FineRegion, Tube

PARTS = (*MIDDLE_PARTS, *LEFT_PARTS)
MIRROR = np.array([-1.0, 1.0, 1.0])


def part_distance(points: np.ndarray, part: Tube | Cone) -> np.ndarray:
    """Approximate signed distance [N], m, of points [N, 3]; negative inside."""
    return _tube_distance(points, part) if isinstance(part, Tube) else _cone_distance(points, part)


def _cone_distance(points: np.ndarray, cone: Cone) -> np.ndarray:
    start, end, stretch = (np.array(value, dtype=np.float64) for value in (cone.start, cone.end, cone.stretch))
    middle = (start + end) / 2
    axis, local = (end - start) / stretch, (points - middle) / stretch - (start - middle) / stretch
    along = np.clip(local @ axis / (axis @ axis), 0.0, 1.0)
    radius = cone.radii[0] + (cone.radii[1] - cone.radii[0]) * along
    return (np.linalg.norm(local - along[:, None] * axis, axis=1) - radius) * np.sqrt(stretch.min())


def _tube_distance(points: np.ndarray, tube: Tube) -> np.ndarray:
    table = np.array(tube.sections)
    position, others = points[:, tube.axis], points[:, [axis for axis in range(3) if axis != tube.axis]]
    inside = np.clip(position, table[0, 0], table[-1, 0])
    outline = CubicSpline(table[:, 0], table[:, 1:])(inside).reshape(-1, 2, 2)
    radii = (outline[:, :, 1] - outline[:, :, 0]) / 2
    cap = np.where(position < inside, *tube.caps)
    radii = np.concatenate([radii, cap[:, None]], axis=1)
    offset = np.concatenate([others - outline.mean(axis=2), (position - inside)[:, None]], axis=1)
    scaled = np.maximum(np.abs(offset) / radii, 1e-9)
    level = np.sum(scaled**tube.exponent, axis=1) ** (1 / tube.exponent)
    slope = (scaled / level[:, None]) ** (tube.exponent - 1) / radii
    return (level - 1) / np.linalg.norm(slope, axis=1)


def smooth_union(first: np.ndarray, second: np.ndarray, blend: float) -> np.ndarray:
    """Union with a fillet: the two fields merge where they differ by less than `blend`."""
    if blend <= 0:
        return np.minimum(first, second)
    near = np.maximum(blend - np.abs(first - second), 0.0) / blend
    return np.minimum(first, second) - near**3 * (blend / 6)


def body_distance(points: np.ndarray) -> np.ndarray:
    """Signed distance [N], m, of points [N, 3] to the body; mirror images have the same."""
    return smooth_union(_side_distance(points), _side_distance(points * MIRROR), BLEND_OF_SIDES)


def _side_distance(points: np.ndarray) -> np.ndarray:
    total = part_distance(points, PARTS[0])
    for part in PARTS[1:]:
        distance = part_distance(points, part)
        if isinstance(part, Cone) and part.carve:
            total = -smooth_union(-total, distance, part.blend)
        else:
            total = smooth_union(total, distance, part.blend)
    return total


def magnify(points: np.ndarray) -> np.ndarray:
    """From the space in which the mesh is even to the body's, [N, 3], m: hands, head and feet are shrunk.

    Defined for x >= 0. The other two axes shrink about the region's centre, so that shapes stay similar.
    """
    for region in FINE_REGIONS:
        points = _shrink(points, region)
    return points


def _shrink(points: np.ndarray, region: FineRegion) -> np.ndarray:
    along = region.direction * points[:, region.axis] - region.start
    q = np.clip(along / region.transition, 0.0, 1.0)
    lost = 1 - 1 / region.magnification
    scale = 1 - lost * (3 - 2 * q) * q**2
    passed = region.transition * (1 - q / 2) * q**3 + np.maximum(along - region.transition, 0.0)
    centre = np.array(region.centre)
    shrunk = centre + scale[:, None] * (points - centre)
    shrunk[:, region.axis] = points[:, region.axis] - region.direction * lost * passed
    return shrunk
