"""A person who moves before cameras: joints, and the events and grey pictures of their skin.

Motions are the project's own (`ctlev_core.body.text_to_motion`), the body is the bundled one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctlev_core.body.layer import joint_transforms, load_body, pose_vertices
from ctlev_core.body.motion.clip import MotionClip, resample
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.body.text_to_motion.compose import generate_motion
from ctlev_core.geometry.camera import Camera, is_inside, project
from data_contracts.events import Events

SENTENCES = (
    "a person marches in place",
    "a person waves with the right hand",
    "a person does three jumping jacks",
    "a person claps, then bows",
)
"""None of them walks out of a picture."""
_STREAM, _SETTLED_S = 53, 0.3
_POINTS = 600
"""Of the skin, whose motion makes events."""
_SPREAD_PX = 1.5


@dataclass(frozen=True, eq=False)
class MovingPerson:
    """A motion as points in the world: metres, y up, the ground at y = 0, facing +z.

    Attributes:
        clip: T frames.
        joints: [T, 24, 3] float64, the joints of SMPL.
        skin: [T, P, 3] float64, points of it.
    """

    clip: MotionClip
    joints: np.ndarray
    skin: np.ndarray


def move_person(number: int, count: int, rate_hz: float, *, max_points: int = _POINTS) -> MovingPerson:
    """Frames [count] of a person, `rate_hz` a second; other numbers are other motions.

    Raises:
        ValueError: the motion is shorter than that.
    """
    clip = generate_motion(SENTENCES[number % len(SENTENCES)], seed=number, rate_hz=60.0)
    return person_of(resample(clip, _SETTLED_S + np.arange(count) / rate_hz), max_points)


def person_of(clip: MotionClip, max_points: int = _POINTS) -> MovingPerson:
    """Joints and skin of a motion."""
    body = load_body()
    rotations = matrix_from_axis_angle(clip.pose.reshape(-1, 24, 3))
    joints = joint_transforms(body, rotations, clip.betas, clip.transl)[1]
    vertices = np.asarray(pose_vertices(body, rotations, clip.betas, clip.transl)[0])
    chosen = np.linspace(0, vertices.shape[1] - 1, min(max_points, vertices.shape[1])).astype(np.int64)
    return MovingPerson(clip, joints, vertices[:, chosen].astype(np.float64))


def draw_events(camera: Camera, person: MovingPerson, count: int, seed: int) -> Events:
    """Events where the skin moves, the more the faster, in order of time; times count from the first frame, us.

    Args:
        camera: its picture takes all of them.
        person: two frames at least.
        count: of events.
        seed: of times, places and polarities.
    """
    random = np.random.default_rng([seed, _STREAM])
    pixels = project(camera, person.skin)
    time_us = 1e6 * (person.clip.time_s - person.clip.time_s[0])
    speed = np.linalg.norm(np.diff(pixels, axis=0), axis=2)
    weights = np.nan_to_num(speed) + 1e-3  # somebody who stands still flickers a little
    drawn = random.choice(weights.size, count, p=(weights / weights.sum()).ravel())
    frame, point = np.divmod(drawn, weights.shape[1])
    share = random.random(count)
    t = time_us[frame] + share * (time_us[frame + 1] - time_us[frame])
    place = pixels[frame, point] * (1 - share[:, None]) + pixels[frame + 1, point] * share[:, None]
    place = np.nan_to_num(place) + random.normal(0, _SPREAD_PX, (count, 2))
    width, height = camera.image_size
    x, y = (np.clip(place[:, axis], 0, limit - 1).astype(np.uint16) for axis, limit in enumerate((width, height)))
    order = np.argsort(t, kind="stable")
    p = random.integers(0, 2, count).astype(np.uint8)
    return Events(t[order].astype(np.int64), x[order], y[order], p, camera.image_size)


def draw_grey_picture(camera: Camera, skin: np.ndarray) -> np.ndarray:
    """A grey picture [H, W] uint8 of points [P, 3] before a wall that is brighter on one side."""
    import cv2

    width, height = camera.image_size
    picture = np.tile(np.linspace(60, 110, width), (height, 1)).astype(np.uint8)
    pixels = project(camera, skin)
    shades = np.linspace(150, 240, len(skin)).astype(int)
    radius = max(2, height // 60)
    for (x, y), shade in zip(pixels[is_inside(pixels, camera.image_size)], shades.tolist(), strict=False):
        cv2.circle(picture, (int(x), int(y)), radius, shade, -1)
    return picture
