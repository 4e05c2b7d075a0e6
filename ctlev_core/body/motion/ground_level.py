"""The height of the ground of a motion that does not say it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctlev_core.body.motion.clip import MotionClip
from ctlev_core.geometry.joint_sets import SMPL_JOINTS

SOLE_M = 0.02
"""Height of the skin over the lowest of a standing foot that still is its sole."""
_FEET = tuple(i for i, name in enumerate(SMPL_JOINTS) if name.endswith(("ankle", "foot")))


def put_feet_on_ground(clip: MotionClip) -> MotionClip:
    """The clip, raised or lowered as a whole so that the lowest sole of all its frames is at a height of 0.

    The soles are those of the bundled body. Nothing else is looked at: a motion on hands and knees, or one that never
    touches the ground, is better left as it is.
    """
    from ctlev_core.body.layer import joint_transforms, load_body, shape_vertices
    from ctlev_core.body.rotations import matrix_from_axis_angle

    body = load_body()
    vertices = shape_vertices(body, clip.betas).astype(np.float64)
    bone = body.weight_indices[np.arange(len(vertices)), body.weight_values.argmax(axis=1)]
    rotations = matrix_from_axis_angle(clip.pose.reshape(-1, 24, 3))
    transforms, _ = joint_transforms(body, rotations, clip.betas, clip.transl)
    lowest = np.inf
    for joint in _FEET:
        part = vertices[bone == joint]
        sole = part[part[:, 1] < part[:, 1].min() + SOLE_M]
        heights = transforms[:, joint, 1, :3] @ sole.T + transforms[:, joint, 1, 3:]
        lowest = min(lowest, float(heights.min()))
    return replace(clip, transl=clip.transl - [0.0, lowest, 0.0])
