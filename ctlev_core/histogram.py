"""The loops behind the event histogram, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit

MAX_COUNT = np.iinfo(np.uint16).max


@njit(cache=True, nogil=True)
def count_events(
    x: np.ndarray,
    y: np.ndarray,
    p: np.ndarray,
    windows: np.ndarray,
    column_of: np.ndarray,
    row_of: np.ndarray,
    histogram: np.ndarray,
) -> int:
    """Add the events of each window to its counts, which stop at 65,535.

    One pass, straight into the result: an event costs two look-ups in tables that stay in cache and one increment.

    Args:
        x: [E] uint16, sensor px.
        y: [E] uint16, sensor px.
        p: [E] uint8; anything but 0 is positive.
        windows: [N, 2] int64, ranges within 0 .. E.
        column_of: [sensor width] int64, image column of each sensor column; -1 = outside the image.
        row_of: [sensor height] int64, image row of each sensor row; -1 = outside the image.
        histogram: [N, C, H, W] uint16, changed in place; C is 2 (positive, negative) or 1 (both).
    Returns:
        Index of the first event outside the sensor, where counting stopped; -1 if there is none.
    """
    num_channels = histogram.shape[1]
    for window in range(len(windows)):
        for event in range(windows[window, 0], windows[window, 1]):
            if x[event] >= len(column_of) or y[event] >= len(row_of):
                return event
            column, row = column_of[x[event]], row_of[y[event]]
            if column < 0 or row < 0:
                continue
            channel = 1 if num_channels == 2 and p[event] == 0 else 0
            count = histogram[window, channel, row, column]
            if count < MAX_COUNT:
                histogram[window, channel, row, column] = count + 1
    return -1


@njit(cache=True, nogil=True)
def full_scales(histogram: np.ndarray, scales: np.ndarray) -> None:
    """Three standard deviations of each window's total counts over the pixels that have events.

    The standard deviation divides by n - 1 and is at least 0.1 / 255, as in DHP19's normalizeImage3Sigma.m. Of a single
    pixel it is 0, so that a lone event comes out white, like equal counts. A window without events gets the floor.

    Args:
        histogram: [N, C, H, W] uint16.
        scales: [N] float64, filled.
    """
    num_windows, num_channels, height, width = histogram.shape
    for window in range(num_windows):
        num_pixels, total = 0, 0
        for row in range(height):
            for column in range(width):
                count = 0
                for channel in range(num_channels):
                    count += histogram[window, channel, row, column]
                num_pixels += count > 0
                total += count
        mean = total / max(num_pixels, 1)
        # Around the mean in a second pass: with sums of squares the difference of two large numbers would be left.
        deviation = 0.0
        for row in range(height):
            for column in range(width):
                count = 0
                for channel in range(num_channels):
                    count += histogram[window, channel, row, column]
                if count > 0:
                    deviation += (count - mean) ** 2
        sigma = np.sqrt(deviation / max(num_pixels - 1, 1))
        scales[window] = 3.0 * max(sigma, 0.1 / 255.0)
