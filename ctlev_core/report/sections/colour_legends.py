"""What the colours of conditions and event images mean."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ctlev_core.render.normals import normal_map
from ctlev_core.render.skeleton import COLOURS, LIMBS
from ctlev_core.report.page.html import Colours

_PARTS = {"right arm": (3, 4), "left arm": (6, 7), "right leg": (9, 10), "left leg": (12, 13), "head": (0, 14, 15)}
"""Limbs of a skeleton, by the joint of OpenPose at their far end."""
_DIRECTIONS = {
    "facing the camera": (0, 0, -1), "facing left": (-1, 0, 0), "facing right": (1, 0, 0), "facing up": (0, -1, 0),
    "facing down": (0, 1, 0),
}  # fmt: skip
"""In camera coordinates: x to the right, y down, z away from the camera."""


def event_colours(image: np.ndarray) -> list[tuple[str, str]]:
    """Of event images like this one [H, W, 3] uint8: green is drawn by `time_bins` alone."""
    if (image == image[..., :1]).all():
        return [(_gradient((60, 60, 60), (255, 255, 255)), "events: the brighter, the more"), ("#000", "no event")]
    if image[..., 1].any():
        return [("#f00", "first third of the time"), ("#0f0", "second"), ("#00f", "last"), ("#000", "no event")]
    return [
        ("#f00", "it got brighter (ON events)"), ("#00f", "it got darker (OFF events)"), ("#f0f", "both"),
        ("#000", "no event"),
    ]  # fmt: skip


def condition_colours(kind: str, options: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Of the conditions that a plug-in draws; nothing where colours have no meaning of their own.

    Args:
        kind: name of the plug-in.
        options: of it, as they are recorded.
    """
    if kind == "skeleton":
        ends = [end for _, end in LIMBS]
        limbs = {part: [COLOURS[ends.index(joint)] for joint in joints] for part, joints in _PARTS.items()}
        return [(_gradient(*colours), part) for part, colours in limbs.items()]
    if kind == "normals":
        normals = np.array(list(_DIRECTIONS.values()), np.float32)[None, None]
        colours = normal_map(normals, options.get("convention", "controlnet"))[0, 0]
        return [(_gradient(colour, colour), words) for words, colour in zip(_DIRECTIONS, colours.tolist(), strict=True)]
    return []


def _gradient(*colours: tuple[int, ...]) -> str:
    if len(set(map(tuple, colours))) == 1:
        return f"rgb({', '.join(map(str, colours[0]))})"
    return f"linear-gradient(90deg, {', '.join(f'rgb({r}, {g}, {b})' for r, g, b in colours)})"


def all_colours(kind: str, options: Mapping[str, Any], image: np.ndarray) -> Colours:
    """Of conditions, then of event images."""
    return [*condition_colours(kind, options), *event_colours(image)]
