"""Joint orders, limbs and left/right partners. Every array of joints names its joint set from here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class JointSet:
    """An order of joints.

    Attributes:
        joints: names in order; left and right are the person's own.
        mirror: index of the partner of each joint under a left/right flip of the image.
    """

    joints: tuple[str, ...]
    mirror: tuple[int, ...]


def _joint_set(*joints: str) -> JointSet:
    swapped = [name.replace("left_", "#_").replace("right_", "left_").replace("#_", "right_") for name in joints]
    return JointSet(joints, tuple(joints.index(name) for name in swapped))


JOINT_SETS = {
    # Order of DHP19's labels (SensorsINI/DHP19, heatmap_generation_example.ipynb): right before left, hips swapped in.
    "dhp19": _joint_set(
        "head",
        "right_shoulder", "left_shoulder",
        "right_elbow", "left_elbow",
        "right_hip", "left_hip",
        "right_hand", "left_hand",
        "right_knee", "left_knee",
        "right_foot", "left_foot",
    ),
}  # fmt: skip

SMPL_JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
SMPL_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)

# The SMPL joint behind each DHP19 joint; a hand of DHP19 is a marker at the wrist, a foot one at the ankle.
SMPL_TO_DHP19 = (15, 17, 16, 19, 18, 2, 1, 21, 20, 5, 4, 8, 7)
