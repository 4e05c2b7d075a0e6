"""A recording in consecutive chunks: cut anew, joined, and checked where one chunk meets the next."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, SensorSize, check_events


def empty_events(sensor_size: SensorSize) -> Events:
    """No events."""
    t, x, y, p = (np.empty(0, dtype) for dtype in EVENT_DTYPES.values())
    return Events(t, x, y, p, sensor_size)


def concatenate(chunks: Iterable[Events]) -> Events:
    """All chunks (one at least) as one recording; a single chunk is returned as it is."""
    parts = list(chunks)
    if len(parts) == 1:
        return parts[0]
    t, x, y, p = (np.concatenate([getattr(part, name) for part in parts]) for name in EVENT_DTYPES)
    marks = [part.signal for part in parts if part.signal is not None]
    signal = np.concatenate(marks) if len(marks) == len(parts) else None
    return Events(t, x, y, p, parts[0].sensor_size, signal=signal)


def regroup(chunks: Iterable[Events], num_events: int) -> Iterator[Events]:
    """The same events in chunks of `num_events`, the last one shorter; one empty chunk where there are no events.

    Args:
        chunks: at least one, of any lengths, of one sensor size.
        num_events: at least 1.
    """
    if num_events < 1:
        raise ValueError(f"num_events must be at least 1, got {num_events}")
    waiting: list[Events] = []
    num_waiting = 0
    any_given = False
    nothing = empty_events((1, 1))
    for chunk in chunks:
        nothing, start = chunk.slice(0, 0), 0
        while len(chunk) - start >= num_events - num_waiting:
            stop = start + num_events - num_waiting
            yield concatenate([*waiting, chunk.slice(start, stop)])
            waiting, num_waiting, start, any_given = [], 0, stop, True
        if start < len(chunk):
            waiting.append(chunk.slice(start, len(chunk)))
            num_waiting += len(chunk) - start
    if waiting:
        yield concatenate(waiting)
    elif not any_given:
        yield nothing


def check_chunks(chunks: Iterable[Events], where: str) -> Iterator[Events]:
    """Hand the chunks on, each checked, with the promises of `Events` kept across their joints too.

    Raises:
        DataError: a chunk breaks `check_events`, starts before the last one ended, or has another sensor size.
    """
    num_before = 0
    for chunk in check_joints(chunks, where):
        yield check_events(chunk, _name_chunk(where, num_before))
        num_before += len(chunk)


def check_joints(chunks: Iterable[Events], where: str) -> Iterator[Events]:
    """Hand on chunks that were checked one by one, with the promises of `Events` kept across their joints too.

    Raises:
        DataError: a chunk starts before the last one ended, has another sensor size, or says of its events whether
            they are signal where another did not.
    """
    num_before = last_t = 0
    has_signal = False
    sensor_size: SensorSize | None = None
    for chunk in chunks:
        if sensor_size is not None and chunk.sensor_size != sensor_size:
            raise DataError(
                f"{where}: sensor_size must be {sensor_size} throughout, got {chunk.sensor_size} from event "
                f"{num_before} on"
            )
        sensor_size = chunk.sensor_size
        _check_joint(chunk, where, num_before, last_t)
        if len(chunk):
            if num_before and has_signal != (chunk.signal is not None):
                raise DataError(f"{where}: signal must be known of all events or of none, not so from {num_before} on")
            has_signal = chunk.signal is not None
            last_t = int(chunk.t[-1])
            num_before += len(chunk)
        yield chunk


def check_chunk(chunk: Events, where: str, num_before: int, last_t: int) -> Events:
    """`check_events` for a chunk that follows `num_before` events, the last of them at `last_t` (0 where none is)."""
    _check_joint(chunk, where, num_before, last_t)
    return check_events(chunk, _name_chunk(where, num_before))


def _check_joint(chunk: Events, where: str, num_before: int, last_t: int) -> None:
    if num_before and len(chunk) and chunk.t[0] < last_t:
        raise DataError(f"{where}: t decreases at event {num_before}: {last_t} us, then {chunk.t[0]} us")


def _name_chunk(where: str, num_before: int) -> str:
    return f"{where} (events counted from event {num_before})" if num_before else where
