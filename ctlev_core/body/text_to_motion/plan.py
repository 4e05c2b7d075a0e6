"""From actions to segments of procedural motion: which key poses, how often, how fast, which way round."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctlev_core.body.motion.everyday_keyframes import EVERYDAY_MOTIONS
from ctlev_core.body.motion.keyframes import MOTIONS
from ctlev_core.body.text_to_motion.grammar import Action
from ctlev_core.body.text_to_motion.words import MAX_DURATION_S, MotionWord
from data_contracts.errors import DataError

GAIT_SECONDS = 3.0
STAND_SECONDS = 1.5
STEP_HOLD_SECONDS = 0.5
HOLD_SECONDS = 1.0
"""How long a posture is kept that nothing follows."""
CIRCLE_SECONDS = {"walk": 6.0, "run": 4.0, "march": 7.0, "crawl": 10.0}
"""Around a circle of a bit more than a metre and a half in radius; of one and a half to two where it is run."""
TURN_RATE_DEG = 110.0
"""A second, of somebody who turns on the spot."""
JUMP_SPEED_M_S = 1.7
"""Horizontal speed in the air where a jump goes forward."""

# A gait begins and ends where one leg swings past the other: the way to and from standing is then to set one foot down.
_GAIT_PHASE = {"walk": 0.25, "run": 0.25, "march": 0.25, "crawl": 0.0}
_IN_PLACE = {"walk": "step_in_place", "run": "march_in_place", "march": "march_in_place"}
_IN_PLACE_SPEED = {"run": 1.5}
_POSTURES = {"seated": "sit_down", "kneeling": "kneel", "supine": "lie_down", "prone": "get_down"}
_RISING_FROM = {"sit_down": "seated", "lie_down": "supine"}
_SPEED_SPREAD, _AMPLITUDE_SPREAD = 0.07, 0.06


@dataclass(frozen=True)
class Segment:
    """A stretch of one motion.

    Attributes:
        motion: name of the key poses.
        duration_s: how long it takes.
        start: phase at its start.
        end: phase at its end; below `start` it runs backwards.
        amplitude: factor on the deviation from the mean pose.
        mirrored: left and right exchanged.
        flows: goes on before and after its phases while it is blended; otherwise the first and last poses hold.
        turn_deg: change of heading, left positive.
        turn_s: how long the turn takes, from the start on.
        jump_scale: factor on the height of jumps.
        jump_speed_m_s: forward, while in the air.
        arms: what arms and head do instead; None = the same motion.
    """

    motion: str
    duration_s: float
    start: float = 0.0
    end: float = 1.0
    amplitude: float = 1.0
    mirrored: bool = False
    flows: bool = False
    turn_deg: float = 0.0
    turn_s: float = 1.0
    jump_scale: float = 1.0
    jump_speed_m_s: float = 0.0
    arms: Segment | None = None


def plan_segments(actions: tuple[Action, ...], rng: np.random.Generator) -> list[Segment]:
    """The segments that the actions ask for, with those between them that change the posture.

    The first action begins in its own posture: somebody who only "stands up" sits first.

    Args:
        actions: of a sentence.
        rng: draws sides that are not said, and how fast and far each motion goes.
    Raises:
        DataError: an action that does not go with the posture before it, or more than `MAX_DURATION_S` altogether.
    """
    posture = _first_posture(actions[0])
    segments: list[Segment] = []
    for number, action in enumerate(actions):
        word = action.word
        if word.kind == "rise":
            # Nobody rises who stands: then it says that the person stands.
            segments += _rise(posture, action, rng) if posture != "standing" else [_hold("standing", HOLD_SECONDS, rng)]
            posture = "standing"
            continue
        target = posture if word.kind in ("arms", "stand") and posture not in ("prone",) else word.posture
        target = "standing" if word.kind == "stand" else target
        if target != posture:
            segments += _change_posture(posture, target, action, rng, entered=word.kind == "posture")
        posture = target
        if word.kind == "posture":
            last = number == len(actions) - 1
            segments += _stay(action, posture, last, rng)
        else:
            segments += _perform(action, posture, rng)
    # Steps are counted from standing to standing; a gait may be under way already, and go on.
    if actions[0].word.kind == "step":
        segments.insert(0, _hold("standing", STEP_HOLD_SECONDS, rng))
    if actions[-1].word.kind == "step":
        segments.append(_hold("standing", STEP_HOLD_SECONDS, rng))
    total = sum(segment.duration_s for segment in segments)
    if total > MAX_DURATION_S:
        raise DataError(f"the motion takes {total:.0f} s, more than the limit of {MAX_DURATION_S:.0f} s")
    return segments


def _first_posture(action: Action) -> str:
    if action.word.kind == "rise":
        return _RISING_FROM[action.word.motion]
    return "standing" if action.word.kind == "posture" else action.word.posture


def _natural(name: str, action: Action | None, rng: np.random.Generator) -> tuple[float, float]:
    """Seconds of one cycle, and the amplitude, of this person on this occasion."""
    motion = MOTIONS.get(name) or EVERYDAY_MOTIONS[name]
    speed = (action.speed if action else 1.0) * np.exp(_SPEED_SPREAD * rng.uniform(-1, 1))
    spread = np.exp(_AMPLITUDE_SPREAD * rng.uniform(-1, 1))
    # What begins and ends at rest takes longer for the same pace between.
    seconds = motion.duration_s * (1.0 if motion.cyclic else 1.2)
    return seconds / speed, (action.amplitude if action else 1.0) * spread


def _hold(posture: str, duration_s: float, rng: np.random.Generator) -> Segment:
    if posture == "standing":
        cycle_s, _ = _natural("stand", None, rng)
        start = rng.uniform()
        return Segment("stand", duration_s, start, start + duration_s / cycle_s, flows=True)
    return Segment(_POSTURES[posture], duration_s, 1.0, 1.0)


def _rise(posture: str, action: Action | None, rng: np.random.Generator) -> list[Segment]:
    name = _POSTURES[posture]
    cycle_s, _ = _natural(name, action, rng)
    start = [_hold(posture, 0.4, rng)] if action else []
    return [*start, Segment(name, cycle_s, 1.0, 0.0)]


def _change_posture(
    posture: str, target: str, action: Action, rng: np.random.Generator, entered: bool
) -> list[Segment]:
    segments = _rise(posture, None, rng) if posture != "standing" else []
    if target != "standing":
        name = _POSTURES[target]
        cycle_s, _ = _natural(name, action if entered else None, rng)
        segments.append(Segment(name, cycle_s))
    return segments


def _stay(action: Action, posture: str, last: bool, rng: np.random.Generator) -> list[Segment]:
    """The posture after it was taken."""
    seconds = action.duration_s or (HOLD_SECONDS if last else 0.3)
    if action.meanwhile is None:
        return [_hold(posture, seconds, rng)]
    arms = _arms(action.meanwhile, rng)
    return [replace(_hold(posture, action.duration_s or arms.duration_s, rng), arms=arms)]


def _perform(action: Action, posture: str, rng: np.random.Generator) -> list[Segment]:
    kind = action.word.kind
    if kind == "arms":
        arms = _arms(action, rng)
        return [replace(_hold(posture, arms.duration_s, rng), arms=arms)]
    if kind == "stand":
        segments = [_hold("standing", action.duration_s or STAND_SECONDS, rng)]
    elif kind == "turn":
        segments = [_turn(action, rng)]
    elif kind in ("gait", "step"):
        segments = [_go(action, rng)]
    else:
        segments = _repeat(action, rng)
    if action.meanwhile is not None and action.meanwhile.word.kind == "arms":
        arms = _arms(action.meanwhile, rng, segments[0].duration_s)
        segments = [replace(segments[0], arms=arms)]
    return segments


def _side(action: Action, rng: np.random.Generator) -> str:
    """Of a direction; drawn where it is not said."""
    said = [side for side in ("left", "right") if side in action.directions]
    return said[0] if said else str(rng.choice(["left", "right"]))


def _mirrored(word: MotionWord, limbs: str, rng: np.random.Generator) -> bool:
    if word.keys_side and limbs in ("left", "right"):
        return limbs != word.keys_side
    return bool(rng.random() < 0.5)


def _turn(action: Action, rng: np.random.Generator) -> Segment:
    whole = bool(action.directions & {"around", "backward"})
    angle = action.angle_deg or (180.0 if whole else 90.0)
    angle *= action.count or 1
    side = _side(action, rng)
    cycle_s, _ = _natural("step_in_place", action, rng)
    # A step every 55 degrees, and whole cycles, so that both feet stand at the end.
    cycles = max(1, round(angle / TURN_RATE_DEG))
    seconds = action.duration_s or cycles * cycle_s
    cycles = max(1, round(seconds / cycle_s))
    signed = angle if side == "left" else -angle
    # The foot on the side of the turn goes first.
    return Segment("step_in_place", seconds, 0, cycles, mirrored=side == "right", turn_deg=signed, turn_s=seconds)


def _go(action: Action, rng: np.random.Generator) -> Segment:
    """Walking, running and steps: so many half cycles, along a line, a bend or a circle."""
    name, kind, directions = action.word.motion, action.word.kind, action.directions
    if (
        "sideways" in directions
        or name == "side_step"
        or (action.word.kind == "step" and directions & {"left", "right"})
    ):
        return _go_sideways(action, rng)
    pace = _IN_PLACE_SPEED.get(name, 1.0) if "in place" in directions else 1.0
    name_there = _IN_PLACE[name] if "in place" in directions else name
    cycle_s, amplitude = _natural(name_there, action, rng)
    cycle_s /= pace
    turn, turn_s = _bend(action, rng)
    default_s = CIRCLE_SECONDS[name] / action.speed if abs(turn) >= 360 else GAIT_SECONDS
    if kind == "step" or action.count:
        half_cycles = action.count or 1
        seconds = action.duration_s or half_cycles * cycle_s / 2
    else:
        seconds = action.duration_s or default_s
        half_cycles = max(1, round(2 * seconds / cycle_s))
        seconds = action.duration_s or half_cycles * cycle_s / 2
    start = _GAIT_PHASE.get(name_there, 0.0)
    end = start + half_cycles / 2
    if "backward" in directions:
        start, end, amplitude = end, start, 0.8 * amplitude
    mirrored = bool(rng.random() < 0.5)
    turn_s = seconds if turn_s is None else min(turn_s, seconds)
    return Segment(name_there, seconds, start, end, amplitude, mirrored, True, turn, turn_s)


def _bend(action: Action, rng: np.random.Generator) -> tuple[float, float | None]:
    """Degrees that a way turns, left positive, and in how many seconds; None = all the way."""
    directions, turning = action.directions, action.meanwhile
    if turning is not None and turning.word.kind == "turn":
        whole = bool(turning.directions & {"around", "backward"})
        angle = turning.angle_deg or (180.0 if whole else 90.0)
        return (angle if _side(turning, rng) == "left" else -angle), None
    if directions & {"circle", "around"}:
        return (360.0 if _side(action, rng) == "left" else -360.0), None
    if directions & {"left", "right"}:
        return (90.0 if "left" in directions else -90.0), 1.3
    return 0.0, 1.0


def _go_sideways(action: Action, rng: np.random.Generator) -> Segment:
    cycle_s, amplitude = _natural("side_step", action, rng)
    cycles = action.count or (1 if action.word.kind == "step" else max(1, round(GAIT_SECONDS / cycle_s)))
    if action.duration_s:
        cycles = max(1, round(action.duration_s / cycle_s))
    seconds = action.duration_s or cycles * cycle_s
    return Segment("side_step", seconds, 0, cycles, amplitude, mirrored=_side(action, rng) == "right")


def _repeat(action: Action, rng: np.random.Generator) -> list[Segment]:
    """A whole-body motion, so many times."""
    word = action.word
    motion = MOTIONS.get(word.motion) or EVERYDAY_MOTIONS[word.motion]
    cycle_s, amplitude = _natural(word.motion, action, rng)
    count = action.count or word.count
    if action.duration_s:
        count = max(1, round(action.duration_s / cycle_s)) if action.count is None else action.count
        cycle_s = action.duration_s / count
    mirrored = _mirrored(word, action.limbs, rng)
    if action.directions & {"left", "right"}:
        # Of the key poses, a spin goes to the left and a cartwheel to the right.
        mirrored = ("left" in action.directions) == (word.motion == "cartwheel")
    forward = {"forward": JUMP_SPEED_M_S, "backward": -0.7 * JUMP_SPEED_M_S}
    speed = next(
        (forward[d] for d in sorted(action.directions) if d in forward and word.motion in ("jump", "hop")), 0.0
    )
    scale = action.amplitude**1.5
    # Half a cartwheel is no cartwheel: what carries the body has its own measure.
    segment = Segment(word.motion, cycle_s, 0, 1, amplitude, mirrored, jump_scale=scale, jump_speed_m_s=speed)
    if motion.cyclic:
        # A cycle of punches has one of each arm; who says how many counts each.
        cycles = count / 2 if word.motion == "punch" and action.count else count
        return [replace(segment, duration_s=cycles * cycle_s, end=cycles)]
    return [segment] * count


def _arms(action: Action, rng: np.random.Generator, duration_s: float | None = None) -> Segment:
    """What arms and head do: cycles to fill the time, or one motion that is held in its middle."""
    word, name = action.word, action.word.motion
    if name == "look":
        around = "around" in action.directions or action.directions >= {"left", "right"} or not action.directions
        name = "look_around" if around else "look"
    if name == "raise_arm" and action.limbs == "both":
        name = "raise_arms"
    motion = MOTIONS.get(name) or EVERYDAY_MOTIONS[name]
    cycle_s, _ = _natural(name, action, rng)
    mirrored = _side(action, rng) == "right" if name == "look" else _mirrored(word, action.limbs, rng)
    count = action.count or word.count
    seconds = action.duration_s or duration_s or count * cycle_s
    if motion.cyclic and action.count is None:
        count = max(1, round(seconds / cycle_s))
    return Segment(name, seconds, 0, count, 1.0, mirrored)
