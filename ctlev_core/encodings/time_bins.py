"""Time bins: how often each pixel fired in each of up to three equal parts of a window, as red, green and blue.

What happens one after the other then lies beside one another, where a single histogram has it on top of one another: of
an N-MNIST recording the three saccades, each of which shows the edges across its own direction. Polarity is discarded,
for an image has three channels; what a direction of movement and a polarity say of an edge is much the same.

Each window is cut into parts of equal duration, from its first event to its last
(`ctlev_core.events.windows.time_bins`).
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from ctlev_core.events import image_drawing, image_grid
from ctlev_core.events.windows import check_order, check_ranges, time_bins
from data_contracts.events import Events

VERSION = 1
COLOURS = 3


class Options(image_grid.ImageFit):
    """Options of the time bins."""

    num_bins: int = Field(default=3, ge=1, le=COLOURS, description="parts of a window; what is left of RGB is black")
    normalisation: image_drawing.Normalisation = Field(
        default="three_sigma", description="what count becomes 255, the same for all bins, as in the event histogram"
    )
    full_scale_count: int = Field(default=8, ge=1, description="the count that becomes 255 with normalisation `count`")


def encode(events: Events, windows: np.ndarray, options: Options) -> np.ndarray:
    """Count the events of each part of each window.

    Args:
        events: E events, in order of time.
        windows: [N, 2] int64, start and stop of each window in events.
        options: options of this encoding.
    Returns:
        [N, num_bins, H, W] uint16, in pixels of the sensor; with resampling `events` in those of the image. Counts stop
        at 65,535.
    Raises:
        ValueError: a window is not a range of the events.
        DataError: an event lies outside the sensor, or time stamps go back.
    """
    from ctlev_core.events import histogram_kernels as kernels

    windows = check_ranges(windows, len(events))
    check_order(events.t)
    width, height = image_grid.count_size(events.sensor_size, options)
    column_of, row_of = image_grid.pixel_bins(events.sensor_size, options)
    parts = time_bins(events.t, windows, options.num_bins).reshape(-1, 2)
    counts = np.empty((len(parts), height * width), np.uint16)
    columns = events.x, events.y, events.p
    outside = kernels.count_events(*columns, parts, column_of, row_of * width, 0, counts)
    image_grid.check_inside(events, outside)
    return counts.reshape(len(windows), options.num_bins, height, width)


def render_image(histogram: np.ndarray, options: Options) -> np.ndarray:
    """Images of the counts: the first bin red, the second green, the third blue; all share one full scale.

    Args:
        histogram: [N, num_bins, H, W] uint16 as `encode` returns it.
        options: options of this encoding.
    Returns:
        [N, image height, image width, 3] uint8 RGB.
    Raises:
        ValueError: the shape or dtype is not that of counts encoded with these options.
    """
    image_grid.check_encoded(histogram, options.num_bins, np.uint16)
    levels = image_drawing.draw_values(histogram, options, options.normalisation, options.full_scale_count)
    images = np.zeros((len(levels), *levels.shape[2:], COLOURS), np.uint8)
    images[..., : options.num_bins] = levels.transpose(0, 2, 3, 1)
    return images


map_points = image_grid.map_points
