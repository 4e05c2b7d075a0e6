"""Text to motion: a sentence about one person to a motion of procedural clips, joined smoothly and set on the ground.

A small and honest stand-in for learned models such as MDM (Tevet et al., ICLR 2023): it knows a few dozen verbs
(`motion_words.py`), and refuses what it does not understand. Whatever has the type `TextToMotion` takes its place; what
such a model wrote into files comes in through `ctlev_core.motions`.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ctlev_core.body.layer import NUM_BETAS, NUM_JOINTS, joint_transforms, load_body
from ctlev_core.body.motion.clip import MotionClip, check_clip
from ctlev_core.body.motion.foot_planting import LEG_JOINTS, plant_feet
from ctlev_core.body.motion.ground_contact import body_path, find_contact
from ctlev_core.body.motion.procedural import (
    COLUMN,
    SIDE_CHANNELS,
    MotionStyle,
    channels_at_phase,
    find_motion,
    rotations_from_channels,
)
from ctlev_core.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle, matrix_from_euler, slerp
from ctlev_core.body.text_to_motion.grammar import parse_sentence
from ctlev_core.body.text_to_motion.plan import Segment, plan_segments
from ctlev_core.geometry.joint_sets import SMPL_JOINTS
from data_contracts.errors import DataError

GRID_S = 0.01
"""Contact with the ground has a history; it is followed at these steps, whatever the rate that is asked for."""
AIRBORNE_M = 0.03
"""Height of a jump from which on the ground has no hold."""
BLEND_S = 0.4
BLEND_S_PER_HALF_TURN = 0.9
"""More where the trunk has to turn far, from standing to the ground say."""
SOFT_ENDS = 0.2
"""Share of a motion, at its begin and at its end, in which it gains and loses its pace."""
HABIT_RAD = 0.035
TEXT_STREAM = 31

ARMS_CHANNELS = (
    "bend", "twist", "lean", "nod", "look", "l_arm", "l_abduct", "l_turn", "l_elbow", "r_arm", "r_abduct", "r_turn",
    "r_elbow",
)  # fmt: skip
STEP_M = 0.08
"""Feet that must move so far against one another between two poses make a step, not a slide."""
STEP_LIFT: dict[str, float] = {"hip": 22.0, "knee": 44.0}


class TextToMotion(Protocol):
    """Anything that makes a motion from a sentence."""

    def __call__(self, sentence: str, *, seed: int = 0, rate_hz: float = 60.0) -> MotionClip:
        """The motion: y up, metres, the ground at y = 0; at time 0 above the origin, facing +z.

        Equal arguments give equal motions, bit for bit; other seeds other performances. The clip's caption is the
        sentence.
        """
        ...


def generate_motion(sentence: str, *, seed: int = 0, rate_hz: float = 60.0) -> MotionClip:
    """A motion of procedural clips; the default `TextToMotion`.

    Each clip begins where the one before ended, and faces as that ended. Between two clips, every joint goes the
    shortest way on SO(3) with an eased pace, while both go on; a foot that must be elsewhere is lifted there. The body
    is set on the ground by its skin and carried on by what touches it, with inertia; feet on the ground are planted.

    Args:
        sentence: such as "a person walks, then jumps twice"; see `motion_sentences.parse_sentence`.
        seed: of the performance: pace, reach, habits, and sides that the sentence leaves open.
        rate_hz: frames a second.
    Returns:
        T frames of the mean shape.
    Raises:
        DataError: the sentence is not understood; the message says which word.
        ValueError: the rate is not positive and finite, or the seed is negative.
    """
    if not 0 < rate_hz < np.inf:
        raise ValueError(f"rate_hz must be positive and finite, got {rate_hz}")
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    rng = np.random.default_rng([seed, TEXT_STREAM, *sentence.encode()])
    performance = _Performance(_plan(sentence, rng), rng)
    time_s = np.arange(int(performance.duration_s * rate_hz + 1e-6) + 1) / rate_hz
    rotations, transl = performance.sample(time_s)
    pose = axis_angle_from_matrix(rotations).reshape(len(time_s), 3 * NUM_JOINTS)
    return check_clip(MotionClip(pose, np.zeros(NUM_BETAS), transl, time_s, sentence), f"sentence {sentence!r}")


def check_sentence(sentence: str) -> None:
    """Raise `DataError` where `generate_motion` would, without making the motion."""
    _plan(sentence, np.random.default_rng(0))


def _plan(sentence: str, rng: np.random.Generator) -> list[Segment]:
    actions = parse_sentence(sentence)
    try:
        return plan_segments(actions, rng)
    except DataError as error:
        raise DataError(f"sentence {sentence!r}: {error}") from None


class _Performance:
    """Segments on a common time axis.

    Attributes:
        duration_s: of all segments.
    """

    def __init__(self, segments: list[Segment], rng: np.random.Generator) -> None:
        habits = HABIT_RAD * rng.normal(size=(2, NUM_JOINTS, 3))
        # The pelvis carries the body; hips and feet that are off make it float or slide.
        habits[:, [SMPL_JOINTS.index(name) for name in ("pelvis", "left_ankle", "right_ankle")]] = 0.0
        self._style = MotionStyle(0.0, 1.0, 1.0, False, habits[0], habits[1])
        self._segments = segments
        self._starts_s = np.concatenate([[0.0], np.cumsum([segment.duration_s for segment in segments])])
        self.duration_s = float(self._starts_s[-1])
        headings = [0.0]
        for segment in segments:
            first, last = _channels(segment, np.array([0.0, segment.duration_s]))
            headings.append(headings[-1] + segment.turn_deg + last[COLUMN["yaw"]] - first[COLUMN["yaw"]])
        # Clips whose first pose looks aside begin in the direction of the heading, all the same.
        self._headings_deg = headings
        self._joins = [self._join(number) for number in range(1, len(segments))]

    def sample(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations [T, 24, 3, 3] and translations [T, 3] m."""
        grid_s = GRID_S * np.arange(int(np.ceil(self.duration_s / GRID_S)) + 2)
        on_grid, grid_jump, velocity = self._pose(grid_s)
        contact = find_contact(on_grid)
        grounded = 1.0 - np.clip(grid_jump / AIRBORNE_M, 0.0, 1.0)
        path = body_path(contact, grounded, GRID_S)
        path[1:] += GRID_S * np.cumsum((velocity[1:] + velocity[:-1]) / 2, axis=0)
        turns = plant_feet(on_grid, contact, path, grounded, GRID_S)
        rotations, jump, _ = self._pose(time_s)
        rotations[:, LEG_JOINTS] = rotations[:, LEG_JOINTS] @ matrix_from_axis_angle(_at_times(time_s, grid_s, turns))
        transl = _at_times(time_s, grid_s, path)
        transl[:, 1] += jump
        return rotations, transl

    def _pose(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotations [T, 24, 3, 3], height of jumps [T] m and velocity in the air [T, 3] m/s; any times, any order."""
        rotations = np.empty((len(time_s), NUM_JOINTS, 3, 3))
        jump, velocity = np.zeros(len(time_s)), np.zeros((len(time_s), 3))
        for number in range(len(self._segments)):
            begin, blend_begin = self._joins[number - 1][:2] if number else (-1.0, -1.0)
            end = self._joins[number][1] if number < len(self._joins) else np.inf
            rows = np.flatnonzero((time_s >= begin) & (time_s < end))
            if not len(rows):
                continue
            own, own_jump, own_velocity = self._segment(number, time_s[rows])
            weight = _ease((time_s[rows] - begin) / (blend_begin - begin)) if number else np.ones(len(rows))
            mixed = np.flatnonzero(weight < 1)
            own[mixed] = slerp(rotations[rows[mixed]], own[mixed], weight[mixed, None])
            rotations[rows] = own
            jump[rows] = (1 - weight) * jump[rows] + weight * own_jump
            velocity[rows] = (1 - weight[:, None]) * velocity[rows] + weight[:, None] * own_velocity
        return rotations, jump, velocity

    def _segment(self, number: int, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        segment, passed_s = self._segments[number], time_s - self._starts_s[number]
        channels = _channels(segment, passed_s)
        for join in (number - 1, number):
            if 0 <= join < len(self._joins):
                self._lift_foot(channels, time_s, join)
        turned = segment.turn_deg * _ease_ends(passed_s / segment.turn_s, 0.1)
        channels[:, COLUMN["yaw"]] += self._headings_deg[number] + turned
        rotations = rotations_from_channels(channels, time_s, self._style)
        jump = segment.jump_scale * np.maximum(channels[:, COLUMN["jump"]], 0.0)
        facing = matrix_from_euler("Y", channels[:, COLUMN["yaw"], None])[:, :, 2]
        airborne = np.clip(jump / AIRBORNE_M, 0.0, 1.0)
        return rotations, jump, segment.jump_speed_m_s * airborne[:, None] * facing

    def _join(self, number: int) -> tuple[float, float, str]:
        """Begin and end in s of the way from the segment before to segment `number`, and the side of a foot to lift."""
        before, after = self._segments[number - 1], self._segments[number]
        poses = np.concatenate([_channels(before, np.array([before.duration_s])), _channels(after, np.zeros(1))])
        turn = np.abs(np.diff(poses[:, [COLUMN["pitch"], COLUMN["roll"]]] % 360, axis=0))
        turn = np.minimum(turn, 360 - turn).max()
        wanted = BLEND_S + BLEND_S_PER_HALF_TURN * turn / 180
        half = min(wanted, 0.9 * before.duration_s, 0.9 * after.duration_s) / 2
        return self._starts_s[number] - half, self._starts_s[number] + half, _stepping_side(poses)

    def _lift_foot(self, channels: np.ndarray, time_s: np.ndarray, join: int) -> None:
        begin, end, side = self._joins[join]
        if side:
            lift = np.sin(np.pi * np.clip((time_s - begin) / (end - begin), 0.0, 1.0)) ** 2
            for name, degrees in STEP_LIFT.items():
                channels[:, COLUMN[f"{side}_{name}"]] += lift * degrees


def _at_times(time_s: np.ndarray, grid_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values [G, ...] of a grid at times [T] between."""
    columns = values.reshape(len(values), -1).T
    return np.stack([np.interp(time_s, grid_s, column) for column in columns], axis=1).reshape(-1, *values.shape[1:])


def _channels(segment: Segment, passed_s: np.ndarray) -> np.ndarray:
    """Channels [T, C] of a segment, `passed_s` [T] after its start; before and after it as `Segment.flows` says."""
    done = passed_s / segment.duration_s
    if not find_motion(segment.motion).cyclic:
        # Its key poses begin and end in motion, the person does not.
        done = _ease_ends(done, SOFT_ENDS)
    elif not segment.flows:
        done = np.clip(done, 0.0, 1.0)
    phase = segment.start + (segment.end - segment.start) * done
    channels = channels_at_phase(segment.motion, phase, segment.amplitude, segment.mirrored)
    return channels if segment.arms is None else _lay_over(channels, segment.arms, passed_s)


def _lay_over(channels: np.ndarray, arms: Segment, passed_s: np.ndarray) -> np.ndarray:
    """Channels with those of arms and head that the motion `arms` names in their place, eased in and out."""
    motion = find_motion(arms.motion)
    left_s = arms.duration_s - passed_s
    done = arms.end * np.clip(passed_s / arms.duration_s, 0.0, 1.0)
    if motion.cyclic:
        phase = done
    elif arms.end == 1 and arms.duration_s > motion.duration_s:
        # Held in the middle for as long as there is time.
        begun, ending = passed_s / motion.duration_s, 1 - left_s / motion.duration_s
        phase = _ease_ends(np.where(passed_s < left_s, np.minimum(begun, 0.5), np.maximum(ending, 0.5)), SOFT_ENDS)
    else:
        phase = _ease_ends(np.where(done < arms.end, done % 1.0, 1.0), SOFT_ENDS)
    own = channels_at_phase(arms.motion, phase, 1.0, arms.mirrored)
    columns = _named_columns(arms)
    ramp_s = min(BLEND_S, arms.duration_s / 3)
    weight = _ease(np.minimum(passed_s, left_s) / ramp_s) if motion.cyclic else np.ones(len(passed_s))
    laid = channels.copy()
    laid[:, columns] += weight[:, None] * (own[:, columns] - channels[:, columns])
    return laid


def _named_columns(arms: Segment) -> list[int]:
    """Columns of arms and head that the key poses name, on the side where they are performed."""
    motion = find_motion(arms.motion)
    names = {name for _, pose in motion.keys for name in pose} | set(motion.base)
    sides = {f"{side}_{name}" for name in names & set(SIDE_CHANNELS) for side in "lr"}
    names = (names | sides) & set(ARMS_CHANNELS)
    if arms.mirrored:
        swapped = {"l_": "r_", "r_": "l_"}
        names = {swapped.get(name[:2], name[:2]) + name[2:] for name in names}
    return [COLUMN[name] for name in sorted(names)]


def _stepping_side(poses: np.ndarray) -> str:
    """`l` or `r`: the foot to lift on the way between two poses [2, C]; empty where none has to move, or one is up."""
    style = MotionStyle(0.0, 1.0, 1.0, False, np.zeros((NUM_JOINTS, 3)), np.zeros((NUM_JOINTS, 3)))
    rotations = rotations_from_channels(poses, np.zeros(2), style)
    rotations[:, 0] = matrix_from_euler("XZ", poses[:, [COLUMN["pitch"], COLUMN["roll"]]])
    _, joints = joint_transforms(load_body(), rotations, np.zeros(NUM_BETAS), np.zeros((2, 3)))
    feet = joints[:, [SMPL_JOINTS.index("left_foot"), SMPL_JOINTS.index("right_foot")]]
    apart = feet[:, 0] - feet[:, 1]
    moved = np.linalg.norm(np.diff(apart[:, ::2], axis=0))
    lowest = joints[:, :, 1].min(axis=1, keepdims=True)
    stand = (feet[..., 1] - lowest < 0.08).all()
    if moved < STEP_M or not stand:
        return ""
    hips = np.abs(np.diff(poses[:, [COLUMN["l_hip"], COLUMN["r_hip"]]], axis=0))[0]
    return "l" if hips[0] >= hips[1] else "r"


def _ease(fraction: np.ndarray) -> np.ndarray:
    """From 0 to 1 with neither speed nor acceleration at the ends."""
    u = np.clip(fraction, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


def _ease_ends(fraction: np.ndarray, ramp: float) -> np.ndarray:
    """From 0 to 1 at a constant pace, but for the share `ramp` at each end."""
    u = np.clip(fraction, 0.0, 1.0)
    start, end = u**2 / (2 * ramp), 1 - ramp - (1 - u) ** 2 / (2 * ramp)
    return np.where(u < ramp, start, np.where(u > 1 - ramp, end, u - ramp / 2)) / (1 - ramp)
