"""How the sensor meets the image: where its pixels come to lie, what counts are made in, and where points go."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Literal

import numpy as np
from pydantic import Field, PositiveInt

from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize

Fit = Literal["pad", "crop", "stretch", "centre"]


class ImageFit(Frozen):
    """Options every encoding has: the size of the image and how the sensor is fitted to it."""

    image_size: tuple[PositiveInt, PositiveInt] | None = Field(
        default=None, description="(width, height) px of the image; the sensor's own where not given"
    )
    fit: Fit = Field(
        default="pad",
        description="how the sensor meets another image size: whole sensor with black bars, image filled and the rest "
        "of the sensor dropped, or both axes scaled on their own; pad and crop keep the aspect and the centre, and "
        "centre keeps the scale too: black bars around a smaller sensor, the border of a larger one dropped",
    )
    resampling: Literal["area", "events"] = Field(
        default="area",
        description="how another image size is reached: `area` encodes at the size of the sensor and draws each image "
        "pixel as the average over its area; `events` puts every event into the image pixel that holds its centre "
        "before anything is counted, which leaves black gaps where the image is larger, and whole counts of image "
        "pixels, as stochastic_rounding and export need. Event images that come finished are always averaged over "
        "areas",
    )


def image_size(sensor_size: SensorSize, options: ImageFit) -> tuple[int, int]:
    """(width, height) px of the image."""
    return options.image_size or sensor_size


def count_size(sensor_size: SensorSize, options: ImageFit) -> tuple[int, int]:
    """(width, height) of what an encoding returns: that of the sensor, or with resampling `events` of the image."""
    return sensor_size if options.resampling == "area" else image_size(sensor_size, options)


def pixel_bins(sensor_size: SensorSize, options: ImageFit) -> tuple[np.ndarray, np.ndarray]:
    """Column of the counts that each sensor column belongs to, and row of each sensor row.

    Each is its own but with resampling `events`: there each sensor pixel belongs to the image pixel that its centre
    falls into, and scaling up leaves pixels without events.

    Returns:
        [sensor width] and [sensor height] int64; -1 outside the image.
    """
    if options.resampling == "area":
        width, height = sensor_size
        return np.arange(width), np.arange(height)
    sizes = image_size(sensor_size, options)
    axes = zip(sensor_size, sizes, _scale_and_offset(sensor_size, options), strict=True)
    columns, rows = (_bins(num_sensor, num_image, *axis) for num_sensor, num_image, axis in axes)
    return columns, rows


def pixel_edges(sensor_size: SensorSize, options: ImageFit) -> tuple[np.ndarray, np.ndarray]:
    """Where the edges of sensor columns and rows lie in the image, by the map of `map_points`.

    Returns:
        [sensor width + 1] and [sensor height + 1] float64, image px, ascending.
    """
    axes = zip(sensor_size, _scale_and_offset(sensor_size, options), strict=True)
    columns, rows = (_edges(num_sensor, *axis) for num_sensor, axis in axes)
    return columns, rows


def is_reduced(sensor_size: SensorSize, options: ImageFit) -> bool:
    """Is a sensor pixel narrower or lower than an image pixel, so that several are averaged?"""
    return any(scale < 1 for scale, _ in _scale_and_offset(sensor_size, options))


def map_points(points: np.ndarray, sensor_size: SensorSize, options: ImageFit) -> np.ndarray:
    """Sensor pixels to image pixels, the same map that bins the events.

    Args:
        points: [..., 2] float (x, y), sensor px, pixel centres at integer + 0.5; NaN stays NaN.
        sensor_size: (width, height) px.
        options: options of the encoding.
    Returns:
        [..., 2], image px, pixel centres at integer + 0.5; points outside the image are kept. A float dtype is kept.
    """
    (scale_x, offset_x), (scale_y, offset_y) = _scale_and_offset(sensor_size, options)
    scale, offset = np.array([scale_x, scale_y], float), np.array([offset_x, offset_y], float)
    points = np.asarray(points)
    dtype = points.dtype if np.issubdtype(points.dtype, np.floating) else np.float64
    return (points * scale + offset).astype(dtype)


def check_inside(events: Events, outside: int) -> None:
    """Raise `DataError` for the event with the number `outside`, which a kernel found; -1 means none."""
    if outside >= 0:
        width, height = events.sensor_size
        raise DataError(
            f"event {outside} at x = {events.x[outside]}, y = {events.y[outside]} px lies outside the sensor of "
            f"{width} x {height} px"
        )


def check_encoded(histogram: np.ndarray, num_channels: int, dtype: type) -> None:
    """Raise `ValueError` unless `histogram` is [N, num_channels, H, W] of `dtype`, as an encoding returns it."""
    if histogram.ndim != 4 or histogram.shape[1] != num_channels or histogram.dtype != dtype:
        expected = f"[N, {num_channels}, H, W] {np.dtype(dtype).name}"
        raise ValueError(f"histogram must be {expected}, got {histogram.shape} {histogram.dtype}")


def check_whole_counts(count_shape: Sequence[int], image_shape: Sequence[int], what: str) -> None:
    """Raise `DataError` unless counts [..., H, W] are those of the pixels of images [..., H, W, 3].

    Args:
        count_shape: of counts.
        image_shape: of images.
        what: option or stage that needs such counts.
    """
    (height, width), (image_height, image_width) = count_shape[-2:], image_shape[-3:-1]
    if (height, width) != (image_height, image_width):
        raise DataError(
            f"{what} needs whole counts of image pixels; counts are of {width} x {height} px, images of {image_width} "
            f"x {image_height} px: set encoding.options.resampling=events, or no encoding.options.image_size"
        )


def _scale_and_offset(sensor_size: SensorSize, options: ImageFit) -> tuple[tuple[Fraction, Fraction], ...]:
    """Of x and of y: image px = scale * sensor px + offset. Exact, or rounding would decide about a pixel."""
    sizes = image_size(sensor_size, options)
    if options.fit == "centre":  # whole pixels: of an odd difference the smaller half comes first
        pairs = zip(sizes, sensor_size, strict=True)
        return tuple((Fraction(1), Fraction((image - sensor) // 2)) for image, sensor in pairs)
    scales = [Fraction(image, sensor) for image, sensor in zip(sizes, sensor_size, strict=True)]
    if options.fit == "pad":
        scales = [min(scales)] * 2
    elif options.fit == "crop":
        scales = [max(scales)] * 2
    axes = zip(scales, sizes, sensor_size, strict=True)
    return tuple((scale, (image - scale * sensor) / 2) for scale, image, sensor in axes)


def _edges(num_sensor: int, scale: Fraction, offset: Fraction) -> np.ndarray:
    """Image px of the edges of the sensor pixels, [num_sensor + 1] float64, each rounded once."""
    numerators = np.arange(num_sensor + 1, dtype=np.int64) * (scale.numerator * offset.denominator)
    numerators += offset.numerator * scale.denominator
    return numerators / (scale.denominator * offset.denominator)


def _bins(num_sensor: int, num_image: int, scale: Fraction, offset: Fraction) -> np.ndarray:
    """Image pixel that holds the centre of each sensor pixel, [num_sensor] int64; -1 outside the image."""
    # floor(scale * (pixel + 1/2) + offset) over one common denominator, in integers.
    doubled_centres = 2 * np.arange(num_sensor, dtype=np.int64) + 1
    numerators = doubled_centres * (scale.numerator * offset.denominator) + 2 * offset.numerator * scale.denominator
    bins = numerators // (2 * scale.denominator * offset.denominator)
    bins[(bins < 0) | (bins >= num_image)] = -1
    return bins
