"""Time surface: how recently each pixel fired, decaying exponentially from the end of the window.

    S[p,y,x] = exp(-(t_end - T[p,y,x]) / tau)

T is the time of the last event of polarity p at the pixel within the window and t_end that of the last event of the
window, so that the newest pixel has 1. A pixel without events has 0; one with events never has, however old they are:
values stop at the smallest normal float32, 1.2e-38.

Source: Lagorce, Orchard, Galluppi, Shi, Benosman, HOTS: A Hierarchy of Event-Based Time-Surfaces for Pattern
Recognition, PAMI 2017, equations 2 to 4. There a surface belongs to each event and covers its neighbourhood; here one
covers the sensor at the end of each window, and events before the window do not show.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from ctlev_core.events import image_drawing, image_grid
from ctlev_core.events.windows import check_order, check_ranges
from data_contracts.events import Events

VERSION = 2


class Options(image_grid.ImageFit):
    """Options of the time surface."""

    polarity: bool = Field(default=True, description="a surface for each polarity; otherwise one for both")
    tau_us: float = Field(default=50_000.0, gt=0, description="time in which a pixel fades to 1/e")


def encode(events: Events, windows: np.ndarray, options: Options) -> np.ndarray:
    """The surface at the end of each window; see the head of this file for the formula.

    Args:
        events: E events, in order of time.
        windows: [N, 2] int64, start and stop of each window in events.
        options: options of this encoding.
    Returns:
        [N, C, H, W] float32 in 0 .. 1; channels (positive, negative), or one channel without polarity. A window without
        events is 0. Where, with resampling `events`, several sensor pixels share an image pixel, the newest counts.
    Raises:
        ValueError: a window is not a range of the events.
        DataError: an event lies outside the sensor, or time stamps go back.
    """
    from ctlev_core.events import temporal_kernels as kernels

    windows = check_ranges(windows, len(events))
    check_order(events.t)
    width, height = image_grid.count_size(events.sensor_size, options)
    column_of, row_of = image_grid.pixel_bins(events.sensor_size, options)
    num_channels = 2 if options.polarity else 1
    surfaces = np.zeros((len(windows), num_channels * height * width), np.float32)
    outside = kernels.decay_from_end(
        events.t,
        events.x,
        events.y,
        events.p,
        windows,
        column_of,
        row_of * width,
        (num_channels - 1) * height * width,
        options.tau_us,
        float(np.finfo(np.float32).tiny),
        surfaces,
    )
    image_grid.check_inside(events, outside)
    return surfaces.reshape(len(windows), num_channels, height, width)


def render_image(histogram: np.ndarray, options: Options) -> np.ndarray:
    """Images of the surfaces: value = floor(255 S), red where positive and blue where negative.

    With resampling `area` these are averaged over image pixels; of a smaller image the brightest is white again.

    Args:
        histogram: [N, C, H, W] float32 as `encode` returns it.
        options: options of this encoding.
    Returns:
        [N, image height, image width, 3] uint8 RGB; three equal channels without polarity.
    Raises:
        ValueError: the shape or dtype is not that of surfaces encoded with these options.
    """
    channels = 2 if options.polarity else 1
    image_grid.check_encoded(histogram, channels, np.float32)
    values = np.floor(255.0 * histogram).astype(np.uint8)
    if options.resampling == "area":
        values = image_drawing.fit_levels(values, options, "max")
    images = np.zeros((len(values), *values.shape[2:], 3), np.uint8)
    images[..., 0], images[..., 2] = values[:, 0], values[:, -1]
    if not options.polarity:
        images[..., 1] = values[:, 0]
    return images


map_points = image_grid.map_points
