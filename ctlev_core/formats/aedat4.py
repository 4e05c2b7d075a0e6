"""AEDAT 4, the files of iniVation's DV software: compressed packets of events, frames, IMU samples and triggers.

Only the event stream is read. Time stamps are the file's own, unix time in microseconds.

Source: iniVation, "AEDAT 4.0 file format"; decoded by the `aedat` package.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.events.decoding import event_chunks
from data_contracts.errors import DataError
from data_contracts.events import Events

VERSION = 1
SUFFIXES = (".aedat4",)

_MAGIC = b"#!AER-DAT4.0"


def sniff(path: Path) -> bool:
    """Does the file start with the AEDAT 4 version line?"""
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def read(path: Path) -> Events:
    """All events of the file's one event stream.

    Raises:
        DataError: a cut or corrupt file, no or several event streams, or events that break `check_events`.
    """
    return event_chunks.concatenate(_read_packets(path))


def read_chunks(path: Path, num_events: int) -> Iterator[Events]:
    """The events of `read` in chunks, put together from the file's packets.

    Raises:
        DataError: as `read`.
    """
    return event_chunks.regroup(_read_packets(path), num_events)


def _read_packets(path: Path) -> Iterator[Events]:
    """An empty chunk, then one a packet."""
    decoder, streams = _decode(path, lambda: _open(path))
    if len(streams) != 1:
        raise DataError(f"{path}: expected one event stream, got {len(streams)}")
    sensor_size = (int(streams[0]["width"]), int(streams[0]["height"]))

    def packets() -> Iterator[Events]:
        yield event_chunks.empty_events(sensor_size)
        while (packet := _decode(path, lambda: next(decoder, None))) is not None:
            if "events" in packet:
                # Past 2^63 the unsigned stamps of a corrupt file turn negative, which the check reports.
                t, x, y, p = (packet["events"][name] for name in ("t", "x", "y", "on"))
                columns = (t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))
                yield Events(*columns, sensor_size)

    yield from event_chunks.check_chunks(packets(), str(path))


def _open(path: Path) -> tuple[Any, list[dict]]:
    import aedat

    decoder = aedat.Decoder(str(path))
    return decoder, [stream for stream in decoder.id_to_stream().values() if stream["type"] == "events"]


def _decode(path: Path, step: Any) -> Any:
    """Run one step of the decoder; it reports a cut file as RuntimeError but panics on some corrupt ones."""
    try:
        return step()
    except BaseException as error:  # a panic is no Exception
        if isinstance(error, (KeyboardInterrupt, SystemExit, MemoryError)):
            raise
        raise DataError(f"{path}: not a complete AEDAT 4 file, the decoder says: {error}") from error
