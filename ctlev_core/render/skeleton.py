"""2D skeletons as coloured pictures, in the manner of OpenPose: what a pose ControlNet is conditioned on.

Two drawings of OpenPose's 18 joints and 17 limbs, as far as a joint set has them:

- `smooth`: anti-aliased, in fractions of a pixel and of the image, limbs below joints; a joint that moves by a tenth of
  a pixel moves the picture, also at 64 px. The bundled base model was trained with it.
- `openpose`: ControlNet v1.0's, pixel by pixel, for its published checkpoints.

Source: limbs and colours of Cao et al., OpenPose (CVPR 2017); `openpose` as `draw_bodypose` of lllyasviel/ControlNet,
annotator/openpose/util.py (v1.0; v1.1 and controlnet_aux draw limbs first, darken them, and so make other pictures).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numba
import numpy as np

from ctlev_core.geometry.joint_sets import JOINT_SETS, openpose_sources
from data_contracts.errors import DataError

DRAWINGS = ("smooth", "openpose")

# The hue wheel of OpenPose-18, RGB: limb i has colour i, joint i has colour i.
COLOURS = (
    (255, 0, 0), (255, 85, 0), (255, 170, 0), (255, 255, 0), (170, 255, 0), (85, 255, 0), (0, 255, 0), (0, 255, 85),
    (0, 255, 170), (0, 255, 255), (0, 170, 255), (0, 85, 255), (0, 0, 255), (85, 0, 255), (170, 0, 255), (255, 0, 255),
    (255, 0, 170), (255, 0, 85),
)  # fmt: skip

# Ends of the limbs as joints of OpenPose, in the order of drawing.
LIMBS = (
    (1, 2), (1, 5), (2, 3), (3, 4), (5, 6), (6, 7), (1, 8), (8, 9), (9, 10), (1, 11), (11, 12), (12, 13), (1, 0),
    (0, 14), (14, 16), (0, 15), (15, 17),
)  # fmt: skip

OVERSAMPLING = 4
SUBPIXEL_BITS = 4
LIMB_WIDTH = 1 / 32
"""Width of a limb over the shorter side of the image, as thick at 64 px as limbs of 2 px."""
JOINT_RADIUS = 1.5 / 64
FAR_AWAY = 4.0
"""Ends of limbs further outside than this many image sizes are pulled in along the limb, to stay within 16 bits."""

STICK_WIDTH_PX = 4
"""ControlNet v1.0: half the width of a limb, and the radius of a joint, at its 512 px."""
CONTROLNET_SIDE_PX = 512

NOWHERE_PX = 1e12
"""A coordinate as large as this, or NaN, is no position: sums of such lose all digits or overflow."""
CORNER_BITS = 16
LARGEST_BAR_PX = 1600
"""Image size up to which the corners of limbs, with ends that are `FAR_AWAY`, are 32-bit numbers."""

Point = tuple[float, float]
Pixel = tuple[int, int]
Colour = tuple[int, int, int]


def draw_skeleton(
    joints2d: np.ndarray,
    visible: np.ndarray,
    joint_set: str,
    image_size: tuple[int, int],
    drawing: str = "smooth",
    stick_width_px: int | None = None,
) -> np.ndarray:
    """Draw one person on black.

    A joint is drawn where it is visible and finite (and within 1e12 px), a limb where both of its ends are.

    `openpose` works in whole pixels, as the peaks of OpenPose's heat maps are: a joint is the pixel in which it lies,
    floor(x), whose centre is at floor(x) + 0.5 here and at floor(x) in OpenCV. Joints outside the image are left out,
    since OpenPose finds none there. `smooth` draws limbs up to the border.

    Args:
        joints2d: [J, 2] px of an image of `image_size`; pixel centres at integer + 0.5.
        visible: [J] bool.
        joint_set: a key of `ctlev_core.geometry.joint_sets.JOINT_SETS`; see `openpose_sources` for what becomes of its
            joints.
        image_size: (width, height) px.
        drawing: one of `DRAWINGS`.
        stick_width_px: of `openpose`, half the width of limbs and the radius of joints; None scales ControlNet's 4 px
            of 512 to the shorter side of the image, 1 px at least. v1.0 itself draws at 512 and resizes.
    Returns:
        [H, W, 3] uint8 RGB.
    Raises:
        DataError: unknown joint set, arrays of another number of joints, or an image without pixels.
        ValueError: unknown drawing, or a stick width below 1 px.
    """
    if drawing not in DRAWINGS:
        raise ValueError(f"unknown drawing {drawing!r}; known: {', '.join(DRAWINGS)}")
    if stick_width_px is not None and stick_width_px < 1:
        raise ValueError(f"the stick width must be 1 px or more, got {stick_width_px}")
    if min(image_size) < 1:
        raise DataError(f"image_size must be (width, height) of 1 px or more, got {image_size}")
    joints = _openpose_joints(joints2d, visible, joint_set)
    if drawing == "smooth":
        return _draw_smooth(joints, image_size)
    scaled = max(1, round(STICK_WIDTH_PX * min(image_size) / CONTROLNET_SIDE_PX))
    return _draw_openpose(joints, image_size, scaled if stick_width_px is None else stick_width_px)


def _openpose_joints(joints2d: np.ndarray, visible: np.ndarray, joint_set: str) -> list[Point | None]:
    """OpenPose's joints; None where the set has none, or it is not visible or not finite."""
    sources = openpose_sources(joint_set)
    count = len(JOINT_SETS[joint_set].joints)
    if np.shape(joints2d) != (count, 2) or np.shape(visible) != (count,):
        shapes = f"{np.shape(joints2d)} and {np.shape(visible)}"
        raise DataError(f"joint set {joint_set!r} needs joints2d [{count}, 2] and visible [{count}], got {shapes}")
    # Python's numbers: calls on arrays of two would take longer than the drawing.
    known: list[Point | None] = [
        (x, y) if seen and abs(x) < NOWHERE_PX and abs(y) < NOWHERE_PX else None
        for (x, y), seen in zip(
            np.asarray(joints2d, dtype=np.float64).tolist(), np.asarray(visible).tolist(), strict=True
        )
    ]
    return [_mean([known[part] for part in parts]) for parts in sources]


def _mean(points: Sequence[Point | None]) -> Point | None:
    """The middle of one or two points; None of none, or where one is missing."""
    first, last = (points[0], points[-1]) if points else (None, None)
    if first is None or last is None:
        return None
    return first if len(points) == 1 else ((first[0] + last[0]) / 2, (first[1] + last[1]) / 2)


def _draw_smooth(joints: Sequence[Point | None], image_size: tuple[int, int]) -> np.ndarray:
    """Drawn on a canvas four times as fine, which covers the skeleton alone, and averaged."""
    width, height = image_size
    segments: list[tuple[Colour, Point, Point]] = []
    for colour, (start, end) in zip(COLOURS, LIMBS, strict=False):
        first, last = joints[start], joints[end]
        ends = None if first is None or last is None else _clip_segment(first, last, image_size)
        if ends is not None:
            segments.append((colour, *ends))
    dots = [
        (colour, joint)
        for colour, joint in zip(COLOURS, joints, strict=True)
        if joint is not None and _is_near(joint, image_size)
    ]
    side = OVERSAMPLING * min(width, height)
    thickness = max(1, round(LIMB_WIDTH * side))
    radius = round(JOINT_RADIUS * side * 2**SUBPIXEL_BITS)
    reach = max(thickness / 2, radius / 2**SUBPIXEL_BITS) / OVERSAMPLING
    image = np.zeros((height, width, 3), np.uint8)
    points = [point for _, *ends in segments for point in ends] + [joint for _, joint in dots]
    box = _bounding_box(points, reach, image_size)
    if box is None:
        return image
    left, top, right, bottom = box
    canvas = np.zeros((OVERSAMPLING * (bottom - top), OVERSAMPLING * (right - left), 3), np.uint8)

    unit = 1 << SUBPIXEL_BITS
    shift_x, shift_y = unit * OVERSAMPLING * left, unit * OVERSAMPLING * top

    def fixed_point(point: Point) -> Pixel:
        """Position on the canvas in cv2's fixed point, whose pixel centres lie at integers."""
        x, y = point
        return round((x * OVERSAMPLING - 0.5) * unit) - shift_x, round((y * OVERSAMPLING - 0.5) * unit) - shift_y

    # Round ends lie under the discs, where these are wider by some px of the canvas.
    ends_are_hidden = radius / unit - thickness / 2 >= 3.0 and max(image_size) <= LARGEST_BAR_PX
    draw_limb = _draw_bar if ends_are_hidden else _draw_round_bar
    for colour, start, end in segments:
        draw_limb(canvas, fixed_point(start), fixed_point(end), colour, thickness)
    for colour, joint in dots:
        cv2.circle(canvas, fixed_point(joint), radius, colour, -1, cv2.LINE_AA, SUBPIXEL_BITS)
    _average_blocks(canvas.reshape(len(canvas), -1), image[top:bottom, left:right])
    return image


def _draw_round_bar(canvas: np.ndarray, start: Pixel, end: Pixel, colour: Colour, thickness: int) -> None:
    cv2.line(canvas, start, end, colour, thickness, cv2.LINE_AA, SUBPIXEL_BITS)


def _draw_bar(canvas: np.ndarray, start: Pixel, end: Pixel, colour: Colour, thickness: int) -> None:
    """The line of `_draw_round_bar` without its round ends, which take OpenCV about as long as the rest.

    Its corners are rounded to 1 / 65,536 px as `cv2.line` rounds them; so the pixels are the same, too.
    """
    finer = CORNER_BITS - SUBPIXEL_BITS
    x0, y0, x1, y1 = start[0] << finer, start[1] << finer, end[0] << finer, end[1] << finer
    length = math.hypot(x1 - x0, y1 - y0)
    if length == 0.0:
        return
    half_width = (thickness << (CORNER_BITS - 1)) + (thickness & 1) * (1 << (CORNER_BITS - 1))
    across_x, across_y = round((y1 - y0) * half_width / length), round((x0 - x1) * half_width / length)
    corners = (
        (x0 + across_x, y0 + across_y), (x0 - across_x, y0 - across_y),
        (x1 - across_x, y1 - across_y), (x1 + across_x, y1 + across_y),
    )  # fmt: skip
    cv2.fillConvexPoly(canvas, np.array(corners, np.int32), colour, cv2.LINE_AA, CORNER_BITS)


def _draw_openpose(joints: Sequence[Point | None], image_size: tuple[int, int], stick_width: int) -> np.ndarray:
    """ControlNet v1.0: discs, then each limb, an ellipse, blended .6 over what is there.

    v1.0 blends the whole picture for each limb. Outside the ellipse both layers are the same, and .4 v + .6 v rounds to
    v; so here only the ellipse's box is blended, to the same picture.
    """
    width, height = image_size
    image = np.zeros((height, width, 3), np.uint8)
    pixels: list[Pixel | None] = [
        (math.floor(joint[0]), math.floor(joint[1]))
        if joint is not None and 0 <= joint[0] < width and 0 <= joint[1] < height
        else None
        for joint in joints
    ]
    for colour, pixel in zip(COLOURS, pixels, strict=True):
        if pixel is not None:
            cv2.circle(image, pixel, stick_width, colour, -1)
    for colour, (start, end) in zip(COLOURS, LIMBS, strict=False):
        first, last = pixels[start], pixels[end]
        if first is None or last is None:
            continue
        step_x, step_y = first[0] - last[0], first[1] - last[1]
        # v1.0 truncates the centre, half the length and the angle.
        centre = (first[0] + last[0]) // 2, (first[1] + last[1]) // 2
        half_length = int((step_x**2 + step_y**2) ** 0.5 / 2)
        angle_deg = int(math.degrees(math.atan2(step_y, step_x)))
        outline: np.ndarray = np.asarray(cv2.ellipse2Poly(centre, (half_length, stick_width), angle_deg, 0, 360, 1))
        x, y, box_width, box_height = cv2.boundingRect(outline)
        left, top = max(x, 0), max(y, 0)
        below = image[top : y + box_height, left : x + box_width]
        above = cv2.fillConvexPoly(below.copy(), outline - (left, top), colour)
        below[:] = cv2.addWeighted(below, 0.4, above, 0.6, 0)
    return image


def _bounding_box(
    points: Sequence[Point], reach: float, image_size: tuple[int, int]
) -> tuple[int, int, int, int] | None:
    """Left, top, right, bottom in whole px of what is drawn within `reach` of the points; None = not in the image."""
    if not points:
        return None
    margin = reach + 1.0  # the soft edge is less than a pixel wide
    xs, ys = zip(*points, strict=True)
    left, top = max(0, math.floor(min(xs) - margin)), max(0, math.floor(min(ys) - margin))
    right, bottom = (
        min(image_size[0], math.ceil(max(xs) + margin)),
        min(image_size[1], math.ceil(max(ys) + margin)),
    )
    return (left, top, right, bottom) if left < right and top < bottom else None


def _is_near(point: Point, image_size: tuple[int, int]) -> bool:
    return all(-FAR_AWAY * n <= value <= (1 + FAR_AWAY) * n for value, n in zip(point, image_size, strict=True))


def _clip_segment(start: Point, end: Point, image_size: tuple[int, int]) -> tuple[Point, Point] | None:
    """The part of a segment within `FAR_AWAY` image sizes, or None (Liang-Barsky)."""
    first, last = 0.0, 1.0
    for axis in range(2):
        low, high = -FAR_AWAY * image_size[axis], (1 + FAR_AWAY) * image_size[axis]
        if low <= start[axis] <= high and low <= end[axis] <= high:
            continue
        step = end[axis] - start[axis]
        if step == 0.0:
            if not low <= start[axis] <= high:
                return None
            continue
        near, far = (low - start[axis]) / step, (high - start[axis]) / step
        first, last = max(first, min(near, far)), min(last, max(near, far))
    if first > last:
        return None
    step_x, step_y = end[0] - start[0], end[1] - start[1]
    return (
        (start[0] + first * step_x, start[1] + first * step_y),
        (start[0] + last * step_x, start[1] + last * step_y),
    )


@numba.njit(cache=True, nogil=True)
def _average_blocks(canvas, image):
    """Mean over blocks of 4 x 4 px, rounded half to even: what cv2.INTER_AREA gives, in a fraction of its time.

    Args:
        canvas: [4 H, 12 W] uint8, three channels side by side.
        image: [H, W, 3] uint8, written where a block is not black, as few are.
    """
    sums = np.zeros(canvas.shape[1], np.uint16)
    words = sums.view(np.uint64)
    for row in range(image.shape[0]):
        # One plain loop over four rows, so that the compiler makes vector instructions of it.
        first, second, third, fourth = canvas[4 * row], canvas[4 * row + 1], canvas[4 * row + 2], canvas[4 * row + 3]
        for i in range(len(sums)):
            sums[i] = np.uint16(first[i]) + np.uint16(second[i]) + np.uint16(third[i]) + np.uint16(fourth[i])
        for column in range(image.shape[1]):
            if words[3 * column] | words[3 * column + 1] | words[3 * column + 2] == 0:
                continue
            for channel in range(3):
                i = 12 * column + channel
                total = np.uint32(sums[i]) + np.uint32(sums[i + 3]) + np.uint32(sums[i + 6]) + np.uint32(sums[i + 9])
                image[row, column, channel] = (total + 7 + ((total >> 4) & 1)) >> 4
