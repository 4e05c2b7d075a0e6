"""The best similarity of two sets of points, row by row, compiled: a batch of 3 x 3 problems is too small for LAPACK.

The singular value decomposition is one-sided Jacobi, which finds small singular values to their own size. Only the two
largest pairs of vectors are taken from it and the third are their cross products: the rotation is then never a
reflection, and a third singular value of zero needs no care. Expressions of whole arrays are written out: they cost
twelve of the seventeen seconds that the first call of each function took to compile.

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
            for joint in range(points.shape[1]):
                for axis in range(3):
                    aligned[row, joint, axis] = points[row, joint, axis]
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
    a = centre_target[0] - (xx * centre[0] + xy * centre[1] + xz * centre[2])
    b = centre_target[1] - (yx * centre[0] + yy * centre[1] + yz * centre[2])
    c = centre_target[2] - (zx * centre[0] + zy * centre[1] + zz * centre[2])
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
    for row in range(3):
        for column in range(3):
            turn[row, column] = scale * rotation[column, row]
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
    for row in range(3):
        for column in range(3):
            product[row, column] *= unit
    centre[0], centre[1], centre[2] = points[first, 0] + a, points[first, 1] + b, points[first, 2] + c
    centre_target[0], centre_target[1] = target[first, 0] + d, target[first, 1] + e
    centre_target[2] = target[first, 2] + f
    return size


@numba.njit(cache=True, nogil=True)
def _best_rotation(product: np.ndarray, turned: np.ndarray, rotation: np.ndarray) -> float:
    """The rotation R with the largest trace of R^T product, into `rotation`; returns that trace."""
    v = np.zeros((3, 3))
    _diagonalise(product, turned, v)
    first, second = _two_longest(turned)
    a, b, c = turned[0, first], turned[1, first], turned[2, first]
    length = np.sqrt(a * a + b * b + c * c)
    if length == 0.0:
        a, b, c = v[0, first], v[1, first], v[2, first]
    else:
        a, b, c = a / length, b / length, c / length
    d, e, f = turned[0, second], turned[1, second], turned[2, second]
    length = np.sqrt(d * d + e * e + f * f)
    if length > 0.0:
        d, e, f = d / length, e / length, f / length
    else:
        d, e, f = _perpendicular(a, b, c)
    g, h, i = b * f - c * e, c * d - a * f, a * e - b * d
    u1, u2, u3 = (a, b, c), (d, e, f), (g, h, i)
    a, b, c = v[0, first], v[1, first], v[2, first]
    d, e, f = v[0, second], v[1, second], v[2, second]
    v1, v2, v3 = (a, b, c), (d, e, f), (b * f - c * e, c * d - a * f, a * e - b * d)
    trace = 0.0
    for row in range(3):
        for column in range(3):
            rotation[row, column] = u1[row] * v1[column] + u2[row] * v2[column] + u3[row] * v3[column]
            trace += rotation[row, column] * product[row, column]
    return max(trace, 0.0)


@numba.njit(cache=True, nogil=True)
def _two_longest(columns: np.ndarray) -> tuple[int, int]:
    """Which columns of a 3 x 3 matrix are the longest and the second longest; the first of equal ones."""
    first, second = 0, -1
    longest, long = -1.0, -1.0
    for column in range(3):
        square = columns[0, column] ** 2 + columns[1, column] ** 2 + columns[2, column] ** 2
        if square > longest:
            first, second, longest, long = column, first, square, longest
        elif square > long:
            second, long = column, square
    return first, second


@numba.njit(cache=True, nogil=True)
def _diagonalise(matrix: np.ndarray, turned: np.ndarray, v: np.ndarray) -> None:
    """An orthogonal V, for which the columns of matrix V are orthogonal to one another, into `v`; those into `turned`.

    `v` comes as zeros.
    """
    for row in range(3):
        v[row, row] = 1.0
        for column in range(3):
            turned[row, column] = matrix[row, column]
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


@numba.njit(cache=True, nogil=True)
def _perpendicular(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Some unit vector perpendicular to a unit vector: its cross product with the axis it lies farthest from."""
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        a, b, c = 0.0, z, -y
    elif abs(y) <= abs(z):
        a, b, c = -z, 0.0, x
    else:
        a, b, c = y, -x, 0.0
    length = np.sqrt(a * a + b * b + c * c)
    return a / length, b / length, c / length
