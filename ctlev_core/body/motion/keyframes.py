"""The key poses of the procedural motions: data only, `motions.py` says what a channel does.

Angles in degrees, `jump` in metres above the ground. A channel without the prefix `l_` or `r_` that exists on both
sides sets both. Channels a key does not name keep the value of the motion's base, or else of `STANDING`.

Trunk: pitch (forward), yaw (left), roll (right) of the whole body; bend (forward), twist (left), lean (right) of the
spine; nod (down) and look (left) of the head. Arm: arm (forward swing), abduct (0 hangs, 90 sideways, 180 up), turn (of
the upper arm about itself; -90 lets a bent forearm point up), elbow (flexion). Leg: hip (flexion), spread (outward),
toes (outward turn), knee (flexion), ankle (toes up).
"""

from __future__ import annotations

from dataclasses import dataclass, field

Pose = dict[str, float]

STANDING: Pose = {"abduct": 12, "elbow": 18, "knee": 4, "hip": 2, "spread": 3, "toes": 6}


@dataclass(frozen=True, eq=False)
class Motion:
    """Key poses at phases of [0, 1].

    Attributes:
        duration_s: of the whole motion at normal speed.
        keys: (phase, pose) in order.
        base: channels every key starts from.
        cyclic: phase 1 is phase 0 again; otherwise the first and last poses hold.
        symmetric: the keys fill [0, 0.5) and the second half is their mirror image.
        turn_deg: turn about the vertical axis per cycle.
    """

    duration_s: float
    keys: tuple[tuple[float, Pose], ...]
    base: Pose = field(default_factory=dict)
    cyclic: bool = True
    symmetric: bool = False
    turn_deg: float = 0.0


_GUARD: Pose = {
    "arm": 40, "elbow": 120, "abduct": 18, "l_hip": 28, "l_knee": 28, "r_hip": -14, "r_knee": 26, "r_toes": 30,
    "bend": 8, "ankle": 5,
}  # fmt: skip

MOTIONS: dict[str, Motion] = {
    "walk": Motion(
        1.05,
        (
            (0.00, {"l_hip": 27, "l_knee": 5, "l_ankle": 5, "r_hip": -18, "r_knee": 18, "r_ankle": -12, "l_arm": -24,
                    "r_arm": 20, "twist": -6}),
            (0.12, {"l_hip": 18, "l_knee": 18, "r_hip": -6, "r_knee": 56, "r_ankle": 0, "l_arm": -16, "r_arm": 14,
                    "twist": -4}),
            (0.25, {"l_hip": 3, "l_knee": 6, "r_hip": 22, "r_knee": 68, "r_ankle": 8, "l_arm": 0, "r_arm": 0}),
            (0.37, {"l_hip": -10, "l_knee": 5, "l_ankle": 8, "r_hip": 31, "r_knee": 26, "l_arm": 14, "r_arm": -16,
                    "twist": 4}),
        ),
        base={"elbow": 22, "bend": 3},
        symmetric=True,
    ),
    "run": Motion(
        0.68,
        (
            (0.00, {"l_hip": 32, "l_knee": 28, "r_hip": -12, "r_knee": 85, "l_arm": -45, "r_arm": 40, "twist": -10}),
            (0.12, {"l_hip": 12, "l_knee": 40, "l_ankle": 15, "r_hip": 16, "r_knee": 108, "l_arm": -25, "r_arm": 22,
                    "twist": -5}),
            (0.25, {"l_hip": -12, "l_knee": 20, "l_ankle": -10, "r_hip": 46, "r_knee": 95, "l_arm": 5, "r_arm": -10}),
            (0.37, {"l_hip": -26, "l_knee": 22, "l_ankle": -25, "r_hip": 55, "r_knee": 60, "l_arm": 28, "r_arm": -32,
                    "twist": 6, "jump": 0.06}),
        ),
        base={"elbow": 88, "bend": 12, "abduct": 18},
        symmetric=True,
    ),
    "punch": Motion(
        1.0,
        (
            (0.00, {}),
            (0.16, {"l_arm": 90, "l_elbow": 6, "twist": -28, "l_abduct": 5}),
            (0.32, {}),
            (0.50, {"twist": -10}),
            (0.66, {"r_arm": 92, "r_elbow": 6, "twist": 48, "r_abduct": 5, "r_hip": -26, "bend": 16}),
            (0.84, {}),
        ),
        base=_GUARD,
    ),
    "jump": Motion(
        1.5,
        (
            (0.00, {}),
            (0.20, {"pitch": 25, "hip": 75, "knee": 95, "ankle": 28, "bend": 25, "arm": -35}),
            (0.36, {"hip": -5, "knee": 3, "ankle": -38, "arm": 110, "jump": 0.08, "bend": -5}),
            (0.46, {"hip": 25, "knee": 45, "ankle": -30, "arm": 150, "jump": 0.42}),
            (0.56, {"hip": 12, "knee": 20, "ankle": -25, "arm": 110, "jump": 0.12}),
            (0.70, {"pitch": 20, "hip": 60, "knee": 80, "ankle": 22, "bend": 22, "arm": 30}),
        ),
    ),
    "wave": Motion(
        0.8,
        (
            (0.00, {"l_elbow": 40, "lean": 4}),
            (0.50, {"l_elbow": 105, "l_abduct": 112, "lean": -2, "look": 10}),
        ),
        base={"l_abduct": 98, "l_turn": -85, "r_abduct": 14},
    ),
    "squat": Motion(
        1.5,
        (
            (0.00, {"arm": 10}),
            (0.50, {"pitch": 30, "hip": 112, "knee": 118, "ankle": 34, "bend": 12, "arm": 95, "elbow": 8}),
        ),
        base={"spread": 9, "toes": 14},
    ),
    "jumping_jack": Motion(
        0.9,
        (
            (0.00, {"spread": 2, "abduct": 10}),
            (0.25, {"spread": 16, "abduct": 90, "jump": 0.12}),
            (0.50, {"spread": 30, "abduct": 168}),
            (0.75, {"spread": 16, "abduct": 90, "jump": 0.12}),
        ),
        base={"elbow": 8},
    ),
    "bow": Motion(
        1.9,
        (
            (0.00, {}),
            (0.45, {"pitch": 52, "hip": 54, "bend": 38, "nod": 22, "arm": 30}),
            (0.60, {"pitch": 50, "hip": 52, "bend": 36, "nod": 26, "arm": 34}),
        ),
    ),
    "dance": Motion(
        1.7,
        (
            (0.00, {"roll": -9, "lean": 12, "l_abduct": 150, "r_abduct": 60, "l_hip": 20, "l_knee": 35, "look": 20}),
            (0.17, {"bend": 12, "knee": 30, "hip": 18, "abduct": 80, "twist": 15}),
            (0.33, {"roll": 9, "lean": -14, "r_abduct": 160, "l_abduct": 50, "r_hip": 45, "r_knee": 70, "twist":
                    -15}),
            (0.50, {"arm": 60, "abduct": 40, "knee": 25, "hip": 14, "yaw": 35}),
            (0.67, {"roll": -8, "lean": 10, "l_hip": 60, "l_spread": 25, "l_knee": 80, "abduct": 110, "turn": -70,
                    "yaw": 20}),
            (0.83, {"bend": -10, "abduct": 130, "knee": 15, "twist": 20}),
        ),
        base={"elbow": 40},
    ),
    "spin": Motion(
        1.1,
        (
            (0.00, {"l_hip": 50, "l_knee": 100, "abduct": 85}),
            (0.50, {"l_hip": 62, "l_knee": 112, "abduct": 60, "arm": 50, "elbow": 60}),
        ),
        base={"l_spread": 28, "l_toes": 40, "r_ankle": -25},
        turn_deg=360.0,
    ),
    "lunge": Motion(
        1.7,
        (
            (0.00, {}),
            (0.40, {"l_hip": 88, "l_knee": 88, "r_hip": -28, "r_knee": 58, "r_ankle": 30}),
            (0.55, {"l_hip": 92, "l_knee": 96, "r_hip": -22, "r_knee": 70, "r_ankle": 34}),
        ),
        base={"abduct": 42, "elbow": 105, "turn": 45},
    ),
    "kick": Motion(
        1.2,
        (
            (0.00, {}),
            (0.22, {"l_hip": 90, "l_knee": 112, "pitch": -8, "r_hip": -10}),
            (0.36, {"l_hip": 98, "l_knee": 6, "pitch": -24, "r_hip": -26, "l_ankle": 15, "arm": 15, "abduct": 35}),
            (0.50, {"l_hip": 85, "l_knee": 105, "pitch": -10, "r_hip": -12}),
            (0.75, {}),
        ),
        base=_GUARD,
    ),
    "crawl": Motion(
        1.1,
        (
            (0.00, {"l_arm": 112, "r_arm": 70, "l_hip": 72, "r_hip": 108, "roll": 3}),
            (0.25, {"l_arm": 92, "r_arm": 98, "r_elbow": 35, "l_hip": 92, "r_hip": 92, "l_knee": 100}),
        ),
        base={"pitch": 84, "knee": 88, "ankle": -40, "nod": -35, "abduct": 8, "elbow": 6, "bend": 4},
        symmetric=True,
    ),
    "throw": Motion(
        1.3,
        (
            (0.00, {"l_hip": 5}),
            (0.35, {"r_abduct": 105, "r_turn": -95, "r_elbow": 95, "twist": -45, "l_hip": 60, "l_knee": 70, "bend":
                    -8, "l_arm": 60}),
            (0.52, {"r_abduct": 100, "r_turn": -60, "r_arm": 60, "r_elbow": 40, "twist": 15, "l_hip": 35, "l_knee":
                    15, "r_hip": -20}),
            (0.68, {"r_arm": 35, "r_abduct": 20, "r_elbow": 12, "twist": 48, "bend": 32, "l_hip": 32, "l_knee": 30,
                    "r_hip": -25, "r_knee": 35}),
        ),
    ),
    "stretch": Motion(
        2.0,
        (
            (0.00, {"lean": 34, "roll": 8, "l_abduct": 168, "r_abduct": 20}),
            (0.25, {"abduct": 150, "bend": -14, "nod": -15}),
        ),
        base={"spread": 12, "elbow": 12},
        symmetric=True,
    ),
    "push_up": Motion(
        1.4,
        (
            (0.00, {"pitch": 68, "elbow": 6, "arm": 80}),
            (0.50, {"pitch": 80, "elbow": 105, "arm": 28, "abduct": 40}),
        ),
        base={"ankle": 25, "hip": 0, "knee": 0, "spread": 4, "nod": -15, "abduct": 25, "toes": 0},
    ),
    "sit_up": Motion(
        1.8,
        (
            (0.00, {"pitch": -86, "hip": 50}),
            (0.50, {"pitch": -28, "hip": 108, "bend": 35, "nod": 10}),
        ),
        base={"knee": 95, "arm": 70, "elbow": 95, "abduct": 20, "ankle": -15},
    ),
    "spin_kick": Motion(
        1.3,
        (
            (0.00, _GUARD),
            (0.25, {**_GUARD, "yaw": -120, "twist": -30, "r_hip": 20, "r_knee": 80}),
            (0.45, {"yaw": -235, "roll": -38, "r_spread": 75, "r_hip": 12, "r_knee": 15, "l_spread": 34, "l_knee":
                    14, "abduct": 50, "elbow": 80}),
            (0.60, {"yaw": -310, "roll": -30, "r_spread": 60, "r_hip": 30, "r_knee": 30, "l_spread": 26, "l_knee":
                    14, "abduct": 45, "elbow": 80}),
            (0.85, {**_GUARD, "yaw": -360, "r_knee": 45}),
            (1.00, {**_GUARD, "yaw": -360}),
        ),
        cyclic=False,
    ),
    "get_up": Motion(
        2.2,
        (
            (0.00, {"pitch": 88, "arm": 60, "abduct": 60, "turn": -60, "elbow": 95, "ankle": -40, "look": 30}),
            (0.25, {"pitch": 66, "arm": 80, "abduct": 20, "elbow": 10, "hip": 10, "ankle": -10, "nod": -25}),
            (0.48, {"pitch": 62, "arm": 75, "elbow": 8, "l_hip": 125, "l_knee": 120, "l_ankle": 20, "r_hip": 60,
                    "r_knee": 95}),
            (0.68, {"pitch": 35, "arm": 45, "l_hip": 100, "l_knee": 105, "l_ankle": 25, "r_hip": 45, "r_knee": 90,
                    "bend": 25}),
            (0.88, {"pitch": 12, "hip": 25, "knee": 28, "bend": 12}),
            (1.00, {}),
        ),
        cyclic=False,
    ),
    "cartwheel": Motion(
        1.5,
        (
            (0.00, {"l_hip": 25, "abduct": 165}),
            (0.22, {"roll": 70, "lean": 20, "spread": 30, "abduct": 165, "elbow": 5}),
            (0.45, {"roll": 165, "spread": 52, "abduct": 172, "elbow": 5}),
            (0.60, {"roll": 215, "spread": 50, "abduct": 172, "elbow": 5}),
            (0.80, {"roll": 300, "spread": 32, "lean": -15, "abduct": 160}),
            (1.00, {"roll": 360, "spread": 12, "abduct": 120}),
        ),
        cyclic=False,
    ),
}  # fmt: skip

SEEN = ("walk", "run", "punch", "jump")
HELD_OUT = ("spin_kick", "get_up", "cartwheel")
UNSEEN = (
    "wave", "squat", "jumping_jack", "bow", "dance", "spin", "lunge", "kick", "crawl", "throw", "stretch", "push_up",
    "sit_up",
)  # fmt: skip
"""Their order numbers the recordings of `studio`."""
