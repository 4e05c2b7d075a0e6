"""Procedural motions: key poses, interpolated smoothly, varied at random, and set on the ground.

SEEN motions are in the training recordings of `studio`, UNSEEN ones are there as conditions to sample from, HELD_OUT
ones are in tests only; EVERYDAY_MOTIONS have no part in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from ctlev_core.body.layer import NUM_JOINTS, joint_transforms, load_body
from ctlev_core.body.motion.everyday_keyframes import EVERYDAY_MOTIONS
from ctlev_core.body.motion.keyframes import HELD_OUT, MOTIONS, SEEN, STANDING, UNSEEN, Motion, Pose
from ctlev_core.body.rotations import matrix_from_axis_angle, matrix_from_euler, slerp
from ctlev_core.geometry.joint_sets import SMPL_JOINTS
from data_contracts.errors import DataError

__all__ = [
    "EVERYDAY_MOTIONS", "HELD_OUT", "MOTIONS", "SEEN", "UNSEEN", "MotionStyle", "channels_at_phase", "find_motion",
    "pose_at", "rotations_from_channels", "sample_pose", "sample_style",
]  # fmt: skip

TRUNK_CHANNELS = ("pitch", "yaw", "roll", "bend", "twist", "lean", "nod", "look", "jump")
SIDE_CHANNELS = ("arm", "abduct", "turn", "elbow", "hip", "spread", "toes", "knee", "ankle")
CHANNELS = TRUNK_CHANNELS + tuple(f"{side}_{name}" for side in ("l", "r") for name in SIDE_CHANNELS)
COLUMN = {name: column for column, name in enumerate(CHANNELS)}
MIRRORED_SIGN = ("yaw", "roll", "twist", "lean", "look")
ORIENTATION_CHANNELS = ("pitch", "yaw", "roll", "jump")
"""Left alone by the amplitude: they carry the body, and half a cartwheel is no cartwheel."""

GROUND_STEP_S = 0.01
GROUND_SOFTNESS_M = 0.012
"""How far above the lowest joint another still carries weight: contact moves smoothly from foot to foot."""
SWAY_PERIOD_S = 2.5


@dataclass(frozen=True, eq=False)
class MotionStyle:
    """How one recording performs a motion.

    Attributes:
        start: phase at time 0.
        speed: 1 = as the key poses say.
        amplitude: factor on the deviation from the mean pose.
        mirrored: left and right exchanged.
        habit_start: [24, 3] rad axis-angle, joint offsets that drift to `habit_end` and back.
        habit_end: [24, 3] rad.
    """

    start: float
    speed: float
    amplitude: float
    mirrored: bool
    habit_start: np.ndarray
    habit_end: np.ndarray


def sample_style(name: str, rng: np.random.Generator, habit_rad: float = 0.07) -> MotionStyle:
    """A random way to perform the motion `name`; `habit_rad` is the standard deviation of the joint offsets."""
    motion = find_motion(name)
    habits = habit_rad * rng.normal(size=(2, NUM_JOINTS, 3))
    habits[:, 0] = 0.0
    return MotionStyle(
        start=rng.uniform(0.0, 1.0 if motion.cyclic else 0.85),
        speed=rng.uniform(0.75, 1.3),
        amplitude=rng.uniform(0.85, 1.15),
        mirrored=bool(rng.random() < 0.5),
        habit_start=habits[0],
        habit_end=habits[1],
    )


def sample_pose(name: str, time_s: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """`pose_at` in a random style."""
    return pose_at(name, time_s, sample_style(name, rng))


def pose_at(name: str, time_s: np.ndarray, style: MotionStyle) -> tuple[np.ndarray, np.ndarray]:
    """The poses of a motion at given times.

    Args:
        name: a key of `MOTIONS` or `EVERYDAY_MOTIONS`.
        time_s: [T], at least 0; any order.
        style: how it is performed.
    Returns:
        rotations: [T, 24, 3, 3] relative to the parent.
        transl: [T, 3] m; the ground is at y = 0, x and z are 0 at time 0.
    Raises:
        DataError: unknown motion, or times that are negative or not finite.
    """
    time_s = np.asarray(time_s, dtype=np.float64)
    if time_s.ndim != 1 or not (np.isfinite(time_s).all() and (time_s >= 0).all()):
        raise DataError(f"motion {name!r}: time_s must be [T], finite and not negative")
    channels = _channels_at(name, time_s, style)
    rotations = rotations_from_channels(channels, time_s, style)
    # Contact with the ground has a history, so it is followed on a grid that does not depend on the times asked for.
    last = int(np.ceil(time_s.max(initial=0.0) / GROUND_STEP_S)) + 1
    grid_s = GROUND_STEP_S * np.arange(last + 1)
    grid_channels = _channels_at(name, grid_s, style)
    ground = _walk_on_ground(rotations_from_channels(grid_channels, grid_s, style))
    transl = np.stack([np.interp(time_s, grid_s, ground[:, axis]) for axis in range(3)], axis=1)
    transl[:, 1] += np.maximum(channels[:, COLUMN["jump"]], 0.0)
    return rotations, transl


def find_motion(name: str) -> Motion:
    """The key poses of a motion.

    Raises:
        DataError: neither `MOTIONS` nor `EVERYDAY_MOTIONS` has it.
    """
    motion = MOTIONS.get(name) or EVERYDAY_MOTIONS.get(name)
    if motion is None:
        raise DataError(f"unknown motion {name!r}; known: {', '.join([*MOTIONS, *EVERYDAY_MOTIONS])}")
    return motion


def _vector(*poses: Pose) -> np.ndarray:
    """Channels [C] of poses laid over one another."""
    vector = np.zeros(len(CHANNELS))
    for pose in poses:
        for name, value in pose.items():
            for channel in (name,) if name in COLUMN else (f"l_{name}", f"r_{name}"):
                vector[COLUMN[channel]] = value
    return vector


def _mirror(channels: np.ndarray) -> np.ndarray:
    """Channels [..., C] with left and right exchanged."""
    swapped = {"l_": "r_", "r_": "l_"}
    partner = [COLUMN[swapped.get(name[:2], name[:2]) + name[2:]] for name in CHANNELS]
    sign = np.array([-1.0 if name in MIRRORED_SIGN else 1.0 for name in CHANNELS])
    return channels[..., partner] * sign


@cache
def _track(name: str) -> tuple[CubicSpline | PchipInterpolator, np.ndarray]:
    """Channels as a smooth function of the phase, and their mean [C]."""
    motion = find_motion(name)
    phases = [phase for phase, _ in motion.keys]
    poses = [_vector(STANDING, motion.base, pose) for _, pose in motion.keys]
    if motion.symmetric:
        phases += [phase + 0.5 for phase in phases]
        poses += [_mirror(pose) for pose in poses]
    mean = np.mean(poses, axis=0)
    if motion.cyclic:
        return CubicSpline([*phases, 1.0], [*poses, poses[0]], bc_type="periodic"), mean
    return PchipInterpolator(phases, poses), mean


def _channels_at(name: str, time_s: np.ndarray, style: MotionStyle) -> np.ndarray:
    """[T, C]: degrees, and metres for `jump`."""
    phase = style.start + style.speed * time_s / find_motion(name).duration_s
    return channels_at_phase(name, phase, style.amplitude, style.mirrored)


def channels_at_phase(name: str, phase: np.ndarray, amplitude: float, mirrored: bool) -> np.ndarray:
    """The channels of a motion at given phases.

    Args:
        name: of the motion.
        phase: [T]; a cyclic motion goes round with each whole number, another one holds its ends outside of [0, 1].
        amplitude: factor on the deviation from the mean pose.
        mirrored: left and right exchanged.
    Returns:
        [T, C] in the order of `CHANNELS`: degrees, and metres for `jump`.
    Raises:
        DataError: unknown motion.
    """
    motion = find_motion(name)
    track, mean = _track(name)
    turns = motion.turn_deg * phase
    phase = phase % 1.0 if motion.cyclic else np.clip(phase, 0.0, 1.0)
    factor = np.array([1.0 if channel in ORIENTATION_CHANNELS else amplitude for channel in CHANNELS])
    channels = mean + factor * (track(phase) - mean)
    channels[:, COLUMN["yaw"]] += turns
    # Knees and elbows do not bend backwards, whatever the amplitude.
    for hinge in ("l_knee", "r_knee", "l_elbow", "r_elbow"):
        channels[:, COLUMN[hinge]] = np.clip(channels[:, COLUMN[hinge]], 0.0, 150.0)
    return _mirror(channels) if mirrored else channels


def rotations_from_channels(channels: np.ndarray, time_s: np.ndarray, style: MotionStyle) -> np.ndarray:
    """Rotations [T, 24, 3, 3] relative to the parent from channels [T, C], the habits of the style at [T] s on top."""
    value = {name: channels[:, column] for name, column in COLUMN.items()}
    zero = np.zeros(len(channels))
    rotations = np.tile(np.eye(3), (len(channels), NUM_JOINTS, 1, 1))

    def turn(joint: str, order: str, *angles: np.ndarray) -> None:
        rotations[:, SMPL_JOINTS.index(joint)] = matrix_from_euler(order, np.stack(angles, axis=1))

    turn("pelvis", "YXZ", value["yaw"], value["pitch"], value["roll"])
    for joint in ("spine1", "spine2", "spine3"):
        turn(joint, "XYZ", value["bend"] / 3, value["twist"] / 3, value["lean"] / 3)
    for joint in ("neck", "head"):
        turn(joint, "XYZ", value["nod"] / 2, value["look"] / 2, zero)
    for side, prefix, sign in (("left", "l_", 1.0), ("right", "r_", -1.0)):
        arm = {name: value[prefix + name] for name in SIDE_CHANNELS}
        turn(f"{side}_shoulder", "XZX", -arm["arm"], sign * (arm["abduct"] - 90.0), arm["turn"])
        turn(f"{side}_elbow", "YXZ", -sign * arm["elbow"], zero, zero)
        turn(f"{side}_hip", "XZY", -arm["hip"], sign * arm["spread"], sign * arm["toes"])
        turn(f"{side}_knee", "XYZ", arm["knee"], zero, zero)
        turn(f"{side}_ankle", "XYZ", -arm["ankle"], zero, zero)
    drift = (0.5 - 0.5 * np.cos(2 * np.pi * time_s / SWAY_PERIOD_S))[:, None]
    habits = slerp(matrix_from_axis_angle(style.habit_start), matrix_from_axis_angle(style.habit_end), drift)
    return rotations @ habits


def _walk_on_ground(rotations: np.ndarray) -> np.ndarray:
    """Translation [T, 3], m, that puts the lowest joints on the ground and lets them stick to it.

    Walking forward comes out of it: the foot on the ground stays, the body moves.
    """
    body = load_body()
    _, joints = joint_transforms(body, rotations, np.zeros(10), np.zeros((len(rotations), 3)))
    height = joints[:, :, 1]
    lowest = height.min(axis=1, keepdims=True)
    load = np.exp((lowest - height) / GROUND_SOFTNESS_M)
    load /= load.sum(axis=1, keepdims=True)
    transl = np.zeros((len(rotations), 3))
    transl[:, 1] = -np.sum(load * height, axis=1)
    step = -np.einsum("tj,tja->ta", (load[1:] + load[:-1]) / 2, np.diff(joints, axis=0))
    transl[1:, ::2] = np.cumsum(step, axis=0)[:, ::2]
    return transl
