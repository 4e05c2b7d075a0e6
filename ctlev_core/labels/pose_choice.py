"""Which poses of a pool to sample from: those that cover it best, or those that a model finds hard.

Poses are compared by the root mean square distance of their 2D joints, px of the image. A joint outside the image
counts as lying on its border, for nothing beyond is seen; one that is not known as the mean of the known ones.

Sources: Gonzalez, Clustering to Minimize the Maximum Intercluster Distance, Theor. Comput. Sci. 38, 1985, and Sener &
Savarese, Active Learning for Convolutional Neural Networks: A Core-Set Approach, ICLR 2018 (farthest points, or
k-center greedy, from what is labelled already).
"""

from __future__ import annotations

import numpy as np

from data_contracts.errors import DataError
from data_contracts.events import SensorSize
from data_contracts.labels import Labels

NUM_NEIGHBOURS = 10
_BLOCK_NUMBERS = 4_000_000


def pose_vectors(labels: Labels, image_size: SensorSize) -> np.ndarray:
    """Poses as points [N, 2 J] float64 whose Euclidean distances are root mean square distances of joints, px.

    Args:
        labels: N, with 2D joints in px of the image.
        image_size: (width, height) px.
    Returns:
        NaN in the rows of which no joint is known.
    Raises:
        DataError: the labels have no 2D joints.
    """
    if labels.joints2d is None:
        raise DataError("labels 'coverage' and 'hard' compare poses, expected labels with 2D joints; use 'random'")
    joints = np.clip(labels.joints2d.astype(np.float64), 0.0, np.array(image_size, np.float64))
    known = ~np.isnan(joints)
    counts = known.sum(axis=1, keepdims=True)
    sums = np.where(known, joints, 0.0).sum(axis=1, keepdims=True)
    means = np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)
    filled = np.where(known, joints, means)
    return filled.reshape(len(filled), -1) / np.sqrt(joints.shape[1])


def farthest_points(candidates: np.ndarray, covered: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Candidates one after another, each the farthest from all that are covered or chosen so far.

    The first n of them are the choice of n. The largest distance that is left is at most twice the smallest possible.

    Args:
        candidates: [N, D], N >= 1.
        covered: [M, D] points that need no cover; with none the first is the one farthest from the mean.
        count: of candidates, at most N.
    Returns:
        Numbers [count] int64, and the distance [count] float64 of each when it was chosen; that never grows, but after
        the first where nothing is covered, whose is that from the mean. Of equally far ones the first.
    """
    if len(covered):
        distances = np.full(len(candidates), np.inf)
        for point in covered:
            np.minimum(distances, np.linalg.norm(candidates - point, axis=1), out=distances)
    else:
        distances = np.linalg.norm(candidates - candidates.mean(axis=0), axis=1)
    chosen, at = np.empty(count, np.int64), np.empty(count)
    for number in range(count):
        farthest = int(np.argmax(distances))
        chosen[number], at[number] = farthest, distances[farthest]
        left = np.linalg.norm(candidates - candidates[farthest], axis=1)
        # Without covered points the distances to the mean were those to nothing.
        distances = left if number == 0 and not len(covered) else np.minimum(distances, left)
        distances[chosen[: number + 1]] = -1.0
    return chosen, at


def predict_errors(candidates: np.ndarray, known: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """The error [N] to expect of each candidate: the mean of those of the `NUM_NEIGHBOURS` nearest known poses.

    Args:
        candidates: [N, D].
        known: [M, D], M >= 1.
        errors: [M] of the known poses.
    """
    from scipy.spatial.distance import cdist  # here, because a cached run needs no scipy

    count = min(NUM_NEIGHBOURS, len(known))
    found = np.empty(len(candidates))
    step = max(1, _BLOCK_NUMBERS // len(known))
    for start in range(0, len(candidates), step):
        # Not by matrix products, whose rounding depends on threads, and with it which of two is nearer.
        distances = cdist(candidates[start : start + step], known)
        nearest = np.argsort(distances, axis=1, kind="stable")[:, :count]
        found[start : start + step] = errors[nearest].mean(axis=1)
    return found


def hardest(errors: np.ndarray, share: float) -> np.ndarray:
    """The rows of the largest errors [N], ascending: that share of them, one at least; of equal ones the first."""
    count = max(1, round(share * len(errors)))
    return np.sort(np.argsort(-errors, kind="stable")[:count])
