"""Voxel grid: the events of a window in B temporal bins, each event shared between the two bins around it.

    t*_i   = (B - 1) (t_i - t_first) / (t_last - t_first)              0 .. B - 1, over the events of the window
    V[b,y,x] = sum over events i at pixel (x, y) of  w_i max(0, 1 - |b - t*_i|)

w_i is +1 for positive and -1 for negative events with polarity `signed`. Events lie on pixels, so the interpolation
of the source in x and y is the identity here. Where all time stamps are equal, t* = 0: everything is in the first bin.

Source: Zhu, Yuan, Chaney, Daniilidis, Unsupervised Event-based Learning of Optical Flow, Depth, and Egomotion, CVPR
2019, equations 1 to 3. The normalisation `mean_std` is that of Rebecq et al., High Speed and High Dynamic Range Video
with an Event Camera, PAMI 2019.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from ctlev_core.events import image_drawing, image_grid
from ctlev_core.events.windows import check_order, check_ranges
from data_contracts.events import Events

VERSION = 2


class Options(image_grid.ImageFit):
    """Options of the voxel grid."""

    num_bins: int = Field(default=5, ge=1, description="temporal bins; 5 as in E2VID, 9 as in Zhu et al.")
    polarity: Literal["signed", "separate", "discarded"] = Field(
        default="signed",
        description="negative events count -1 in the bins of the positive ones (Zhu et al.), +1 in bins of their own "
        "(channels: all positive bins, then all negative), or +1 in the same bins",
    )
    normalisation: Literal["none", "max", "mean_std"] = Field(
        default="none",
        description="of each window: none, division by the largest magnitude, or mean 0 and standard deviation 1 over "
        "the voxels that are not 0 (E2VID)",
    )
    full_scale: float | None = Field(
        default=None,
        gt=0,
        description="what becomes 255 in the image; where not given, three standard deviations of the window's pixels, "
        "as DHP19 normalises counts",
    )


def encode(events: Events, windows: np.ndarray, options: Options) -> np.ndarray:
    """Sum the events of each window in temporal bins; see the head of this file for the formula.

    Args:
        events: E events, in order of time.
        windows: [N, 2] int64, start and stop of each window in events.
        options: options of this encoding.
    Returns:
        [N, C, H, W] float32, C = `num_bins`, or twice that with polarity `separate`. Sums are made in 64 bits. A
        window without events is 0.
    Raises:
        ValueError: a window is not a range of the events.
        DataError: an event lies outside the sensor, or time stamps go back.
    """
    from ctlev_core.events import temporal_kernels as kernels

    windows = check_ranges(windows, len(events))
    check_order(events.t)
    width, height = image_grid.count_size(events.sensor_size, options)
    column_of, row_of = image_grid.pixel_bins(events.sensor_size, options)
    is_separate = options.polarity == "separate"
    num_channels = options.num_bins * (2 if is_separate else 1)
    scratch = np.zeros(num_channels * height * width)
    longest = (windows[:, 1] - windows[:, 0]).max(initial=0)
    touched = np.empty(min(2 * longest, scratch.size // 8), np.int64)
    grids = np.zeros((len(windows), scratch.size), np.float32)
    outside = kernels.add_to_bins(
        events.t,
        events.x,
        events.y,
        events.p,
        windows,
        column_of,
        row_of * width,
        options.num_bins,
        options.num_bins * height * width if is_separate else 0,
        -1.0 if options.polarity == "signed" else 1.0,
        scratch,
        touched,
        grids,
    )
    image_grid.check_inside(events, outside)
    for grid in grids:
        _normalise(grid, options)
    return grids.reshape(len(windows), num_channels, height, width)


def _normalise(grid: np.ndarray, options: Options) -> None:
    """One window in place; what is 0 stays 0."""
    if options.normalisation == "none":
        return
    used = grid != 0
    if not used.any():
        return
    values = grid[used].astype(np.float64)
    if options.normalisation == "max":
        grid[used] = values / np.abs(values).max()
        return
    deviation = values.std()
    # Equal values, a single voxel among them, have no deviation: only their mean is taken off.
    grid[used] = (values - values.mean()) / (deviation if deviation > 0 else 1.0)


def render_image(histogram: np.ndarray, options: Options) -> np.ndarray:
    """Images of the grids: value = min(255, floor(255 v / full scale)), red where positive and blue where negative.

    The bins are added up: of `signed` grids red is the sum of what is positive, blue that of what is negative. Full
    scale is three standard deviations (n - 1) of red + blue over the pixels where that is not 0; equal ones are at it.
    With resampling `area` these values are averaged over image pixels; in a smaller image the contrast is brought back
    by three standard deviations, but not where `full_scale` is given.

    Args:
        histogram: [N, C, H, W] float32 as `encode` returns it.
        options: options of this encoding.
    Returns:
        [N, image height, image width, 3] uint8 RGB; three equal channels where polarity is discarded.
    Raises:
        ValueError: the shape or dtype is not that of grids encoded with these options.
    """
    channels = options.num_bins * (2 if options.polarity == "separate" else 1)
    image_grid.check_encoded(histogram, channels, np.float32)
    is_grey = options.polarity == "discarded"
    width, height = size = histogram.shape[:1:-1]
    if options.resampling == "area":
        width, height = image_grid.image_size(size, options)
    images = np.zeros((len(histogram), height, width, 3), np.uint8)
    for grid, image in zip(histogram, images, strict=True):
        if options.polarity == "separate":
            red, blue = (np.abs(half).sum(axis=0) for half in np.split(grid, 2))
        else:
            red, blue = np.maximum(grid, 0).sum(axis=0), np.maximum(-grid, 0).sum(axis=0)
        values = (red + blue)[None] if is_grey else np.stack([red, blue])
        full_scale = options.full_scale or _three_sigma(red + blue)
        levels = np.minimum(255, np.floor(255.0 * values.astype(np.float64) / full_scale)).astype(np.uint8)
        if options.resampling == "area":
            levels = image_drawing.fit_levels(levels[None], options, "count" if options.full_scale else "three_sigma")[
                0
            ]
        image[..., 0], image[..., 2] = levels[0], levels[-1]
        if is_grey:
            image[..., 1] = levels[0]
    return images


def _three_sigma(magnitudes: np.ndarray) -> float:
    used = magnitudes[magnitudes > 0].astype(np.float64)
    sigma = float(used.std(ddof=1)) if len(used) > 1 else 0.0
    # An isolated pixel, and pixels that are all equal, come out white, as in the event histogram.
    return 3 * sigma if sigma > 0 else float(used.max(initial=0)) or 1.0


map_points = image_grid.map_points
