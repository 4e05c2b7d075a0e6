"""Event histogram: how often each pixel fired in a window, by polarity.

As an image it is what the diffusion model learns: black where nothing happened, positive events red, negative events
blue; white where polarity is discarded.

Source: ControlEvents (Hu et al., WACV 2026), event representation; DHP19 (Calabrese et al., CVPRW 2019) for the
normalisation and the numbers of events.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from pydantic import Field

from ctlev_core.events import image_drawing, image_grid
from ctlev_core.events.windows import check_ranges
from data_contracts.events import Events

VERSION = 2


class Options(image_grid.ImageFit):
    """Options of the event histogram."""

    polarity: bool = Field(
        default=True, description="count positive and negative events apart; DHP19 discards polarity"
    )
    normalisation: image_drawing.Normalisation = Field(
        default="three_sigma",
        description="what count becomes 255: three standard deviations of the window's counts (DHP19), the window's "
        "largest count, or full_scale_count",
    )
    full_scale_count: int = Field(default=8, ge=1, description="the count that becomes 255 with normalisation `count`")


def encode(events: Events, windows: np.ndarray, options: Options) -> np.ndarray:
    """Count the events of each window, in pixels of the sensor; with resampling `events` in those of the image.

    With short windows most of the time goes into new memory: `encode_each` needs none.

    Args:
        events: E events.
        windows: [N, 2] int64, start and stop of each window in events.
        options: options of this encoding.
    Returns:
        [N, C, H, W] uint16; channels (positive, negative), or one channel without polarity. Counts stop at 65,535.
    Raises:
        ValueError: a window is not a range of the events, or the image is too large.
        DataError: an event lies outside the sensor.
    """
    from ctlev_core.events import histogram_kernels as kernels

    windows = check_ranges(windows, len(events))
    shape = _shape(events, options)
    longest = (windows[:, 1] - windows[:, 0]).max(initial=0)
    # Zeros come from the operating system page by page: as good as cleared memory where few cells are touched.
    is_clear = longest < kernels.SPARSE * math.prod(shape) and shape[:0:-1] == events.sensor_size
    counts = (np.zeros if is_clear else np.empty)((len(windows), *shape), np.uint16)
    count = _counter(events, windows, options)
    outside = count(windows, counts.reshape(len(windows), math.prod(shape)), is_clear)
    image_grid.check_inside(events, outside)
    return counts


def encode_each(events: Events, windows: np.ndarray, options: Options) -> Iterator[np.ndarray]:
    """What `encode` returns, window after window in one array that is used again: copy what is to be kept.

    Args:
        events: E events.
        windows: [N, 2] int64, start and stop of each window in events.
        options: options of this encoding.
    Yields:
        [C, H, W] uint16, valid until the next is asked for; changes made to it show in later windows.
    Raises:
        ValueError: a window is not a range of the events, or the image is too large.
        DataError: an event lies outside the sensor.
    """
    from ctlev_core.events import histogram_kernels as kernels

    windows = check_ranges(windows, len(events))
    counts = np.zeros(_shape(events, options), np.uint16)
    flat = counts.reshape(1, counts.size)
    count = _counter(events, windows, options)
    is_sensor = counts.shape[:0:-1] == events.sensor_size
    is_clear = True
    for row, (start, stop) in enumerate(windows.tolist()):
        image_grid.check_inside(events, count(windows[row : row + 1], flat, is_clear))
        yield counts
        is_clear = is_sensor and stop - start < kernels.SPARSE * counts.size
        if is_clear:
            columns = events.x, events.y, events.p, start, stop
            kernels.clear_pixels(*columns, events.sensor_size, options.polarity, flat[0])


def _shape(events: Events, options: Options) -> tuple[int, int, int]:
    """(C, H, W) of one window."""
    width, height = image_grid.count_size(events.sensor_size, options)
    num_channels = 2 if options.polarity else 1
    if num_channels * height * width >= 2**32:
        raise ValueError(f"a window must have fewer than 2^32 cells, got {num_channels} x {height} x {width}")
    return num_channels, height, width


def _counter(events: Events, windows: np.ndarray, options: Options) -> Callable[..., int]:
    """The kernel for these options, of (windows, histogram [N, cells], is_clear): fast where nothing is scaled."""
    from ctlev_core.events import histogram_kernels as kernels

    num_channels, height, width = _shape(events, options)
    num_cells = num_channels * height * width
    if (width, height) == events.sensor_size:
        has_dense = (windows[:, 1] - windows[:, 0]).max(initial=0) > kernels.DENSE * num_cells
        narrow = np.zeros(num_cells if has_dense else 0, np.uint8)
        return lambda windows, histogram, is_clear=False: kernels.count_pixels(
            events.x, events.y, events.p, windows, (width, height), options.polarity, narrow, is_clear, histogram
        )
    column_of, row_of = image_grid.pixel_bins(events.sensor_size, options)
    negative_start = (num_channels - 1) * height * width
    return lambda windows, histogram, is_clear=False: kernels.count_events(
        events.x, events.y, events.p, windows, column_of, row_of * width, negative_start, histogram
    )


def render_image(histogram: np.ndarray, options: Options) -> np.ndarray:
    """Images of the counts: value = min(255, floor(255 count / full scale)), black where there are no events.

    Both polarities share one full scale, so that their ratio survives: three standard deviations of the total counts
    over the pixels with events (n - 1 in the divisor, at least 0.1 / 255), or the largest count of any channel. What
    comes of that in an image of another size than the sensor's says `ctlev_core.events.image_drawing`.

    Args:
        histogram: [N, C, H, W] uint16 as `encode` returns it.
        options: options of this encoding.
    Returns:
        [N, image height, image width, 3] uint8 RGB: red = positive, green = 0, blue = negative; three equal channels
        without polarity.
    Raises:
        ValueError: the shape or dtype is not that of counts encoded with these options.
    Source: SensorsINI/DHP19, normalizeImage3Sigma.m. There one channel holds both polarities.
    """
    channels = 2 if options.polarity else 1
    image_grid.check_encoded(histogram, channels, np.uint16)
    from ctlev_core.events import histogram_kernels as kernels

    histogram = np.ascontiguousarray(histogram)
    size = histogram.shape[:1:-1]
    if options.resampling == "area" and image_grid.image_size(size, options) != size:
        levels = image_drawing.draw_values(histogram, options, options.normalisation, options.full_scale_count)
        return _as_colours(levels)
    images = np.zeros((len(histogram), *histogram.shape[2:], 3), np.uint8)
    kernels.draw(histogram, full_scales(histogram, options), images)
    return images


def render_levels(levels: np.ndarray, options: Options) -> np.ndarray:
    """Images of grey levels at the size of the sensor, as finished event images have them; goes on as `render_image`.

    Args:
        levels: [N, C, H, W] uint8, channels as `encode` returns them.
        options: options of this encoding; areas are averaged with any `resampling`.
    Returns:
        [N, image height, image width, 3] uint8 RGB.
    Raises:
        ValueError: the shape or dtype is another.
    """
    image_grid.check_encoded(levels, 2 if options.polarity else 1, np.uint8)
    return _as_colours(image_drawing.fit_levels(levels, options, options.normalisation))


map_points = image_grid.map_points


def full_scales(histogram: np.ndarray, options: Options) -> np.ndarray:
    """The count that becomes 255 in each window, [N] float64, positive."""
    return image_drawing.full_scales(histogram, options.normalisation, options.full_scale_count)


def _as_colours(levels: np.ndarray) -> np.ndarray:
    """Channels [N, C, H, W] as red and blue, or as grey where there is one."""
    if levels.shape[1] == 1:
        return np.repeat(levels[:, 0, :, :, None], 3, axis=3)
    images = np.zeros((len(levels), *levels.shape[2:], 3), np.uint8)
    images[..., 0], images[..., 2] = levels[:, 0], levels[:, -1]
    return images
