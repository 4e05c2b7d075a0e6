"""Everyday objects as a few flat parts each: what the small base model's pictures and `studio_objects` are drawn from.

Every noun is a tuple of parts in a square of [-1, 1] x [-1, 1], x right and y down. A part is a filled polygon, a
filled ellipse or a thick line, with a tone: 1 takes the object's colour, below 1 darkens it, above 1 lightens it.
`ctlev_core.studio.object_drawing` draws them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

COLOURS = {
    "red": (205, 45, 40), "orange": (235, 135, 40), "yellow": (235, 215, 60), "green": (60, 160, 70),
    "blue": (45, 90, 200), "purple": (130, 65, 165), "pink": (235, 135, 175), "brown": (125, 85, 50),
    "white": (235, 235, 232), "grey": (130, 130, 132), "black": (32, 32, 36), "cyan": (70, 195, 210),
}  # fmt: skip


@dataclass(frozen=True)
class Part:
    """One flat part of an object: its outline [K, 2] in the unit square, how it is filled, and its tone."""

    points: tuple[tuple[float, float], ...]
    tone: float = 1.0
    line_width: float = 0.0


def _poly(*points: tuple[float, float], tone: float = 1.0) -> Part:
    return Part(points, tone)


def _box(left: float, top: float, right: float, bottom: float, tone: float = 1.0) -> Part:
    return Part(((left, top), (right, top), (right, bottom), (left, bottom)), tone)


def _disc(x: float, y: float, radius_x: float, radius_y: float | None = None, tone: float = 1.0) -> Part:
    radius_y = radius_x if radius_y is None else radius_y
    angles = np.linspace(0, 2 * np.pi, 28, endpoint=False)
    return Part(tuple((x + radius_x * np.cos(a), y + radius_y * np.sin(a)) for a in angles), tone)


def _line(*points: tuple[float, float], width: float = 0.12, tone: float = 1.0) -> Part:
    return Part(points, tone, width)


def _arc(x: float, y: float, radius: float, start: float, stop: float, width: float = 0.12, tone: float = 1.0) -> Part:
    angles = np.radians(np.linspace(start, stop, 16))
    return Part(tuple((x + radius * np.cos(a), y + radius * np.sin(a)) for a in angles), tone, width)


def _star(spikes: int, inner: float) -> Part:
    angles = np.pi * np.arange(2 * spikes) / spikes - np.pi / 2
    radii = np.where(np.arange(2 * spikes) % 2, inner, 1.0)
    return Part(tuple((r * np.cos(a), r * np.sin(a)) for r, a in zip(radii, angles, strict=True)))


def _wheels(y: float, radius: float, *xs: float) -> tuple[Part, ...]:
    return tuple(part for x in xs for part in (_disc(x, y, radius, tone=0.3), _disc(x, y, radius * 0.45, tone=1.6)))


OBJECTS: dict[str, tuple[Part, ...]] = {
    "ball": (_disc(0, 0, 0.9), _arc(-0.9, 0, 0.9, -60, 60, 0.06, 0.5), _arc(0.9, 0, 0.9, 120, 240, 0.06, 0.5)),
    "box": (
        _box(-0.8, -0.3, 0.5, 0.9), _poly((-0.8, -0.3), (-0.45, -0.8), (0.85, -0.8), (0.5, -0.3), tone=1.4),
        _poly((0.5, -0.3), (0.85, -0.8), (0.85, 0.4), (0.5, 0.9), tone=0.6),
    ),
    "ring": (_arc(0, 0, 0.75, 0, 360, 0.3),),
    "star": (_star(5, 0.42),),
    "sun": (_star(10, 0.7), _disc(0, 0, 0.55, tone=1.3)),
    "moon": (
        _poly(*[(0.9 * np.cos(a), 0.9 * np.sin(a)) for a in np.radians(np.linspace(40, 320, 24))], *[(0.45 +
            0.62 * np.cos(a), 0.62 * np.sin(a)) for a in np.radians(np.linspace(290, 70, 18))]),
    ),
    "cross": (_box(-0.28, -0.9, 0.28, 0.9), _box(-0.9, -0.28, 0.9, 0.28)),
    "heart": (
        _poly(*[(0.056 * 16 * np.sin(a) ** 3, -0.056 * (13 * np.cos(a) - 5 * np.cos(2 * a) - 2 * np.cos(3 * a) -
            np.cos(4 * a))) for a in np.linspace(0, 2 * np.pi, 40)]),
    ),
    "arrow": (_poly((-0.95, -0.2), (0.2, -0.2), (0.2, -0.6), (0.95, 0), (0.2, 0.6), (0.2, 0.2), (-0.95, 0.2)),),
    "pyramid": (_poly((0, -0.85), (0.2, 0.85), (-0.9, 0.6)), _poly((0, -0.85), (0.9, 0.45), (0.2, 0.85), tone=0.6)),
    "car": (
        _poly((-0.95, 0.35), (-0.95, 0), (-0.55, -0.05), (-0.3, -0.45), (0.35, -0.45), (0.6, -0.05), (0.95,
            0.05), (0.95, 0.35)),
        _poly((-0.4, -0.05), (-0.22, -0.36), (0.3, -0.36), (0.45, -0.05), tone=1.7), *_wheels(0.38, 0.24, -0.5, 0.52),
    ),
    "bus": (
        _box(-0.95, -0.6, 0.95, 0.45), *[_box(x, -0.4, x + 0.32, 0, tone=1.7) for x in (-0.85, -0.42, 0.01, 0.44)],
        *_wheels(0.48, 0.22, -0.55, 0.55),
    ),
    "truck": (
        _box(-0.95, -0.6, 0.25, 0.35),
        _poly((0.3, 0.35), (0.3, -0.3), (0.7, -0.3), (0.95, 0), (0.95, 0.35), tone=0.7),
        *_wheels(0.42, 0.22, -0.6, -0.1, 0.65),
    ),
    "bicycle": (
        _arc(-0.55, 0.3, 0.38, 0, 360, 0.07, 0.4), _arc(0.55, 0.3, 0.38, 0, 360, 0.07, 0.4),
        _line((-0.55, 0.3), (-0.2, -0.3), (0.35, -0.3), (0.05, 0.3), (-0.2, -0.3), width=0.09),
        _line((0.05, 0.3), (-0.55, 0.3), width=0.09), _line((0.55, 0.3), (0.3, -0.5), (0.5, -0.55), width=0.09),
        _line((-0.35, -0.45), (-0.08, -0.45), width=0.12, tone=0.5),
    ),
    "boat": (
        _poly((-0.9, 0.35), (0.9, 0.35), (0.6, 0.8), (-0.6, 0.8)), _line((0, 0.35), (0, -0.9), width=0.08, tone=0.5),
        _poly((0.08, -0.85), (0.75, 0.2), (0.08, 0.2), tone=1.6),
        _poly((-0.08, -0.6), (-0.08, 0.2), (-0.6, 0.2), tone=1.3),
    ),
    "airplane": (
        _disc(0, 0, 0.95, 0.16), _poly((-0.15, 0), (0.25, 0), (-0.25, 0.8), (-0.45, 0.8), tone=0.7),
        _poly((-0.15, 0), (0.25, 0), (-0.25, -0.8), (-0.45, -0.8), tone=1.3),
        _poly((-0.7, 0), (-0.55, 0), (-0.8, -0.4), (-0.98, -0.4), tone=0.7),
    ),
    "house": (
        _box(-0.7, -0.1, 0.7, 0.9), _poly((-0.95, -0.1), (0, -0.9), (0.95, -0.1), tone=0.55),
        _box(-0.15, 0.35, 0.2, 0.9, tone=0.4), _box(0.32, 0.1, 0.58, 0.4, tone=1.7),
        _box(-0.55, 0.1, -0.28, 0.4, tone=1.7),
    ),
    "tower": (
        _poly((-0.3, 0.95), (-0.2, -0.5), (0.2, -0.5), (0.3, 0.95)), _box(-0.32, -0.62, 0.32, -0.42, tone=0.6),
        _poly((-0.28, -0.6), (0, -0.98), (0.28, -0.6), tone=0.5), _box(-0.08, -0.2, 0.08, 0.1, tone=1.7),
    ),
    "bridge": (
        _box(-0.98, 0.0, 0.98, 0.16), _arc(0, 0.75, 0.75, 180, 360, 0.13, 0.7), _box(-0.9, 0, -0.72, 0.9, tone=0.6),
        _box(0.72, 0, 0.9, 0.9, tone=0.6),
    ),
    "tree": (
        _box(-0.12, 0.2, 0.12, 0.95, tone=0.45), _disc(0, -0.3, 0.62, 0.6), _disc(-0.35, 0.05, 0.4, tone=0.8),
        _disc(0.38, 0, 0.38, tone=1.2),
    ),
    "pine": (
        _box(-0.1, 0.6, 0.1, 0.95, tone=0.45), _poly((0, -0.3), (0.75, 0.65), (-0.75, 0.65), tone=0.8),
        _poly((0, -0.65), (0.6, 0.2), (-0.6, 0.2)), _poly((0, -0.95), (0.42, -0.25), (-0.42, -0.25), tone=1.2),
    ),
    "flower": (
        *[_disc(0.5 * np.cos(a), -0.3 + 0.5 * np.sin(a), 0.27) for a in np.radians(np.arange(0, 360, 60))],
        _disc(0, -0.3, 0.26, tone=1.8), _line((0, 0.2), (0, 0.95), width=0.1, tone=0.5),
    ),
    "mushroom": (
        _box(-0.2, 0, 0.2, 0.85, tone=1.7),
        _poly(*[(0.9 * np.cos(a), 0.1 + 0.85 * np.sin(a)) for a in np.radians(np.linspace(180, 360, 20))]),
        _disc(-0.3, -0.3, 0.14, tone=1.8), _disc(0.3, -0.2, 0.12, tone=1.8),
    ),
    "apple": (
        _disc(-0.25, 0.15, 0.55, 0.65), _disc(0.25, 0.15, 0.55, 0.65),
        _line((0, -0.4), (0.1, -0.85), width=0.1, tone=0.4),
    ),
    "banana": (
        _poly(*[(0.9 * np.cos(a), -0.35 + 0.9 * np.sin(a)) for a in np.radians(np.linspace(10, 170, 18))],
            *[(0.85 * np.cos(a), -0.5 + 0.6 * np.sin(a)) for a in np.radians(np.linspace(165, 15, 18))]),
    ),
    "cup": (
        _poly((-0.6, -0.6), (0.45, -0.6), (0.35, 0.75), (-0.5, 0.75)), _disc(-0.08, -0.6, 0.52, 0.14, tone=0.5),
        _arc(0.45, 0, 0.35, -90, 90, 0.12),
    ),
    "bottle": (
        _poly((-0.32, 0.95), (-0.32, -0.1), (-0.12, -0.4), (-0.12, -0.85), (0.12, -0.85), (0.12, -0.4), (0.32,
            -0.1), (0.32, 0.95)),
        _box(-0.14, -0.97, 0.14, -0.83, tone=0.5), _box(-0.32, 0.15, 0.32, 0.6, tone=1.6),
    ),
    "vase": (
        _poly((-0.25, -0.9), (0.25, -0.9), (0.18, -0.55), (0.55, 0), (0.45, 0.6), (0.25, 0.9), (-0.25, 0.9),
            (-0.45, 0.6), (-0.55, 0), (-0.18, -0.55)),
    ),
    "chair": (
        _line((-0.5, -0.9), (-0.5, 0.9)), _box(-0.56, -0.9, -0.36, 0.1, tone=0.8), _box(-0.55, 0.05, 0.6, 0.25),
        _line((0.5, 0.2), (0.5, 0.9)), _line((-0.2, 0.2), (-0.2, 0.75), tone=0.7),
        _line((0.25, 0.2), (0.25, 0.75), tone=0.7),
    ),
    "table": (
        _poly((-0.6, -0.4), (0.6, -0.4), (0.95, -0.05), (-0.95, -0.05), tone=1.2), _line((-0.8, 0), (-0.8, 0.85)),
        _line((0.8, 0), (0.8, 0.85)), _line((-0.45, 0), (-0.45, 0.5), tone=0.7),
        _line((0.45, 0), (0.45, 0.5), tone=0.7),
    ),
    "lamp": (
        _poly((-0.35, -0.9), (0.35, -0.9), (0.65, -0.1), (-0.65, -0.1), tone=1.4),
        _line((0, -0.1), (0, 0.8), width=0.1, tone=0.6), _disc(0, 0.85, 0.4, 0.12, tone=0.6),
    ),
    "umbrella": (
        _poly(*[(0.95 * np.cos(a), 0.1 + 0.9 * np.sin(a)) for a in np.radians(np.linspace(180, 360, 20))]),
        _line((0, 0.1), (0, 0.75), (0.15, 0.85), (0.28, 0.72), width=0.09, tone=0.5),
    ),
    "clock": (
        _disc(0, 0, 0.9), _disc(0, 0, 0.74, tone=1.8), _line((0, 0), (0, -0.55), tone=0.3),
        _line((0, 0), (0.38, 0.2), tone=0.3),
    ),
    "key": (
        _arc(-0.55, 0, 0.3, 0, 360, 0.16), _line((-0.25, 0), (0.9, 0), width=0.15), _line((0.6, 0), (0.6, 0.3)),
        _line((0.85, 0), (0.85, 0.3)),
    ),
    "hammer": (
        _line((0, -0.5), (0, 0.95), width=0.16, tone=0.6), _box(-0.55, -0.8, 0.45, -0.42),
        _poly((0.45, -0.8), (0.8, -0.6), (0.45, -0.42)),
    ),
    "scissors": (
        _line((-0.35, 0.35), (0.5, -0.9), tone=1.4), _line((0.35, 0.35), (-0.5, -0.9), tone=1.2),
        _arc(-0.45, 0.6, 0.27, 0, 360), _arc(0.45, 0.6, 0.27, 0, 360),
    ),
    "ladder": (
        _line((-0.35, -0.95), (-0.35, 0.95)), _line((0.35, -0.95), (0.35, 0.95)),
        *[_line((-0.35, y), (0.35, y), width=0.09, tone=0.8) for y in (-0.65, -0.3, 0.05, 0.4, 0.75)],
    ),
    "guitar": (
        _disc(0, 0.55, 0.48, 0.4), _disc(0, 0.1, 0.34, 0.3), _disc(0, 0.35, 0.15, tone=0.3),
        _line((0, 0.3), (0, -0.8), width=0.12, tone=0.5), _box(-0.12, -0.98, 0.12, -0.75, tone=0.4),
    ),
    "book": (
        _poly((-0.9, -0.5), (0, -0.35), (0, 0.65), (-0.9, 0.5)),
        _poly((0.9, -0.5), (0, -0.35), (0, 0.65), (0.9, 0.5), tone=1.3),
    ),
    "flag": (
        _line((-0.7, -0.95), (-0.7, 0.95), width=0.1, tone=0.5),
        _poly((-0.65, -0.9), (0.0, -0.75), (0.8, -0.9), (0.8, 0), (0.0, 0.15), (-0.65, 0)),
    ),
    "hat": (_disc(0, 0.4, 0.95, 0.22), _box(-0.5, -0.5, 0.5, 0.4), _box(-0.5, 0.12, 0.5, 0.32, tone=0.4)),
    "shoe": (
        _poly((-0.85, -0.6), (-0.3, -0.6), (-0.15, -0.1), (0.8, 0.2), (0.9, 0.5), (-0.85, 0.5)),
        _box(-0.88, 0.48, 0.92, 0.66, tone=0.4),
    ),
    "phone": (_box(-0.45, -0.9, 0.45, 0.9), _box(-0.36, -0.7, 0.36, 0.6, tone=1.7), _disc(0, 0.75, 0.08, tone=0.4)),
    "camera": (
        _box(-0.9, -0.45, 0.9, 0.65), _box(-0.3, -0.7, 0.3, -0.4), _disc(0, 0.1, 0.42, tone=0.35),
        _disc(0, 0.1, 0.22, tone=1.6),
    ),
    "fish": (
        _disc(-0.15, 0, 0.7, 0.4), _poly((0.4, 0), (0.95, -0.45), (0.85, 0), (0.95, 0.45), tone=0.7),
        _disc(-0.55, -0.1, 0.08, tone=0.2),
    ),
    "bird": (
        _disc(0, 0.1, 0.6, 0.36), _disc(-0.6, -0.25, 0.26),
        _poly((-0.82, -0.3), (-0.98, -0.2), (-0.82, -0.15), tone=1.6),
        _poly((0, 0), (0.5, -0.75), (0.45, 0.1), tone=0.65),
        _poly((0.5, 0.05), (0.95, 0.0), (0.9, 0.25), (0.5, 0.25), tone=0.8),
    ),
    "butterfly": (
        _disc(-0.48, -0.35, 0.42, 0.45), _disc(0.48, -0.35, 0.42, 0.45), _disc(-0.38, 0.4, 0.32, tone=1.3),
        _disc(0.38, 0.4, 0.32, tone=1.3), _disc(0, 0, 0.09, 0.6, tone=0.3),
    ),
    "cat": (
        _disc(0, 0.15, 0.65, 0.58), _poly((-0.6, -0.1), (-0.55, -0.85), (-0.12, -0.38)),
        _poly((0.6, -0.1), (0.55, -0.85), (0.12, -0.38)), _disc(-0.25, 0.05, 0.1, tone=0.2),
        _disc(0.25, 0.05, 0.1, tone=0.2), _poly((-0.08, 0.28), (0.08, 0.28), (0, 0.38), tone=0.3),
    ),
    "dog": (
        _disc(0, 0.2, 0.36, 0.2), _box(-0.7, -0.1, 0.5, 0.35), _line((-0.6, 0.3), (-0.6, 0.9)),
        _line((0.4, 0.3), (0.4, 0.9)), _line((-0.35, 0.3), (-0.35, 0.85), tone=0.7),
        _line((0.15, 0.3), (0.15, 0.85), tone=0.7), _disc(0.62, -0.3, 0.3, 0.24),
        _poly((0.42, -0.45), (0.3, -0.1), (0.52, -0.2), tone=0.5), _line((-0.68, -0.05), (-0.95, -0.45), width=0.1),
    ),
    "face": (
        _disc(0, 0, 0.72, 0.9), _disc(-0.27, -0.2, 0.1, 0.07, tone=0.25), _disc(0.27, -0.2, 0.1, 0.07, tone=0.25),
        _line((0, -0.1), (-0.06, 0.2), (0.06, 0.22), width=0.07, tone=0.6), _arc(0, 0.25, 0.32, 20, 160, 0.09, 0.3),
    ),
    "person": (
        _disc(0, -0.72, 0.2), _box(-0.26, -0.48, 0.26, 0.2, tone=0.8),
        _line((-0.26, -0.4), (-0.55, 0.15), width=0.16), _line((0.26, -0.4), (0.55, 0.15), width=0.16),
        _line((-0.13, 0.2), (-0.2, 0.95), width=0.2, tone=0.5), _line((0.13, 0.2), (0.2, 0.95), width=0.2, tone=0.5),
    ),
    "hand": (
        _box(-0.4, -0.1, 0.35, 0.8),
        *[_line((x, 0), (1.25 * x, y), width=0.17) for x, y in ((-0.32, -0.65), (-0.1, -0.9), (0.12, -0.85),
            (0.3, -0.6))],
        _line((0.3, 0.5), (0.75, 0.05), width=0.19),
    ),
    "street": (
        _poly((-0.98, 0.95), (-0.15, -0.4), (0.15, -0.4), (0.98, 0.95), tone=0.6),
        _line((0, 0.9), (0, 0.4), tone=1.9), _line((0, 0.15), (0, -0.3), width=0.06, tone=1.9),
        _box(-0.98, -0.9, -0.45, 0.3), _box(0.45, -0.7, 0.98, 0.3, tone=1.3),
    ),
    "road": (
        _poly((-0.6, 0.98), (-0.2, -0.98), (0.2, -0.98), (0.6, 0.98), tone=0.7), _line((0, 0.9), (0, 0.35), tone=1.9),
        _line((0, 0.1), (0, -0.35), tone=1.9), _line((0, -0.55), (0, -0.85), width=0.08, tone=1.9),
    ),
    "light": (
        _line((0, 0.95), (0, -0.2), width=0.12, tone=0.5), _box(-0.28, -0.95, 0.28, 0.0, tone=0.6),
        _disc(0, -0.75, 0.14, tone=1.9), _disc(0, -0.47, 0.14), _disc(0, -0.2, 0.14, tone=1.3),
    ),
    "spot": (_disc(0, 0, 0.35),),
    "wheel": (
        _arc(0, 0, 0.8, 0, 360, 0.22, 0.5),
        *[_line((0, 0), (0.75 * np.cos(a), 0.75 * np.sin(a)), width=0.08) for a in np.radians(np.arange(0, 360,
            60))],
        _disc(0, 0, 0.16, tone=1.4),
    ),
    "windmill": (
        _poly((-0.35, 0.95), (-0.18, -0.25), (0.18, -0.25), (0.35, 0.95)),
        *[_line((0, -0.25), (0.7 * np.cos(a), -0.25 + 0.7 * np.sin(a)), width=0.16, tone=1.6) for a in
            np.radians((30, 120, 210, 300))],
    ),
}  # fmt: skip

# Names are of the thing itself: no parts, no other noun's, and no noun of `OBJECTS` that looks otherwise.
NAMES: dict[str, list[str]] = {
    "airplane": ["airplane", "plane", "aircraft"],
    "bicycle": ["bicycle", "bike", "cycle"],
    "boat": ["boat", "sailboat", "ship"],
    "butterfly": ["butterfly", "moth"],
    "car": ["car", "sedan", "automobile"],
    "cat": ["cat", "kitten", "kitty"],
    "chair": ["chair", "seat"],
    "clock": ["clock", "watch", "timepiece"],
    "cup": ["cup", "mug", "teacup"],
    "dog": ["dog", "puppy", "hound"],
    "fish": ["fish", "goldfish"],
    "flower": ["flower", "blossom", "bloom"],
    "guitar": ["guitar", "acoustic guitar"],
    "hammer": ["hammer", "mallet"],
    "house": ["house", "home", "cottage"],
    "key": ["key", "door key", "latchkey"],
    "ladder": ["ladder", "stepladder"],
    "lamp": ["lamp", "desk lamp", "lantern"],
    "pine": ["pine", "pine tree", "fir"],
    "scissors": ["scissors", "shears"],
    "shoe": ["shoe", "sneaker", "trainer"],
    "star": ["star", "pentagram"],
    "umbrella": ["umbrella", "parasol"],
    "windmill": ["windmill", "mill"],
}
"""What else some nouns are called; the noun itself comes first."""
