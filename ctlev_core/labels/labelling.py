"""From the label track of a recording to one label per window of events."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ctlev_core.geometry.camera import is_inside
from data_contracts.labels import Labels


def labels_at_windows(labels: Labels, t_start_us: np.ndarray, t_end_us: np.ndarray) -> Labels:
    """One label row per window: the mean position of each joint over the window.

    Args:
        labels: the track, times ascending; a single row without joints labels every window.
        t_start_us: [N] int64, first event of each window.
        t_end_us: [N] int64, last event of each window.

    Returns:
        N rows at the middles of the windows. A window between two labels takes the nearest one. A joint is visible when
        it is visible in at least half of the rows averaged. Class, SMPL parameters and joints in 3D are those of the
        row nearest to the middle, where means of joints in 2D are too: rotations have no plain mean.
    Source: DHP19 labels a frame with the NaN-mean of the Vicon rows in its window
        (SensorsINI/DHP19, ExtractEventsToFramesAndMeanLabels.m); it has no visibility flags.
    """
    t_start_us, t_end_us = np.asarray(t_start_us, np.int64), np.asarray(t_end_us, np.int64)
    first = np.searchsorted(labels.t_us, t_start_us, side="left")
    last = np.searchsorted(labels.t_us, t_end_us, side="right")
    empty = first >= last
    middle_us = (t_start_us + t_end_us) // 2
    nearest = _nearest(labels.t_us, middle_us)
    first, last = np.where(empty, nearest, first), np.where(empty, nearest + 1, last)
    found = replace(labels.take(nearest), t_us=middle_us)
    if labels.joints2d is None or labels.visible is None:
        return found
    joints = np.empty((len(first), *labels.joints2d.shape[1:]), np.float32)
    visible = np.empty((len(first), labels.visible.shape[1]), bool)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the mean of NaN alone is NaN, which is what we mean
        for row, (start, stop) in enumerate(zip(first, last, strict=True)):
            joints[row] = np.nanmean(labels.joints2d[start:stop].astype(np.float64), axis=0)
            visible[row] = labels.visible[start:stop].mean(axis=0) >= 0.5
    visible &= np.isfinite(joints).all(axis=-1)
    return replace(found, joints2d=joints, visible=visible)


def has_label(labels: Labels, t_start_us: np.ndarray, t_end_us: np.ndarray) -> np.ndarray:
    """Which windows [N] the track has something to say of: a label within, or as near as labels usually follow.

    Recordings go on where nobody labelled them. What was true half a second ago is no label.

    Args:
        labels: the track, times ascending; a single row holds throughout.
        t_start_us: [N] int64, first event of each window.
        t_end_us: [N] int64, last event of each window.
    """
    if len(labels) == 1:
        return np.ones(len(t_start_us), bool)
    near_us = int(np.median(np.diff(labels.t_us)))
    return np.searchsorted(labels.t_us, t_start_us - near_us) < np.searchsorted(
        labels.t_us, t_end_us + near_us, side="right"
    )


def labels_in_image(
    labels: Labels, map_points: Callable[[np.ndarray], np.ndarray], image_size: tuple[int, int]
) -> Labels:
    """Labels in sensor pixels as labels in image pixels.

    Args:
        labels: N rows in sensor pixels.
        map_points: points [..., 2] in sensor pixels to image pixels; each axis is scaled and shifted on its own.
        image_size: (width, height) px of the image.
    Returns:
        Joints and intrinsics of the image; a joint that the crop or the border cut off is not visible.
    """
    moved: dict[str, np.ndarray] = {}
    if labels.joints2d is not None and labels.visible is not None:
        joints = map_points(labels.joints2d).astype(np.float32)
        moved = {"joints2d": joints, "visible": labels.visible & is_inside(joints, image_size)}
    if labels.intrinsics is not None:
        scale, _ = scale_and_offset(map_points)
        focal = labels.intrinsics[:, :2] * scale
        centre = map_points(labels.intrinsics[:, 2:].astype(np.float64))
        moved["intrinsics"] = np.concatenate([focal, centre], axis=1).astype(np.float32)
    return replace(labels, **moved)


def scale_and_offset(map_points: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Image px = scale [2] * sensor px + offset [2], of the map that an encoding has for points of a sensor."""
    offset, unit = map_points(np.array([[0.0, 0.0], [1.0, 1.0]]))
    return unit - offset, offset


def _nearest(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    right = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(np.abs(times[left] - wanted) <= np.abs(times[right] - wanted), left, right)
