"""The best similarity of two sets of points, row by row, compiled: a batch of 3 x 3 problems is too small for LAPACK.

The singular value decomposition is one-sided Jacobi, which finds small singular values to their own size. Only the two
largest pairs of vectors are taken from it and the third are their cross products: the rotation is then never a
reflection, and a third singular value of zero needs no care.

Source: Umeyama, IEEE TPAMI 1991, eq. 34-43; Demmel & Veselic, SIAM J. Matrix Anal. Appl. 13, 1992.
"""

from __future__ import annotations

import numba
import numpy as np

_MAX_SWEEPS = 40
_EPSILON = 2.0**-52


@numba.njit(cache=True, nogil=True)
def align_rows(
    points: np.ndarray, target: np.ndarray, known: np.ndarray, relative_size: float, aligned: np.ndarray
) -> None:
    """Write `points` [N, J, 3], brought onto `target` [N, J, 3] where `known` [N, J], to `aligned` [N, J, 3].

    Points whose spread is at most `relative_size` of their distance from the origin coincide.
    """
    turn, centre, centre_target = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for row in range(len(points)):
        if not _find_similarity(points[row], target[row], known[row], relative_size, turn, centre, centre_target):
            aligned[row] = points[row]
            continue
        for axis in range(3):
            a, b, c = turn[axis]
            for joint in range(points.shape[1]):
                x = points[row, joint, 0] - centre[0]
                y = points[row, joint, 1] - centre[1]
                z = points[row, joint, 2] - centre[2]
                aligned[row, joint, axis] = a * x + b * y + c * z + centre_target[axis]


@numba.njit(cache=True, nogil=True)
def mean_distances(
    points: np.ndarray,
    target: np.ndarray,
    shifts: np.ndarray,
    with_similarity: bool,
    relative_size: float,
    means: np.ndarray,
) -> None:
    """Mean distances of `points` [N, V, 3] from `target` [N, V, 3], all known, into `means` [N, S + 1].

    The first S are those of points moved by `shifts` [N, S, 3], the last that of points brought onto the target as by
    `align_rows`, where it is asked for: moved points are not kept, for writing many takes longer than moving them.
    """
    count = points.shape[1]
    turn, centre, centre_target = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    known = np.ones(count, np.bool_)
    for row in range(len(points)):
        for number in range(shifts.shape[1]):
            a, b, c = shifts[row, number]
            total = 0.0
            for point in range(count):
                x = points[row, point, 0] - target[row, point, 0] + a
                y = points[row, point, 1] - target[row, point, 1] + b
                z = points[row, point, 2] - target[row, point, 2] + c
                total += np.sqrt(x * x + y * y + z * z)
            means[row, number] = total / count
        if with_similarity:
            _find_similarity(points[row], target[row], known, relative_size, turn, centre, centre_target)
            total = _sum_of_distances(points[row], target[row], turn, centre, centre_target)
            means[row, shifts.shape[1]] = total / count


@numba.njit(cache=True, nogil=True)
def _sum_of_distances(
    points: np.ndarray, target: np.ndarray, turn: np.ndarray, centre: np.ndarray, centre_target: np.ndarray
) -> float:
    """Of `points` [V, 3], moved from `centre` to `centre_target` and turned, from `target` [V, 3]."""
    xx, xy, xz = turn[0]
    yx, yy, yz = turn[1]
    zx, zy, zz = turn[2]
    # One constant an axis: turned points, less the turned centre, plus that of the target.
    a, b, c = centre_target - turn @ centre
    total = 0.0
    for point in range(len(points)):
        u, v, w = points[point]
        x = xx * u + xy * v + xz * w + (a - target[point, 0])
        y = yx * u + yy * v + yz * w + (b - target[point, 1])
        z = zx * u + zy * v + zz * w + (c - target[point, 2])
        total += np.sqrt(x * x + y * y + z * z)
    return total


@numba.njit(cache=True, nogil=True)
def _find_similarity(
    points: np.ndarray,
    target: np.ndarray,
    known: np.ndarray,
    relative_size: float,
    turn: np.ndarray,
    centre: np.ndarray,
    centre_target: np.ndarray,
) -> bool:
    """The best: turn (point - centre) + centre_target, the scale within `turn`; False where nothing is known."""
    product, turned = np.zeros((3, 3)), np.zeros((3, 3))
    size = _moments(points, target, known, centre, centre_target, product)
    if size < 0.0:
        return False
    farthest = max(abs(centre[0]), abs(centre[1]), abs(centre[2]))
    rotation = np.zeros((3, 3))
    scale = 0.0
    if size > relative_size * farthest:
        scale = _best_rotation(product, turned, rotation) / size
    turn[:] = scale * rotation.T
    return True


@numba.njit(cache=True, nogil=True)
def _moments(
    points: np.ndarray,
    target: np.ndarray,
    known: np.ndarray,
    centre: np.ndarray,
    centre_target: np.ndarray,
    product: np.ndarray,
) -> float:
    """Means of the known points into `centre` and `centre_target`, and the sum of the outer products of centred points
    and centred target, over the points' size, into `product`; returns the size, -1 where nothing is known.

    In one pass, as seen from the first known point: however far away points are, no digits are lost.
    """
    count, first = 0, 0
    square = 0.0
    a = b = c = d = e = f = 0.0
    xx = xy = xz = yx = yy = yz = zx = zy = zz = 0.0
    for joint in range(len(points)):
        if known[joint]:
            if count == 0:
                first = joint
            count += 1
            x, y, z = (
                points[joint, 0] - np.float64(points[first, 0]),
                points[joint, 1] - np.float64(points[first, 1]),
                points[joint, 2] - np.float64(points[first, 2]),
            )
            u, v, w = (
                target[joint, 0] - np.float64(target[first, 0]),
                target[joint, 1] - np.float64(target[first, 1]),
                target[joint, 2] - np.float64(target[first, 2]),
            )
            a, b, c, d, e, f = a + x, b + y, c + z, d + u, e + v, f + w
            square += x * x + y * y + z * z
            xx, xy, xz = xx + x * u, xy + x * v, xz + x * w
            yx, yy, yz = yx + y * u, yy + y * v, yz + y * w
            zx, zy, zz = zx + z * u, zy + z * v, zz + z * w
    if count == 0:
        return -1.0
    size = np.sqrt(max(square - (a * a + b * b + c * c) / count, 0.0))
    unit = 1.0 / size if size > 0.0 else 0.0
    a, b, c, d, e, f = a / count, b / count, c / count, d / count, e / count, f / count
    product[0, 0], product[0, 1], product[0, 2] = xx - count * a * d, xy - count * a * e, xz - count * a * f
    product[1, 0], product[1, 1], product[1, 2] = yx - count * b * d, yy - count * b * e, yz - count * b * f
    product[2, 0], product[2, 1], product[2, 2] = zx - count * c * d, zy - count * c * e, zz - count * c * f
    product *= unit
    centre[0], centre[1], centre[2] = points[first, 0] + a, points[first, 1] + b, points[first, 2] + c
    centre_target[0], centre_target[1] = target[first, 0] + d, target[first, 1] + e
    centre_target[2] = target[first, 2] + f
    return size


@numba.njit(cache=True, nogil=True)
def _best_rotation(product: np.ndarray, turned: np.ndarray, rotation: np.ndarray) -> float:
    """The rotation R with the largest trace of R^T product, into `rotation`; returns that trace."""
    v = _diagonalise(product, turned)
    lengths = np.array([_length(turned[:, 0]), _length(turned[:, 1]), _length(turned[:, 2])])
    order = np.argsort(-lengths)
    first, second = order[0], order[1]
    v1, v2 = v[:, first].copy(), v[:, second].copy()
    if lengths[first] == 0.0:
        u1 = v1.copy()
    else:
        u1 = turned[:, first] / lengths[first]
    if lengths[second] > 0.0:
        u2 = turned[:, second] / lengths[second]
    else:
        u2 = _perpendicular(u1)
    u3, v3 = _cross(u1, u2), _cross(v1, v2)
    trace = 0.0
    for row in range(3):
        for column in range(3):
            rotation[row, column] = u1[row] * v1[column] + u2[row] * v2[column] + u3[row] * v3[column]
            trace += rotation[row, column] * product[row, column]
    return max(trace, 0.0)


@numba.njit(cache=True, nogil=True)
def _diagonalise(matrix: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """V, orthogonal, for which the columns of matrix V are orthogonal to one another; those into `turned`."""
    v = np.eye(3)
    turned[:] = matrix
    for _ in range(_MAX_SWEEPS):
        is_done = True
        for p in range(2):
            for q in range(p + 1, 3):
                a = turned[0, p] ** 2 + turned[1, p] ** 2 + turned[2, p] ** 2
                b = turned[0, q] ** 2 + turned[1, q] ** 2 + turned[2, q] ** 2
                c = turned[0, p] * turned[0, q] + turned[1, p] * turned[1, q] + turned[2, p] * turned[2, q]
                if abs(c) <= _EPSILON * np.sqrt(a * b):
                    continue
                is_done = False
                zeta = (b - a) / (2.0 * c)
                tangent = np.copysign(1.0, zeta) / (abs(zeta) + np.sqrt(1.0 + zeta * zeta))
                cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
                sine = cosine * tangent
                for row in range(3):
                    x, y = turned[row, p], turned[row, q]
                    turned[row, p], turned[row, q] = cosine * x - sine * y, sine * x + cosine * y
                    x, y = v[row, p], v[row, q]
                    v[row, p], v[row, q] = cosine * x - sine * y, sine * x + cosine * y
        if is_done:
            break
    return v


@numba.njit(cache=True, nogil=True)
def _length(vector: np.ndarray) -> float:
    return np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)


@numba.njit(cache=True, nogil=True)
def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@numba.njit(cache=True, nogil=True)
def _perpendicular(unit: np.ndarray) -> np.ndarray:
    """Some unit vector perpendicular to a unit vector."""
    axis = np.zeros(3)
    axis[np.argmin(np.abs(unit))] = 1.0
    found = _cross(unit, axis)
    return found / _length(found)
