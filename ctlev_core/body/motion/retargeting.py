"""Motion of another skeleton to SMPL's joints: bones of the limbs keep their directions in the world.

Let W_j turn the bones of source joint j from the source's rest pose to the world, and let the columns of M be the
source's left, up and forward. M^T W_j M is the same turn with y up and the person facing +z at rest. It is what SMPL's
joint needs if both rest poses agree; they do for trunk, neck, head and feet of two people who stand, and they do not
for limbs (arms that hang, legs apart). There A_j first turns SMPL's rest bone onto the source's, the shortest way, so
that the orientation of SMPL's joint in the world is

    G_j = M^T W_j M A_j

and thighs, shanks, upper arms and forearms of the bundled body point exactly where the source's do (those of another
SMPL body are off by as much as its rest bones are off the bundled one's, a few degrees). A foot's A is a turn about the
vertical alone, since where a skeleton puts its toe joint says little of the sole; a hand has the forearm's.

Positions are scaled so that legs are as long as those of the mean body, and follow the middle of the hips; where the
source's ground is at a height of 0, feet touch it but for what proportions differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from ctlev_core.body.motion.clip import MotionClip, check_clip, move_world
from ctlev_core.body.motion.source_skeleton import (
    SIDES,
    UP,
    SkeletonMotion,
    chain_between,
    check_limbs,
    common_ancestor,
    leg_length,
    moving_up,
    on_its_feet,
    rest_axes,
)
from ctlev_core.geometry.joint_sets import SMPL_JOINTS, SMPL_PARENTS

MAX_FOOT_TURN_DEG = 60.0


def retarget(motion: SkeletonMotion, landmarks: Mapping[str, int], where: str) -> MotionClip:
    """The motion on SMPL's joints.

    Args:
        motion: of the source.
        landmarks: indices of the joints `landmarks.LANDMARKS`, and of `head` where there is one.
        where: names it in messages.
    Returns:
        Metres, y up, the mean shape; the body faces +z where the source faces as in its rest pose.
    Raises:
        DataError: the joints do not hang on one another as limbs do, a limb has no length, the source's person does
            not stand in the rest pose nor in any frame, or a number is not finite.
    """
    from ctlev_core.body.layer import load_body
    from ctlev_core.body.rotations import axis_angle_from_matrix

    check_limbs(motion, landmarks, where)
    motion = on_its_feet(motion, landmarks, where)
    axes = rest_axes(motion, landmarks, where)
    body: dict[str, np.ndarray] = dict(zip(SMPL_JOINTS, load_body().joints, strict=True))
    rest = {name: motion.rest[joint] @ axes for name, joint in landmarks.items()}
    source = _sources(motion, landmarks)
    alignment = _alignments(body, rest, _toes(motion, landmarks, axes))
    turned = {}
    world = np.empty((24, len(motion.time_s), 3, 3))
    for joint, (name, parent) in enumerate(zip(SMPL_JOINTS, SMPL_PARENTS, strict=True)):
        if name not in source:
            world[joint] = world[parent]
            continue
        world[joint] = _turn_on_chain(motion, *source[name], axes, turned) @ alignment.get(name, np.eye(3))
    local = world.copy()
    local[1:] = np.swapaxes(world[list(SMPL_PARENTS[1:])], -1, -2) @ world[1:]
    pose = np.swapaxes(axis_angle_from_matrix(local), 0, 1).reshape(-1, 72)

    scale = leg_length(body) / leg_length(rest)
    hips = scale * (motion.positions[landmarks["left_hip"]] + motion.positions[landmarks["right_hip"]]) / 2 @ axes
    offset = (body["left_hip"] + body["right_hip"]) / 2 - body["pelvis"]
    transl = hips - world[0] @ offset - body["pelvis"]
    clip = check_clip(MotionClip(pose, np.zeros(10), transl, motion.time_s), where)
    up = moving_up(motion, landmarks, axes)
    return clip if up[1] == 1.0 else move_world(clip, shortest_turn(up, UP), np.zeros(3))


def _sources(motion: SkeletonMotion, landmarks: Mapping[str, int]) -> dict[str, tuple[list[int], float]]:
    """For each SMPL joint that the source moves, a chain of source joints and a place on it, in joints."""
    parents = motion.parents
    pelvis = common_ancestor(parents, landmarks["left_hip"], landmarks["right_hip"])
    chest = common_ancestor(parents, landmarks["left_shoulder"], landmarks["right_shoulder"])
    spine = chain_between(parents, pelvis, chest)
    # However many joints a source's spine has, SMPL's three share its bend evenly.
    found = {name: (spine, (len(spine) - 1) * i / 3) for i, name in enumerate(("pelvis", "spine1", "spine2", "spine3"))}
    if "head" in landmarks:
        neck = chain_between(parents, chest, landmarks["head"])
        found |= {"neck": (neck, (len(neck) - 1) / 2), "head": (neck, len(neck) - 1.0)}
    for side in SIDES:
        shoulder = landmarks[f"{side}_shoulder"]
        collar = parents[shoulder]
        if collar != chest:
            found[f"{side}_collar"] = ([collar], 0.0)
        for part in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist"):
            found[f"{side}_{part}"] = ([landmarks[f"{side}_{part}"]], 0.0)
        toes = [joint for joint, parent in enumerate(parents) if parent == landmarks[f"{side}_ankle"]]
        if len(toes) == 1:
            found[f"{side}_foot"] = (toes, 0.0)
    return found


def _turn_on_chain(
    motion: SkeletonMotion, chain: list[int], place: float, axes: np.ndarray, turned: dict[int, np.ndarray]
) -> np.ndarray:
    """M^T W M [T, 3, 3] at a place between two joints of a chain, on the shortest way from one to the other."""
    from ctlev_core.body.rotations import slerp

    below = min(int(place + 1e-9), len(chain) - 1)
    for joint in chain[below : below + 2]:
        if joint not in turned:
            turned[joint] = axes.T @ motion.orientation[joint] @ axes
    if place - below < 1e-9:
        return turned[chain[below]]
    return slerp(turned[chain[below]], turned[chain[below + 1]], place - below)


def _alignments(
    body: Mapping[str, np.ndarray], rest: Mapping[str, np.ndarray], toes: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """A of each joint where it is not the identity."""
    found = {}
    for side in SIDES:
        for upper, middle, end in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist")):
            joints = [f"{side}_{part}" for part in (upper, middle, end)]
            bones = [(body[b] - body[a], rest[b] - rest[a]) for a, b in pairwise(joints)]
            found[joints[0]] = shortest_turn(*bones[0])
            # From where the upper bone has taken it, so that a limb that is turned as a whole is not twisted.
            found[joints[1]] = shortest_turn(found[joints[0]] @ bones[1][0], bones[1][1]) @ found[joints[0]]
        found[f"{side}_wrist"] = found[f"{side}_elbow"]
        level = np.array([1.0, 0.0, 1.0])
        foot = level * (body[f"{side}_foot"] - body[f"{side}_ankle"]), level * toes[side]
        cosine = foot[0] @ foot[1] / np.linalg.norm(foot[0]) / max(float(np.linalg.norm(foot[1])), 1e-300)
        if cosine > np.cos(np.deg2rad(MAX_FOOT_TURN_DEG)):
            found[f"{side}_ankle"] = found[f"{side}_foot"] = shortest_turn(*foot)
    return found


def _toes(motion: SkeletonMotion, landmarks: Mapping[str, int], axes: np.ndarray) -> dict[str, np.ndarray]:
    """From each ankle to the tip of the toes in the rest pose [3], y up."""
    ankles = {side: landmarks[f"{side}_ankle"] for side in SIDES}
    return {side: (motion.tips[ankle] - motion.rest[ankle]) @ axes for side, ankle in ankles.items()}


def shortest_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] by the smallest angle that takes the direction `start` to the direction `end`."""
    from ctlev_core.body.rotations import matrix_from_axis_angle

    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis = np.cross(start, end)
    sine, cosine = float(np.linalg.norm(axis)), float(start @ end)
    if sine < 1e-12:
        # Any axis across will do where they are opposite.
        across = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
        axis, sine = (across / np.linalg.norm(across), 1.0) if cosine < 0 else (np.zeros(3), 1.0)
    return matrix_from_axis_angle(axis / sine * np.arctan2(np.linalg.norm(np.cross(start, end)), cosine))
