"""Event histogram: how often each pixel fired in a window, by polarity.

As an image it is what the diffusion model learns: black where nothing happened, positive events red, negative events
blue; white where polarity is discarded.

Source: ControlEvents (Hu et al., WACV 2026), event representation; DHP19 (Calabrese et al., CVPRW 2019) for the
normalisation and the numbers of events.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Literal

import numpy as np
from pydantic import Field, PositiveInt

from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize

VERSION = 1


class Options(Frozen):
    """Options of the event histogram."""

    polarity: bool = Field(
        default=True, description="count positive and negative events apart; DHP19 discards polarity"
    )
    image_size: tuple[PositiveInt, PositiveInt] | None = Field(
        default=None, description="(width, height) px of the image; the sensor's own where not given"
    )
    fit: Literal["pad", "crop", "stretch"] = Field(
        default="pad",
        description="how the sensor meets another image size: whole sensor with black bars, image filled and the rest "
        "of the sensor dropped, or both axes scaled on their own; pad and crop keep the aspect and the centre",
    )
    normalisation: Literal["three_sigma", "max", "count"] = Field(
        default="three_sigma",
        description="what count becomes 255: three standard deviations of the window's counts (DHP19), the window's "
        "largest count, or full_scale_count",
    )
    full_scale_count: int = Field(default=8, ge=1, description="the count that becomes 255 with normalisation `count`")


def encode(events: Events, windows: np.ndarray, options: Options) -> np.ndarray:
    """Count the events of each window.

    Each sensor pixel belongs to the image pixel its centre falls into; scaling up thus leaves pixels without events.

    Args:
        events: E events.
        windows: [N, 2] int64, start and stop of each window in events.
        options: options of this encoding.
    Returns:
        [N, C, H, W] uint16; channels (positive, negative), or one channel without polarity. Counts stop at 65,535.
    Raises:
        ValueError: a window is not a range of the events.
        DataError: an event lies outside the sensor.
    """
    from ctlev_core import histogram as kernels

    windows = np.ascontiguousarray(windows, np.int64)
    if windows.ndim != 2 or windows.shape[1] != 2:
        raise ValueError(f"windows must be [N, 2], got {windows.shape}")
    wrong = (windows[:, 0] < 0) | (windows[:, 1] < windows[:, 0]) | (windows[:, 1] > len(events))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise ValueError(f"window {row} must be a range within {len(events)} events, got {windows[row].tolist()}")
    width, height = _image_size(events.sensor_size, options)
    num_channels = 2 if options.polarity else 1
    (scale_x, offset_x), (scale_y, offset_y) = _scale_and_offset(events.sensor_size, options)
    column_of = _bins(events.sensor_size[0], width, scale_x, offset_x)
    row_start_of = _bins(events.sensor_size[1], height, scale_y, offset_y) * width
    negative_start = (num_channels - 1) * height * width
    scratch = np.empty(num_channels * height * width, np.uint16)
    counts = np.empty((len(windows), scratch.size), np.uint16)
    outside = kernels.count_events(
        events.x, events.y, events.p, windows, column_of, row_start_of, negative_start, scratch, counts
    )
    if outside >= 0:
        raise DataError(
            f"event {outside} at x = {events.x[outside]}, y = {events.y[outside]} px lies outside the sensor of "
            f"{events.sensor_size[0]} x {events.sensor_size[1]} px"
        )
    return counts.reshape(len(windows), num_channels, height, width)


def render_image(histogram: np.ndarray, options: Options) -> np.ndarray:
    """Images of the counts: value = min(255, floor(255 count / full scale)), black where there are no events.

    Both polarities share one full scale, so that their ratio survives: three standard deviations of the total counts
    over the pixels with events (n - 1 in the divisor, at least 0.1 / 255), or the largest count of any channel.

    Args:
        histogram: [N, C, H, W] uint16 as `encode` returns it.
        options: options of this encoding.
    Returns:
        [N, H, W, 3] uint8 RGB: red = positive, green = 0, blue = negative; three equal channels without polarity.
    Raises:
        ValueError: the shape or dtype is not that of counts encoded with these options.
    Source: SensorsINI/DHP19, normalizeImage3Sigma.m. There one channel holds both polarities.
    """
    channels = 2 if options.polarity else 1
    if histogram.ndim != 4 or histogram.shape[1] != channels or histogram.dtype != np.uint16:
        raise ValueError(f"histogram must be [N, {channels}, H, W] uint16, got {histogram.shape} {histogram.dtype}")
    values = np.empty(histogram.shape, np.uint8)
    for window, full_scale in enumerate(_full_scales(histogram, options)):
        # A few counts make a whole image: scale each possible count once, then look the pixels up.
        possible = np.arange(int(histogram[window].max(initial=0)) + 1)
        values[window] = np.minimum(255, np.floor(255.0 * possible / full_scale)).astype(np.uint8)[histogram[window]]
    images = np.zeros((len(histogram), *histogram.shape[2:], 3), np.uint8)
    images[..., 0] = values[:, 0]
    images[..., 2] = values[:, -1]
    if not options.polarity:
        images[..., 1] = values[:, 0]
    return images


def map_points(points: np.ndarray, sensor_size: SensorSize, options: Options) -> np.ndarray:
    """Sensor pixels to image pixels, the same map that bins the events.

    Args:
        points: [..., 2] float (x, y), sensor px, pixel centres at integer + 0.5; NaN stays NaN.
        sensor_size: (width, height) px.
        options: options of this encoding.
    Returns:
        [..., 2], image px, pixel centres at integer + 0.5; points outside the image are kept. A float dtype is kept.
    """
    (scale_x, offset_x), (scale_y, offset_y) = _scale_and_offset(sensor_size, options)
    scale, offset = np.array([scale_x, scale_y], float), np.array([offset_x, offset_y], float)
    points = np.asarray(points)
    dtype = points.dtype if np.issubdtype(points.dtype, np.floating) else np.float64
    return (points * scale + offset).astype(dtype)


def _image_size(sensor_size: SensorSize, options: Options) -> tuple[int, int]:
    return options.image_size or sensor_size


def _scale_and_offset(sensor_size: SensorSize, options: Options) -> tuple[tuple[Fraction, Fraction], ...]:
    """Of x and of y: image px = scale * sensor px + offset. Exact, or rounding would decide about a pixel."""
    image_size = _image_size(sensor_size, options)
    scales = [Fraction(image, sensor) for image, sensor in zip(image_size, sensor_size, strict=True)]
    if options.fit == "pad":
        scales = [min(scales)] * 2
    elif options.fit == "crop":
        scales = [max(scales)] * 2
    axes = zip(scales, image_size, sensor_size, strict=True)
    return tuple((scale, (image - scale * sensor) / 2) for scale, image, sensor in axes)


def _bins(num_sensor: int, num_image: int, scale: Fraction, offset: Fraction) -> np.ndarray:
    """Image pixel that holds the centre of each sensor pixel, [num_sensor] int64; -1 outside the image."""
    # floor(scale * (pixel + 1/2) + offset) over one common denominator, in integers.
    doubled_centres = 2 * np.arange(num_sensor, dtype=np.int64) + 1
    numerators = doubled_centres * (scale.numerator * offset.denominator) + 2 * offset.numerator * scale.denominator
    bins = numerators // (2 * scale.denominator * offset.denominator)
    bins[(bins < 0) | (bins >= num_image)] = -1
    return bins


def _full_scales(histogram: np.ndarray, options: Options) -> np.ndarray:
    """The count that becomes 255 in each window, [N] float64, positive."""
    if options.normalisation == "count":
        return np.full(len(histogram), float(options.full_scale_count))
    if options.normalisation == "max":
        return np.maximum(histogram.max(axis=(1, 2, 3), initial=0), 1).astype(np.float64)
    from ctlev_core import histogram as kernels

    scales = np.empty(len(histogram))
    kernels.full_scales(np.ascontiguousarray(histogram), scales)
    return scales
