"""What a rigid motion of the world does to SMPL's parameters: the one place that knows where a body turns.

SMPL turns a body about its own pelvis J, not about the origin: x = R (x_rest - J) + J + transl. After a rigid motion of
the world, X' = A X + a, the same body has R' = A R and transl' = A (J + transl) + a - J.
"""

from __future__ import annotations

import numpy as np


def move_roots(
    root: np.ndarray, transl: np.ndarray, pelvis: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Root rotations and translations of SMPL after X' = rotation X + translation.

    Args:
        root: [..., 3, 3] rotations of the root joint.
        transl: [..., 3] m, SMPL's translations.
        pelvis: [3] or [..., 3] m, the root joint J of the shaped body at rest.
        rotation: [3, 3], or [..., 3, 3] where each body's world moves on its own.
        translation: [3] or [..., 3] m.
    Returns:
        root [..., 3, 3] and transl [..., 3] after the motion.
    """
    moved = np.matmul(rotation, (pelvis + transl)[..., None])[..., 0]
    return np.matmul(rotation, root), moved + translation - pelvis


def motion_between(
    root: np.ndarray, transl: np.ndarray, moved_root: np.ndarray, moved_transl: np.ndarray, pelvis: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The rigid motion that takes bodies from one place to another: what `move_roots` would need to do it.

    Args:
        root: [..., 3, 3] and transl [..., 3] m, before.
        transl: see above.
        moved_root: [..., 3, 3] and moved_transl [..., 3] m, after.
        moved_transl: see above.
        pelvis: [3] or [..., 3] m, as in `move_roots`.
    Returns:
        rotation [..., 3, 3] and translation [..., 3] m.
    """
    rotation = moved_root @ np.swapaxes(root, -1, -2)
    translation = pelvis + moved_transl - np.matmul(rotation, (pelvis + transl)[..., None])[..., 0]
    return rotation, translation
