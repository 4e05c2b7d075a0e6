"""The loops behind the event histogram, compiled.

What limits them was measured on one core of an AMD EPYC (Zen 4, 3.65 GHz; benchmarks/encoding.py measures it anew):
incrementing random cells of a histogram that fits the first-level cache takes 1.05 cycles an event, of one in the
second-level cache 2 to 3, whatever the width of a cell; computing cell numbers takes 0.7, reading an event's 5 bytes
0.6. So cell numbers are computed for a block of events at once, which the compiler vectorises. A second copy of the
histogram, against increments that wait for one another on a busy pixel, gained nothing, nor did large memory pages or
tiles of pixels; sorting events into chunks that fit the first-level cache costs as much as it saves.
"""

from __future__ import annotations

import numpy as np
from numba import njit

BLOCK = 256
"""Events whose cell numbers are computed at once: 128 to 512 were equally fast, 32 and 4096 slower."""
DENSE = 2
"""With more events than this a cell, narrow counters pay for adding them up at the end."""
SPARSE = 1 / 40
"""With fewer events than this a cell, clearing only the pixels of a window is faster than clearing all."""


@njit(cache=True, nogil=True)
def count_pixels(
    x: np.ndarray,
    y: np.ndarray,
    p: np.ndarray,
    windows: np.ndarray,
    sensor_size: tuple[int, int],
    with_polarity: bool,
    narrow: np.ndarray,
    is_clear: bool,
    histogram: np.ndarray,
) -> int:
    """Count the events of each window in an image that is the sensor itself; counts stop at 65,535.

    Counts are made where they are wanted, in memory that is cleared just before: that reads it into the cache in order,
    and was measured up to 1.8 times as fast as counting in new memory that the operating system had cleared. Windows
    with many events are counted in one byte a cell first: two channels of 640 x 480 px then fit a cache of 1 MiB.

    Args:
        x: [E] uint16, sensor px.
        y: [E] uint16, sensor px.
        p: [E] uint8; anything but 0 is positive.
        windows: [N, 2] int64, ranges within 0 .. E.
        sensor_size: (width, height) px.
        with_polarity: two channels (positive, negative) instead of one.
        narrow: [cells] uint8, zeros; zeros again afterwards, unless an event lies outside. May be empty where no window
            has more than `DENSE` events a cell.
        is_clear: the histogram holds zeros already.
        histogram: [N, cells] uint16, filled; the cells are those of [C, height, width].
    Returns:
        Index of the first event outside the sensor, where counting stopped; -1 if there is none.
    """
    width, height = np.uint32(sensor_size[0]), np.uint32(sensor_size[1])
    negative_start = width * height if with_polarity else np.uint32(0)
    cells = np.empty(BLOCK, np.uint32)
    for window in range(len(windows)):
        counts = histogram[window]
        if not is_clear:
            counts[:] = 0
        start, stop = windows[window]
        is_dense = stop - start > DENSE * len(counts)
        while start < stop:
            # A literal number of events in all blocks but the last, so that the loops over them are unrolled.
            if stop - start >= BLOCK:
                used = BLOCK
                inside = _pixel_cells(x, y, p, start, BLOCK, width, height, negative_start, cells)
            else:
                used = stop - start
                inside = _pixel_cells(x, y, p, start, used, width, height, negative_start, cells)
            if not inside:
                return _first_outside(x, y, start, start + used, width, height)
            if is_dense:
                _increment_narrow(cells, used, narrow, counts)
            else:
                _increment(cells, used, counts)
            start += used
        if is_dense:
            _add_narrow(narrow, counts)
    return -1


@njit(cache=True, nogil=True)
def count_events(
    x: np.ndarray,
    y: np.ndarray,
    p: np.ndarray,
    windows: np.ndarray,
    column_of: np.ndarray,
    row_start_of: np.ndarray,
    negative_start: int,
    histogram: np.ndarray,
) -> int:
    """Count the events of each window in an image of any size, by tables that say where pixels go.

    Args:
        x: [E] uint16, sensor px.
        y: [E] uint16, sensor px.
        p: [E] uint8; anything but 0 is positive.
        windows: [N, 2] int64, ranges within 0 .. E.
        column_of: [sensor width] int64, image column of each sensor column; negative = outside the image.
        row_start_of: [sensor height] int64, cell where the image row of each sensor row starts; negative = outside.
        negative_start: cell where the channel of negative events starts; 0 where polarity is discarded.
        histogram: [N, cells] uint16, filled; the cells are those of [C, H, W].
    Returns:
        Index of the first event outside the sensor, where counting stopped; -1 if there is none.
    """
    width, height = len(column_of), len(row_start_of)
    cells = np.empty(BLOCK, np.uint32)
    for window in range(len(windows)):
        counts = histogram[window]
        counts[:] = 0
        for start in range(windows[window, 0], windows[window, 1], BLOCK):
            stop = min(start + BLOCK, windows[window, 1])
            outside = _first_outside(x, y, start, stop, width, height)
            if outside >= 0:
                return outside
            used = 0
            for i in range(start, stop):
                event = np.uint64(i)
                column, row_start = column_of[x[event]], row_start_of[y[event]]
                cells[np.uint64(used)] = row_start + column + negative_start * (p[event] == 0)
                # An event outside the image is overwritten by the next.
                if (column | row_start) >= 0:
                    used += 1
            _increment(cells, used, counts)
    return -1


@njit(cache=True, nogil=True)
def clear_pixels(
    x: np.ndarray,
    y: np.ndarray,
    p: np.ndarray,
    start: int,
    stop: int,
    sensor_size: tuple[int, int],
    with_polarity: bool,
    counts: np.ndarray,
) -> None:
    """Set the cells of events that `count_pixels` counted to zero again.

    Args:
        x: [E] uint16, sensor px, inside the sensor.
        y: [E] uint16, sensor px, inside the sensor.
        p: [E] uint8; anything but 0 is positive.
        start: the first event.
        stop: one past the last.
        sensor_size: (width, height) px.
        with_polarity: as in `count_pixels`.
        counts: [cells] uint16.
    """
    width, height = np.uint32(sensor_size[0]), np.uint32(sensor_size[1])
    negative_start = width * height if with_polarity else np.uint32(0)
    cells = np.empty(BLOCK, np.uint32)
    for block in range(start, stop, BLOCK):
        used = min(BLOCK, stop - block)
        _pixel_cells(x, y, p, block, used, width, height, negative_start, cells)
        for i in range(used):
            counts[np.uint64(cells[np.uint64(i)])] = np.uint16(0)


@njit(cache=True, nogil=True)
def _pixel_cells(
    x: np.ndarray,
    y: np.ndarray,
    p: np.ndarray,
    start: int,
    used: int,
    width: np.uint32,
    height: np.uint32,
    negative_start: np.uint32,
    cells: np.ndarray,
) -> bool:
    """Cell numbers of a block of events; are all of them inside the sensor?"""
    largest_x, largest_y = np.uint16(0), np.uint16(0)
    for i in range(used):
        event = np.uint64(start + i)
        largest_x, largest_y = max(largest_x, x[event]), max(largest_y, y[event])
        channel_start = negative_start if p[event] == 0 else np.uint32(0)
        cells[i] = np.uint32(y[event]) * width + np.uint32(x[event]) + channel_start
    return bool(largest_x < width and largest_y < height)


@njit(cache=True, nogil=True)
def _increment(cells: np.ndarray, used: int, counts: np.ndarray) -> None:
    for i in range(used):
        # Unsigned, so that no code for negative indices is made.
        cell = np.uint64(cells[np.uint64(i)])
        count = np.uint16(counts[cell] + np.uint16(1))
        counts[cell] = count
        if count == 0:
            counts[cell] = np.uint16(65535)


@njit(cache=True, nogil=True)
def _increment_narrow(cells: np.ndarray, used: int, narrow: np.ndarray, counts: np.ndarray) -> None:
    """Count in bytes; when one wraps to 0, its 256 events go to the wide count."""
    for i in range(used):
        cell = np.uint64(cells[np.uint64(i)])
        count = np.uint8(narrow[cell] + np.uint8(1))
        narrow[cell] = count
        if count == 0:
            counts[cell] = np.uint16(min(np.uint32(counts[cell]) + np.uint32(256), np.uint32(65535)))


@njit(cache=True, nogil=True)
def _add_narrow(narrow: np.ndarray, counts: np.ndarray) -> None:
    """Move what is left in the bytes to the wide counts."""
    for cell in range(len(counts)):
        counts[cell] = np.uint16(min(np.uint32(counts[cell]) + np.uint32(narrow[cell]), np.uint32(65535)))
        narrow[cell] = np.uint8(0)


@njit(cache=True, nogil=True)
def _first_outside(
    x: np.ndarray, y: np.ndarray, start: int, stop: int, width: int | np.uint32, height: int | np.uint32
) -> int:
    """Number of the first event outside the sensor, -1 if there is none."""
    largest_x, largest_y = np.uint16(0), np.uint16(0)
    for i in range(start, stop):
        event = np.uint64(i)
        largest_x, largest_y = max(largest_x, x[event]), max(largest_y, y[event])
    if largest_x < width and largest_y < height:
        return -1
    for event in range(start, stop):
        if x[event] >= width or y[event] >= height:
            return event
    return -1


@njit(cache=True, nogil=True)
def full_scales(histogram: np.ndarray, scales: np.ndarray) -> None:
    """Three standard deviations of each window's total counts over the pixels that have events.

    The standard deviation divides by n - 1 and is at least 0.1 / 255, as in DHP19's normalizeImage3Sigma.m. Of a single
    pixel it is 0, so that an isolated event comes out white, like equal counts. A window without events gets the floor.

    Args:
        histogram: [N, C, H, W] uint16, contiguous.
        scales: [N] float64, filled.
    """
    num_windows, num_channels, height, width = histogram.shape
    num_cells = height * width
    counts = np.empty(num_cells, np.int64)
    for window in range(num_windows):
        channels = histogram[window].reshape(num_channels, num_cells)
        num_pixels, total = 0, 0
        for pixel in range(num_cells):
            count = np.int64(channels[0, pixel])
            for channel in range(1, num_channels):
                count += np.int64(channels[channel, pixel])
            counts[num_pixels] = count
            # A pixel without events is overwritten by the next.
            num_pixels += count > 0
            total += count
        mean = total / max(num_pixels, 1)
        # Around the mean in a second pass: with sums of squares the difference of two large numbers would be left.
        deviation = 0.0
        for count in counts[:num_pixels]:
            deviation += (count - mean) ** 2
        sigma = np.sqrt(deviation / max(num_pixels - 1, 1))
        scales[window] = 3.0 * max(sigma, 0.1 / 255.0)


@njit(cache=True, nogil=True)
def draw(histogram: np.ndarray, scales: np.ndarray, images: np.ndarray) -> None:
    """Counts to grey levels, floor(255 count / scale), at most 255: red = first channel, blue = last.

    Args:
        histogram: [N, C, H, W] uint16, C = 1 or 2.
        scales: [N] float64, positive.
        images: [N, H, W, 3] uint8, zeros on entry; all three channels are alike where C = 1.
    """
    num_windows, num_channels, height, width = histogram.shape
    num_cells = height * width
    for window in range(num_windows):
        counts = histogram[window].reshape(num_channels, num_cells)
        values = images[window].reshape(num_cells, 3)
        for channel in range(num_channels):
            for pixel in range(num_cells):
                count = counts[channel, pixel]
                if count == 0:
                    continue
                value = _grey_level(count, scales[window])
                values[pixel, 2 * channel] = value
                if num_channels == 1:
                    values[pixel, 1] = values[pixel, 2] = value


@njit(cache=True, nogil=True)
def grey_levels(histogram: np.ndarray, scales: np.ndarray, levels: np.ndarray) -> None:
    """Counts to the grey levels of `draw`, every channel by itself.

    Args:
        histogram: [N, C, H, W] uint16, contiguous.
        scales: [N] float64, positive.
        levels: [N, C, H, W] uint8, filled.
    """
    for window in range(len(histogram)):
        counts, values = histogram[window].reshape(-1), levels[window].reshape(-1)
        for cell in range(len(counts)):
            count = counts[cell]
            values[cell] = _grey_level(count, scales[window]) if count != 0 else np.uint8(0)


@njit(cache=True, nogil=True)
def _grey_level(count: int, scale: float) -> np.uint8:
    return np.uint8(min(255.0, np.floor(255.0 * count / scale)))
