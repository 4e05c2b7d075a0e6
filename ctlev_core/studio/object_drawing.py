"""Pictures of objects and of compositions of two: random geometry, light and tone make each drawing different."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ctlev_core.studio.compositions import Composition
from ctlev_core.studio.objects import COLOURS, OBJECTS, Part

SUPERSAMPLING = 4
LINE_SHARE = 0.9
"""Width of a drawn line as a share of that of its part: lines do not stretch with the object, so they are thinner."""
SIZE_RANGE = (0.5, 0.92)
"""Half the side of an object's square, as a share of half the picture's shorter side."""
GAP = 0.06
"""Distance of two objects side by side, as a share of half the picture's side."""


@dataclass(frozen=True, eq=False)
class _Placement:
    """Where an object's square lies: p -> matrix p + centre, px of the supersampled picture; `radius` sizes lines."""

    matrix: np.ndarray
    centre: np.ndarray
    radius: float


def draw_object(
    noun: str,
    colour: str,
    canvas: np.ndarray,
    rng: np.random.Generator,
    size_range: tuple[float, float] = SIZE_RANGE,
    supersampling: int = SUPERSAMPLING,
) -> np.ndarray:
    """Draw one object somewhere on a background.

    Args:
        noun: a key of `OBJECTS`.
        colour: a key of `COLOURS`.
        canvas: [H, W, 3] uint8 RGB background; not changed.
        rng: geometry, light and tone.
        size_range: smallest and largest size, as `SIZE_RANGE`.
        supersampling: the picture is drawn at so many times its size, then averaged; 1 = hard edges.
    Returns:
        [H, W, 3] uint8.
    """
    image, half = _enlarged(canvas, supersampling)
    angle = rng.normal(0, 0.2)
    radius = half * rng.uniform(*size_range)
    matrix = _random_matrix(radius, angle, rng)
    centre = _middle(image) + rng.uniform(-1, 1, 2) * max(half - radius, 0) * 0.8
    _paint(image, OBJECTS[noun], colour, _Placement(matrix, centre, radius), half, rng)
    return _averaged(image, canvas)


def draw_composition(
    composition: Composition,
    colours: tuple[str, str],
    canvas: np.ndarray,
    rng: np.random.Generator,
    size_range: tuple[float, float] = (0.7, 0.95),
    supersampling: int = SUPERSAMPLING,
) -> np.ndarray:
    """Draw two objects as their relation says: one on the other, or side by side on one ground.

    Objects that touch stand upright, so they are turned less than a single one.

    Args:
        composition: what to draw.
        colours: keys of `COLOURS`, of the first and the second object.
        canvas: [H, W, 3] uint8 RGB background; not changed.
        rng: geometry, light and tone.
        size_range: smallest and largest size of both together, as `SIZE_RANGE`.
        supersampling: as for `draw_object`.
    Returns:
        [H, W, 3] uint8.
    """
    image, half = _enlarged(canvas, supersampling)
    total = half * rng.uniform(*size_range)
    nouns = (composition.first, composition.second)
    matrices = [_random_matrix(0.5 * total, rng.normal(0, 0.06), rng) for _ in nouns]
    boxes = [_bounds(OBJECTS[noun], matrix) for noun, matrix in zip(nouns, matrices, strict=True)]
    centres = _stacked(boxes) if composition.relation == "on" else _side_by_side(boxes, GAP * total)
    (left, top), (right, bottom) = _union([box + centre for box, centre in zip(boxes, centres, strict=True)])
    # Both together fill the size that was drawn for them, whatever their shapes.
    scale = 2 * total / max(right - left, bottom - top)
    size = scale * np.array([right - left, bottom - top])
    shift = rng.uniform(-1, 1, 2) * np.maximum(half - size / 2, 0) * 0.8
    middle = _middle(image) + shift - scale * np.array([left + right, top + bottom]) / 2
    for noun, colour, matrix, centre in zip(nouns, colours, matrices, centres, strict=True):
        placement = _Placement(scale * matrix, middle + scale * centre, 0.5 * scale * total)
        _paint(image, OBJECTS[noun], colour, placement, half, rng)
    return _averaged(image, canvas)


def _random_matrix(radius: float, angle: float, rng: np.random.Generator) -> np.ndarray:
    """Random stretch, shear and mirror image [2, 2] of a square of half side `radius`, px, turned by `angle`, rad."""
    stretch = np.exp(rng.normal(0, 0.12, 2))
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shear = np.array([[1.0, rng.normal(0, 0.1)], [0.0, 1.0]])
    flip = np.diag([rng.choice((-1.0, 1.0)), 1.0])
    return radius * rotation @ shear @ np.diag(stretch) @ flip


def _bounds(parts: tuple[Part, ...], matrix: np.ndarray) -> np.ndarray:
    """Corners [2, 2] of the smallest upright box around an object: (left, top), (right, bottom)."""
    scale = np.sqrt(abs(np.linalg.det(matrix)))
    boxes = []
    for part in parts:
        points = np.array(part.points) @ matrix.T
        reach = 0.5 * LINE_SHARE * part.line_width * scale
        boxes.append(np.array([points.min(axis=0) - reach, points.max(axis=0) + reach]))
    return _union(boxes)


def _union(boxes: list[np.ndarray]) -> np.ndarray:
    return np.array([np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)])


def _stacked(boxes: list[np.ndarray]) -> list[np.ndarray]:
    """Shifts [2] that put the first box on the second, middle over middle, where they touch at height 0."""
    return [np.array([-box[:, 0].mean(), -box[edge, 1]]) for box, edge in zip(boxes, (1, 0), strict=True)]


def _side_by_side(boxes: list[np.ndarray], gap: float) -> list[np.ndarray]:
    """Shifts [2] that put the first box left of the second, on one ground at height 0."""
    return [
        np.array([side * gap / 2 - box[edge, 0], -box[1, 1]])
        for box, edge, side in zip(boxes, (1, 0), (-1, 1), strict=True)
    ]


def _enlarged(canvas: np.ndarray, supersampling: int) -> tuple[np.ndarray, float]:
    """The background to draw on, float32, and half its shorter side, px."""
    height, width = canvas.shape[:2]
    size = (width * supersampling, height * supersampling)
    image = cv2.resize(canvas, size, interpolation=cv2.INTER_LINEAR).astype(np.float32)
    return image, min(size) / 2


def _averaged(image: np.ndarray, canvas: np.ndarray) -> np.ndarray:
    small = cv2.resize(image, canvas.shape[1::-1], interpolation=cv2.INTER_AREA)
    return np.clip(small, 0, 255).astype(np.uint8)


def _middle(image: np.ndarray) -> np.ndarray:
    return np.array(image.shape[1::-1]) / 2


def _paint(
    image: np.ndarray,
    parts: tuple[Part, ...],
    colour: str,
    placement: _Placement,
    half: float,
    rng: np.random.Generator,
) -> None:
    """Draw the parts of one object, each over those before, in a light that falls off across the picture."""
    base = np.clip(np.array(COLOURS[colour]) + rng.normal(0, 14, 3), 15, 245)
    light_direction, light = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.35)
    height, width = image.shape[:2]
    rows = np.arange(height, dtype=np.float32)[:, None] / half - height / 2 / half
    columns = np.arange(width, dtype=np.float32) / half - width / 2 / half
    shading = 1 + light * (rows * np.sin(light_direction) + columns * np.cos(light_direction))
    for part in parts:
        jitter = rng.normal(0, 0.025, 2) if len(part.points) > 8 else rng.normal(0, 0.03, (len(part.points), 2))
        points = (np.array(part.points) + jitter) @ placement.matrix.T + placement.centre
        points = points.round().astype(np.int32)
        mask = np.zeros((height, width), np.uint8)
        if part.line_width:
            thickness = max(1, round(part.line_width * placement.radius * LINE_SHARE))
            cv2.polylines(mask, [points], False, 1, thickness)
        else:
            cv2.fillPoly(mask, [points], 1)
        tone = part.tone * float(np.exp(rng.normal(0, 0.08)))
        # Lighter tones move towards white, darker ones towards black, so that a part stays visible on any colour.
        fill = base * tone if tone <= 1 else base + (255 - base) * min(tone - 1, 0.95)
        inside = mask.astype(bool)
        image[inside] = fill * shading[inside][:, None]
