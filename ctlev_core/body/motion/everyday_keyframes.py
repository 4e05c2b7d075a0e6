"""The key poses of everyday motions, for motions told in words: data only, in the channels of `keyframes.py`.

They are apart from `keyframes.MOTIONS`, whose members number the recordings of `studio`.
"""

from __future__ import annotations

from ctlev_core.body.motion.keyframes import Motion, Pose

_SEATED: Pose = {
    "pitch": 4, "hip": 91, "knee": 87, "bend": 5, "arm": 16, "elbow": 44, "turn": 8, "spread": 5,
}  # fmt: skip
"""On a chair: thighs level, shins upright; the pelvis is behind the feet."""

EVERYDAY_MOTIONS: dict[str, Motion] = {
    "stand": Motion(
        4.0,
        (
            (0.00, {}),
            (0.30, {"lean": 2, "look": 5, "bend": 2, "l_arm": 3}),
            (0.70, {"lean": -2, "look": -4, "bend": 1, "r_arm": 3}),
        ),
    ),
    "step_in_place": Motion(
        1.0,
        (
            (0.00, {}),
            (0.25, {"l_hip": 26, "l_knee": 46, "l_ankle": 2, "r_knee": 6, "l_arm": -8, "r_arm": 8}),
        ),
        symmetric=True,
    ),
    "march": Motion(
        1.1,
        (
            (0.00, {"l_hip": -10, "l_knee": 22, "l_ankle": -6, "r_hip": 17, "r_knee": 5}),
            (0.12, {"l_hip": 46, "l_knee": 70, "r_hip": 10, "r_knee": 6, "r_arm": 24, "l_arm": -24}),
            (0.25, {"l_hip": 82, "l_knee": 88, "l_ankle": -12, "r_hip": 2, "r_arm": 46, "l_arm": -34}),
            (0.37, {"l_hip": 50, "l_knee": 46, "r_hip": -5, "r_knee": 6, "r_arm": 24, "l_arm": -20}),
        ),
        base={"elbow": 62, "bend": 2},
        symmetric=True,
    ),
    "march_in_place": Motion(
        1.1,
        (
            (0.00, {"knee": 6, "hip": 3}),
            (0.12, {"l_hip": 50, "l_knee": 64, "r_arm": 24, "l_arm": -24}),
            (0.25, {"l_hip": 78, "l_knee": 88, "l_ankle": -12, "r_arm": 44, "l_arm": -32}),
            (0.37, {"l_hip": 50, "l_knee": 64, "r_arm": 24, "l_arm": -20}),
        ),
        base={"elbow": 66, "bend": 3},
        symmetric=True,
    ),
    "side_step": Motion(
        1.1,
        (
            (0.00, {}),
            (0.22, {"l_hip": 16, "l_knee": 24, "l_spread": 18, "r_spread": 6, "lean": 3}),
            (0.45, {"spread": 15, "knee": 8, "hip": 5, "abduct": 16}),
            (0.55, {"spread": 15, "knee": 8, "hip": 5, "abduct": 16}),
            (0.78, {"r_hip": 16, "r_knee": 24, "r_spread": 12, "l_spread": 5, "lean": -3}),
        ),
    ),
    "hop": Motion(
        0.8,
        (
            (0.00, {"l_hip": 22, "l_knee": 36, "l_ankle": 14, "arm": -12, "bend": 12}),
            (0.22, {"l_hip": 2, "l_knee": 4, "l_ankle": -30, "arm": 28, "jump": 0.03}),
            (0.42, {"l_hip": 12, "l_knee": 20, "l_ankle": -24, "arm": 36, "jump": 0.16}),
            (0.62, {"l_hip": 8, "l_knee": 14, "l_ankle": -14, "arm": 18, "jump": 0.03}),
        ),
        base={"r_hip": 18, "r_knee": 82, "elbow": 52, "abduct": 24, "bend": 6},
    ),
    "clap": Motion(
        0.5,
        (
            (0.00, {"turn": 8}),
            (0.50, {"turn": 46, "bend": 2}),
        ),
        base={"arm": 34, "elbow": 76, "abduct": 6},
    ),
    "raise_arms": Motion(
        1.6,
        (
            (0.00, {}),
            (0.40, {"abduct": 166, "elbow": 6, "nod": -6, "bend": -3}),
            (0.65, {"abduct": 170, "elbow": 5, "nod": -8, "bend": -4}),
            (1.00, {}),
        ),
        cyclic=False,
    ),
    "raise_arm": Motion(
        1.6,
        (
            (0.00, {}),
            (0.40, {"l_abduct": 166, "l_elbow": 6, "lean": 4}),
            (0.65, {"l_abduct": 170, "l_elbow": 5, "lean": 5}),
            (1.00, {}),
        ),
        cyclic=False,
    ),
    "pick_up": Motion(
        2.4,
        (
            (0.00, {}),
            (0.42, {"pitch": 46, "hip": 122, "knee": 100, "ankle": 24, "bend": 34, "arm": 64, "elbow": 6, "nod": 8}),
            (0.55, {"pitch": 46, "hip": 122, "knee": 100, "ankle": 24, "bend": 36, "arm": 62, "elbow": 14, "nod": 10}),
            (1.00, {"arm": 20, "elbow": 68, "turn": 18}),
        ),
        cyclic=False,
    ),
    "look_around": Motion(
        3.0,
        (
            (0.00, {}),
            (0.22, {"look": 62, "twist": 16}),
            (0.36, {"look": 64, "twist": 18}),
            (0.66, {"look": -62, "twist": -16}),
            (0.80, {"look": -64, "twist": -18}),
            (1.00, {}),
        ),
        cyclic=False,
    ),
    "look": Motion(
        1.8,
        (
            (0.00, {}),
            (0.35, {"look": 62, "twist": 16}),
            (0.65, {"look": 64, "twist": 18}),
            (1.00, {}),
        ),
        cyclic=False,
    ),
    "nod": Motion(0.7, ((0.00, {}), (0.50, {"nod": 30}))),
    "shake_head": Motion(0.9, ((0.00, {}), (0.25, {"look": 36})), symmetric=True),
    "point": Motion(
        1.8,
        (
            (0.00, {}),
            (0.30, {"l_arm": 88, "l_elbow": 3, "l_abduct": 4, "twist": -8}),
            (0.70, {"l_arm": 90, "l_elbow": 2, "l_abduct": 4, "twist": -8}),
            (1.00, {}),
        ),
        cyclic=False,
    ),
    "drink": Motion(
        2.6,
        (
            (0.00, {}),
            (0.30, {"r_arm": 52, "r_elbow": 128, "r_turn": 22, "r_abduct": 14, "nod": -6}),
            (0.52, {"r_arm": 66, "r_elbow": 132, "r_turn": 22, "r_abduct": 20, "nod": -26}),
            (0.70, {"r_arm": 52, "r_elbow": 126, "r_turn": 22, "r_abduct": 14, "nod": -4}),
            (1.00, {}),
        ),
        cyclic=False,
    ),
    "sit_down": Motion(
        1.7,
        (
            (0.00, {}),
            (0.42, {"pitch": 30, "hip": 66, "knee": 56, "ankle": 20, "bend": 14, "arm": 26}),
            (0.75, {"pitch": 20, "hip": 100, "knee": 86, "ankle": 6, "bend": 12, "arm": 30, "elbow": 40}),
            (1.00, _SEATED),
        ),
        cyclic=False,
    ),
    "kneel": Motion(
        1.6,
        (
            (0.00, {}),
            (0.45, {"pitch": 12, "l_hip": 68, "l_knee": 56, "l_ankle": 0, "r_hip": -4, "r_knee": 52, "r_ankle": 36,
                    "bend": 8}),
            (1.00, {"l_hip": 90, "l_knee": 90, "l_ankle": 0, "r_hip": 0, "r_knee": 93, "r_ankle": -4, "l_arm": 16,
                    "l_elbow": 40, "bend": 4}),
        ),
        cyclic=False,
    ),
    "get_down": Motion(
        1.2,
        (
            (0.00, {}),
            (0.50, {"pitch": 44, "hip": 116, "knee": 96, "ankle": 24, "bend": 26, "arm": 70, "elbow": 6}),
            (1.00, {"pitch": 70, "hip": 134, "knee": 104, "ankle": 16, "bend": 24, "arm": 92, "elbow": 4, "nod": -20}),
        ),
        cyclic=False,
    ),
    "lie_down": Motion(
        3.2,
        (
            (0.00, {}),
            (0.24, {"pitch": 26, "hip": 112, "knee": 120, "ankle": 34, "bend": 18, "arm": 30}),
            (0.42, {"pitch": -6, "hip": 128, "knee": 118, "ankle": -16, "bend": 26, "arm": -38, "elbow": 12,
                    "abduct": 22}),
            (0.58, {"pitch": -24, "hip": 112, "knee": 98, "ankle": -38, "bend": 24, "arm": -40, "elbow": 30,
                    "abduct": 26}),
            (0.80, {"pitch": -72, "hip": 46, "knee": 58, "ankle": -34, "bend": 12, "arm": -16, "elbow": 40,
                    "abduct": 26, "nod": 14}),
            (1.00, {"pitch": -89, "hip": 2, "knee": 4, "ankle": -26, "abduct": 24, "elbow": 8, "nod": 4}),
        ),
        cyclic=False,
    ),
}  # fmt: skip
