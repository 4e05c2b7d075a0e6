"""How a camera moves before a still picture: paths of straight stretches, in pixels of its sensor.

    saccades   three moves along an isosceles triangle and a rest after each, as a pan-tilt unit did for N-Caltech101
    square     along the edges of a square at constant speed, as the rails of N-ImageNet did
    circle     at constant speed
    drift      one straight stretch at constant speed: edges along it send nothing

Source: Orchard et al., Converting Static Image Datasets to Spiking Neuromorphic Datasets Using Saccades, Frontiers in
Neuroscience 2015 (three saccades of 100 ms each); Kim et al., N-ImageNet, ICCV 2021 (a camera that moves in a plane
parallel to the monitor). Extents, rests and the profile of a saccade's speed are our choice.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from data_contracts.errors import DataError

Motion = Literal["saccades", "square", "circle", "drift"]
MOTIONS: tuple[Motion, ...] = get_args(Motion)

REST_SHARE = 0.3
"""Of a saccade and the rest after it, how long the rest takes."""
CIRCLE_CHORDS = 32
"""A circle is a polygon, which misses it by half a percent of the radius."""


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Straight stretches from point to point.

    Attributes:
        times_s: [K] s, ascending; before the first and after the last the camera rests.
        positions_px: [K, 2] px, x right and y down: where the camera looks, against the middle of the picture.
        eased: a stretch starts and ends at rest, its speed a raised cosine; otherwise its speed is constant.

    Raises:
        DataError: times that do not ascend, or positions that do not fit them or are not finite.
    """

    times_s: np.ndarray
    positions_px: np.ndarray
    eased: bool = False

    def __post_init__(self) -> None:
        count = len(self.times_s)
        if count < 2 or self.positions_px.shape != (count, 2):
            raise DataError(
                f"camera path: expected two or more times [K] and positions [K, 2], got {self.times_s.shape} and "
                f"{self.positions_px.shape}"
            )
        if not (np.diff(self.times_s) > 0).all() or not np.isfinite(self.positions_px).all():
            raise DataError("camera path: times must ascend and positions be finite")

    @property
    def extent_px(self) -> np.ndarray:
        """How far [2] the path goes from the middle, in x and in y."""
        return np.abs(self.positions_px).max(axis=0)

    def position_px(self, time_s: float) -> np.ndarray:
        """Where the camera looks [2] at a time."""
        stretch, progress = self._progress(time_s)
        if self.eased:
            progress -= math.sin(2 * math.pi * progress) / (2 * math.pi)
        start, end = self.positions_px[stretch : stretch + 2]
        return start + progress * (end - start)

    def speed_bound_px_s(self, start_s: float, stop_s: float) -> float:
        """The largest speed from start to stop, which is not before it."""
        if stop_s <= self.times_s[0] or start_s >= self.times_s[-1]:
            return 0.0
        first, begin = self._progress(start_s)
        last, end = self._progress(stop_s)
        if not self.eased:
            return max(self._mean_speeds_px_s[first : last + 1])
        # The raised cosine is highest in the middle of a stretch.
        peaks = [0.5] * (last - first + 1)
        peaks[0] = max(begin, 0.5)
        peaks[-1] = min(max(begin, 0.5), end) if first == last else min(end, 0.5)
        return max(
            speed * (1 - math.cos(2 * math.pi * peak))
            for speed, peak in zip(self._mean_speeds_px_s[first : last + 1], peaks, strict=True)
        )

    @cached_property
    def _mean_speeds_px_s(self) -> list[float]:
        return (np.linalg.norm(np.diff(self.positions_px, axis=0), axis=1) / np.diff(self.times_s)).tolist()

    def _progress(self, time_s: float) -> tuple[int, float]:
        """The stretch a time is in, and how much of it has passed, 0 to 1."""
        stretch = min(max(bisect_right(self.times_s, time_s) - 1, 0), len(self.times_s) - 2)
        begin, end = self.times_s[stretch : stretch + 2]
        return stretch, float(min(max((time_s - begin) / (end - begin), 0.0), 1.0))


def sample_camera_path(rng: np.random.Generator, motion: Motion, extent_px: float, duration_s: float) -> CameraPath:
    """A path of a kind, once through in `duration_s`; the start or the direction is random.

    Args:
        rng: which way around, and from where.
        motion: the kind.
        extent_px: how far the path goes from side to side, px.
        duration_s: s.
    Raises:
        DataError: an extent or duration that is not positive.
    """
    if not (extent_px > 0 and duration_s > 0):
        raise DataError(f"camera path: extent and duration must be positive, got {extent_px} px and {duration_s} s")
    if motion == "drift":
        angle = rng.uniform(0, 2 * np.pi)
        end = 0.5 * extent_px * np.array([np.cos(angle), np.sin(angle)])
        return CameraPath(np.array([0.0, duration_s]), np.array([-end, end]))
    corners = 0.5 * extent_px * _closed_path(motion)
    corners = np.roll(corners, rng.integers(len(corners)), axis=0)
    if rng.random() < 0.5:
        corners = corners[::-1]
    corners = np.concatenate([corners, corners[:1]])
    starts_s = np.linspace(0, duration_s, len(corners))
    if motion != "saccades":
        return CameraPath(starts_s, corners)
    stops_s = starts_s[:-1] + (1 - REST_SHARE) * np.diff(starts_s)
    times_s = np.column_stack([starts_s[:-1], stops_s]).ravel()
    return CameraPath(times_s, np.column_stack([corners[:-1], corners[1:]]).reshape(-1, 2), eased=True)


def _closed_path(motion: Motion) -> np.ndarray:
    """Corners [K, 2] of a closed path in the square [-1, 1] x [-1, 1]."""
    if motion == "saccades":
        return np.array([(-1.0, -1.0), (0.0, 1.0), (1.0, -1.0)])
    if motion == "square":
        return np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    angles = 2 * np.pi * np.arange(CIRCLE_CHORDS) / CIRCLE_CHORDS
    return np.column_stack([np.cos(angles), np.sin(angles)])
