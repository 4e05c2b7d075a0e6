"""The loops of the body layer: forward kinematics, and linear blend skinning of one frame or of many.

Batches go through memory once: sixteen frames lie side by side in vector registers while one vertex is skinned, and
what it needs of them, a few bones of 12 numbers, stays in the first cache. All release the GIL. No frame's result
depends on which others are in its batch.

Source: Loper et al., SMPL, ACM TOG 2015, eq. 2-4 and 7.
"""

from __future__ import annotations

import numba
import numpy as np

FRAMES_ABREAST = 16
"""Frames that are skinned together: as many float32 as the widest vector registers hold."""


def abreast(transforms: np.ndarray) -> np.ndarray:
    """Transforms [T, 24, 3, 4] as [blocks, 24, 12 * 16] float32: one number of sixteen frames, then the next number."""
    count, num_joints = transforms.shape[:2]
    blocks = -(-count // FRAMES_ABREAST)
    padded = np.zeros((blocks * FRAMES_ABREAST, num_joints, 12), np.float32)
    padded[:count] = transforms.reshape(count, num_joints, 12)
    moved = padded.reshape(blocks, FRAMES_ABREAST, num_joints, 12).transpose(0, 2, 3, 1)
    return np.ascontiguousarray(moved).reshape(blocks, num_joints, 12 * FRAMES_ABREAST)


@numba.njit(cache=True, nogil=True)
def chain_bones(rotations, rest, transl, parents, transforms, joints):
    """Forward kinematics, into `transforms` [T, 24, 3, 4] and `joints` [T, 24, 3]; `rest` is [1 or T, 24, 3]."""
    for t in range(rotations.shape[0]):
        bones = rest[t if rest.shape[0] > 1 else 0]
        for joint in range(rotations.shape[1]):
            parent = parents[joint]
            local, move = rotations[t, joint], transforms[t, joint]
            for row in range(3):
                if parent < 0:
                    joints[t, joint, row] = bones[joint, row] + transl[t, row]
                    for column in range(3):
                        move[row, column] = local[row, column]
                else:
                    a, b, c = (
                        transforms[t, parent, row, 0],
                        transforms[t, parent, row, 1],
                        transforms[t, parent, row, 2],
                    )
                    x, y, z = (
                        bones[joint, 0] - bones[parent, 0],
                        bones[joint, 1] - bones[parent, 1],
                        bones[joint, 2] - bones[parent, 2],
                    )
                    joints[t, joint, row] = a * x + b * y + c * z + joints[t, parent, row]
                    for column in range(3):
                        move[row, column] = a * local[0, column] + b * local[1, column] + c * local[2, column]
                x, y, z = bones[joint, 0], bones[joint, 1], bones[joint, 2]
                move[row, 3] = joints[t, joint, row] - (move[row, 0] * x + move[row, 1] * y + move[row, 2] * z)


@numba.njit(cache=True, nogil=True)
def skin(vertices, normals, weight_indices, weight_values, transforms, posed, posed_normals):
    """Linear blend skinning of one frame, into `posed` and `posed_normals`, all [V, 3].

    Normals turn with the blended matrix and are left unnormalised: exact for a rigid bone, within a few degrees at a
    bent joint, and a third of the cost of normals from the posed faces.
    """
    for i in range(vertices.shape[0]):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for row in range(3):
            a = b = c = d = vertices.dtype.type(0.0)
            for k in range(weight_indices.shape[1]):
                weight, bone = weight_values[i, k], weight_indices[i, k]
                a += weight * transforms[bone, row, 0]
                b += weight * transforms[bone, row, 1]
                c += weight * transforms[bone, row, 2]
                d += weight * transforms[bone, row, 3]
            posed[i, row] = a * x + b * y + c * z + d
            posed_normals[i, row] = a * nx + b * ny + c * nz


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _blend_bones(indices, weights, bones, blended):
    """The weighted sum of a vertex's bones, 12 numbers of 16 frames, into `blended` [192]."""
    j0, j1, j2, j3 = indices[0], indices[1], indices[2], indices[3]
    w0, w1, w2, w3 = weights[0], weights[1], weights[2], weights[3]
    # The heaviest come first, so that the first zero ends the list.
    if w1 == 0.0:
        for n in range(192):
            blended[n] = w0 * bones[j0, n]
    elif w2 == 0.0:
        for n in range(192):
            blended[n] = w0 * bones[j0, n] + w1 * bones[j1, n]
    else:
        for n in range(192):
            blended[n] = w0 * bones[j0, n] + w1 * bones[j1, n] + w2 * bones[j2, n] + w3 * bones[j3, n]
    for k in range(4, weights.shape[0]):
        weight, joint = weights[k], indices[k]
        if weight == 0.0:
            break
        for n in range(192):
            blended[n] += weight * bones[joint, n]


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def skin_frames(rest, weight_indices, weight_values, moves, has_offsets, posed):
    """Linear blend skinning of a batch, into `posed` [T, V, 3].

    `moves` is [blocks, 24, 192], see `abreast`; `posed` holds on entry what is added to `rest` [V, 3], if
    `has_offsets`. Frames past the end are computed and not stored, so that every frame goes through the same
    instructions.
    """
    blended = np.empty(192, np.float32)
    points = np.zeros((3, 16), np.float32)
    moved = np.empty((16, 3), np.float32)
    for block in range(moves.shape[0]):
        first = block * 16
        count = min(16, posed.shape[0] - first)
        for i in range(rest.shape[0]):
            _blend_bones(weight_indices[i], weight_values[i], moves[block], blended)
            if has_offsets:
                for f in range(count):
                    for axis in range(3):
                        points[axis, f] = posed[first + f, i, axis]
            x0, y0, z0 = rest[i, 0], rest[i, 1], rest[i, 2]
            for f in range(16):
                x, y, z = x0 + points[0, f], y0 + points[1, f], z0 + points[2, f]
                moved[f, 0] = blended[f] * x + blended[16 + f] * y + blended[32 + f] * z + blended[48 + f]
                moved[f, 1] = blended[64 + f] * x + blended[80 + f] * y + blended[96 + f] * z + blended[112 + f]
                moved[f, 2] = blended[128 + f] * x + blended[144 + f] * y + blended[160 + f] * z + blended[176 + f]
            # Written out: as a loop, or as an assignment of rows, the compiler makes this the slowest part.
            for f in range(count):
                posed[first + f, i, 0] = moved[f, 0]
                posed[first + f, i, 1] = moved[f, 1]
                posed[first + f, i, 2] = moved[f, 2]
