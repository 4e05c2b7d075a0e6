"""Which joints of a skeleton are hips, knees, ankles, shoulders, elbows and wrists: by their names.

Motion capture has no standard of joint names. Stripped of what all names begin with (`mixamorig:`, `Bip01 `), of case
and of punctuation, they say the side (`Left`, `L`, in front or behind) and one of few words. Pelvis, spine, neck and
collars are not looked for by name: retargeting finds them from what hangs on what.

Source: the skeletons of CMU's BVH conversions (MotionBuilder, 3ds Max and Daz), of Mixamo, LAFAN1, Xsens, Biovision,
Unreal, Unity, VRM, Rokoko and Bandai-Namco, of CMU's own ASF files, and SMPL's.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from data_contracts.errors import DataError

# In order of preference: MotionBuilder's `LeftShoulder` is a collar where there is a `LeftArm`, and SMPL's `left_foot`
# are the toes where there is a `left_ankle`.
_WORDS = {
    "hip": ("upleg", "upperleg", "thigh", "thighbend", "femur", "hip"),
    "knee": ("knee", "lowleg", "lowerleg", "shin", "calf", "tibia", "leg"),
    "ankle": ("ankle", "foot"),
    "shoulder": ("arm", "uparm", "upperarm", "shldr", "shldrbend", "humerus", "shoulder"),
    "elbow": ("elbow", "forearm", "forearmbend", "lowarm", "lowerarm", "radius"),
    "wrist": ("wrist", "hand"),
}
_SIDES = (("left{}", "right{}"), ("{}left", "{}right"), ("l{}", "r{}"), ("{}l", "{}r"))

LANDMARKS = tuple(f"{side}_{part}" for part in _WORDS for side in ("left", "right"))
"""The twelve joints that a skeleton must have; a `head` is optional."""


def find_landmarks(names: Sequence[str], where: str) -> dict[str, int]:
    """Indices of the joints `LANDMARKS`, and of `head` where there is one.

    Args:
        names: of all joints of a skeleton.
        where: names it in messages.
    Raises:
        DataError: some are not found; the message lists them and the names that there are.
    """
    indices = {name: index for index, name in reversed(list(enumerate(_bare_names(names))))}
    best: dict[str, int] = {}
    for templates in _SIDES:
        found = {}
        for part, words in _WORDS.items():
            for side, template in zip(("left", "right"), templates, strict=True):
                match = next((word for word in words if template.format(word) in indices), None)
                if match is not None:
                    found[f"{side}_{part}"] = indices[template.format(match)]
        best = max(best, found, key=len)
    missing = [name for name in LANDMARKS if name not in best]
    if missing:
        raise DataError(
            f"{where}: no joint of a known name for {', '.join(missing)}; the skeleton has: {', '.join(names)}"
        )
    if "head" in indices:
        best["head"] = indices["head"]
    return best


def _bare_names(names: Sequence[str]) -> list[str]:
    """Lower case without punctuation, name space and what all names but perhaps the root's begin with."""
    plain = [re.sub(r"[^a-z0-9]", "", name.rpartition(":")[2].lower()) for name in names]
    others = plain[1:]
    if len(others) < 2:
        return plain
    # The first and the last in alphabetical order begin with what all begin with, and differ after it.
    first, last = min(others), max(others)
    shared = next((i for i, pair in enumerate(zip(first, last, strict=False)) if pair[0] != pair[1]), len(first))
    return [name.removeprefix(first[:shared]) for name in plain]
