"""Tables of events from anywhere (npy, npz, HDF5, text): columns of any name and type to the columns of `Events`.

- Column names: see `COLUMN_NAMES`; letters' case and order do not matter.
- Times: integers are microseconds, floats are seconds, rounded to the nearest microsecond. A format may say that floats
  without any fraction in the whole file are microseconds.
- Polarity: {0, 1}, {-1, 1} or bool; -1 and 0 in one file contradict each other.
- Coordinates: whole numbers of any type.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ctlev_core.events.decoding import event_chunks
from ctlev_core.events.decoding.sensor_sizes import COMMON_SENSORS, smallest_sensor
from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, SensorSize

Columns = Mapping[str, np.ndarray]
"""t, x, y, p [N] of any numeric type."""

COLUMN_NAMES = {
    "t": ("t", "ts", "time", "times", "timestamp", "timestamps", "t_us", "time_us", "timestamp_us"),
    "x": ("x", "xs", "x_pos", "x_px", "col", "column"),
    "y": ("y", "ys", "y_pos", "y_px", "row"),
    "p": ("p", "ps", "pol", "polarity", "polarities", "on"),
}

_LARGEST_COORDINATE = np.iinfo(np.uint16).max
_LARGEST_T = np.iinfo(np.int64).max
_LARGEST_SECONDS = 9.2e12


def find_columns(names: Iterable[str], where: str) -> dict[str, str]:
    """Which of `names` holds t, x, y and p; columns that are missing are left out.

    Raises:
        DataError: two names for one column.
    """
    found: dict[str, str] = {}
    for name in names:
        for column, known in COLUMN_NAMES.items():
            if name.strip().lower() in known:
                if column in found:
                    raise DataError(f"{where}: two columns for {column}: {found[column]!r} and {name!r}")
                found[column] = name
    return found


def require_columns(names: Iterable[str], where: str) -> dict[str, str]:
    """As `find_columns`, all four.

    Raises:
        DataError: a column is missing or there twice; the message names it and lists what there is.
    """
    names = list(names)
    found = find_columns(names, where)
    missing = [f"{column} ({', '.join(COLUMN_NAMES[column])})" for column in COLUMN_NAMES if column not in found]
    if missing:
        raise DataError(f"{where}: no column {' and no column '.join(missing)}; got {', '.join(names) or 'none'}")
    return found


def parse_sensor_size(text: str) -> SensorSize | None:
    """`WIDTHxHEIGHT` as two numbers; None for anything else."""
    size = re.fullmatch(r"\s*(\d{1,5})\s*[x, ]\s*(\d{1,5})\s*", text)
    return (int(size[1]), int(size[2])) if size else None


@dataclass
class _Converter:
    """Chunks of columns to events; remembers what one chunk says about the next."""

    where: str
    whole_floats_are_us: bool
    num_events: int = 0
    largest_x: int = -1
    largest_y: int = -1
    all_whole: bool = True
    polarities: set[int] = field(default_factory=set)

    def scan(self, columns: Columns) -> None:
        """Check x, y and p, and learn what only the whole file tells."""
        x, y, _ = self._without_times(columns)
        if len(x):
            self.largest_x, self.largest_y = max(self.largest_x, int(x.max())), max(self.largest_y, int(y.max()))
        t = columns["t"]
        if self.all_whole and t.dtype.kind == "f":
            self.all_whole = bool((np.floor(t) == t).all())
        self.num_events += len(x)

    def convert(self, columns: Columns, sensor_size: SensorSize) -> Events:
        """The events of one chunk."""
        x, y, p = self._without_times(columns)
        t = self._times(columns["t"])
        self.num_events += len(t)
        return Events(t, x, y, p, sensor_size)

    def _without_times(self, columns: Columns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        lengths = {name: columns[name].shape for name in EVENT_DTYPES}
        if len(set(lengths.values())) != 1 or len(lengths["t"]) != 1:
            raise DataError(f"{self.where}: columns must be [N] and of one length, got {lengths}")
        for name in EVENT_DTYPES:
            if columns[name].dtype.kind not in "buif":
                raise DataError(f"{self.where}: column {name} must hold numbers, got {columns[name].dtype}")
        x, y = (self._whole(name, columns[name], 0, _LARGEST_COORDINATE).astype(np.uint16) for name in ("x", "y"))
        return x, y, self._polarity(columns["p"])

    def _whole(self, name: str, values: np.ndarray, low: int, high: int) -> np.ndarray:
        if values.dtype.kind == "b":
            values = values.view(np.uint8)
        limits = np.iinfo(values.dtype) if values.dtype.kind in "ui" else None
        if limits is not None and low <= limits.min and limits.max <= high:
            return values
        wrong = (values < low) | (values > high)
        if values.dtype.kind == "f":
            wrong |= np.floor(values) != values  # also true of NaN
        if wrong.any():
            first = int(np.argmax(wrong))
            raise DataError(
                f"{self.where}: {name} must be a whole number from {low} to {high}, got {values[first]} at event "
                f"{self.num_events + first}"
            )
        return values

    def _polarity(self, values: np.ndarray) -> np.ndarray:
        if values.dtype.kind == "b":
            return values.astype(np.uint8)
        values = self._whole("p", values, -1, 1)
        self.polarities |= {value for value in (-1, 0) if (values == value).any()}
        if len(self.polarities) == 2:
            raise DataError(f"{self.where}: OFF events have polarity -1 and 0, expected one of them throughout")
        return (values > 0).astype(np.uint8)

    def _times(self, values: np.ndarray) -> np.ndarray:
        if values.dtype.kind != "f":
            return self._whole("t (us)", values, 0, _LARGEST_T).astype(np.int64)
        if self.whole_floats_are_us and self.all_whole:
            return self._whole("t (us)", values, 0, 1 << 62).astype(np.int64)
        wrong = ~((values >= 0) & (values < _LARGEST_SECONDS))
        if wrong.any():
            first = int(np.argmax(wrong))
            raise DataError(
                f"{self.where}: t must be seconds from 0 on, got {values[first]} at event {self.num_events + first}"
            )
        return seconds_to_us(values)


def says_us(name: str) -> bool:
    """Does a column's name say that its times are microseconds, whatever their type?"""
    return name.strip().lower().endswith("_us")


def times_as_named(name: str, times: np.ndarray, where: str) -> np.ndarray:
    """Times of a column that says they are microseconds, rounded to whole ones; others as they are.

    Raises:
        DataError: they are negative, not finite or too large.
    """
    if times.dtype.kind != "f" or not says_us(name):
        return times
    wrong = ~((times >= 0) & (times < 2.0**62))
    if wrong.any():
        raise DataError(f"{where}: column {name!r} must be microseconds from 0 on, got {times[np.argmax(wrong)]}")
    return np.rint(times).astype(np.int64)


def seconds_to_us(seconds: np.ndarray) -> np.ndarray:
    """Microseconds [N] int64 nearest to the exact value of each float, ties to even.

    A plain `rint(seconds * 1e6)` rounds twice and is off by one near halves. Here the fraction is split into two parts
    whose products with 10^6 are exact, so that only the final decision rounds.

    Args:
        seconds: [N] float, finite, from 0 to 9.2e12.
    """
    values = np.asarray(seconds, np.float64)
    whole = np.floor(values)
    fraction = values - whole
    high = np.floor(fraction * 2.0**26) * 2.0**-26
    product_high, product_low = high * 1e6, (fraction - high) * 1e6
    below = np.floor(product_high)
    excess = (product_high - below - 0.5) + product_low
    below = below.astype(np.int64)
    up = (excess > 0) | ((excess == 0) & (below & 1 == 1))
    # The low part may carry past the next whole number, by less than a fiftieth.
    return whole.astype(np.int64) * 1_000_000 + below + up


def to_events(
    chunks: Callable[[], Iterator[Columns]],
    where: str,
    sensor_size: SensorSize | None = None,
    whole_floats_are_us: bool = False,
    sensors: Sequence[SensorSize] = COMMON_SENSORS,
) -> Iterator[Events]:
    """Chunks of columns as checked events.

    Args:
        chunks: makes an iterator from the first chunk on; called twice where only the whole file tells the sensor size
            or the unit of the times.
        where: names the file in messages.
        sensor_size: (width, height) px; the first of `sensors` that holds all events where not given.
        whole_floats_are_us: floats are microseconds if none in the file has a fraction, else seconds.
        sensors: (width, height) px.
    Raises:
        DataError: columns of different lengths, not numbers, or out of range; no sensor size and no events; events that
            break `check_events`.
    """
    converter = _Converter(where, whole_floats_are_us)
    if sensor_size is None or whole_floats_are_us:
        scanner = _Converter(where, whole_floats_are_us)
        for columns in chunks():
            scanner.scan(columns)
        converter.all_whole = scanner.all_whole
        if sensor_size is None:
            if scanner.num_events == 0:
                raise DataError(f"{where}: no events, and nothing else tells the sensor size")
            sensor_size = smallest_sensor(scanner.largest_x, scanner.largest_y, where, sensors)
    size = sensor_size
    yield from event_chunks.check_chunks((converter.convert(columns, size) for columns in chunks()), where)
