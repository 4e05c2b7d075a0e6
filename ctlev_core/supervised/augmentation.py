"""How training samples are varied, and those of body regressors: mirrored and moved together with their bodies.

Frames of one sequence are all varied alike, so that they still follow from one another.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.supervised.image_shifts import shift_images
from data_contracts.image_rows import Images


class BodySamples(NamedTuple):
    """Frames [N, H, W, 3] uint8 and their bodies in the camera frame, float32.

    Attributes:
        frames: event images.
        rotations: [N, 24, 3, 3], each joint relative to its parent.
        betas: [N, 10].
        transl: [N, 3] m.
        intrinsics: [N, 4] px: fx, fy, cx, cy.
    """

    frames: Images
    rotations: np.ndarray
    betas: np.ndarray
    transl: np.ndarray
    intrinsics: np.ndarray


def draw_flips(sequence: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Which frames [N] to mirror: those of every other sequence, by chance.

    Args:
        sequence: [N] number of the sequence of each frame, from 0 and without gaps.
        generator: of the choice.
    """
    return (generator.random(_count(sequence)) < 0.5)[sequence]


def draw_shifts(shift_px: int, sequence: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """How far to move each frame, [N, 2] whole px in x and y of up to `shift_px` either way; arguments as above."""
    return generator.integers(-shift_px, shift_px + 1, size=(_count(sequence), 2))[sequence]


def mirror_half(samples: BodySamples, sequence: np.ndarray, generator: np.random.Generator) -> BodySamples:
    """Mirror each sequence with probability one half: x changes sign, left and right change places.

    The pelvis of the rest pose lies on the mirror plane, so translations are mirrored like points.

    Args:
        samples: N frames and bodies.
        sequence: as `draw_flips` takes it.
        generator: of the choice.
    """
    flip = draw_flips(sequence, generator)
    mirror = np.diag([-1.0, 1.0, 1.0]).astype(np.float32)
    rotations = mirror @ samples.rotations[:, JOINT_SETS["smpl"].mirror] @ mirror
    intrinsics = samples.intrinsics * np.array([1, 1, -1, 1], np.float32)
    intrinsics[:, 2] += samples.frames.shape[2]
    frames = np.asarray(samples.frames)
    return BodySamples(
        np.where(flip[:, None, None, None], frames[:, :, ::-1], frames),
        np.where(flip[:, None, None, None], rotations, samples.rotations),
        samples.betas,
        np.where(flip[:, None], samples.transl * np.array([-1, 1, 1], np.float32), samples.transl),
        np.where(flip[:, None], intrinsics, samples.intrinsics),
    )


def shift(samples: BodySamples, shift_px: int, sequence: np.ndarray, generator: np.random.Generator) -> BodySamples:
    """Move each sequence by its own whole number of px, and its bodies, at their own depths, with it.

    A body that moves aside is also seen from a little further round: shift_px / focal length, 2.4 degrees at 4 of
    96 px, which the label does not follow.

    Args:
        samples: N frames and bodies.
        shift_px: at most so many px in x and y, either way.
        sequence: as `draw_flips` takes it.
        generator: of the shifts.
    """
    if not shift_px:
        return samples
    shifts = draw_shifts(shift_px, sequence, generator)
    transl = samples.transl.copy()
    transl[:, :2] += samples.transl[:, 2:] * shifts.astype(np.float32) / samples.intrinsics[:, :2]
    return samples._replace(frames=shift_images(np.asarray(samples.frames), shifts), transl=transl)


def _count(sequence: np.ndarray) -> int:
    return int(sequence.max(initial=-1)) + 1
