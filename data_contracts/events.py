"""The one in-memory form of event data, and the checks every reader's output must pass.

Columns, not an array of structs: every encoder and the Parquet files read them as they lie.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from data_contracts.errors import DataError

SensorSize = tuple[int, int]
"""(width, height) in pixels."""

MAX_SENSOR_PIXELS = 2**24
"""The largest event cameras have 2^20. A corrupt file that states another size asks for gigabytes a window."""

POLARITY_CHANNELS = ("positive", "negative")
"""Channel order of every array with a polarity axis: channel 0 = ON (p = 1), channel 1 = OFF (p = 0)."""


@dataclass(frozen=True, eq=False)
class Events:
    """N events of one recording, in the order of their time stamps.

    Attributes:
        t: [N] int64, microseconds, non-decreasing and non-negative.
        x: [N] uint16, pixels, 0 <= x < sensor width, left to right.
        y: [N] uint16, pixels, 0 <= y < sensor height, top to bottom.
        p: [N] uint8, 1 = ON (brighter), 0 = OFF (darker).
        sensor_size: (width, height) in pixels.
        signal: [N] bool, True = light changed, False = the sensor's noise; None = nobody knows, as of a real camera.
    """

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    p: np.ndarray
    sensor_size: SensorSize
    signal: np.ndarray | None = field(default=None, kw_only=True)

    def __len__(self) -> int:
        return len(self.t)

    @property
    def duration_us(self) -> int:
        """Time between the first and the last event in microseconds; 0 when there are fewer than two."""
        return int(self.t[-1] - self.t[0]) if len(self.t) > 1 else 0

    def slice(self, start: int, stop: int) -> Events:
        """Events start .. stop - 1 as views of the same columns."""
        signal = None if self.signal is None else self.signal[start:stop]
        t, x, y, p = (getattr(self, name)[start:stop] for name in EVENT_DTYPES)
        return Events(t, x, y, p, self.sensor_size, signal=signal)


def check_sensor_size(size: SensorSize, where: str) -> SensorSize:
    """The size; raises `DataError` where no sensor has it."""
    width, height = size
    if width < 1 or height < 1:
        raise DataError(f"{where}: sensor_size must be at least 1 x 1 px, got {width} x {height}")
    if width * height > MAX_SENSOR_PIXELS:
        raise DataError(
            f"{where}: sensor_size must be of {MAX_SENSOR_PIXELS} px at most, got {width} x {height} = {width * height}"
        )
    return size


EVENT_DTYPES = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.uint8}


def check_events(events: Events, where: str) -> Events:
    """Raise `DataError` unless `events` keeps every promise in the docstring of `Events`.

    Args:
        events: what a reader or a simulator returned.
        where: names the recording in the message, for example the file.

    Returns:
        The same object, so that a reader can end in `return check_events(...)`.
    """
    width, height = check_sensor_size(events.sensor_size, where)
    for name, dtype in EVENT_DTYPES.items():
        column = getattr(events, name)
        if column.ndim != 1 or column.dtype != dtype:
            raise DataError(f"{where}: column {name} must be [N] {np.dtype(dtype)}, got {column.shape} {column.dtype}")
        if len(column) != len(events.t):
            raise DataError(f"{where}: column {name} has {len(column)} rows, column t has {len(events.t)}")
    signal = events.signal
    if signal is not None and (signal.shape != events.t.shape or signal.dtype != np.bool_):
        raise DataError(f"{where}: column signal must be [{len(events)}] bool, got {signal.shape} {signal.dtype}")
    if len(events) == 0:
        return events
    if events.t[0] < 0:
        raise DataError(f"{where}: time stamps must not be negative, got t = {events.t[0]} us at event 0")
    # Comparing neighbours rather than np.diff: no int64 temporary, and no overflow for far-apart stamps.
    descending = events.t[1:] < events.t[:-1]
    if descending.any():
        first = int(np.argmax(descending)) + 1
        raise DataError(f"{where}: t decreases at event {first}: {events.t[first - 1]} us, then {events.t[first]} us")
    for name, limit in (("x", width), ("y", height), ("p", 2)):
        column = getattr(events, name)
        if int(column.max()) >= limit:
            first = int(np.argmax(column >= limit))
            raise DataError(f"{where}: {name} must be below {limit}, got {column[first]} at event {first}")
    return events
