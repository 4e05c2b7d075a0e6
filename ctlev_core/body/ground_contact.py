"""Bodies set on the ground: the skin's lowest places touch it and stick to it, whatever the pose.

`motions.py` does this with joints, which is enough for feet. Here it is the skin, so that a lying or sitting body does
not sink in by the thickness of its flesh.
"""

from __future__ import annotations

import numpy as np

from ctlev_core.body.layer import NUM_BETAS, load_body, pose_vertices

SOFTNESS_M = 0.004
"""How far above the lowest vertex another still carries weight: contact moves smoothly from place to place."""
_CHUNK = 128


def stand_on_ground(rotations: np.ndarray) -> np.ndarray:
    """Translations that put a moving body on the ground, y = 0, and let what touches it stay where it is.

    Each vertex carries a share of the weight that falls off exponentially with its height above the lowest one; the
    weighted mean height is 0, and so is the weighted mean horizontal step from frame to frame. Walking forward comes
    out of it: the foot on the ground stays, the body moves. Two feet that slide against one another share the slip.

    Args:
        rotations: [T, 24, 3, 3] relative to the parent; the steps between frames must be small, 10 ms or so.
    Returns:
        [T, 3] float64, m; x and z are 0 in the first frame.
    """
    body = load_body()
    transl = np.zeros((len(rotations), 3))
    steps = np.zeros((len(rotations), 3))
    for start in range(0, len(rotations), _CHUNK):
        # One frame of the chunk before, for the step from it.
        first = max(start - 1, 0)
        part = rotations[first : start + _CHUNK]
        vertices, _ = pose_vertices(body, part, np.zeros(NUM_BETAS), np.zeros((len(part), 3)))
        height = vertices[..., 1]
        lowest = height.min(axis=1, keepdims=True)
        load = np.exp((lowest - height) / SOFTNESS_M)
        load /= load.sum(axis=1, keepdims=True)
        transl[first : start + _CHUNK, 1] = -np.einsum("tv,tv->t", load, height)
        shared = (load[1:] + load[:-1]) / 2
        steps[first + 1 : start + _CHUNK] = -np.einsum("tv,tva->ta", shared, np.diff(vertices, axis=0))
    transl[:, ::2] = np.cumsum(steps[:, ::2], axis=0)
    return transl
