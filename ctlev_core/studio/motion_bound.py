"""How fast anything moves in the picture of a body that goes from key pose to key pose.

A curve whose second derivative is at most A has, over a span h, a speed of at most its mean velocity's plus A h / 2. So
vertices are posed at both ends of short segments, and what they may do between is bounded. With joints that turn at
constant speeds w_j about axes fixed to their bones, bone b turns at no more than

    S_b = S_parent + w_b,       its angular velocity changes by no more than    D_b = D_parent + S_parent w_b

and a point at the distance d from the joint of b accelerates, relative to that joint, by no more than (D_b + S_b^2) d.
Summed from the root down to the vertex, and over its bones by their weights, that is A in space. For the projection
q = (x, y) / z it follows from z q'' = (x, y)'' - q z'' - 2 q' z'. The frames that the scene is then rendered at are
bounded like this instead of by the last frame's optical flow (ESIM), which a burst of motion takes by surprise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from ctlev_core.body.layer import BodyModel
from ctlev_core.geometry.camera import Camera
from ctlev_core.geometry.joint_sets import SMPL_PARENTS
from ctlev_core.render.rasteriser import NEAR_M

SEGMENT_TURN_RAD = 0.1
"""By how much the fastest bone may turn in a segment: then the bound is within a tenth of the speed."""
MARGIN_M = 0.15
"""Twice the longest edge of a posed body: of a face that reaches into the picture no corner is further outside."""
_CHORD_PX, _CHORD_M, _NEAREST_M, _FARTHEST_M, _ASIDE_M = range(5)


@dataclass(frozen=True, eq=False)
class Turning:
    """Bounds of how the bones of one body turn in each of N intervals; the source is the head of this module.

    Attributes:
        speed: [N, 24] rad/s, S.
        change: [N, 24] rad/s^2, D.
        own: [N, 24] rad/s, w.
    """

    speed: np.ndarray
    change: np.ndarray
    own: np.ndarray


def bound_turning(own: np.ndarray) -> Turning:
    """`Turning` from the speeds [N, 24], rad/s, of joints relative to their parents."""
    speed, change = own.copy(), np.zeros_like(own)
    for joint, parent in enumerate(SMPL_PARENTS):
        if parent >= 0:
            speed[:, joint] += speed[:, parent]
            change[:, joint] = change[:, parent] + speed[:, parent] * own[:, joint]
    return Turning(speed, change, own)


def bound_acceleration(body: BodyModel, betas: np.ndarray, rest: np.ndarray, turning: Turning) -> np.ndarray:
    """What no vertex exceeds in each interval, [N] m/s^2, while the body itself shifts at constant speed.

    Args:
        body: the body, without its corrective shapes; `bound_correctives` is about those.
        betas: [10] its shape.
        rest: [V, 3] m, its rest vertices.
        turning: of N intervals.
    """
    joints = body.joints + body.joint_shapedirs @ np.asarray(betas, np.float64)
    lever = turning.change + turning.speed**2
    of_joint = np.zeros_like(lever)
    for joint, parent in enumerate(SMPL_PARENTS):
        if parent >= 0:
            length = np.linalg.norm(joints[joint] - joints[parent])
            of_joint[:, joint] = of_joint[:, parent] + lever[:, parent] * length
    arm = np.linalg.norm(rest[:, None] - joints[body.weight_indices], axis=-1)
    # By what each of the 24 joints' two numbers counts for a vertex; no vertex has a joint twice.
    share = np.zeros((len(rest), 2, lever.shape[1]), np.float32)
    rows = np.arange(len(rest))[:, None]
    share[rows, 0, body.weight_indices] = body.weight_values
    share[rows, 1, body.weight_indices] = body.weight_values * arm
    numbers = np.concatenate([of_joint, lever], axis=1).astype(np.float32)
    return (numbers @ share.reshape(len(rest), -1).T).max(axis=1, initial=0.0).astype(np.float64)


def bound_correctives(body: BodyModel, turning: Turning) -> np.ndarray:
    """What corrective shapes add to the acceleration of a vertex at most, [N] m/s^2; 0 where the body has none.

    They are linear in the entries of R - 1 of each joint, whose Frobenius norm is 2 sqrt(2) at most and changes at no
    more than sqrt(2) w, which itself changes at no more than sqrt(2) w^2. The bones carry them round.
    """
    if body.posedirs is None:
        return np.zeros(len(turning.own))
    num_joints = len(SMPL_PARENTS) - 1
    # [23] m that a vertex is moved by at most per unit of a joint's R - 1.
    gain = np.linalg.norm(body.posedirs.reshape(num_joints, 9, -1, 3), axis=(1, 3)).max(axis=1)
    rate, curvature = (np.sqrt(2) * turning.own[:, 1:] ** power @ gain for power in (1, 2))
    lever = (turning.change + turning.speed**2).max(axis=1)
    return lever * 2 * np.sqrt(2) * gain.sum() + 2 * turning.speed.max(axis=1) * rate + curvature


def bound_speeds(points: np.ndarray, spans_s: np.ndarray, acceleration: np.ndarray, camera: Camera) -> np.ndarray:
    """What no projected vertex exceeds in each segment, [S] px/s.

    A vertex counts unless it is at both ends of the segment beyond the same edge of the picture by `MARGIN_M`. While a
    part of the body may be at `NEAR_M` or nearer, where it is cut off, it is what nothing within the picture exceeds;
    and 0 while all of it is.

    Args:
        points: [S + 1, V, 3] float32, m, camera frame: vertices at the ends of the segments.
        spans_s: [S] how long they last.
        acceleration: [S] m/s^2, what no vertex exceeds in each.
        camera: without distortion.
    """
    fx, fy, cx, cy = camera.intrinsics
    chords = np.empty((len(spans_s), 5))
    _measure_chords(points, fx, fy, cx, cy, *camera.image_size, NEAR_M, MARGIN_M, chords)
    # No further than this from the straight line between its ends.
    bulge = acceleration * spans_s**2 / 8
    speed = chords[:, _CHORD_M] / spans_s + acceleration * spans_s / 2
    near = np.maximum(chords[:, _NEAREST_M] - bulge, NEAR_M)
    oblique = 1.0 + ((chords[:, _ASIDE_M] + bulge) / near) ** 2
    focal = max(fx, fy)
    slack = focal * np.sqrt(oblique) * (acceleration / near + 2 * (speed / near) ** 2)
    far_away = chords[:, _CHORD_PX] / spans_s + slack * spans_s / 2
    width, height = camera.image_size
    corner = np.hypot(max(abs(cx), abs(width - cx)) / fx, max(abs(cy), abs(height - cy)) / fy)
    close_by = focal * np.sqrt(1.0 + corner**2) * speed / NEAR_M
    is_far = chords[:, _NEAREST_M] - bulge > NEAR_M
    return np.where(is_far, far_away, np.where(chords[:, _FARTHEST_M] + bulge > NEAR_M, close_by, 0.0))


@numba.njit(cache=True, nogil=True)
def _measure_chords(points, fx, fy, cx, cy, width, height, near, margin, chords):
    """The largest chord in px and in m, the least and largest depth, and the largest distance from the optical axis."""
    right, low = width - cx, height - cy
    for s in range(points.shape[0] - 1):
        longest_px = longest_m = aside = 0.0
        nearest, farthest = np.inf, -np.inf
        for i in range(points.shape[1]):
            x, y, z = float(points[s, i, 0]), float(points[s, i, 1]), float(points[s, i, 2])
            u, v, w = float(points[s + 1, i, 0]), float(points[s + 1, i, 1]), float(points[s + 1, i, 2])
            nearest, farthest = min(nearest, z, w), max(farthest, z, w)
            longest_m = max(longest_m, (u - x) ** 2 + (v - y) ** 2 + (w - z) ** 2)
            aside = max(aside, x * x + y * y, u * u + v * v)
            is_left = max(fx * (x + margin) + cx * z, fx * (u + margin) + cx * w) < 0.0
            is_right = min(fx * (x - margin) - right * z, fx * (u - margin) - right * w) > 0.0
            is_above = max(fy * (y + margin) + cy * z, fy * (v + margin) + cy * w) < 0.0
            is_below = min(fy * (y - margin) - low * z, fy * (v - margin) - low * w) > 0.0
            if min(z, w) > near and not (is_left or is_right or is_above or is_below):
                dx, dy = fx * (u / w - x / z), fy * (v / w - y / z)
                longest_px = max(longest_px, dx * dx + dy * dy)
        chords[s, 0], chords[s, 1] = np.sqrt(longest_px), np.sqrt(longest_m)
        chords[s, 2], chords[s, 3], chords[s, 4] = nearest, farthest, np.sqrt(aside)
