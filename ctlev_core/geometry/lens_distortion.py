"""Lens distortion: OpenCV's rational model, where it is one-to-one, and its inverse.

A normalised image point (x, y) = (X / Z, Y / Z) with s = x^2 + y^2 becomes

    x' = x a / b + 2 p1 x y + p2 (s + 2 x^2)        a = 1 + k1 s + k2 s^2 + k3 s^3
    y' = y a / b + 2 p2 x y + p1 (s + 2 y^2)        b = 1 + k4 s + k5 s^2 + k6 s^3

The polynomials are fitted inside the image. Far outside they turn around, so that a point beside the camera comes back
into the picture; `cv2.projectPoints` draws it there. Here a point counts only in the region around the optical axis in
which the map is one-to-one. The map is the gradient of a potential (its Jacobian is symmetric), so this region is where
the Jacobian is positive definite, up to the first radius at which the radial part turns or has a pole.

Source: OpenCV, camera calibration and 3D reconstruction, "detailed description" (no thin prism, no tilt).
"""

from __future__ import annotations

import numpy as np

NUM_COEFFICIENTS = 8
"""k1, k2, p1, p2, k3, k4, k5, k6: OpenCV's order."""
MAX_NEWTON_STEPS = 100
MAX_HALVINGS = 30
ROUNDING = 4 * np.finfo(np.float64).eps
TOLERANCE = 1e-12
"""Largest error of the inverse, in normalised units, over 1 + the point's radius: 2e-9 px at a focal length of 1679."""


def distort(points: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Distorted normalised points [..., 2] float64 of normalised points [..., 2].

    NaN outside the region in which the map is one-to-one, and for points that are not finite.

    Args:
        points: [..., 2], normalised image coordinates.
        coefficients: [8] float64: k1, k2, p1, p2, k3, k4, k5, k6.
    """
    with np.errstate(all="ignore"):
        distorted, jacobian = _map(points, coefficients)
        valid = _is_one_to_one(points, jacobian, largest_radius(coefficients))
    return np.where(valid[..., None], distorted, np.nan)


def undistort(points: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Normalised points [..., 2] float64 whose distorted images are `points`: the inverse of `distort`.

    Newton's method, halving a step that leaves the one-to-one region or does not bring the image nearer. Since the map
    is the gradient of a function that is convex there, this finds the solution where there is one. NaN where the image
    of the result is further than `TOLERANCE` from the point: no point of the scene is seen there.
    """
    targets = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    radius = largest_radius(coefficients)
    scale = 1.0 + np.hypot(*targets.T)
    with np.errstate(all="ignore"):
        found = np.where(_is_one_to_one(targets, _map(targets, coefficients)[1], radius)[:, None], targets, 0.0)
        error = np.hypot(*(_map(found, coefficients)[0] - targets).T)
        moving = error > ROUNDING * scale
        for _ in range(MAX_NEWTON_STEPS):
            rows = np.flatnonzero(moving)
            if len(rows) == 0:
                break
            found[rows], reached = _newton_step(found[rows], targets[rows], error[rows], coefficients, radius)
            moving[rows] = (reached < error[rows]) & (reached > ROUNDING * scale[rows])
            error[rows] = reached
        # Where a point is not finite, so are both sides.
        solved = np.isfinite(scale) & (error <= TOLERANCE * scale)
    return np.where(solved[:, None], found, np.nan).reshape(np.shape(points))


def _newton_step(
    points: np.ndarray, targets: np.ndarray, error: np.ndarray, coefficients: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 2] whose images are nearer to the targets, and how near [N]; unchanged where there is none."""
    image, jacobian = _map(points, coefficients)
    step = _solve_symmetric(jacobian, image - targets)
    better_points, better_error = points.copy(), error.copy()
    rows = np.arange(len(points))
    for halving in range(MAX_HALVINGS):
        trial = points[rows] - 0.5**halving * step[rows]
        image, jacobian = _map(trial, coefficients)
        trial_error = np.hypot(*(image - targets[rows]).T)
        better = (trial_error < error[rows]) & _is_one_to_one(trial, jacobian, radius)
        better_points[rows[better]], better_error[rows[better]] = trial[better], trial_error[better]
        rows = rows[~better]
        if len(rows) == 0:
            break
    return better_points, better_error


def largest_radius(coefficients: np.ndarray) -> float:
    """Distance from the axis, in normalised units, up to which the radial part rises and has no pole; may be inf."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients
    a, b = np.poly1d([k3, k2, k1, 1.0]), np.poly1d([k6, k5, k4, 1.0])
    # d/dr (r a / b) = (a b + 2 s (a' b - a b')) / b^2 with s = r^2.
    rise = a * b + 2 * np.poly1d([1.0, 0.0]) * (a.deriv() * b - a * b.deriv())
    roots = np.concatenate([np.roots(rise.coeffs), np.roots(b.coeffs)])
    turns = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(np.sqrt(turns.min())) if len(turns) else np.inf


def _map(points: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image [..., 2] of each point, and the Jacobian [3, ...]: xx, xy = yx, yy."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    x, y = points[..., 0], points[..., 1]
    s = x * x + y * y
    a = 1.0 + s * (k1 + s * (k2 + s * k3))
    b = 1.0 + s * (k4 + s * (k5 + s * k6))
    a_slope = k1 + s * (2 * k2 + s * 3 * k3)
    b_slope = k4 + s * (2 * k5 + s * 3 * k6)
    gain = a / b
    slope = (a_slope - gain * b_slope) / b
    image = np.stack(
        [x * gain + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * gain + 2 * p2 * x * y + p1 * (s + 2 * y * y)], axis=-1
    )
    xx = gain + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    yy = gain + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return image, np.stack([xx, xy, yy])


def _is_one_to_one(points: np.ndarray, jacobian: np.ndarray, radius: float) -> np.ndarray:
    xx, xy, yy = jacobian
    inside = np.hypot(points[..., 0], points[..., 1]) < radius
    return inside & (xx + yy > 0.0) & (xx * yy > xy * xy)


def _solve_symmetric(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions [N, 2] of 2 x 2 systems with the symmetric matrices [3, N]: xx, xy, yy."""
    xx, xy, yy = matrix
    determinant = xx * yy - xy * xy
    u, v = right.T
    return np.stack([yy * u - xy * v, xx * v - xy * u], axis=1) / determinant[:, None]
