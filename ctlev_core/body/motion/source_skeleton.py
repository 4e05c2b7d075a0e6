"""The moving skeleton of a motion file, what hangs on what in it, and how its person stands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ctlev_core.body.motion.landmarks import LANDMARKS
from data_contracts.errors import DataError

SIDES = ("left", "right")
MAX_TILT_DEG = 60.0
"""Of trunk, thighs and shanks against the vertical, in the rest pose of a person who stands: some spread their legs."""
MAX_LEAN_DEG = 30.0
"""The same in a frame that takes the place of the rest pose, and on average where it says which way is up."""
HIP_HEIGHTS = (0.5, 1.5)
"""Of people on their feet, in lengths of their legs."""
UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class SkeletonMotion:
    """T frames of a skeleton with J joints.

    Attributes:
        names: of the joints.
        parents: J indices, each smaller than the joint's own; -1 for the root.
        rest: [J, 3] float64, in any unit, where the joints are while nothing is turned.
        tips: [J, 3] float64, the end of what hangs on each joint in the rest pose: of a foot, the toes.
        orientation: [J, T, 3, 3] float64, from the rest pose to the world.
        positions: [J, T, 3] float64, joints in the world, in the unit of `rest`.
        time_s: [T] float64.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    rest: np.ndarray
    tips: np.ndarray
    orientation: np.ndarray
    positions: np.ndarray
    time_s: np.ndarray


def ancestors(parents: tuple[int, ...], joint: int) -> list[int]:
    """The joint, its parent, and so on to the root."""
    chain = [joint]
    while parents[chain[-1]] >= 0:
        chain.append(parents[chain[-1]])
    return chain


def chain_between(parents: tuple[int, ...], start: int, end: int) -> list[int]:
    """`start`, then the joints above `end` that are not above `start`, from the top to `end`."""
    above = set(ancestors(parents, start))
    return [start, *[joint for joint in reversed(ancestors(parents, end)) if joint not in above]]


def common_ancestor(parents: tuple[int, ...], one: int, other: int) -> int:
    """The lowest joint on which both hang."""
    above = set(ancestors(parents, other))
    return next(joint for joint in ancestors(parents, one) if joint in above)


def check_limbs(motion: SkeletonMotion, landmarks: Mapping[str, int], where: str) -> None:
    """Raise `DataError` unless knees hang on hips, ankles on knees and so on, at a distance."""
    for chain in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist")):
        for side in SIDES:
            for upper, lower in pairwise(chain):
                joints = landmarks[f"{side}_{upper}"], landmarks[f"{side}_{lower}"]
                names = " and ".join(motion.names[joint] for joint in joints)
                if joints[0] not in ancestors(motion.parents, joints[1])[1:]:
                    raise DataError(f"{where}: {names} are no limb: the second does not hang on the first")
                if np.linalg.norm(motion.rest[joints[1]] - motion.rest[joints[0]]) < 1e-9:
                    raise DataError(f"{where}: {names} are at the same place in the rest pose")


def on_its_feet(motion: SkeletonMotion, landmarks: Mapping[str, int], where: str) -> SkeletonMotion:
    """The same motion with a person who stands as its rest pose.

    Mostly the file's own does. Some files (LAFAN1's) have a meaningless one, all bones along one axis: then the frame
    in which the person stands straightest takes its place, and turns are counted from there.

    Raises:
        DataError: nobody stands anywhere.
    """
    at = {name: motion.rest[landmarks[name]][None] for name in LANDMARKS}
    if _uprightness(at, _nearest_axis(_trunk_and_legs(at)[0][0]))[0] >= np.cos(np.deg2rad(MAX_TILT_DEG)):
        return motion
    at = {name: motion.positions[landmarks[name]] for name in LANDMARKS}
    uprightness = _uprightness(at, _nearest_axis(np.median(_trunk_and_legs(at)[0], axis=0)))
    frame = int(np.argmax(uprightness))
    if uprightness[frame] < np.cos(np.deg2rad(MAX_LEAN_DEG)):
        raise DataError(
            f"{where}: expected a person who stands, in the rest pose or at least in one frame; got neither"
        )
    start = motion.orientation[:, frame]
    tips = motion.positions[:, frame] + np.einsum("jab,jb->ja", start, motion.tips - motion.rest)
    orientation = motion.orientation @ np.swapaxes(start, -1, -2)[:, None]
    return replace(motion, rest=motion.positions[:, frame], tips=tips, orientation=orientation)


def rest_axes(motion: SkeletonMotion, landmarks: Mapping[str, int], where: str) -> np.ndarray:
    """Left, up and forward of the rest pose as columns [3, 3]; up is an axis of its world, left level.

    Raises:
        DataError: both hips are at the same place.
    """
    at = {name: motion.rest[landmarks[name]][None] for name in LANDMARKS}
    trunk = _trunk_and_legs(at)[0][0]
    up = _nearest_axis(trunk)
    left = (at["left_hip"] - at["right_hip"])[0]
    left = left - (left @ up) * up
    if np.linalg.norm(left) < 1e-6 * np.linalg.norm(trunk):
        raise DataError(f"{where}: both hips are at the same place in the rest pose, so that left is not known")
    left = left / np.linalg.norm(left)
    return np.stack([left, up, np.cross(left, up)], axis=1)


def moving_up(motion: SkeletonMotion, landmarks: Mapping[str, int], axes: np.ndarray) -> np.ndarray:
    """Which axis [3] of the rest pose's frame is up while the person moves: y, unless all speaks for another one.

    Some files stand along y in their rest pose and along z in every frame. People may also lie, so that another axis
    is taken only where trunk and legs are straight along it and hips as high above 0 as legs are long, and not so
    along y.
    """
    at = {name: motion.positions[landmarks[name]] @ axes for name in LANDMARKS}
    trunk, legs = (np.median(part, axis=0) for part in _trunk_and_legs(at))
    up = _nearest_axis(trunk)
    straight = np.cos(np.deg2rad(MAX_LEAN_DEG))
    stands = all(part @ up > straight * np.linalg.norm(part) for part in (trunk, legs))
    low, high = (
        limit * leg_length({name: motion.rest[landmarks[name]] for name in LANDMARKS}) for limit in HIP_HEIGHTS
    )
    height = np.median(at["left_hip"] + at["right_hip"], axis=0) / 2
    return up if stands and low < height @ up < high and height @ UP < low else UP


def leg_length(joints: Mapping[str, np.ndarray]) -> float:
    """Thigh and shank, mean of both sides, of landmarks [3]."""
    pairs = [(f"{side}_{a}", f"{side}_{b}") for side in SIDES for a, b in (("hip", "knee"), ("knee", "ankle"))]
    return sum(float(np.linalg.norm(joints[b] - joints[a])) for a, b in pairs) / 2


def _trunk_and_legs(at: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """From the hips to the shoulders, and from the ankles to the hips [T, 3]."""
    hips, shoulders, ankles = (at[f"left_{part}"] + at[f"right_{part}"] for part in ("hip", "shoulder", "ankle"))
    return (shoulders - hips) / 2, (hips - ankles) / 2


def _uprightness(at: Mapping[str, np.ndarray], up: np.ndarray) -> np.ndarray:
    """The smallest cosine [T] between up and the trunk, a thigh or a shank."""
    bones = [_trunk_and_legs(at)[0]]
    for side in SIDES:
        bones += [at[f"{side}_{a}"] - at[f"{side}_{b}"] for a, b in (("hip", "knee"), ("knee", "ankle"))]
    cosines = [bone @ up / np.maximum(np.linalg.norm(bone, axis=-1), 1e-300) for bone in bones]
    return np.min(cosines, axis=0)


def _nearest_axis(direction: np.ndarray) -> np.ndarray:
    """The coordinate axis [3], one way or the other, along which a direction mostly goes."""
    axis = int(np.argmax(np.abs(direction)))
    unit = np.zeros(3)
    unit[axis] = -1.0 if direction[axis] < 0 else 1.0
    return unit
