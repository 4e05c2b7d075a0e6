"""From counts to grey levels, and from grey levels of the sensor to those of an image of another size.

    counts at the size of the sensor
    -> grey levels by the normalisation of the encoding, 0 .. 255, at the size of the sensor
    -> averages over the area of each image pixel
    -> contrast, where the image is smaller
    -> grey levels of the image

Event images that come finished begin at the second step: a recording, and a release that its authors made with the same
normalisation, give the same images. Averages over several pixels dim sparse images; the normalisation, once
more, makes them visible again. In an image of the sensor's size the levels are those of the first step; in a larger one
they are spread, not changed.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np

from ctlev_core.events.image_grid import Fit, ImageFit, image_size, is_reduced, pixel_edges
from ctlev_core.events.image_resampling import Overlaps, average_areas, find_overlaps
from data_contracts.events import SensorSize

Normalisation = Literal["three_sigma", "max", "count"]
FIXED_POINT = 256
"""What an average of one grey level becomes, so that fractions count when contrast is found."""


def draw_values(
    counts: np.ndarray, fit: ImageFit, normalisation: Normalisation, full_scale_count: int = 8
) -> np.ndarray:
    """Grey levels of the image of each window.

    Args:
        counts: [N, C, H, W] uint16, any number of channels, at `image_grid.count_size`.
        fit: size of the image, and how the sensor is fitted to it.
        normalisation: see `full_scales`.
        full_scale_count: see `full_scales`.
    Returns:
        [N, C, image height, image width] uint8.
    """
    counts = np.ascontiguousarray(counts)
    scales = full_scales(counts, normalisation, full_scale_count)
    if fit.resampling == "events":
        return grey_levels(counts, scales)
    num_windows, num_channels, height, width = counts.shape
    image_width, image_height = image_size((width, height), fit)
    levels = np.empty((num_windows, num_channels, image_height, image_width), np.uint8)
    for row in range(num_windows):  # one by one: levels at the size of the sensor may be far larger than those kept
        one = slice(row, row + 1)
        levels[one] = fit_levels(grey_levels(counts[one], scales[one]), fit, normalisation)
    return levels


def full_scales(counts: np.ndarray, normalisation: Normalisation, full_scale_count: int = 8) -> np.ndarray:
    """The count that becomes 255 in each window; all channels share it, so that their ratio survives.

    Args:
        counts: [N, C, H, W] uint16.
        normalisation: three standard deviations of the counts of all channels together over the pixels with events
            (n - 1 in the divisor, at least 0.1 / 255), the largest count of any channel, or `full_scale_count`.
        full_scale_count: used with `count` alone.
    Returns:
        [N] float64, positive.
    """
    if normalisation == "count":
        return np.full(len(counts), float(full_scale_count))
    if normalisation == "max":
        return np.maximum(counts.max(axis=(1, 2, 3), initial=0), 1).astype(np.float64)
    from ctlev_core.events import histogram_kernels as kernels

    scales = np.empty(len(counts))
    kernels.full_scales(np.ascontiguousarray(counts), scales)
    return scales


def grey_levels(counts: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """min(255, floor(255 count / scale)) of [N, C, H, W] uint16 counts and [N] scales; uint8."""
    from ctlev_core.events import histogram_kernels as kernels

    levels = np.empty(counts.shape, np.uint8)
    kernels.grey_levels(np.ascontiguousarray(counts), scales, levels)
    return levels


def fit_levels(levels: np.ndarray, fit: ImageFit, contrast: Normalisation) -> np.ndarray:
    """Grey levels of the sensor, or of a finished event image, as an image of another size.

    Args:
        levels: [N, C, H, W] uint8, any number of channels.
        fit: size of the image, and how the sensor is fitted to it; its `resampling` is not asked.
        contrast: what becomes 255 in an image that is smaller than the sensor along an axis; `count`: levels stay the
            averages they are.
    Returns:
        [N, C, image height, image width] uint8; `levels` themselves where the size stays.
    """
    num_windows, num_channels, height, width = levels.shape
    sensor_size = width, height
    image_width, image_height = size = image_size(sensor_size, fit)
    if size == sensor_size:
        return levels
    fitted = np.empty((num_windows, num_channels, image_height, image_width), np.uint8)
    overlaps = _overlaps(sensor_size, size, fit.fit)
    has_contrast = contrast != "count" and is_reduced(sensor_size, fit)
    for row, channels in enumerate(levels):
        averages = average_areas(channels, *overlaps)
        if not has_contrast:
            fitted[row] = np.rint(averages)
            continue
        values = np.rint(FIXED_POINT * averages).astype(np.uint16)[None]
        fitted[row] = grey_levels(values, full_scales(values, contrast))[0]
    return fitted


@lru_cache(maxsize=64)
def _overlaps(sensor_size: SensorSize, size: tuple[int, int], fit: Fit) -> tuple[Overlaps, Overlaps]:
    """Of the columns and of the rows; recordings of many sizes take turns."""
    columns, rows = pixel_edges(sensor_size, ImageFit(image_size=size, fit=fit))
    return find_overlaps(columns, size[0]), find_overlaps(rows, size[1])
