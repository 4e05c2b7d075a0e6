"""Joint orders, limbs and left/right partners. Every array of joints names its joint set from here."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

from data_contracts.errors import DataError


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


SMPL_JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
SMPL_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)

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
    # Order of CDEHP's labels (CDEHP-Dataset/cdehp-dataset.github.io, annotation.md): left before right, all joints
    # by side; it says "buttock" for hip.
    "cdehp": _joint_set(
        "head",
        "left_shoulder", "right_shoulder",
        "left_elbow", "right_elbow",
        "left_hand", "right_hand",
        "left_hip", "right_hip",
        "left_knee", "right_knee",
        "left_foot", "right_foot",
    ),
    "smpl": _joint_set(*SMPL_JOINTS),
    # OpenPose's 18 joints (Cao et al., CVPR 2017), the order of ControlNet's skeleton maps.
    "openpose": _joint_set(
        "nose", "neck",
        "right_shoulder", "right_elbow", "right_wrist",
        "left_shoulder", "left_elbow", "left_wrist",
        "right_hip", "right_knee", "right_ankle",
        "left_hip", "left_knee", "left_ankle",
        "right_eye", "left_eye", "right_ear", "left_ear",
    ),
}  # fmt: skip

# The SMPL joint behind each DHP19 joint; a hand of DHP19 is a marker at the wrist, a foot one at the ankle.
SMPL_TO_DHP19 = (15, 17, 16, 19, 18, 2, 1, 21, 20, 5, 4, 8, 7)

# SMPL names a joint of the fingers and one of the toes `hand` and `foot`; the marker sets mean wrist and ankle.
_MARKER_ON_SMPL = {
    f"{side}_{marker}": f"{side}_{joint}"
    for side in ("left", "right")
    for marker, joint in (("hand", "wrist"), ("foot", "ankle"))
}


def joint_indices(source: str, target: str) -> list[int]:
    """Where in joint set `source` each joint of `target` is, to reorder joints: `joints[:, indices]`.

    Joints correspond by name; of SMPL, the wrist is the hand of the other sets and the ankle the foot.

    Raises:
        DataError: an unknown joint set, or `source` lacks a joint of `target`.
    """
    for name in (source, target):
        if name not in JOINT_SETS:
            raise DataError(f"unknown joint set {name!r}; known: {', '.join(JOINT_SETS)}")
    names = JOINT_SETS[target].joints
    if source == "smpl" and target != "smpl":
        names = tuple(_MARKER_ON_SMPL.get(name, name) for name in names)
    known = JOINT_SETS[source].joints
    missing = [name for name in names if name not in known]
    if missing:
        raise DataError(f"joint set {source!r} lacks joints of {target!r}: {', '.join(missing)}")
    return [known.index(name) for name in names]


@cache
def openpose_sources(joint_set: str) -> tuple[tuple[int, ...], ...]:
    """Which joints of a set each of OpenPose's 18 joints is the mean of; none where the set has nothing like it.

    Of the marker sets, hand and foot are OpenPose's wrist and ankle; of SMPL, its own wrist and ankle. OpenPose's neck
    is the middle of the shoulders, also for SMPL, whose neck joint lies 6 cm higher. The head stands in for the nose,
    which is approximate: the markers of DHP19 and CDEHP are on the head, SMPL's joint is inside the skull between the
    ears. Only OpenPose has eyes and ears.

    Raises:
        DataError: an unknown joint set.
    """
    if joint_set not in JOINT_SETS:
        raise DataError(f"unknown joint set {joint_set!r}; known: {', '.join(JOINT_SETS)}")
    names = JOINT_SETS[joint_set].joints
    if joint_set == "openpose":
        return tuple((index,) for index in range(len(names)))
    sources: list[tuple[int, ...]] = []
    for wanted in JOINT_SETS["openpose"].joints:
        if wanted == "neck":
            stand_ins = [("right_shoulder", "left_shoulder")]
        else:
            marker = wanted.replace("wrist", "hand").replace("ankle", "foot").replace("nose", "head")
            stand_ins = [(wanted,), (marker,)]
        found = [parts for parts in stand_ins if set(parts) <= set(names)]
        sources.append(tuple(names.index(part) for part in found[0]) if found else ())
    return tuple(sources)
