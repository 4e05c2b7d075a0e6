"""Cameras: pinhole with lens distortion, projection, triangulation.

OpenCV frame: x right, y down, z forward. Pixel centres lie at integer + 0.5; a calibration made with OpenCV, whose
pixel centres lie at integers, therefore has a principal point 0.5 px less than ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctlev_core.geometry.lens_distortion import NUM_COEFFICIENTS, distort, undistort
from data_contracts.errors import DataError

NO_PARALLAX = 1e-10
"""Rank tolerance of triangulation: views whose rays differ by less, in radians, do not fix a depth."""
REFINEMENT_STEPS = 10


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: x_camera = R x_world + translation, pixel = K distort(x_camera / depth).

    Attributes:
        K: [3, 3] float64, px; the origin is the outer corner of the top left pixel.
        R: [3, 3] float64, world to camera.
        translation: [3] float64, m, camera frame.
        image_size: (width, height) px.
        distortion: [8] float64: k1, k2, p1, p2, k3, k4, k5, k6 of `ctlev_core.geometry.lens_distortion`; None = none.
    """

    K: np.ndarray
    R: np.ndarray
    translation: np.ndarray
    image_size: tuple[int, int]
    distortion: np.ndarray | None = None

    def __post_init__(self) -> None:
        expected = {"K": (3, 3), "R": (3, 3), "translation": (3,), "distortion": (NUM_COEFFICIENTS,)}
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and (np.shape(value) != shape or not np.isfinite(value).all()):
                raise ValueError(f"camera: {name} must be {list(shape)} finite numbers, got {np.asarray(value)!r}")

    @property
    def intrinsics(self) -> np.ndarray:
        """fx, fy, cx, cy [4] float64, px; skew and distortion are not among them."""
        return self.K[[0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float64)

    @property
    def centre(self) -> np.ndarray:
        """Where the camera stands, [3] float64, m, world frame."""
        return -self.R.T @ self.translation

    def scaled(self, factor: float) -> Camera:
        """The same view on a grid `factor` times as fine; sizes are rounded to whole pixels."""
        width, height = self.image_size
        K = self.K.copy()
        K[:2] *= factor
        return replace(self, K=K, image_size=(round(width * factor), round(height * factor)))


def camera_from_intrinsics(intrinsics: np.ndarray, image_size: tuple[int, int]) -> Camera:
    """The camera with `intrinsics` [4], px: fx, fy, cx, cy, in whose own frame the world is given."""
    fx, fy, cx, cy = np.asarray(intrinsics, dtype=np.float64)
    return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.eye(3), np.zeros(3), image_size)


def from_projection_matrix(matrix: np.ndarray, image_size: tuple[int, int], where: str) -> Camera:
    """The pinhole camera behind a projection matrix: pixel = (u, v), (u, v, 1) ~ matrix (X, Y, Z, 1).

    The matrix is known up to scale and sign only. It is split by an RQ decomposition into K (upper triangular, with
    skew, positive diagonal, K[2, 2] = 1), a proper rotation R, and the translation, in the unit of the matrix's world.

    Args:
        matrix: [3, 4] float64; for a camera that sees upright pictures (no mirror image).
        image_size: (width, height) px.
        where: names the file in the message.
    Raises:
        DataError: not a matrix of finite numbers, or its left 3 x 3 block is singular: a camera at infinity.
    Source: Hartley and Zisserman, Multiple View Geometry, 2nd edition, section 6.2.4.
    """
    if np.shape(matrix) != (3, 4) or not np.isfinite(matrix).all():
        raise DataError(f"{where}: a projection matrix is [3, 4] finite numbers, got {np.asarray(matrix)!r}")
    determinant = np.linalg.det(matrix[:, :3])
    if not abs(determinant) > np.finfo(float).eps * np.linalg.norm(matrix[:, :3]) ** 3:
        raise DataError(f"{where}: the left 3 x 3 block of the projection matrix is singular")
    # This sign makes R a rotation and the depth in front of the camera positive.
    matrix = matrix * np.sign(determinant)
    lower_q, lower_r = np.linalg.qr(matrix[::-1, :3].T)
    K, R = lower_r.T[::-1, ::-1], lower_q.T[::-1]
    signs = np.sign(np.diag(K))
    K, R = K * signs, R * signs[:, None]
    translation = np.linalg.solve(K, matrix[:, 3])
    return Camera(K / K[2, 2], R, translation, image_size)


def orbit_rotation(yaw_rad: float, pitch_rad: float) -> np.ndarray:
    """World-to-camera rotation [3, 3] float64 of a camera that looks at the middle of an upright world (y up).

    Yaw turns around the vertical axis, 0 sees the front of somebody who faces +z; positive pitch looks down.
    """
    pitch, yaw = pitch_rad, yaw_rad
    turn_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    turn_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    # World y points up and people face +z; the camera has y down and looks along +z: half a turn about x.
    return np.diag([1.0, -1.0, -1.0]) @ turn_x @ turn_y


def project(camera: Camera, points_world: np.ndarray) -> np.ndarray:
    """Pixels [..., 2] float64 of world points [..., 3] m.

    NaN where there is no finite pixel: on or behind the plane of the camera, where the distortion folds back (see
    `ctlev_core.geometry.lens_distortion`), and for points that are not finite.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        points = points_world @ camera.R.T + camera.translation
        depth = points[..., 2:]
        in_front = depth > 0.0
        normalised = points / np.where(in_front, depth, 1.0)
        if camera.distortion is not None:
            normalised[..., :2] = distort(normalised[..., :2], camera.distortion)
        pixels = (normalised @ camera.K.T)[..., :2]
        return np.where(in_front & np.isfinite(pixels).all(axis=-1, keepdims=True), pixels, np.nan)


def undistort_points(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Where the same camera without distortion would see what it sees at `pixels`: [..., 2] float64 px.

    NaN where the lens shows nothing of the scene, and where a pixel is not finite.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    if camera.distortion is None:
        return np.where(np.isfinite(pixels).all(axis=-1, keepdims=True), pixels, np.nan)
    with np.errstate(invalid="ignore", over="ignore"):
        points = undistort(_normalised(camera, pixels), camera.distortion)
        return points @ camera.K[:2, :2].T + camera.K[:2, 2]


def triangulate(cameras: Sequence[Camera], pixels: np.ndarray) -> np.ndarray:
    """The points that two or more cameras see: least squares of the distances in the images.

    The linear solution (DLT) on normalised coordinates starts a Gauss-Newton iteration on the distances in px between
    the undistorted observations and the projections, summed over all cameras that see the point.

    Args:
        cameras: C of them.
        pixels: [C, ..., 2]; an observation that is not finite is left out.
    Returns:
        [..., 3] float64, m, world frame. NaN where fewer than two cameras see the point, where their rays are
        parallel to 1e-10 or meet behind one of them.
    Raises:
        ValueError: fewer than two cameras, or not one array of pixels for each.
    Source: Hartley and Zisserman, sections 12.2 and 12.3 (there with the optimal correction for two views; the minimum
        is the same).
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    if len(cameras) < 2 or len(pixels) != len(cameras) or pixels.shape[-1] != 2:
        found = f"{pixels.shape} of {len(cameras)}"
        raise ValueError(f"triangulation needs pixels [C, ..., 2] of two cameras or more, got {found}")
    undistorted = np.stack([undistort_points(*view) for view in zip(cameras, pixels, strict=True)])
    observed = undistorted.reshape(len(cameras), -1, 2)
    seen: np.ndarray = np.isfinite(observed[..., 0])
    observed = np.where(seen[..., None], observed, 0.0)
    # Around the cameras, in units of their distances: an origin far away would cost digits.
    centres = np.stack([camera.centre for camera in cameras])
    origin = centres.mean(axis=0)
    scale = float(np.linalg.norm(centres - origin, axis=1).max()) or 1.0
    R = np.stack([camera.R for camera in cameras])
    shifts = np.einsum("cij,cj->ci", R, origin - centres) / scale
    K = np.stack([camera.K for camera in cameras])
    with np.errstate(all="ignore"):
        points, well_posed = _intersect_rays(R, shifts, K, observed, seen)
        points = _refine(R, shifts, K, observed, seen, points)
        depth = np.einsum("cj,nj->cn", R[:, 2], points) + shifts[:, 2:]
        well_posed &= ((depth > 0) | ~seen).all(axis=0) & (seen.sum(axis=0) >= 2)
    points = np.where(well_posed[:, None], points * scale + origin, np.nan)
    return points.reshape(*pixels.shape[1:-1], 3)


def is_inside(pixels: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """[...] bool: does the pixel position [..., 2] lie in the image? NaN does not."""
    return np.all((pixels >= 0.0) & (pixels < np.asarray(image_size, dtype=np.float64)), axis=-1)


def _normalised(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Pixels to normalised image coordinates [..., 2]; K may have skew."""
    return np.linalg.solve(camera.K[:2, :2], (pixels - camera.K[:2, 2])[..., None])[..., 0]


def _intersect_rays(
    R: np.ndarray, shifts: np.ndarray, K: np.ndarray, observed: np.ndarray, seen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Linear triangulation: points [N, 3], and which [N] bool are fixed by their rays."""
    rays = np.linalg.solve(K[:, None, :2, :2], (observed - K[:, None, :2, 2])[..., None])[..., 0]
    matrices = np.concatenate([R, shifts[..., None]], axis=2)
    # Two equations a view: ray x (third row) - (first or second row), times the unknown point, is 0.
    equations = rays[..., None] * matrices[:, None, 2:] - matrices[:, None, :2]
    equations /= np.sqrt(1.0 + (rays**2).sum(axis=-1))[..., None, None]
    equations *= seen[..., None, None]
    stacked = equations.transpose(1, 0, 2, 3).reshape(-1, 2 * len(R), 4)
    _, singular, right = np.linalg.svd(stacked, full_matrices=False)
    solution = right[:, -1]
    fixed = (singular[:, 2] > NO_PARALLAX * singular[:, 0]) & (np.abs(solution[:, 3]) > NO_PARALLAX)
    return np.where(fixed[:, None], solution[:, :3] / solution[:, 3:], 0.0), fixed


def _refine(
    R: np.ndarray, shifts: np.ndarray, K: np.ndarray, observed: np.ndarray, seen: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Gauss-Newton on the summed squared distances in px; a step that does not reduce them ends a point's iteration."""
    in_image = np.einsum("cij,cjk->cik", K, R)

    def residuals(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        homogeneous = np.einsum("cij,nj->cni", in_image, at) + np.einsum("cij,cj->ci", K, shifts)[:, None]
        projected = homogeneous[..., :2] / homogeneous[..., 2:]
        slopes = (in_image[:, None, :2] - projected[..., None] * in_image[:, None, 2:]) / homogeneous[..., 2:, None]
        # Not a product: a camera that does not see the point may have it on its plane, where these are infinite.
        return np.where(seen[..., None], projected - observed, 0.0), np.where(seen[..., None, None], slopes, 0.0)

    error, slopes = residuals(points)
    for _ in range(REFINEMENT_STEPS):
        normal = np.einsum("cnri,cnrj->nij", slopes, slopes)
        normal = np.where(np.isfinite(normal).all(axis=(1, 2), keepdims=True), normal, 0.0)
        solvable = np.linalg.cond(normal) < 1.0 / np.finfo(float).eps
        normal[~solvable] = np.eye(3)
        step = np.linalg.solve(normal, np.einsum("cnri,cnr->ni", slopes, error)[..., None])[..., 0]
        trial = points - step
        trial_error, trial_slopes = residuals(trial)
        better = solvable & ((trial_error**2).sum(axis=(0, 2)) < (error**2).sum(axis=(0, 2)))
        if not better.any():
            break
        points = np.where(better[:, None], trial, points)
        error = np.where(better[:, None], trial_error, error)
        slopes = np.where(better[:, None, None], trial_slopes, slopes)
    return points
