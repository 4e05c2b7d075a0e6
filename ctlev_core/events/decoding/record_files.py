"""Binary event files of fixed-size records: read whole or in chunks through one compiled decoder.

A decoder takes a run of records and a state, and leaves the state as the next run needs it. The state also gathers what
`check_events` would have to visit every event for once more: whether times ever went back, and the largest coordinates.
Polarities are one bit in every such format. Only where these say that a promise is broken is `check_events` asked, for
its message.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctlev_core.events.decoding import event_chunks
from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, SensorSize, check_sensor_size

LAST_T, TIME_WENT_BACK, LARGEST_X, LARGEST_Y, NUM_SHARED = 0, 1, 2, 3, 4
"""Where the shared part of a decoder's state lies; the decoder's own part follows. All start at 0."""

_SMALLEST_BLOCK, _LARGEST_BLOCK = 1 << 16, 1 << 19  # records


@dataclass(frozen=True)
class RecordFile:
    """One file and how to decode it.

    Attributes:
        path: the file.
        offset: bytes before the first record.
        dtype: of the items a record is made of.
        items: items a record.
        unit: what a record is called in messages, for example `word`.
        decode: (items, state, t, x, y, p) -> number of events written.
        own_state: what the decoder's own part of the state starts as.
        sensor_size: (width, height) px, or a function of the state after the last record and the number of events.
        count_events: items -> an upper bound of the number of events; one a record where not given.
        finish: applied to checked events, for example to turn the image round.
    """

    path: Path
    offset: int
    dtype: np.dtype
    items: int
    unit: str
    decode: Callable[..., int]
    own_state: tuple[int, ...]
    sensor_size: SensorSize | Callable[[np.ndarray, int], SensorSize]
    count_events: Callable[[np.ndarray], int] | None = None
    finish: Callable[[Events], Events] | None = None

    @property
    def record_bytes(self) -> int:
        """Size of a record."""
        return self.dtype.itemsize * self.items

    def new_state(self) -> np.ndarray:
        """The state before the first record."""
        return np.array([0] * NUM_SHARED + list(self.own_state), np.int64)

    def num_records(self) -> int:
        """How many records the file has.

        Raises:
            DataError: none, or a cut one.
        """
        num_bytes = self.path.stat().st_size - self.offset
        if num_bytes <= 0:
            raise DataError(
                f"{self.path}: the file ends after its {self.offset}-byte header, expected {self.unit}s"
                if self.offset
                else f"{self.path}: the file is empty, expected {self.unit}s"
            )
        if num_bytes % self.record_bytes:
            raise DataError(
                f"{self.path}: cut inside a {self.unit.split()[-1]}: {num_bytes} bytes after the header, "
                f"expected a multiple of {self.record_bytes} for {self.unit}s"
            )
        return num_bytes // self.record_bytes


def read(file: RecordFile) -> Events:
    """All events.

    Raises:
        DataError: no records, a cut one, an unknown sensor size, or events that break `check_events`.
    """
    num_records = file.num_records()
    # Mapped, so that a recording larger than memory needs room for its events only.
    mapped = np.memmap(file.path, file.dtype, mode="c", offset=file.offset, shape=(num_records * file.items,))
    state = file.new_state()
    t, x, y, p = _decode(file, np.asarray(mapped), state)
    return _checked(file, Events(t, x, y, p, find_sensor_size(file, state, len(t))), state, 0, 0)


def read_chunks(file: RecordFile, num_events: int) -> Iterator[Events]:
    """The events of `read` in chunks of `num_events`, in memory that does not grow with the file.

    The file is read twice where only its events tell the sensor size.

    Raises:
        DataError: as `read`.
    """
    sensor_size = file.sensor_size
    if not callable(sensor_size):
        check_sensor_size(sensor_size, str(file.path))
    else:
        state, total = scan(file)
        sensor_size = find_sensor_size(file, state, total)
    yield from event_chunks.regroup(_read_blocks(file, sensor_size, num_events), num_events)


def _read_blocks(file: RecordFile, sensor_size: SensorSize, num_events: int) -> Iterator[Events]:
    state = file.new_state()
    num_before = 0
    for items in _blocks(file, num_events):
        last_t = int(state[LAST_T])
        t, x, y, p = _decode(file, items, state)
        yield _checked(file, Events(t, x, y, p, sensor_size), state, num_before, last_t)
        num_before += len(t)


def scan(file: RecordFile) -> tuple[np.ndarray, int]:
    """The decoder's state after the last record and the number of events, without keeping them."""
    state = file.new_state()
    total = sum(len(_decode(file, items, state)[0]) for items in _blocks(file, _LARGEST_BLOCK))
    return state, total


def find_sensor_size(file: RecordFile, state: np.ndarray, num_events: int) -> SensorSize:
    """The file's sensor size, after its last record."""
    size = file.sensor_size(state, num_events) if callable(file.sensor_size) else file.sensor_size
    return check_sensor_size(size, str(file.path))


def _blocks(file: RecordFile, num_records: int) -> Iterator[np.ndarray]:
    remaining = file.num_records()
    block = min(max(num_records, _SMALLEST_BLOCK), _LARGEST_BLOCK)
    with file.path.open("rb") as handle:
        handle.seek(file.offset)
        while remaining:
            count = min(block, remaining)
            items = np.fromfile(handle, file.dtype, count * file.items)
            if len(items) != count * file.items:
                raise DataError(f"{file.path}: the file became shorter while it was read")
            yield items
            remaining -= count


def _decode(file: RecordFile, items: np.ndarray, state: np.ndarray) -> list[np.ndarray]:
    capacity = file.count_events(items) if file.count_events else len(items) // file.items
    columns = [np.empty(capacity, dtype) for dtype in EVENT_DTYPES.values()]
    count = file.decode(items, state, *columns)
    return [column[:count] for column in columns]


def _checked(file: RecordFile, events: Events, state: np.ndarray, num_before: int, last_t: int) -> Events:
    width, height = events.sensor_size
    if state[TIME_WENT_BACK] or state[LARGEST_X] >= width or state[LARGEST_Y] >= height or min(width, height) < 1:
        event_chunks.check_chunk(events, str(file.path), num_before, last_t)
    return file.finish(events) if file.finish else events
