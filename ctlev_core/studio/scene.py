"""Random people, light, cameras and backgrounds, and the pictures of them: what `studio` and the base model share."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np

from ctlev_core.body.layer import BodyModel, joint_transforms, load_body, pose_offsets, shape_vertices, skin
from ctlev_core.body.skinning import abreast, skin_frames
from ctlev_core.geometry.camera import Camera, project
from ctlev_core.geometry.joint_sets import SMPL_JOINTS
from ctlev_core.render.rasteriser import NEAR_M, rasterise
from data_contracts.errors import DataError

__all__ = [
    "BodyPainter", "Camera", "Light", "Subject", "project", "render_body_frames", "render_person", "sample_background",
    "sample_betas", "sample_light", "sample_subject",
]  # fmt: skip

SUPERSAMPLING = 2
BOUNCE_LIGHT = 0.15
"""Share of the direct light that reaches the side turned away."""
DARKEST = 0.02

SKIN, TROUSERS, SHIRT, SHOES, HAIR = range(5)
_SIDES = ("left", "right")
_SHIRT_JOINTS = (
    "spine1", "spine2", "spine3", *(f"{side}_{name}" for side in _SIDES for name in ("collar", "shoulder")),
)  # fmt: skip
_SHOE_JOINTS = tuple(f"{side}_{name}" for side in _SIDES for name in ("ankle", "foot"))


@dataclass(frozen=True, eq=False)
class Subject:
    """A person: the shape `betas` [10] and the reflectance `albedo` [V, C] float32 of each vertex, C = 1 or 3."""

    betas: np.ndarray
    albedo: np.ndarray


@dataclass(frozen=True, eq=False)
class Light:
    """One distant lamp and ambient light; `direction` [3] points to the lamp, camera frame, unit length."""

    direction: np.ndarray
    ambient: float


def sample_betas(rng: np.random.Generator) -> np.ndarray:
    """A random body shape [10], two and a half standard deviations at most."""
    return np.clip(1.2 * rng.normal(size=10), -2.5, 2.5)


def sample_subject(rng: np.random.Generator, colour: bool, body: BodyModel | None = None) -> Subject:
    """A random person: shape, skin, hair, clothes with a pattern; grey when not `colour`."""
    body = body or load_body()
    betas = sample_betas(rng)
    parts = _clothing(rng, body)
    base = rng.uniform(0.06, 0.85, (5, 3))
    base[SKIN] = rng.uniform(0.45, 1.1) * np.array([0.8, 0.6, 0.5])
    base[HAIR] = rng.uniform(0.04, 0.35) * np.array([1.0, 0.8, 0.6])
    if not colour:
        base = base.mean(axis=1, keepdims=True)
    pattern = np.zeros(len(body.v_template))
    for _ in range(3):
        wave = rng.normal(size=3) * rng.uniform(15.0, 60.0)
        pattern += rng.uniform(0.0, 0.35) * np.sin(body.v_template @ wave + rng.uniform(0.0, 2 * np.pi))
    strength = np.where(np.isin(parts, (TROUSERS, SHIRT)), 1.0, 0.25)
    albedo = base[parts] * np.exp(strength * pattern)[:, None]
    return Subject(betas, np.clip(albedo, 0.03, 0.95).astype(np.float32))


def _clothing(rng: np.random.Generator, body: BodyModel) -> np.ndarray:
    """Part [V] of each vertex, by the joint that moves it most; sleeves and trouser legs are short at random."""
    owner = np.array(SMPL_JOINTS)[body.weight_indices[:, 0]]
    shirt = _SHIRT_JOINTS + (("left_elbow", "right_elbow") if rng.random() < 0.5 else ())
    trousers = ("pelvis", "left_hip", "right_hip") + (("left_knee", "right_knee") if rng.random() < 0.6 else ())
    parts = np.full(len(owner), SKIN)
    for part, joints in ((TROUSERS, trousers), (SHIRT, shirt), (SHOES, _SHOE_JOINTS)):
        parts[np.isin(owner, joints)] = part
    up, forward = (body.v_template - body.joints[SMPL_JOINTS.index("head")])[:, 1:].T
    parts[np.isin(owner, ("head", "neck")) & (up > 0.067) & ((up > 0.147) | (forward < -0.035))] = HAIR
    return parts


def sample_light(rng: np.random.Generator) -> Light:
    """A lamp above and in front of the person."""
    direction = np.array([rng.uniform(-0.8, 0.8), rng.uniform(-1.0, -0.2), -1.0])
    return Light(direction / np.linalg.norm(direction), rng.uniform(0.3, 0.55))


def sample_background(rng: np.random.Generator, image_size: tuple[int, int], colour: bool) -> np.ndarray:
    """A random wall with stains of several sizes, often with a floor: [H, W, 3 or 1] float32 in (0, 1]."""
    width, height = image_size
    channels = 3 if colour else 1
    wall = np.empty((height, width, channels))
    wall[:] = rng.uniform(0.15, 0.7, channels)
    if not (colour and rng.random() < 0.3):
        for cells, amplitude in ((4, 0.35), (10, 0.2), (28, 0.12)):
            noise = rng.normal(size=(cells, cells, channels)) * amplitude * rng.uniform(0.2, 1.0)
            wall *= np.exp(cv2.resize(noise, image_size, interpolation=cv2.INTER_CUBIC).reshape(wall.shape))
        if rng.random() < 0.5:
            wall[int(rng.uniform(0.6, 0.95) * height) :] *= rng.uniform(0.6, 1.5)
    return np.clip(wall, DARKEST, 1.0).astype(np.float32)


class BodyPainter:
    """Paints one person before a still background, pose by pose, and touches only the box around the body.

    An instance keeps pictures to draw on, so that several threads must not share it.

    Args:
        subject: the person.
        camera: the view; its image size is the size of the background. Its distortion is ignored.
        background: [H, W, C] float32 in (0, 1], C as in `subject.albedo`.
        light: the lamp.
        body: the bundled body when None.
    Raises:
        DataError: the background does not fit the camera or the subject.
    """

    def __init__(
        self, subject: Subject, camera: Camera, background: np.ndarray, light: Light, body: BodyModel | None = None
    ) -> None:
        self.body = body or load_body()
        width, height = camera.image_size
        shape = (height, width, subject.albedo.shape[1])
        if background.shape != shape:
            raise DataError(f"background must be {shape} for this camera and subject, got {background.shape}")
        self.subject, self.camera, self.light = subject, camera, light
        self.background = np.ascontiguousarray(background, np.float32)
        self._K = np.ascontiguousarray(camera.scaled(SUPERSAMPLING).K, np.float64)
        self.rest = shape_vertices(self.body, subject.betas)
        self._vertices, self._normals = np.empty_like(self.rest), np.empty_like(self.rest)
        self._colours = np.empty_like(subject.albedo)
        self._image = np.empty((SUPERSAMPLING * height, SUPERSAMPLING * width, shape[2]), np.float32)
        self._depth_inverse = np.zeros(self._image.shape[:2], np.float32)

    def in_camera(self, rotations: np.ndarray, transl: np.ndarray) -> np.ndarray:
        """The map of each bone from the rest pose to the camera frame, [T, 24, 3, 4] float32, of T poses."""
        transforms, _ = joint_transforms(self.body, rotations, self.subject.betas, transl)
        moves = self.camera.R @ transforms
        moves[..., 3] += self.camera.translation
        return moves.astype(np.float32)

    def pose(self, rotations: np.ndarray, transl: np.ndarray) -> np.ndarray:
        """Vertices [T, V, 3] float32, m, camera frame, of T poses."""
        offsets, moves = pose_offsets(self.body, rotations), self.in_camera(rotations, transl)
        posed = np.empty((len(moves), *self.rest.shape), np.float32) if offsets is None else offsets
        body, has_offsets = self.body, offsets is not None
        skin_frames(self.rest, body.weight_indices, body.weight_values, abreast(moves), has_offsets, posed)
        return posed

    def paint(self, moves: np.ndarray, offsets: np.ndarray | None) -> tuple[int, int, np.ndarray]:
        """The part of the picture that the body may cover: skin, shade (Lambert), rasterise at twice the size, average.

        Args:
            moves: [24, 3, 4], one of those of `in_camera`.
            offsets: [V, 3] of `pose_offsets`, or None.
        Returns:
            left and top in px, and [h, w, C] float32 in (0, 1] with the background between; [0, 0, C] without a body.
        """
        # These stay separate calls: numba's cache does not notice when a kernel called from another module changes.
        body, unposed = self.body, self.rest if offsets is None else self.rest + offsets
        skin(unposed, body.normals, body.weight_indices, body.weight_values, moves, self._vertices, self._normals)
        left, top, right, bottom = _find_box(self._vertices, self._K, NEAR_M, *self.camera.image_size)
        patch = np.empty((bottom - top, right - left, self._colours.shape[1]), np.float32)
        if patch.size:
            _shade(self._normals, self.subject.albedo, self.light.direction, self.light.ambient, self._colours)
            rasterise(
                self._vertices, body.faces, self._colours, self._K, NEAR_M, True, self._image, self._depth_inverse
            )
            _average_blocks(self._image, self._depth_inverse, self.background, left, top, patch)
        return left, top, patch


def render_body_frames(
    subject: Subject,
    rotations: np.ndarray,
    transl: np.ndarray,
    camera: Camera,
    background: np.ndarray,
    light: Light,
    body: BodyModel | None = None,
) -> np.ndarray:
    """Linear-intensity pictures of a moving person; see `BodyPainter`.

    Args:
        subject: the person.
        rotations: [T, 24, 3, 3] relative to the parent.
        transl: [T, 3] m.
        camera: the view; its image size is the size of the result.
        background: [H, W, C] float32 in (0, 1], C as in `subject.albedo`.
        light: the lamp.
        body: the bundled body when None.
    Returns:
        [T, H, W, C] float32 in (0, 1].
    Raises:
        DataError: the background does not fit the camera or the subject.
    """
    painter = BodyPainter(subject, camera, background, light, body)
    offsets = pose_offsets(painter.body, rotations)
    out = np.repeat(painter.background[None], len(rotations), axis=0)
    for frame, moves in enumerate(painter.in_camera(rotations, transl)):
        left, top, patch = painter.paint(moves, None if offsets is None else offsets[frame])
        out[frame, top : top + patch.shape[0], left : left + patch.shape[1]] = patch
    return out


def render_person(
    rng: np.random.Generator,
    subject: Subject,
    rotations: np.ndarray,
    transl: np.ndarray,
    camera: Camera,
    background: np.ndarray,
    image_size: tuple[int, int],
) -> np.ndarray:
    """One picture [H, W, 3 or 1] float32 in (0, 1], linear, of one pose under random light.

    Args:
        rng: draws the light.
        subject: the person.
        rotations: [24, 3, 3]; transl: [3] m.
        transl: see above.
        camera: the view.
        background: [H, W, C].
        image_size: (width, height) px; must be the camera's.
    Raises:
        DataError: sizes disagree.
    """
    if image_size != camera.image_size:
        raise DataError(f"the camera makes images of {camera.image_size} px, asked for {image_size}")
    return render_body_frames(subject, rotations[None], transl[None], camera, background, sample_light(rng))[0]


@numba.njit(cache=True, nogil=True)
def _shade(normals, albedo, lamp, ambient, colours):
    """Lambert's law at each vertex."""
    for i in range(normals.shape[0]):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
        cosine = (x * lamp[0] + y * lamp[1] + z * lamp[2]) / length
        light = ambient + (1.0 - ambient) * (cosine if cosine > 0.0 else -BOUNCE_LIGHT * cosine)
        for k in range(albedo.shape[1]):
            colours[i, k] = albedo[i, k] * light


@numba.njit(cache=True, nogil=True)
def _find_box(vertices, K, near, width, height):
    """Left, top, right and bottom (exclusive), px of the averaged picture, of all that the mesh may cover.

    What crosses the near plane is cut there and may be anywhere: then the box is the whole picture.
    """
    left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
    behind = 0
    for i in range(vertices.shape[0]):
        if vertices[i, 2] > near:
            inverse = 1.0 / vertices[i, 2]
            x, y = K[0, 0] * vertices[i, 0] * inverse + K[0, 2], K[1, 1] * vertices[i, 1] * inverse + K[1, 2]
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
        else:
            behind += 1
    if behind == vertices.shape[0]:
        return 0, 0, 0, 0
    if behind > 0:
        return 0, 0, width, height
    # Clamped before the cast: far outside the picture a position need not fit an integer.
    first_column = int(np.floor(min(max(left / SUPERSAMPLING, 0.0), float(width))))
    first_row = int(np.floor(min(max(top / SUPERSAMPLING, 0.0), float(height))))
    last_column = int(np.ceil(max(min(right / SUPERSAMPLING, float(width)), 0.0)))
    last_row = int(np.ceil(max(min(bottom / SUPERSAMPLING, float(height)), 0.0)))
    if first_column >= last_column or first_row >= last_row:
        return 0, 0, 0, 0
    return first_column, first_row, last_column, last_row


@numba.njit(cache=True, nogil=True)
def _average_blocks(image, depth_inverse, background, left, top, out):
    """Means over blocks of SUPERSAMPLING x SUPERSAMPLING pixels, into `out`, whose first is at (left, top).

    Where no surface is, the background counts. What is read of the depth is put back to 0, for the next picture.
    """
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            for k in range(out.shape[2]):
                behind, total = background[top + row, left + column, k], np.float32(0.0)
                for dy in range(SUPERSAMPLING):
                    for dx in range(SUPERSAMPLING):
                        y, x = SUPERSAMPLING * (top + row) + dy, SUPERSAMPLING * (left + column) + dx
                        total += image[y, x, k] if depth_inverse[y, x] > 0.0 else behind
                out[row, column, k] = total / np.float32(SUPERSAMPLING * SUPERSAMPLING)
    depth_inverse[
        SUPERSAMPLING * top : SUPERSAMPLING * (top + out.shape[0]),
        SUPERSAMPLING * left : SUPERSAMPLING * (left + out.shape[1]),
    ] = 0.0
