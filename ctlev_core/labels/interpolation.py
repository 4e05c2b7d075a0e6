"""Labels at any moment between two labelled ones: points go straight, joints turn at constant speed.

Nothing is guessed: there is no label before the first one, after the last one, or where one is missing between two.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_contracts.labels import Labels

MAX_SPACING = 1.5
"""Two labels with more than so many times the usual time between them have a gap: at least one is missing."""
_STRAIGHT = ("joints2d", "joints3d", "smpl_betas", "smpl_transl", "intrinsics")


def is_between_labels(labels: Labels, t_us: np.ndarray) -> np.ndarray:
    """Which moments [N] bool `interpolate_labels` knows of: those of a label, or between two without a gap.

    The usual time between labels is the median. Classes alone, without positions, hold throughout.

    Args:
        labels: the track, times ascending.
        t_us: [N] int64.
    """
    if not labels.arrays:
        return np.ones(len(t_us), bool)
    before, after, _ = _neighbours(labels.t_us, np.asarray(t_us, np.int64))
    last = len(labels) - 1
    inside = (before >= 0) & (after <= last)
    spacing = labels.t_us[np.minimum(after, last)] - labels.t_us[np.maximum(before, 0)]
    steps = np.diff(np.unique(labels.t_us))
    return inside & (spacing <= MAX_SPACING * (np.median(steps) if len(steps) else 0))


def interpolate_labels(labels: Labels, t_us: np.ndarray) -> Labels:
    """The labels of N moments.

    Args:
        labels: the track, times ascending; of labels of one time the first counts.
        t_us: [N] int64.
    Returns:
        N rows. Positions, shapes and intrinsics are linear in time, each of the 24 rotations of a body takes the
        shortest way at constant angular speed (slerp). A joint is visible where it is so in both labels, and unknown
        where it is unknown in one. The class is that of the nearer label. At the time of a label the row is that label.
    Raises:
        ValueError: `is_between_labels` is False of a moment.
    """
    t_us = np.asarray(t_us, np.int64)
    known = is_between_labels(labels, t_us)
    if not known.all():
        span = f"{labels.t_us[0]} .. {labels.t_us[-1]} us"
        raise ValueError(f"{t_us[np.argmin(known)]} us lies outside the labels, {span}, or in a gap of them")
    if not labels.arrays:
        return replace(labels.take(np.zeros(len(t_us), np.int64)), t_us=t_us)
    labels = labels.take(np.unique(labels.t_us, return_index=True)[1])
    before, after, fraction = _neighbours(labels.t_us, t_us)
    found = labels.take(np.where(fraction <= 0.5, before, after))
    moving = np.flatnonzero(after > before)
    before, after, fraction = before[moving], after[moving], fraction[moving]
    arrays = {name: array.copy() for name, array in found.arrays.items()}
    for name in _STRAIGHT:
        if name in arrays:
            start, end = (labels.arrays[name][rows].astype(np.float64) for rows in (before, after))
            arrays[name][moving] = start + fraction.reshape(-1, *[1] * (start.ndim - 1)) * (end - start)
    if "visible" in arrays:
        arrays["visible"][moving] = labels.arrays["visible"][before] & labels.arrays["visible"][after]
    if "smpl_pose" in arrays and len(moving):
        arrays["smpl_pose"][moving] = _turned(labels.arrays["smpl_pose"], before, after, fraction)
    return replace(found, t_us=t_us, **arrays)


def _turned(pose: np.ndarray, before: np.ndarray, after: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Poses [M, 72] rad so far on the way from one row to another."""
    from ctlev_core.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle, slerp

    start, end = (matrix_from_axis_angle(pose[rows].astype(np.float64).reshape(-1, 24, 3)) for rows in (before, after))
    return axis_angle_from_matrix(slerp(start, end, fraction[:, None])).reshape(-1, 72)


def _neighbours(times: np.ndarray, t_us: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The labels [N] before and after each moment, the same one at its very time, and how far it is between them.

    Before the first label, `before` is -1; behind the last, `after` is the number of labels.
    """
    after = np.searchsorted(times, t_us, side="left")
    is_label = times[np.minimum(after, len(times) - 1)] == t_us
    before = np.where(is_label, after, after - 1)
    start, end = times[np.maximum(before, 0)], times[np.minimum(after, len(times) - 1)]
    return before, after, (t_us - start) / np.where(end > start, end - start, 1)
