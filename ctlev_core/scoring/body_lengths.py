"""Lengths of a labelled person that thresholds of correct joints are measured with: torso and head."""

from __future__ import annotations

import numpy as np

from ctlev_core.geometry.joint_sets import JOINT_SETS


def torso_length(joints: np.ndarray, joint_set: str, visible: np.ndarray | None = None) -> np.ndarray:
    """Left shoulder to right hip, [N], of joints [N, J, 2 or 3]; NaN where one of them is, or is not visible [N, J].

    Source: Sapp & Taskar, MODEC, CVPR 2013. Event-HPE measures from neck to pelvis.

    Raises:
        ValueError: the joint set is unknown or lacks one of them.
    """
    shoulder, hip = _joints(joints, visible, _indices(joint_set, "torso", "left_shoulder", "right_hip"))
    return np.linalg.norm(shoulder - hip, axis=-1)


def head_length(joints: np.ndarray, joint_set: str, visible: np.ndarray | None = None) -> np.ndarray:
    """Length of the head, [N], of joints [N, J, 2 or 3]; NaN where a joint of it is, or is not visible [N, J].

    SMPL's joints of neck and head lie inside; twice their distance, as in Event-HPE. Of the other sets, the distance of
    the head (OpenPose: the nose) from the middle of the shoulders: it takes the neck in, and is longer than the head
    segment of MPII, which is 0.6 of the diagonal of a box around the head.

    Source: PCKh, Andriluka et al., CVPR 2014; Event-HPE (Zou et al., ICCV 2021), `loss_funcs.py`.

    Raises:
        ValueError: the joint set is unknown or lacks one of them.
    """
    if joint_set == "smpl":
        neck, head = _joints(joints, visible, _indices(joint_set, "head", "neck", "head"))
        return 2 * np.linalg.norm(neck - head, axis=-1)
    top = "nose" if joint_set == "openpose" else "head"
    head, left, right = _joints(joints, visible, _indices(joint_set, "head", top, "left_shoulder", "right_shoulder"))
    return np.linalg.norm(head - (left + right) / 2, axis=-1)


def _joints(joints: np.ndarray, visible: np.ndarray | None, indices: list[int]) -> list[np.ndarray]:
    """Positions [N, 2 or 3] float64 of some joints, NaN where one is not visible."""
    found = [joints[:, index].astype(np.float64) for index in indices]
    for position, index in zip(found, indices, strict=True):
        if visible is not None:
            position[~visible[:, index]] = np.nan
    return found


def _indices(joint_set: str, length: str, *names: str) -> list[int]:
    known = JOINT_SETS[joint_set].joints if joint_set in JOINT_SETS else ()
    if not set(names) <= set(known):
        raise ValueError(f"the {length} needs a joint set of {', '.join(JOINT_SETS)}, got {joint_set!r}")
    return [known.index(name) for name in names]
