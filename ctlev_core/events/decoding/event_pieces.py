"""A recording in consecutive pieces: cut anew, joined, and checked where one piece meets the next."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, SensorSize, check_events


def empty_events(sensor_size: SensorSize) -> Events:
    """No events."""
    t, x, y, p = (np.empty(0, dtype) for dtype in EVENT_DTYPES.values())
    return Events(t, x, y, p, sensor_size)


def concatenate(pieces: Iterable[Events]) -> Events:
    """All pieces (one at least) as one recording; a single piece is returned as it is."""
    parts = list(pieces)
    if len(parts) == 1:
        return parts[0]
    t, x, y, p = (np.concatenate([getattr(part, name) for part in parts]) for name in EVENT_DTYPES)
    return Events(t, x, y, p, parts[0].sensor_size)


def regroup(pieces: Iterable[Events], num_events: int) -> Iterator[Events]:
    """The same events in pieces of `num_events`, the last one shorter; one empty piece where there are no events.

    Args:
        pieces: at least one, of any lengths, of one sensor size.
        num_events: at least 1.
    """
    if num_events < 1:
        raise ValueError(f"num_events must be at least 1, got {num_events}")
    waiting: list[Events] = []
    num_waiting = 0
    any_given = False
    sensor_size = (1, 1)
    for piece in pieces:
        sensor_size = piece.sensor_size
        start = 0
        while len(piece) - start >= num_events - num_waiting:
            stop = start + num_events - num_waiting
            yield concatenate([*waiting, piece.slice(start, stop)])
            waiting, num_waiting, start, any_given = [], 0, stop, True
        if start < len(piece):
            waiting.append(piece.slice(start, len(piece)))
            num_waiting += len(piece) - start
    if waiting:
        yield concatenate(waiting)
    elif not any_given:
        yield empty_events(sensor_size)


def check_pieces(pieces: Iterable[Events], where: str) -> Iterator[Events]:
    """Hand the pieces on, each checked, with the promises of `Events` kept across their joints too.

    Raises:
        DataError: a piece breaks `check_events`, starts before the last one ended, or has another sensor size.
    """
    num_before = 0
    for piece in check_joints(pieces, where):
        yield check_events(piece, _name_piece(where, num_before))
        num_before += len(piece)


def check_joints(pieces: Iterable[Events], where: str) -> Iterator[Events]:
    """Hand on pieces that were checked one by one, with the promises of `Events` kept across their joints too.

    Raises:
        DataError: a piece starts before the last one ended, or has another sensor size.
    """
    num_before = last_t = 0
    sensor_size: SensorSize | None = None
    for piece in pieces:
        if sensor_size is not None and piece.sensor_size != sensor_size:
            raise DataError(
                f"{where}: sensor_size must be {sensor_size} throughout, got {piece.sensor_size} from event "
                f"{num_before} on"
            )
        sensor_size = piece.sensor_size
        _check_joint(piece, where, num_before, last_t)
        if len(piece):
            last_t = int(piece.t[-1])
            num_before += len(piece)
        yield piece


def check_piece(piece: Events, where: str, num_before: int, last_t: int) -> Events:
    """`check_events` for a piece that follows `num_before` events, the last of them at `last_t` (0 where none is)."""
    _check_joint(piece, where, num_before, last_t)
    return check_events(piece, _name_piece(where, num_before))


def _check_joint(piece: Events, where: str, num_before: int, last_t: int) -> None:
    if num_before and len(piece) and piece.t[0] < last_t:
        raise DataError(f"{where}: t decreases at event {num_before}: {last_t} us, then {piece.t[0]} us")


def _name_piece(where: str, num_before: int) -> str:
    return f"{where} (events counted from event {num_before})" if num_before else where
