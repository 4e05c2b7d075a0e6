"""2D skeletons as coloured pictures, in the manner of OpenPose: what a pose ControlNet is conditioned on.

Source: limb order and colours of the 18-joint map of Cao et al., OpenPose (CVPR 2017), as drawn for ControlNet v1.0;
the neck, which DHP19 does not label, is the middle of the shoulders.
"""

from __future__ import annotations

import cv2
import numpy as np

from ctlev_core.skeletons import JOINT_SETS
from data_contracts.errors import DataError

# The hue wheel of OpenPose-18, RGB: limb i has colour i, joint i of OpenPose's order has colour i.
COLOURS = (
    (255, 0, 0), (255, 85, 0), (255, 170, 0), (255, 255, 0), (170, 255, 0), (85, 255, 0), (0, 255, 0), (0, 255, 85),
    (0, 255, 170), (0, 255, 255), (0, 170, 255), (0, 85, 255), (0, 0, 255), (85, 0, 255), (170, 0, 255), (255, 0, 255),
    (255, 0, 170), (255, 0, 85),
)  # fmt: skip

# OpenPose's first 14 joints; the eyes and ears have no counterpart in any joint set here.
OPENPOSE_JOINTS = (
    "head", "neck", "right_shoulder", "right_elbow", "right_hand", "left_shoulder", "left_elbow", "left_hand",
    "right_hip", "right_knee", "right_foot", "left_hip", "left_knee", "left_foot",
)  # fmt: skip
LIMBS = (
    ("neck", "right_shoulder"),
    ("neck", "left_shoulder"),
    ("right_shoulder", "right_elbow"),
    ("right_elbow", "right_hand"),
    ("left_shoulder", "left_elbow"),
    ("left_elbow", "left_hand"),
    ("neck", "right_hip"),
    ("right_hip", "right_knee"),
    ("right_knee", "right_foot"),
    ("neck", "left_hip"),
    ("left_hip", "left_knee"),
    ("left_knee", "left_foot"),
    ("neck", "head"),
)

OVERSAMPLING = 4
SUBPIXEL_BITS = 4
LIMB_WIDTH = 1 / 32
"""Width of a limb over the shorter side of the image, as thick at 64 px as limbs of 2 px."""
JOINT_RADIUS = 1.5 / 64
FAR_AWAY = 4.0
"""Ends of limbs further outside than this many image sizes are pulled in along the limb, to stay within 16 bits."""


def draw_skeleton(joints2d: np.ndarray, visible: np.ndarray, joint_set: str, image_size: tuple[int, int]) -> np.ndarray:
    """Draw one person on black.

    A limb is drawn where both of its ends are visible and finite, whether they lie in the image or not.

    Args:
        joints2d: [J, 2] px of an image of `image_size`; pixel centres at integer + 0.5.
        visible: [J] bool.
        joint_set: a key of `ctlev_core.skeletons.JOINT_SETS`.
        image_size: (width, height) px.
    Returns:
        [H, W, 3] uint8 RGB.
    Raises:
        DataError: unknown joint set, or arrays of another number of joints.
    """
    positions = _named_positions(joints2d, visible, joint_set)
    width, height = image_size
    canvas = np.zeros((OVERSAMPLING * height, OVERSAMPLING * width, 3), np.uint8)
    side = OVERSAMPLING * min(width, height)
    thickness = max(1, round(LIMB_WIDTH * side))
    for colour, (start, end) in zip(COLOURS, LIMBS, strict=False):
        if start in positions and end in positions:
            ends = _clip_segment(positions[start], positions[end], image_size)
            if ends is not None:
                tips = _fixed_point(ends[0]), _fixed_point(ends[1])
                cv2.line(canvas, tips[0], tips[1], colour, thickness, cv2.LINE_AA, SUBPIXEL_BITS)
    radius = round(JOINT_RADIUS * side * 2**SUBPIXEL_BITS)
    for colour, name in zip(COLOURS, OPENPOSE_JOINTS, strict=False):
        if name in positions and _clip_segment(positions[name], positions[name], image_size) is not None:
            cv2.circle(canvas, _fixed_point(positions[name]), radius, colour, -1, cv2.LINE_AA, SUBPIXEL_BITS)
    return cv2.resize(canvas, image_size, interpolation=cv2.INTER_AREA)


def _named_positions(joints2d: np.ndarray, visible: np.ndarray, joint_set: str) -> dict[str, np.ndarray]:
    """The joints to draw, by name, with the neck where both shoulders are known."""
    if joint_set not in JOINT_SETS:
        raise DataError(f"unknown joint set {joint_set!r}; known: {', '.join(JOINT_SETS)}")
    names = JOINT_SETS[joint_set].joints
    if np.shape(joints2d) != (len(names), 2) or np.shape(visible) != (len(names),):
        shapes = f"{np.shape(joints2d)} and {np.shape(visible)}"
        raise DataError(
            f"joint set {joint_set!r} needs joints2d [{len(names)}, 2] and visible [{len(names)}], got {shapes}"
        )
    positions = {
        name: np.asarray(joint, dtype=np.float64)
        for name, joint, seen in zip(names, joints2d, visible, strict=True)
        if seen and np.isfinite(joint).all()
    }
    if "neck" not in positions and "left_shoulder" in positions and "right_shoulder" in positions:
        positions["neck"] = (positions["left_shoulder"] + positions["right_shoulder"]) / 2
    return positions


def _clip_segment(
    start: np.ndarray, end: np.ndarray, image_size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray] | None:
    """The part of a segment within `FAR_AWAY` image sizes, or None (Liang-Barsky)."""
    size = np.asarray(image_size, dtype=np.float64)
    low, high = -FAR_AWAY * size, (1 + FAR_AWAY) * size
    first, last = 0.0, 1.0
    for axis in range(2):
        step = end[axis] - start[axis]
        if step == 0.0:
            if not low[axis] <= start[axis] <= high[axis]:
                return None
            continue
        bounds = sorted(((low[axis] - start[axis]) / step, (high[axis] - start[axis]) / step))
        first, last = max(first, bounds[0]), min(last, bounds[1])
    if first > last:
        return None
    return start + first * (end - start), start + last * (end - start)


def _fixed_point(position: np.ndarray) -> tuple[int, int]:
    """Position on the fine canvas in cv2's fixed point, whose pixel centres lie at integers."""
    x, y = np.rint((position * OVERSAMPLING - 0.5) * 2**SUBPIXEL_BITS).astype(int)
    return int(x), int(y)
